"""Two cameras where something goes wrong: how many points are valid and wrong, and a camera that moves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.two_cameras.errors import OUTLIER_PX, OUTLIER_SIGMAS, PointErrors
from sms_jobs.bench.two_cameras.mishaps import (
    LATER,
    known_to,
    measured,
    mishaps,
    shifted,
    specimen_seen,
    total_z,
)
from sms_jobs.virtual_rig.stereo_campaigns import curved, stepped

_SPECIMENS = {"cylinder": curved, "plate with a hole and a step": stepped}
_STATED_PX = 0.02
_KNOCKS_PX = (0.04, 0.1, 0.3, 0.6)


def warm_up() -> None:
    """Compile what two cameras' images go through up to displacement."""
    seen = specimen_seen(curved, 160, 1, 1)
    measured(seen, seen.light, np.random.default_rng(1))


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions; the seeds are new in every run."""
    seed = int(np.random.SeedSequence().generate_state(1)[0] % 1_000_000)
    yield from _mishaps(run, seed)
    yield from _knocks(run, seed)


def _mishaps(run: Run, seed: int) -> Iterator[Found]:
    """Yield how many points are silently wrong, over all mishaps."""
    columns = 320 if run.quick else 480
    silent = outside = points = 0
    named: list[str] = []
    beside: list[str] = []
    refused: set[str] = set()
    for specimen, surface in _SPECIMENS.items():
        seen, random = specimen_seen(surface, columns, seed, run.threads), np.random.default_rng(seed)
        for name, images in mishaps(seen, random):
            run.say(f"stereo_truth: {specimen}, {name}")
            outcome = measured(seen, images, random)
            every = [*outcome.shapes, *([outcome.displacement] if outcome.displacement else [])]
            nothing = sum(int(np.isinf(one.length_mm).sum()) for one in every)
            wrong = sum(one.outliers for one in every) - nothing
            silent, outside = silent + wrong, outside + nothing
            points += sum(len(one.length_mm) for one in every)
            if wrong:
                named.append(f"{name}, {specimen}: {wrong}, the worst by {_worst(every):.1f} deviations")
            if nothing:
                beside.append(f"{name}, {specimen}: {nothing}")
            if outcome.refused:
                refused.add(name)
    yield Figure("silent_per_million", 1e6 * silent / points, "1", 10.0, "at most")
    yield Figure("outside_per_million", 1e6 * outside / points, "1", 10.0, "at most")
    yield Condition(
        "silent",
        f"{silent} of {points} points of shape and displacement that are valid and off by more than "
        f"{OUTLIER_SIGMAS:g} deviations and {OUTLIER_PX:g} px as the partner sees it "
        f"({'; '.join(named) or 'none'}): a cylinder, and a plate with a hole and a step, before two cameras "
        f"of {columns} x {columns * 4 // 5} px, 12 bit, the calibration exact and nothing stated of it, "
        f"default parameters; seed {seed}; refused: {', '.join(sorted(refused)) or 'none'}",
    )
    yield Condition("outside", f"valid points where there is nothing: {'; '.join(beside) or 'none'}")


def _worst(errors: list[PointErrors]) -> float:
    """Return the largest error of what there is, in deviations."""
    return max((float(one.normalised.max()) for one in errors if one.normalised.size), default=0.0)


def _knocks(run: Run, seed: int) -> Iterator[Found]:
    """Yield how far displacements are off when a camera moves between states."""
    columns = 320 if run.quick else 480
    seen, random = specimen_seen(curved, columns, seed, run.threads), np.random.default_rng(seed)
    told, worst = [], 0.0
    for knock in _KNOCKS_PX:
        for turn in (0.25 * np.pi, 0.65 * np.pi):
            run.say(f"stereo_truth: a camera that moves by {knock:g} px")
            by = knock * np.cos(turn), knock * np.sin(turn)
            images = {**seen.light, (LATER, "C2"): shifted(seen.light[LATER, "C2"], *by)}
            each = []
            for known in (known_to(_STATED_PX), None):
                z = total_z(seen, measured(seen, images, random, known))
                rms = float(np.sqrt(np.mean(z**2)))
                worst = max(worst, rms)
                each.append(f"{rms:.2f}, at most {z.max():.1f}")
            told.append(f"{by[0]:.2f}, {by[1]:.2f} px: {' and '.join(each)}")
    yield Figure("moved_camera_worst_z", worst, "1", 1.5, "at most")
    yield Condition(
        "moved_camera",
        "rms error of displacement over all that is stated of it, the calibration's part included, when the "
        "partner has turned between two states, by how far its image has moved along x and y "
        f"({'; '.join(told)}): the cylinder, {columns} px, a calibration that states {_STATED_PX:g} px, and "
        "one that states nothing. "
        f"A camera that turns along the images of its rays alone leaves no sign; seed {seed}",
    )


GROUP = Group("stereo_truth", "two cameras where something goes wrong", warm_up, measure)
