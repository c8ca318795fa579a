"""Coverage: how many errors lie within two stated standard deviations, by where they are and of what."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np
from scipy import ndimage

from sms_jobs.bench.correlated.lone_camera import DEFORMED, correlated
from sms_jobs.bench.correlated.truth_pairs import READ_NOISE, TruthPair, pairs
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.sessions.bar_session import MANY_SESSIONS, bar_session
from sms_jobs.bench.sessions.drawn_calibrations import moved, of_a_bar_session
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.deformation import correlate, strain
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.kinds.surface_ports import maker_of
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.records.fields import DisplacementField, PhaseMaps, StrainField, Surface
from sms_jobs.records.quantity import SYMMETRIC
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.campaigns import Made, hole_and_step_translation, tension_panel, top_hat_bending
from sms_jobs.virtual_rig.stereo_campaigns import stepped, stereo_campaign, stereo_rig
from sms_jobs.virtual_rig.truth import Truth

Scores: TypeAlias = dict[tuple[str, str], list[Floats]]
"""Errors in standard deviations, by quantity and stratum."""

_NOMINAL = 0.9545
_LEAST = 10_000
"""Errors that a stratum has at least; of fewer nothing is said."""
_DRAWS, _SEED = 6, 3
_SENSORS_OF_THE_BAR = 4
_COLUMNS, _STAND_OFF_MM = 640, 500.0
_NEAR_PX = 10
"""Of an edge or a fold: a subset's radius."""
_FOLD = np.radians(10.0)
"""Between the normals at both sides of a pixel."""
_CURVED = np.radians(0.05)
"""A pixel, of the normal."""
_DIM = 0.5
"""Of the median modulation."""
_DIAGONAL = [SYMMETRIC.index(name) for name in ("XX", "YY", "ZZ")]


def warm_up() -> None:
    """Compile what a pair goes through."""
    _judge_pair(next(pairs(0))(), 1, defaultdict(list))


def measure(run: Run) -> Iterator[Found]:
    """Yield the share of errors within two deviations; seeds and calibrations are drawn anew in every run."""
    seed = int(np.random.SeedSequence().generate_state(1)[0] % 1_000_000)
    rng = np.random.default_rng(seed)
    scores: Scores = defaultdict(list)
    draws = 1 if run.quick else _DRAWS
    for calibration, campaign in _campaigns(run.quick):
        shelf = Shelf(campaign, run.threads)
        run.say(f"recording {campaign.name}")
        at_rest, last = (
            Subject(campaign.name, state.label, campaign.views[0])
            for state in (campaign.reference, campaign.states[-1])
        )
        for subject in (at_rest, last):
            shelf.record(subject)
        for number, known in enumerate(_calibrations(calibration, draws, rng), start=1):
            run.say(f"{campaign.name}: calibration {number}")
            _judge(shelf, at_rest, last, known, scores)
    for pair in (make() for make in pairs(seed, quick=run.quick)):
        if pair.group in ("clean", "sine", "crack"):
            run.say(f"matching {pair.name}")
            _judge_pair(pair, run.threads, scores)
    found = {key: np.concatenate(parts) for key, parts in scores.items()}
    shares = {key: _share(values) for key, values in found.items() if len(values) >= _LEAST}
    worst = max(shares, key=lambda key: abs(shares[key] - _NOMINAL))
    yield Figure("2sigma_worst_stratum", shares[worst], " ".join(worst), 0.93, "at least")
    for (quantity, stratum), share in sorted(shares.items()):
        count = len(found[quantity, stratum])
        yield Figure(f"2sigma_{quantity}_{stratum}", share, f"of {count} errors")
    few = sorted(f"{q} {s} ({len(v)})" for (q, s), v in found.items() if 0 < len(v) < _LEAST)
    yield Condition(
        "2sigma",
        "components one by one; tension panel, top hat, plate with hole and step in fringes, 512 px, "
        f"cylinder and plate with hole and step before two cameras of {_COLUMNS} px (first view, defaults, "
        f"first and last state), the top hat with {draws} calibrations drawn from the covariance "
        f"of {len(MANY_SESSIONS.angles)} poses of a bar, the others with the exact one; pairs of a camera "
        f"alone; seed {seed}. Normal errors have 0.9545 within two deviations, and 0.93 to 0.97 is wanted; "
        f"of fewer than {_LEAST} errors nothing is said" + (f": {', '.join(few)}" if few else ""),
    )


def _campaigns(quick: bool) -> Iterator[Made]:
    yield tension_panel("tension-panel", "small")
    if quick:
        return
    yield top_hat_bending("top-hat", "small")
    yield hole_and_step_translation("hole-and-step", "small")
    rig = stereo_rig(_COLUMNS, 4 * _COLUMNS // 5, stand_off_mm=_STAND_OFF_MM)
    yield stereo_campaign("cylinder", rig=rig)
    field_mm = _STAND_OFF_MM * _COLUMNS / rig.sensor("C1").intrinsics.fx
    yield stereo_campaign("stepped", rig=rig, surface=stepped(field_mm))


def _share(scores: Floats) -> float:
    return float(np.mean(np.abs(scores) <= 2.0))


def _calibrations(calibration: Calibration, draws: int, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Yield calibrations as one would have them, and what they say of themselves, as records."""
    names = [sensor.name for sensor in calibration.rig.sensors]
    if len(names) != _SENSORS_OF_THE_BAR:
        yield {"calibration": calibration}
        return
    uncertainty = of_a_bar_session(calibration, bar_session(MANY_SESSIONS, _SEED))
    nothing = np.zeros(len(uncertainty.covariance))
    for _ in range(draws):
        steps = rng.multivariate_normal(nothing, uncertainty.covariance, method="eigh")
        steps[np.diag(uncertainty.covariance) == 0.0] = 0.0  # but for rounding, as the sort of a lens must be
        yield {"calibration": moved(calibration, names, steps), "uncertainty": uncertainty}


def _judge(shelf: Shelf, at_rest: Subject, last: Subject, known: dict[str, Any], scores: Scores) -> None:
    """Measure two states with a calibration, and add the errors in deviations to `scores`."""
    maker = all_kinds()[maker_of(last.view).kind]
    for subject in (at_rest, last):
        shelf.records[CALIBRATION, subject] = known
        shelf.run(maker, subject, maker.parameters())
    for kind in (correlate.KIND, strain.KIND):
        shelf.run(kind, last, kind.parameters())
    truth, made = shelf.truth(last), shelf.records[maker.name, at_rest]
    surface: Surface = made["surface"]
    displacement: DisplacementField = shelf.records["correlate", last]["displacement"]
    strained: StrainField = shelf.records["strain", last]["strain"]
    assert surface.covariance is not None
    of_shape, of_displacement, of_strain = (
        (surface.position - truth.shape.xyz, surface.covariance[_DIAGONAL]),
        (displacement.displacement - truth.displacement, displacement.covariance[_DIAGONAL]),
        (strained.strain - truth.strain("green-lagrange"), strained.sigma.astype(np.float64) ** 2),
    )
    strata = _strata(truth, made.get("phase"))
    for quantity, (error, variance), field in (
        ("shape", of_shape, surface),
        ("displacement", of_displacement, displacement),
        ("strain", of_strain, strained),
    ):
        part = 0.0 if field.sigma_calibration is None else field.sigma_calibration.astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            score = error / np.sqrt(variance + np.square(part))
        valid = (field.reason == 0) & np.isfinite(score).all(axis=0)
        for stratum, where in strata.items():
            of = stratum if maker.name == "reconstruct" else f"{maker.name}_{stratum}"
            scores[quantity, of].append(score[:, valid & where].ravel())


def _strata(truth: Truth, phase: PhaseMaps | None) -> dict[str, Mask]:
    """Return where what is measured belongs to; a pixel may belong to several, and to an edge alone."""
    shape = truth.shape
    expected = shape.seen & shape.lit & truth.lit_and_seen_at_end
    square = 2 * _NEAR_PX + 1
    one_patch = ndimage.minimum_filter(shape.region, square) == ndimage.maximum_filter(shape.region, square)
    inner = ndimage.minimum_filter(expected, square) & one_patch
    turned = _turned(shape.normal)
    folded = ndimage.maximum_filter(np.where(np.isfinite(turned), turned, 0.0), square) > _FOLD
    smooth = inner & ~folded
    found = {
        "flat": smooth & (turned <= _CURVED),
        "curved": smooth & (turned > _CURVED),
        "fold": inner & folded,
        "edge": expected & ~inner,
    }
    if phase is not None:
        modulation = phase.modulation.min(axis=0)
        found["dim"] = smooth & (modulation < _DIM * np.nanmedian(modulation[expected]))
    return found


def _turned(normal: Floats) -> Floats:
    """Return by how much the normal (3, rows, columns) turns from a pixel to its neighbours, in rad."""
    steps = [np.linalg.norm(np.gradient(normal, axis=axis), axis=0) for axis in (1, 2)]
    return np.asarray(np.maximum(*steps))


def _judge_pair(pair: TruthPair, threads: int, scores: Scores) -> None:
    """Measure a pair of a camera alone, and add the errors of u and v in deviations to `scores`."""
    shelf = correlated(pair.reference, pair.deformed, READ_NOISE, CorrelateParameters(), threads)
    found: DisplacementField = shelf.records["correlate", DEFORMED]["displacement"]
    sigma = np.sqrt(found.covariance[[0, 2]].astype(np.float64))
    score = (found.image_displacement - pair.displacement) / sigma
    valid = (found.reason == 0) & np.isfinite(score).all(axis=0)
    inner = np.zeros_like(valid)
    inner[2 * _NEAR_PX : -2 * _NEAR_PX, 2 * _NEAR_PX : -2 * _NEAR_PX] = True
    near_crack = np.zeros_like(valid)
    if pair.slip is not None:
        middle = valid.shape[1] // 2
        near_crack[:, middle - 2 * _NEAR_PX : middle + 2 * _NEAR_PX] = True
    of = {"clean": "alone_flat", "sine": "alone_steep", "crack": "alone_flat"}[pair.group]
    for stratum, where in (
        (of, inner & ~near_crack),
        ("alone_crack", inner & near_crack),
        ("alone_edge", ~inner),
    ):
        scores["displacement", stratum].append(score[:, valid & where].ravel())


GROUP = Group(
    "coverage",
    "the share of errors within two stated standard deviations, by where they are",
    warm_up,
    measure,
)
