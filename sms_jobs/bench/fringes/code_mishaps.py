"""Fringes beside a Gray code to which something happened, or of which something wrong is told."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.fringes.fringe_mishaps import Mishap, Session, recorded
from sms_jobs.records.gray_code import GrayCode
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.scene import (
    Plane,
    PlateWithHoleAndStep,
    ProjectorResponse,
    Simulation,
    Sphere,
    TopHat,
)
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.truth import exact_shape

BOTH = (0.0, pi / 2.0)
CODED = (
    FringeSequence((16,), 4, BOTH, gray=GrayCode(5, (32.0,), "inverse")),
    FringeSequence((16,), 5, BOTH, gray=GrayCode(5, (32.0,), "white-black")),
    FringeSequence((16,), 6, BOTH, gray=GrayCode(5, (32.0,), "fringes")),
    FringeSequence((24,), 4, BOTH, gray=GrayCode(6, (48.0,), "white-black")),
    FringeSequence((8,), 8, BOTH, gray=GrayCode(5, (32.0,), "fringes")),
    FringeSequence((16,), 4, BOTH, gray=GrayCode(4, (16.0,), "inverse")),
    FringeSequence((48, 32), 4, BOTH, gray=GrayCode(6, (64.0,), "white-black")),
    FringeSequence((16,), 4, (0.0,), gray=GrayCode(5, (32.0,), "inverse")),
    FringeSequence((20,), 3, (0.0,), gray=GrayCode(6, (40.0,), "white-black")),
)
"""Stripes of half, a quarter and a whole fringe, all thresholds, one and two densities and directions."""

_SURFACES = (
    Plane(150.0, 150.0),
    PlateWithHoleAndStep(150.0, 150.0, (-35.0, 15.0), 18.0, (35.0, -20.0), (45.0, 60.0), 12.0),
    TopHat(150.0, 150.0, 25.0, 50.0, 20.0, 8.0, 40.0),
    Sphere(60.0),
)


def coded_session(
    random: np.random.Generator,
    sequence: FringeSequence | None = None,
    *,
    hard: bool = False,
    plain: bool = False,
) -> Session:
    """Record a specimen as it should be, with fringes beside a Gray code.

    Drawn are what is seen (a plate, one with a hole and a step, a top hat, a sphere), noise of 8 to 30 levels
    of 4095 in the dark, speckle, exposure, ambient light, an exponent up to 1.3, and how far camera and
    projector are out of focus. A `hard` one has noise up to 100 levels, an exponent up to 2.2, fringes of
    half the depth, and more ambient light; a `plain` one a plate, and a camera in focus. So is the sequence
    drawn, where none is given.
    """
    calibration, campaign = small_plate("plate")
    assert campaign.scene is not None
    assert campaign.scene.speckle is not None
    surfaces = _SURFACES[:1] if plain else _SURFACES
    noise = float(np.exp(random.uniform(np.log(8.0), np.log(100.0 if hard else 30.0))))
    camera = replace(
        campaign.scene.camera,
        exposure=float(random.uniform(0.5 if hard else 0.7, 1.0)),
        read_noise=noise * campaign.scene.camera.full_well / 4095.0,
        blur_px=campaign.scene.camera.blur_px if plain else float(random.uniform(0.3, 1.0)),
        ambient=float(random.uniform(0.0, 0.3 if hard else 0.1)),
    )
    scene = replace(
        campaign.scene,
        surface=surfaces[random.integers(len(surfaces))],
        seed=int(random.integers(1 << 30)),
        speckle=replace(campaign.scene.speckle, seed=int(random.integers(1 << 30))),
        camera=camera,
        projector=ProjectorResponse(
            gamma=float(random.uniform(1.0, 2.2 if hard else 1.3)),
            defocus_px=float(random.uniform(0.0, 1.5)),
            visibility=float(random.uniform(0.5 if hard else 0.9, 1.0)),
        ),
    )
    shown = sequence or CODED[random.integers(len(CODED))]
    measurement = recorded(calibration, scene, shown)
    return Session(calibration, scene, measurement, exact_shape(Simulation(scene, "C1", "P1", (), "S00")))


def code_mishaps(session: Session, random: np.random.Generator) -> Iterator[Mishap]:
    """Yield recordings each with one mishap of fringes, code, or both, at a place that is drawn.

    What takes two directions is left out of a session with one.
    """
    right = session.measurement
    yield from _told_wrongly(right)
    yield from _fringe_frames(right, random)
    yield from _code_frames(session, random)
    yield from _moved(right, random)


def _changed(right: Measurement, frames: NDArray[Any]) -> Measurement:
    return replace(right, frames=ArrayStack(frames))


def _frames(right: Measurement) -> NDArray[Any]:
    return right.frames.rows(0, right.frames.shape[1]).copy()


def _told_wrongly(right: Measurement) -> Iterator[Mishap]:
    """Yield what is told wrongly of frames that are right: a density, steps, their direction."""
    sequence, frames = right.sequence, _frames(right)
    density, steps = sequence.densities[0], sequence.steps
    told = replace(sequence, densities=(density - 1, *sequence.densities[1:]))
    words = (f"{density - 1} fringes are stated", f"those of {density}:")
    yield Mishap("code: density", replace(right, sequence=told), (words,))
    if len(sequence.densities) == 1 and sequence.gray is not None and sequence.gray.threshold == "fringes":
        # One pattern of each direction's code is told to be one more step.
        other = replace(
            sequence,
            steps=steps + 1,
            gray=replace(sequence.gray, bits=sequence.gray.bits - 1, stripes=(16.0,)),
        )
        each = [
            _places(sequence.frames_of(k)) + _places(sequence.code_frames_of(k)) for k in _directions(right)
        ]
        order = [f for own in each for f in own[: steps + 1]] + [f for own in each for f in own[steps + 1 :]]
        seen = replace(_changed(right, frames[order]), sequence=other)
        yield Mishap("code: steps", seen, ((f"runs of {steps} phase steps",),))
    back = frames.copy()
    for k in _directions(right):
        own = np.array(_places(sequence.frames_of(k))).reshape(-1, steps)
        back[own] = frames[np.concatenate([own[:, :1], own[:, :0:-1]], axis=1)]
    yield Mishap("code: steps in reverse", _changed(right, back), (("phase steps run the other way",),))


def _directions(right: Measurement) -> range:
    return range(len(right.sequence.orientations_rad))


def _places(part: NDArray[np.intp] | slice) -> list[int]:
    return list(range(part.start, part.stop)) if isinstance(part, slice) else part.tolist()


def _fringe_frames(right: Measurement, random: np.random.Generator) -> Iterator[Mishap]:
    """Yield recordings of which a frame of fringes is doubled, missing, or at another place."""
    sequence, frames = right.sequence, _frames(right)
    k, steps = int(random.choice(_directions(right))), sequence.steps
    own = _places(sequence.frames_of(k))
    one, other = (own[int(i)] for i in sorted(random.choice(steps, 2, replace=False)))
    doubled = frames.copy()
    doubled[one] = frames[other]
    yield Mishap("code: fringes doubled", _changed(right, doubled), ((f"frame {one} (", "the same as"),))
    missing = np.concatenate([frames[:one], frames[one + 1 :], frames[-1:]])
    yield Mishap("code: fringes missing", _changed(right, missing), (("is missing",), ("do not",), ("see",)))
    turned = frames.copy()
    for at in _directions(right):
        each = np.array(_places(sequence.frames_of(at))).reshape(-1, steps)
        turned[each] = frames[np.roll(each, 1, axis=1)]
    yield Mishap("code: steps turned", _changed(right, turned), (("beside the code",),))


def _changing(session: Session, orientation: int) -> list[int]:
    """Return two bits of a code at least that change within what is lit: others look the same if dark."""
    sequence, frames = session.measurement.sequence, _frames(session.measurement)
    assert sequence.gray is not None
    lit, bits = session.shape.lit, sequence.gray.bits
    own = frames[_places(sequence.code_frames_of(orientation))][:: sequence.gray.frames_each // bits, lit]
    around = frames[_places(sequence.frames_of(orientation))][:, lit].mean(axis=0)
    share = np.mean(own > around, axis=1)
    return sorted({bits - 2, bits - 1, *(int(b) for b in np.flatnonzero((share > 0.2) & (share < 0.8)))})


def _code_frames(session: Session, random: np.random.Generator) -> Iterator[Mishap]:
    """Yield recordings of which patterns of the code are not what they are said to be."""
    right = session.measurement
    sequence, frames = right.sequence, _frames(right)
    assert sequence.gray is not None
    k, bits = int(random.choice(_directions(right))), sequence.gray.bits
    each = sequence.gray.frames_each // bits
    own = np.array(_places(sequence.code_frames_of(k))).reshape(bits, each)
    one, other = (int(i) for i in sorted(random.choice(_changing(session, k), 2, replace=False)))
    swapped = frames.copy()
    swapped[own[[one, other]]] = frames[own[[other, one]]]
    yield Mishap(
        "code: bits exchanged", _changed(right, swapped), ((f"bits {one} and {other} have changed places",),)
    )
    inverted = frames.copy()
    if each == 2:
        inverted[own[one]] = frames[own[one, ::-1]]
    else:
        around = frames[_places(sequence.frames_of(k))].mean(axis=0)
        if sequence.gray.threshold == "white-black":
            around = frames[-2:].mean(axis=0)
        flipped = np.rint(2.0 * around - frames[own[one, 0]])
        inverted[own[one, 0]] = np.clip(flipped, 0, right.full_scale)
    yield Mishap("code: bit inverted", _changed(right, inverted), ((f"bit {one} is inverted",),))
    order = frames.copy()
    for at in _directions(right):
        every = np.array(_places(sequence.code_frames_of(at))).reshape(bits, each)
        order[every] = frames[every[::-1]]
    yield Mishap("code: order reversed", _changed(right, order), (("in the other order",),))
    twice = frames.copy()
    twice[own[one, 0]] = frames[own[other, 0]]
    named = (("bit", f"{one}"),)
    yield Mishap("code: pattern doubled", _changed(right, twice), named)
    dark = frames.copy()
    dark[own[one, 0]] = np.rint(np.maximum(random.normal(40.0, right.read_noise, frames[0].shape), 0.0))
    yield Mishap("code: pattern dark", _changed(right, dark), named)
    gone = np.concatenate([frames[: own[one, 0]], frames[own[one, 0] + 1 :], frames[-1:]])
    yield Mishap("code: pattern missing", _changed(right, gone), (("bit",), ("code",), ("patterns",)))


def _moved(right: Measurement, random: np.random.Generator) -> Iterator[Mishap]:
    """Yield recordings whose directions have changed places, or in which the camera moved by a pixel."""
    sequence, frames = right.sequence, _frames(right)
    fringes = [_places(sequence.frames_of(k)) for k in _directions(right)]
    code = [_places(sequence.code_frames_of(k)) for k in _directions(right)]
    rest = list(range(code[-1][-1] + 1, len(frames)))
    way = [(0, 1), (0, -1), (1, 0), (-1, 0)][random.integers(4)]
    moved = frames.copy()
    moved[code[0][0] :] = np.roll(frames[code[0][0] :], way, axis=(1, 2))
    still = (("the image moves",), ("still",))
    if sequence.gray is not None and sequence.gray.threshold != "fringes":
        # Patterns alone show no image without stripes.
        yield Mishap("code: camera moved before the code", _changed(right, moved), still)
    if len(fringes) < 2:
        return
    across = fringes[1] + fringes[0] + code[1] + code[0] + rest
    yield Mishap("code: directions exchanged", _changed(right, frames[across]), (("along 90 and 0 deg",),))
    of_code = fringes[1] + fringes[0] + code[0] + code[1] + rest
    yield Mishap(
        "code: fringes of the other direction",
        _changed(right, frames[of_code]),
        (("fringes and code", "directions have changed places"),),
    )
    shifted = frames.copy()
    later = fringes[1] + code[1]
    shifted[later] = np.roll(frames[later], way, axis=(1, 2))
    yield Mishap("code: camera moved between directions", _changed(right, shifted), still)
