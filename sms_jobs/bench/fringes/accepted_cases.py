"""What is recorded and accepted though something is not as it is told: how far off points are.

Pixels on silhouettes, a camera of 8 bits whose noise nobody has told, and mishaps that are too small to be
refused, or do no harm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import log
from typing import TypeAlias

import numpy as np
from scipy import ndimage

from sms_jobs.bench.fringes import bent_waveforms, plate_before_wall
from sms_jobs.bench.fringes.bent_waveforms import scores
from sms_jobs.bench.fringes.code_mishaps import CODED, code_mishaps, coded_session
from sms_jobs.bench.fringes.fringe_mishaps import (
    Session,
    mishaps,
    perfect_session,
    reconstructed,
    under_a_lamp,
    with_light_of,
)
from sms_jobs.kinds.shape.reconstruct import ReconstructParameters
from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.phase.frame_lag import NEIGHBOURS
from sms_jobs.metrology.phase.frame_noise import noise_of_steps
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason

_FULL_SCALE = 255
_NOISE = (0.5, 3.0)  # grey levels of 255
_MOST_LAG, _MOST_FLICKER = 0.03, 0.02
_SLIGHT_GAIN, _SLIGHT_SHIFT_PX, _SLIGHT_DRIFT = 0.03, 0.04, 0.02

Judged: TypeAlias = Callable[[np.random.Generator], tuple[Floats, float]]


@dataclass(frozen=True)
class AcceptedCase:
    """A recording that is drawn anew each time, and how far off the points are that it gives.

    Attributes
    ----------
    name
        What is not as it is told.
    judged
        Returns error over stated deviation of the valid points, and which part of the image is valid.
    """

    name: str
    judged: Judged


def _sigma(surface: Surface) -> Floats:
    variance: Floats = trace(position_covariance(surface))
    return np.asarray(np.sqrt(variance))


def _silhouettes(sequence: FringeSequence, parameters: ReconstructParameters, *, mixed: bool) -> Judged:
    """Return what judges a plate before a wall: all valid points, or those of `mixed` pixels alone."""

    def judged(random: np.random.Generator) -> tuple[Floats, float]:
        seen = plate_before_wall.record(plate_before_wall.random_scene(random), sequence)
        surface = plate_before_wall.reconstructed(seen, parameters)
        valid = surface.reason == Reason.VALID
        told = valid & seen.mixed if mixed else valid
        return (seen.error(surface.position) / _sigma(surface))[told], float(valid.mean())

    return judged


def _eight_bits(sequence: FringeSequence) -> Judged:
    """Return what judges a plate seen with 8 bits, whose noise is what its own frames show."""

    def judged(random: np.random.Generator) -> tuple[Floats, float]:
        noise = float(np.exp(random.uniform(log(_NOISE[0]), log(_NOISE[1])))) / _FULL_SCALE
        seen = bent_waveforms.record(random, sequence, 1.0, noise, twice=False, full_scale=_FULL_SCALE)
        frames = seen.measurement.frames.rows(0, seen.measurement.frames.shape[1])
        found = noise_of_steps(frames.reshape(-1, sequence.steps, *frames.shape[1:]), _FULL_SCALE)
        assert found is not None
        told = replace(seen.measurement, gain=found.gain, read_noise=found.read_noise)
        return scores(replace(seen, measurement=told), {"blur_px": 0.0})

    return judged


def _of_session(session: Session, each: list[Measurement]) -> tuple[Floats, float]:
    """Judge what is accepted of some recordings of a session, 3 px inside what is lit."""
    inside = ndimage.binary_erosion(session.shape.lit, iterations=3)
    found, parts = [np.zeros(0)], []
    for measurement in each:
        surface, _ = reconstructed(session, measurement)
        if surface is not None:
            valid = (surface.reason == Reason.VALID) & inside
            error = np.linalg.norm(surface.position - session.shape.xyz, axis=0)
            found.append((error / _sigma(surface))[valid])
            parts.append(float(valid.mean()))
    return np.concatenate(found), float(np.mean(parts)) if parts else 0.0


def _slight(random: np.random.Generator) -> tuple[Floats, float]:
    """Judge recordings with a gain of 3 %, a shift of 0.04 px, and a lamp that drifts by 2 %, all at most."""
    session = perfect_session(random)
    right = session.measurement
    frames = right.frames.rows(0, right.frames.shape[1]).astype(np.float64)
    count = len(frames)
    gain = np.ones(count)
    gain[random.integers(count)] += random.uniform(-_SLIGHT_GAIN, _SLIGHT_GAIN)
    drift = 1.0 + random.uniform(-_SLIGHT_DRIFT, _SLIGHT_DRIFT) * np.arange(count) / count
    shift = random.uniform(-_SLIGHT_SHIFT_PX, _SLIGHT_SHIFT_PX, 2)
    later = ndimage.shift(frames[count // 2 :], (0.0, *shift), order=3, mode="nearest")
    moved = np.concatenate([frames[: count // 2], later])
    shown = [frames * gain[:, None, None], frames * drift[:, None, None], moved]
    each = [np.clip(np.rint(one), 0, right.full_scale).astype(np.uint16) for one in shown]
    return _of_session(session, [replace(right, frames=ArrayStack(one)) for one in each])


def _lagging(random: np.random.Generator) -> tuple[Floats, float]:
    """Judge recordings whose frames hold up to 3 % of the light of the frame before, or after, them."""
    found, parts = [np.zeros(0)], []
    for sequence in (None, _LINEAR):
        session = perfect_session(random, sequence)
        each = [with_light_of(session, one, random.uniform(0.0, _MOST_LAG)) for one in NEIGHBOURS]
        errors, part = _of_session(session, each)
        found.append(errors)
        parts.append(part)
    return np.concatenate(found), float(np.mean(parts))


def _flickering(random: np.random.Generator) -> tuple[Floats, float]:
    """Judge recordings beside a lamp that flickers by up to 2 % of the light."""
    session = perfect_session(random)
    each = [under_a_lamp(session, part, random) for part in random.uniform(0.0, _MOST_FLICKER, 2)]
    return _of_session(session, each)


def _harmless(random: np.random.Generator) -> tuple[Floats, float]:
    """Judge what is accepted of all mishaps: as a rule nothing."""
    session = perfect_session(random)
    return _of_session(session, [mishap.measurement for mishap in mishaps(session, random)])


def _harmless_codes(random: np.random.Generator) -> tuple[Floats, float]:
    """Judge what is accepted of all mishaps of fringes beside a code, and of a camera that moves between.

    It moves by a pixel before the patterns of a code that has no inverses, nor white and black: nothing of
    that is seen where the borders stay near their places, and the fringes alone tell the shape.
    """
    session = coded_session(random, plain=True)
    each = [mishap.measurement for mishap in code_mishaps(session, random)]
    alone = coded_session(random, CODED[2], plain=True)
    frames = alone.measurement.frames.rows(0, alone.measurement.frames.shape[1]).copy()
    start = alone.measurement.sequence.code_frames_of(0).start
    axis = int(random.integers(1, 3))
    frames[start:] = np.roll(frames[start:], int(random.choice([-1, 1])), axis=axis)
    moved = replace(alone.measurement, frames=ArrayStack(frames))
    (some, _), (others, part) = _of_session(session, each), _of_session(alone, [moved])
    return np.concatenate([some, others]), part


_LADDER, _LINEAR = FringeSequence((16, 15, 14, 12, 8)), FringeSequence(tuple(range(12)))
_UNWRAPPED, _RANGED = ReconstructParameters(), ReconstructParameters(method="fdr", returns=2)

ACCEPTED = (
    AcceptedCase("silhouettes, unwrapping", _silhouettes(_LADDER, _UNWRAPPED, mixed=False)),
    AcceptedCase("silhouettes, ranging", _silhouettes(_LINEAR, _RANGED, mixed=False)),
    AcceptedCase("mixed pixels, unwrapping", _silhouettes(_LADDER, _UNWRAPPED, mixed=True)),
    AcceptedCase("mixed pixels, ranging", _silhouettes(_LINEAR, _RANGED, mixed=True)),
    AcceptedCase("8 bits, three steps", _eight_bits(FringeSequence((32, 31, 30, 28, 24, 16), 3))),
    AcceptedCase("8 bits, four steps", _eight_bits(FringeSequence((32, 31, 30, 28, 24, 16), 4))),
    AcceptedCase("slight mishaps", _slight),
    AcceptedCase("light of the frame before or after", _lagging),
    AcceptedCase("a lamp that flickers", _flickering),
    AcceptedCase("harmless mishaps", _harmless),
    AcceptedCase("harmless mishaps beside a code", _harmless_codes),
)
