"""Recordings of the virtual rig to which something happened, or of which something wrong is told."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.errors import MeasurementFailed
from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.phase.frame_lag import Neighbour
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import ProjectorResponse, Rigid, Scene, Simulation
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import run_kind
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import Shape, exact_shape

SUBJECT = Subject("plate", "S00", "C1P1")
SILENT_SIGMA, SILENT_MM = 6.0, 0.2
"""A point is silently wrong that is valid and off by more than both."""

_SEQUENCES = (
    FringeSequence((16, 15, 14, 12, 8)),
    FringeSequence((1, 3, 9, 27), steps=5),
    FringeSequence((32, 31, 30, 28, 24, 16)),
)


@dataclass(frozen=True)
class Session:
    """A recording of a plate of 128 px to which nothing happened, and what is true of it."""

    calibration: Calibration
    scene: Scene
    measurement: Measurement
    shape: Shape


@dataclass(frozen=True)
class Mishap:
    """A recording to which something happened.

    Attributes
    ----------
    name
        Of what happened.
    measurement
        What is left of the recording, and told of it.
    named
        Words that name the guilty frame or word: all of one group have to be said.
    """

    name: str
    measurement: Measurement
    named: tuple[tuple[str, ...], ...]


def perfect_session(random: np.random.Generator, sequence: FringeSequence | None = None) -> Session:
    """Record a plate as it should be: noise, speckle, exposure, gamma and defocus are drawn.

    So is the sequence, where none is given.
    """
    calibration, campaign = small_plate("plate")
    assert campaign.scene is not None
    assert campaign.scene.speckle is not None
    scene = replace(
        campaign.scene,
        seed=int(random.integers(1 << 30)),
        speckle=replace(campaign.scene.speckle, seed=int(random.integers(1 << 30))),
        camera=replace(campaign.scene.camera, exposure=float(random.uniform(0.3, 1.1))),
        projector=ProjectorResponse(
            gamma=float(random.uniform(1.0, 1.2)), defocus_px=float(random.uniform(0.0, 1.0))
        ),
    )
    shown = sequence or _SEQUENCES[random.integers(len(_SEQUENCES))]
    measurement = recorded(calibration, scene, shown)
    return Session(calibration, scene, measurement, exact_shape(Simulation(scene, "C1", "P1", (), "S00")))


def recorded(
    calibration: Calibration, scene: Scene, sequence: FringeSequence, deformation: tuple[Any, ...] = ()
) -> Measurement:
    """Record a scene with a sequence, frames in memory."""
    seen = render(Simulation(scene, "C1", "P1", deformation, "S00"), sequence)
    return Measurement(
        calibration.valid_from,
        sequence,
        seen.full_scale,
        seen.gain,
        seen.read_noise,
        seen.texture,
        ArrayStack(seen.frames.rows(0, seen.frames.shape[1])),
    )


def mishaps(session: Session, random: np.random.Generator) -> Iterator[Mishap]:
    """Yield ten recordings, each with one mishap, at a place that is drawn."""
    right, sequence = session.measurement, session.measurement.sequence
    frames = right.frames.rows(0, right.frames.shape[1])
    count, densities = len(frames), sequence.densities

    def changed(frames: NDArray[Any], sequence: FringeSequence = sequence) -> Measurement:
        return replace(right, frames=ArrayStack(frames), sequence=sequence)

    one, other = (int(f) for f in sorted(random.choice(count, 2, replace=False)))
    of_one = (f"frame {one} (",)

    swapped = frames.copy()
    swapped[[one, other]] = frames[[other, one]]
    yield Mishap("exchanged", changed(swapped), ((f"frames {one} (", f"and {other} (", "changed places"),))
    doubled = frames.copy()
    doubled[one] = frames[other]
    yield Mishap("doubled", changed(doubled), ((*of_one, "the same as"),))
    dark = frames.copy()
    dark[one] = np.rint(np.maximum(random.normal(40.0, right.read_noise, frames[one].shape), 0.0))
    yield Mishap("dark", changed(dark), ((*of_one, "is dark"),))
    brighter = frames.copy()
    gain = float(random.choice([0.7, 0.85, 1.15, 1.3]))
    # A frame that is dark where the specimen is looks the same at any exposure.
    level = frames[:, session.shape.lit].mean(axis=1)
    bright = int(random.choice(np.flatnonzero(level >= np.median(level))))
    brighter[bright] = np.minimum(np.rint(gain * frames[bright]), right.full_scale)
    yield Mishap("gain", changed(brighter), ((f"frame {bright} (", "times as bright"),))

    place = int(random.integers(len(densities)))
    told = densities[place] + (1 if densities[place] + 1 not in densities else -1)
    if told in densities or told < 1:
        told = densities[place] + 2
    counted = (*densities[:place], told, *densities[place + 1 :])
    yield Mishap(
        "count",
        changed(frames, replace(sequence, densities=counted)),
        ((f"{told} fringes are stated", f"those of {densities[place]}:"),),
    )
    yield Mishap("steps", _other_steps(right), ((f"runs of {sequence.steps} phase steps",),))
    half = count // 2
    yield Mishap(
        "directions exchanged",
        changed(np.concatenate([frames[half:], frames[:half]])),
        (("along 90 and 0 deg",),),
    )
    turned = replace(sequence, orientations_rad=(pi, pi / 2.0))
    yield Mishap("mirrored", changed(frames, turned), (("along 0 and 90 deg", "180"),))
    across = [(0, 1), (0, -1), (1, 0), (-1, 0)][random.integers(4)]
    moved = frames.copy()
    moved[half:] = np.roll(frames[half:], across, axis=(1, 2))
    yield Mishap("camera moved", changed(moved), (("the image moves", "most between", "still"),))
    way = random.normal(size=3)
    x, y, z = (float(v) for v in way / np.linalg.norm(way))
    at = int(random.integers(2, count - 1))
    after = recorded(session.calibration, session.scene, sequence, (Rigid((0.0, 0.0, 0.0), (x, y, z)),))
    stack = np.concatenate([frames[:at], after.frames.rows(0, frames.shape[1])[at:]])
    yield Mishap("specimen moved", changed(stack), (("camera and specimen still",),))


def with_light_of(session: Session, neighbour: Neighbour, part: float) -> Measurement:
    """Return a recording each of whose frames holds a part of the light of the frame before or after it.

    Nothing was shown before the first, nor after the last.
    """
    right = session.measurement
    frames = right.frames.rows(0, right.frames.shape[1]).astype(np.float64)
    first, last = frames[:1], frames[-1:]
    before, after = np.concatenate([first, frames[:-1]]), np.concatenate([frames[1:], last])
    return _shown(right, frames + part * ((before if neighbour == "before" else after) - frames))


def under_a_lamp(session: Session, part: float, random: np.random.Generator) -> Measurement:
    """Return a recording under a lamp that flickers by a part of the mean light, at a rate that is drawn."""
    right = session.measurement
    frames = right.frames.rows(0, right.frames.shape[1]).astype(np.float64)
    rate, start = random.uniform(0.02, 0.5), random.uniform(0.0, 2.0 * pi)
    light = part * np.cos(2.0 * pi * rate * np.arange(len(frames)) + start)
    return _shown(right, frames + light[:, None, None] * frames.mean(axis=0))


def _shown(right: Measurement, frames: NDArray[np.float64]) -> Measurement:
    """Return a recording with other grey levels."""
    levels = np.clip(np.rint(frames), 0, right.full_scale).astype(np.uint16)
    return replace(right, frames=ArrayStack(levels))


def _other_steps(right: Measurement) -> Measurement:
    """Return a recording of which another number of steps is told, and as many densities as fit."""
    frames, sequence = right.frames.rows(0, right.frames.shape[1]), right.sequence
    each = len(sequence.densities) * sequence.steps
    steps = next(q for q in (*range(sequence.steps + 1, each), *range(3, sequence.steps)) if each % q == 0)
    densities = (1, *range(2, each // steps + 1))
    return replace(
        right, frames=ArrayStack(frames), sequence=replace(sequence, steps=steps, densities=densities)
    )


def reconstructed(session: Session, measurement: Measurement) -> tuple[Surface | None, str]:
    """Return the surface that a recording gives with default parameters, or why it is refused."""
    records = {"measurement": measurement, "calibration": session.calibration}
    try:
        output = run_kind(KIND, SUBJECT, records, 1, ReconstructParameters())
    except MeasurementFailed as error:
        return None, str(error)
    surface: Surface = output.records["surface"]
    return surface, ""


def is_named(mishap: Mishap, said: str) -> bool:
    """Say whether a refusal names what happened."""
    return any(all(word in said for word in group) for group in mishap.named)


def silent_points(session: Session, surface: Surface | None) -> int:
    """Return how many points, 3 px inside what is lit, are valid and wrong."""
    if surface is None:
        return 0
    inside = ndimage.binary_erosion(session.shape.lit, iterations=3)
    off = np.linalg.norm(surface.position - session.shape.xyz, axis=0)
    assert surface.covariance is not None
    sigma = np.sqrt(trace(surface.covariance))
    wrong = (surface.reason == Reason.VALID) & ~((off < SILENT_SIGMA * sigma) | (off < SILENT_MM))
    return int(np.count_nonzero(inside & wrong))
