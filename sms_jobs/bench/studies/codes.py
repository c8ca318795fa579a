"""Codes of other people: how many pixels noise makes ambiguous, and how many are wrong without saying so."""

from __future__ import annotations

from collections.abc import Callable
from math import pi

import numpy as np

from sms_jobs.bench.study import Outcome, Study, Table, new_figure
from sms_jobs.kinds.shape.foreign_patterns import stated_code
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.joint_fit import fit_jointly
from sms_jobs.metrology.phase.temporal_unwrapping import unwrap
from sms_jobs.records.measurement import FringeSequence

_MICRO = (64.0, 59.7, 60.9, 61.8, 62.9, 65.0, 66.1, 66.9, 67.8, 68.4)
CODES = {
    "micro, ten densities from 59.7 to 68.4": FringeSequence.with_counts(_MICRO, (3,) + (1,) * 9, (0.0,)),
    "embedded, 16, 17, 20": FringeSequence.with_counts((16, 17, 20), (3, 2, 2), (0.0,)),
    "70, 64, 59 in four steps": FringeSequence((70, 64, 59), 4, (0.0,)),
    "106.67, 90.14, 74.71 in four steps": FringeSequence((106.67, 90.14, 74.71), 4, (0.0,)),
}
NOISE = (0.01, 0.02, 0.04, 0.08, 0.12)
_ROWS, _COLUMNS = 250, 400
_MEAN, _MODULATION, _FULL_SCALE = 1500.0, 1000.0, 4095


def _row(sequence: FringeSequence, noise: float, random: np.random.Generator) -> tuple[float, int, float]:
    """Return the ambiguous part, how many others have a wrong order, and errors over stated deviations."""
    code = stated_code(sequence)
    omega = random.uniform(-pi, pi, (_ROWS, _COLUMNS))
    wave = np.cos(np.multiply.outer(code.densities, omega) + code.turns[:, None, None])
    # Half of the variance at the mean level is shot noise.
    variance = (noise * _MODULATION) ** 2
    grey = GreyLevels(_FULL_SCALE, 0.5 * variance / _MEAN, float(np.sqrt(0.5 * variance)))
    level = _MEAN + _MODULATION * wave
    noisy = level + np.sqrt(grey.variance(level)) * random.standard_normal(level.shape)
    frames = np.clip(np.rint(noisy), 0, _FULL_SCALE - 1).astype(np.uint16)
    if sequence.joint:
        found = fit_jointly(frames, code, grey)
    else:
        found = unwrap(
            frames,
            sequence.densities,
            sequence.steps,
            full_scale=grey.full_scale,
            gain=grey.gain,
            read_noise=grey.read_noise,
        )
    wrong = np.abs(found.omega - omega) > pi / code.densities.max()
    told = ~found.ambiguous
    error = ((found.omega - omega) / found.omega_sigma)[told & ~wrong]
    return float(found.ambiguous.mean()), int(np.count_nonzero(told & wrong)), float(np.std(error))


def run(say: Callable[[str], None]) -> Outcome:
    """Decode every code at every noise, at pixels anywhere in the projector's image."""
    random = np.random.default_rng(74)
    rows: list[tuple[str | float, ...]] = []
    figure = new_figure(8.0, 4.5)
    axes = figure.add_subplot()
    for name, sequence in CODES.items():
        say(name)
        found = [_row(sequence, noise, random) for noise in NOISE]
        rows.append((name, *(value for one in found for value in one)))
        axes.plot(NOISE, [100.0 * part for part, _, _ in found], "o-", label=name)
    axes.set_xlabel("noise of a frame over the modulation")
    axes.set_ylabel("ambiguous pixels [%]")
    axes.legend(fontsize="x-small")
    kinds = ("ambiguous", "wrong orders", "errors / stated")
    columns = ("code", *(f"{noise}: {kind}" for noise in NOISE for kind in kinds))
    remarks = {
        "conditions": f"{_ROWS * _COLUMNS} px at each noise, which is a frame's over the modulation; exact "
        "cosines of one modulation, normal noise of which half is shot noise, 12 bit; wrong orders are "
        "counted among pixels that are not ambiguous"
    }
    return Outcome(Table(columns, rows, remarks), figure)


STUDY = Study("codes", "codes of other people: ambiguous pixels and wrong orders over noise", run)
