"""What is wrong with a set of frames, in words, while the specimen is still held."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.instruments.spool import Spooled
from sms_jobs.metrology.images.image_quality import image_quality
from sms_jobs.metrology.images.texture_extent import LEAST_CONTRAST
from sms_jobs.metrology.phase.recording_quality import recording_quality
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.recording import Verdict

LOOKED_AT = (slice(None, None, 4), slice(None, None, 4))
"""The rows and columns of an image that are looked at for the verdict."""
APART_S = 0.01
"""In 10 ms a cross-head of 2 mm a minute moves a third of a micrometre, a thousandth of a pixel of 0.3 mm."""
_DARK = 0.05
"""Of full scale: an image that is nowhere brighter shows next to nothing of its lens."""


@dataclass(frozen=True)
class Limits:
    """What a set must not have.

    Attributes
    ----------
    saturated_fraction
        Most of the lit region that may be saturated.
    lit_fraction
        Least part of the image that must be lit.
    recordings
        How often a set may be recorded until it keeps the limits; the last is kept as it is.
    channels
        Those that have to be read before and after a set, by name, each with how far it may go meanwhile, in
        the unit of its name; None for any way.
    apart_s
        How far apart in time the images of cameras without a projector may be that are to show one state.
    speckled
        Whether these show a specimen: of a plain artefact the edges alone stand out.
    """

    saturated_fraction: float = 0.02
    lit_fraction: float = 0.01
    recordings: int = 2
    channels: Mapping[str, float | None] = field(default_factory=dict)
    apart_s: float = APART_S
    speckled: bool = True

    def require_channels(self, rig: str, known: Collection[str]) -> None:
        """Raise `InvalidInput` when a rig does not have a channel that has to be read."""
        for name in self.channels:
            if name not in known:
                raise InvalidInput(
                    f"rig {rig} has no channel '{name}', which has to be read at every state; it has "
                    f"{', '.join(known) or 'none'}: describe it under [[channels]] or [[file_channels]]"
                )


def judged(file: Spooled, sequence: FringeSequence, saturated: NDArray[np.bool_]) -> Verdict:
    """Judge a finished set by fringes of its first orientation, on some of their pixels.

    Parameters
    ----------
    saturated
        Which of the pixels `LOOKED_AT` were saturated in a frame of the shortest exposure.
    """
    turn = range(sequence.frames_per_exposure)[sequence.frames_of_anchor(0)]
    steps = np.stack([file.frame(number)[LOOKED_AT] for number in turn])
    about = file.header.about
    quality = recording_quality(steps, saturated, about["full_scale"], about["gain"], about["read_noise"])
    return Verdict(quality.lit_fraction, quality.saturated_fraction, quality.modulation)


def judged_image(file: Spooled, speckled: bool, place: int = 0) -> Verdict:
    """Judge a finished image without fringes, on all of its pixels; `place` is that of its frame."""
    about = file.header.about
    found = image_quality(
        file.frame(place), about["full_scale"], about["gain"], about["read_noise"], areas=speckled
    )
    return Verdict(
        found.lit_fraction,
        found.saturated_fraction,
        found.contrast,
        contrast_to_noise=found.contrast_to_noise,
        level=found.level,
    )


def wanting(verdict: Verdict, limits: Limits) -> list[str]:
    """Return what images of a set do not keep of the limits."""
    doubts = []
    if verdict.saturated_fraction > limits.saturated_fraction:
        doubts.append(
            f"{verdict.saturated_fraction:.0%} of the lit region is saturated, allowed is "
            f"{limits.saturated_fraction:.0%}"
        )
    if verdict.lit_fraction < limits.lit_fraction and verdict.level is not None:
        doubts.append(_nothing_to_match(verdict, verdict.level, limits))
    elif verdict.lit_fraction < limits.lit_fraction:
        doubts.append(
            f"fringes stand out in {verdict.lit_fraction:.2%} of the image, wanted is "
            f"{limits.lit_fraction:.2%}"
        )
    return doubts


def _nothing_to_match(verdict: Verdict, level: float, limits: Limits) -> str:
    why = (
        f"99 % of its pixels are below {level:.1%} of full scale: look at lens cap, lamp and exposure"
        if level < _DARK
        else "look at focus, light and speckle"
    )
    return (
        f"grey levels scatter by {LEAST_CONTRAST:g} times their noise in {verdict.lit_fraction:.2%} of the "
        f"image, wanted is {limits.lit_fraction:.2%}; {why}"
    )


def far_apart(cameras: Collection[str], apart_s: float, limits: Limits) -> list[str]:
    """Return what speaks against images of cameras that are to show one state: they may be of two."""
    if apart_s <= limits.apart_s:
        return []
    names, apart_ms, allowed_ms = " and ".join(cameras), 1e3 * apart_s, 1e3 * limits.apart_s
    words = f"{names} were exposed up to {apart_ms:.3g} ms apart, allowed is {allowed_ms:.3g} ms"
    return [f"{words}: trigger them by one wire, or allow more by apart_ms if nothing moves"]


def drifted(
    before: Mapping[str, float], after: Mapping[str, float], units: Mapping[str, str], limits: Limits
) -> list[str]:
    """Return which channels went too far while a set was recorded; what is no number went too far."""
    doubts = []
    for name, allowed in limits.channels.items():
        if allowed is not None and not abs(after[name] - before[name]) <= allowed:
            doubts.append(
                f"{name} went from {before[name]:g} to {after[name]:g} {units[name]} while it was recorded, "
                f"allowed is {allowed:g} {units[name]}"
            )
    return doubts
