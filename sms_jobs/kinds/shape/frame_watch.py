"""Checks whether the frames of a tuple are what they are said to be, on patches of the image."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, degrees, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import MeasurementFailed
from sms_jobs.kinds.shape.code_watch import CodeFinding
from sms_jobs.kinds.shape.watched_frames import LEAST_PIXELS, OtherLight, WatchedFrames, frame_places
from sms_jobs.metrology.arrays import Singles
from sms_jobs.metrology.images.frame_motion import image_shifts
from sms_jobs.metrology.phase.frame_fit import (
    lit_pixels,
    share_by_chance,
)
from sms_jobs.metrology.phase.frame_lag import Neighbour
from sms_jobs.metrology.phase.frame_mishaps import Mishap, find_mishap
from sms_jobs.metrology.phase.joint_check import JointFrames, agrees, find_joint_mishap
from sms_jobs.metrology.phase.joint_fit import JointCode
from sms_jobs.metrology.phase.phase_jumps import find_jump
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.subject import Subject

_PAIRS = (4, 16)  # of rows, at least and at most: one for 32 rows
_ROWS_A_PAIR = 32
_BLOCKS, _BLOCK_PX = 8, 16  # of neighbouring columns
_SURE = 6.0  # standard deviations
_OF_ONE_FRAME = ("exchanged", "dark", "doubled", "gain", "other")
_UNIFORM = 0.5  # of the modulation, by which a uniform field differs from the mean at least
_DISTURBING = 3.0  # times the accepted phase error
_MOST_LAG = 0.05  # of a neighbour's light: what a few hundredths move phases by is known to first order
_BY_CHANCE, _MORE = 2.0, 0.1
"""Of phases that do not belong together some agree by chance: as many again, or a tenth of the others, are
to agree before any is believed."""


class FramePatches:
    """Small patches of all frames, spread over the image, taken from slabs of rows as they come by."""

    def __init__(self, rows: int, columns: int) -> None:
        pairs = int(np.clip(rows // _ROWS_A_PAIR, *_PAIRS))
        first = rows * (2 * np.arange(pairs) + 1) // (2 * pairs) & ~1  # slabs begin at even rows
        self._first = np.unique(first[first + 1 < rows])
        blocks = min(_BLOCKS, columns // _BLOCK_PX)
        start = columns * (2 * np.arange(blocks) + 1) // (2 * max(blocks, 1)) - _BLOCK_PX // 2
        self._columns = start[:, None] + np.arange(_BLOCK_PX)
        self._taken: list[NDArray[Any]] = []

    def take(self, rows: slice, frames: NDArray[Any]) -> None:
        """Keep what lies in a slab (frames, rows, columns)."""
        for row in self._first[(self._first >= rows.start) & (self._first < rows.stop)] - rows.start:
            # (frames, 2, blocks, columns) -> (blocks, frames, 2, columns)
            self._taken.append(np.moveaxis(frames[:, row : row + 2][..., self._columns], 2, 0))

    def stacked(self) -> NDArray[Any]:
        """Return what was kept, (frames, patches, 2, columns)."""
        if not self._taken:
            return np.empty((0, 0, 2, _BLOCK_PX), np.uint16)
        return np.ascontiguousarray(np.moveaxis(np.concatenate(self._taken), 0, 1))


def check_frames(
    subject: Subject,
    measurement: Measurement,
    patches: NDArray[Any],
    accepted_rad: float,
    motion_px: float,
    ranged: bool,
    codes: tuple[JointCode, ...] = (),
    doubt: CodeFinding | None = None,
) -> OtherLight:
    """Check that the frames agree with the fringe sequence and with each other.

    Parameters
    ----------
    patches
        From `FramePatches`, (patterns, patches, 2, columns).
    accepted_rad
        Phase error of the fringes themselves that is accepted.
    motion_px
        Shift of the image between the fringes of two densities that is accepted.
    ranged
        Whether pixels may see several surfaces.
    codes
        What the frames of each orientation show, where the densities share a modulation.
    doubt
        What is wrong with fringes and the Gray code beside them.

    Returns
    -------
    What they hold besides, as far as it is accepted.

    Raises
    ------
    MeasurementFailed
        They do not; it names the frame, or the word about them, that is wrong.

    Notes
    -----
    Nothing is said where fewer than 200 of the sampled pixels are lit. Of a single density beside a Gray code
    motion and other light alone are looked for here, the rest by `code_watch`; what that cannot explain
    motion may.
    """
    contradiction = f"the frames of {subject} are not what they are said to be: {{}}"
    if doubt is not None:
        moved = "" if doubt.explained or not patches.size else _motion(measurement, patches, (), motion_px)
        raise MeasurementFailed(contradiction.format(moved or doubt.text))
    if not patches.size:
        return OtherLight()
    grey, places = measurement.grey_levels, frame_places(measurement, len(patches))
    flat = patches.reshape(len(patches), -1)
    lit = np.logical_and.reduce([lit_pixels(flat[own], grey) for own in places])
    if np.count_nonzero(lit) < LEAST_PIXELS:
        return OtherLight()
    if codes:
        if finding := _jointly(measurement, codes, [flat[own][:, lit] for own in places], accepted_rad):
            raise MeasurementFailed(contradiction.format(finding))
        return OtherLight()
    seen = WatchedFrames(measurement, flat[:, lit], accepted_rad, ranged)
    finding, light = _finding(seen, patches, motion_px), seen.other_light()
    lag = light.lag
    # A noise that was estimated from such frames hides how little they agree.
    if finding or seen.suspected > _MOST_LAG or any(fit.few_agree for fit in seen.fits):
        finding = _lagging(seen) or finding
    if not finding and lag is not None and lag.part > _MOST_LAG:
        finding = _of_neighbours(lag.part, lag.neighbour)
    if finding:
        raise MeasurementFailed(contradiction.format(finding))
    return light


def _finding(seen: WatchedFrames, patches: NDArray[Any], motion_px: float) -> str:
    """Say what is wrong with frames that are fitted density by density; nothing where nothing is."""
    measurement, sequence, fits = seen.measurement, seen.measurement.sequence, seen.fits
    if sequence.gray is not None and len(seen.densities) == 1:
        return _motion(measurement, patches, (), motion_px) or _uniform(seen)
    mishap = None if all(fit.agrees for fit in fits) else find_mishap(seen.told, fits)
    finding = ""
    if mishap is None or mishap.what in _OF_ONE_FRAME:
        touched = () if mishap is None else tuple(f // sequence.steps for f in mishap.frames)
        finding = _motion(measurement, patches, touched, motion_px)
    if not finding and mishap is not None:
        finding = _in_words(mishap, _namer(measurement, np.concatenate(seen.places)), seen.densities)
    return finding or _phases(seen) or _uniform(seen)


def _lagging(seen: WatchedFrames) -> str:
    """Say that frames hold light of a neighbour; nothing where that does not explain what is wrong."""
    found = seen.explaining_lag()
    if found is None or _phases(found[2]):
        return ""
    return _of_neighbours(found[0], found[1])


def _of_neighbours(part: float, neighbour: Neighbour) -> str:
    return (
        f"they hold {part:.0%} of the light of the frame {neighbour} each: the projector changes slowly, or "
        "the camera exposes while it changes; let it settle longer (settle_ms of the rig), see that "
        "exposures begin and end while one pattern is shown, and record again"
    )


def _jointly(
    measurement: Measurement, codes: tuple[JointCode, ...], levels: list[NDArray[Any]], accepted_rad: float
) -> str:
    """Say which frame of a sequence that shares one modulation is not what is told; nothing if all are.

    `levels` are (frames, pixels) of each orientation.
    """
    sequence = measurement.sequence
    for k, (own, code) in enumerate(zip(levels, codes, strict=True)):
        one = JointFrames(own, code, measurement.grey_levels, accepted_rad)
        share = one.share()
        if agrees(share):
            continue
        mishap = find_joint_mishap(one)
        if mishap is not None:
            numbers = np.arange(sequence.frames_per_exposure)[sequence.frames_of(k)]
            return _in_words(mishap, _namer(measurement, numbers), sequence.densities)
        along = degrees(sequence.orientations_rad[k])
        return (
            f"the frames along {along:g} deg belong to one phase, mean and modulation in {share:.1%} of the "
            "lit pixels: see that densities, steps and order are right, that nothing moved, that the "
            "projector is linear, and that no fringes are so much finer than others that blur dampens them"
        )
    return ""


def _uniform(seen: WatchedFrames) -> str:
    """Say which frame of the density 0 is not the uniform field that is told; nothing where all are.

    The bright and the dark field are as far from the mean of the fringes as these are, or farther: nothing
    blurs them.
    """
    levels, sequence = seen.levels, seen.measurement.sequence
    shown = list(sequence.patterns())
    for own in seen.places:
        fringes = levels[own].astype(np.float32)
        mean, modulation = fringes.mean(axis=0), np.sqrt(2.0) * fringes.std(axis=0)
        away = {}
        for number, (orientation, density, step) in enumerate(shown):
            if density == 0 and orientation == shown[own[0]][0]:
                told = cos(2.0 * pi * step / sequence.steps)
                away[number] = float(np.median((levels[number] - mean) / modulation)) / told
        if min(away.values(), default=1.0) > _UNIFORM:
            continue
        if max(away.values()) < 0.0:
            first, last = away
            return f"frames {first} and {last}, bright and dark, have changed places: correct their order"
        worst = min(away, key=lambda number: away[number])
        return f"frame {worst} does not show the uniform field of the density 0: record them again"
    return ""


def _namer(measurement: Measurement, numbers: NDArray[np.intp]) -> Callable[[int], str]:
    """Return what names a frame, among those without the density 0."""
    shown = list(measurement.sequence.patterns())

    def name(frame: int) -> str:
        orientation, density, step = shown[numbers[frame]]
        return f"{numbers[frame]} ({density} fringes along {degrees(orientation):g} deg, step {step})"

    return name


def _in_words(mishap: Mishap, name: Callable[[int], str], told: tuple[int | float, ...]) -> str:
    """Say what is wrong, and what to do."""
    again = "record them again"
    if mishap.what == "count":
        return (
            f"{mishap.stated:g} fringes are stated, but the phases are those of {mishap.actual:g}: correct "
            "the fringe densities"
        )
    if mishap.what == "list":
        found, were = (", ".join(map(str, some)) for some in (mishap.densities, told))
        return f"the phases are those of {found} fringes, not of {were}: correct the fringe densities"
    if mishap.what == "steps":
        return (
            f"they are runs of {mishap.actual:g} phase steps, not of {mishap.stated}: correct the phase steps"
        )
    if mishap.what == "exchanged":
        one, other = map(name, mishap.frames)
        return f"frames {one} and {other} have changed places: correct their order, or {again}"
    (frame,) = map(name, mishap.frames)
    if mishap.what == "missing":
        return f"a frame is missing at {frame}, and those after it come one too early: {again}"
    if mishap.what == "dark":
        return f"frame {frame} is dark: {again}"
    if mishap.what == "doubled":
        return f"frame {frame} shows the same as frame {name(int(mishap.actual))}: {again}"
    if mishap.what == "gain":
        return f"frame {frame} is {mishap.actual:.2f} times as bright as it should be: {again}"
    return (
        f"frame {frame} does not show its pattern, or the scene moved beside it: keep camera and specimen "
        f"still and {again}"
    )


def _motion(
    measurement: Measurement, patches: NDArray[Any], touched: tuple[int, ...], accepted_px: float
) -> str:
    """Say between which fringes the image moves; nothing where it stands still, or cannot tell.

    `patches` are those of all frames of an exposure, `touched` the numbers of densities, counted over all
    orientations, whose frames are not as told.
    """
    sequence, grey = measurement.sequence, measurement.grey_levels
    means = _means(measurement, patches)
    names = [_fringes(measurement, i) for i in range(len(means) - len(_codes(measurement)))]
    names += [name for name, _ in _codes(measurement)]
    left = np.setdiff1d(np.arange(len(means)), touched)
    if left.size < 2:
        return ""
    noise = float(np.sqrt(grey.variance(np.array([means.mean()]))[0] / sequence.steps))
    found = image_shifts(means[left], patches.max(axis=0) < grey.full_scale, noise)
    if np.isnan(found.shift).any():
        return ""
    low, high, both = found.shift.argmin(axis=0), found.shift.argmax(axis=0), np.arange(2)
    moved = found.shift[high, both] - found.shift[low, both]
    sigma = np.hypot(found.sigma[high, both], found.sigma[low, both])
    if not np.any((moved > accepted_px) & (moved > _SURE * sigma)):
        return ""
    # Where it moves most from one density to the next.
    at = int(np.argmax(np.sum(np.square(np.diff(found.shift, axis=0)), axis=1)))
    before, after = (names[int(left[i])] for i in (at, at + 1))
    return (
        f"the image moves by {np.hypot(*moved):.2g} px while they are recorded, most between {before} and "
        f"{after}, and {accepted_px:g} px are accepted: keep camera and specimen still and record again"
    )


def _means(measurement: Measurement, patches: NDArray[Any]) -> Singles:
    """Return images in which fringes and stripes are gone, (images, patches, 2, columns).

    The mean over the steps of each density of each orientation, and what a code has in their place.
    """
    sequence = measurement.sequence
    every = np.arange(len(patches))
    own = [every[sequence.frames_of(k, uniform=False)] for k in range(len(sequence.orientations_rad))]
    fringes = patches[np.concatenate(own)].reshape(-1, sequence.steps, *patches.shape[1:])
    code = [patches[place].mean(axis=0, dtype=np.float32) for _, place in _codes(measurement)]
    return np.concatenate(
        [fringes.mean(axis=1, dtype=np.float32), np.asarray(code).reshape(-1, *patches.shape[1:])]
    )


def _codes(measurement: Measurement) -> list[tuple[str, slice]]:
    """Return the frames of a Gray code in whose mean its stripes are gone, and what they are called.

    Patterns and their inverses, or white and black; of patterns alone there are none.
    """
    sequence = measurement.sequence
    if sequence.gray is None or sequence.gray.threshold == "fringes":
        return []
    if sequence.gray.threshold == "white-black":
        count = sequence.frames_per_exposure
        return [("the white and the black frame", slice(count - 2, count))]
    along = [degrees(angle) for angle in sequence.orientations_rad]
    return [(f"the code along {one:g} deg", sequence.code_frames_of(k)) for k, one in enumerate(along)]


def _fringes(measurement: Measurement, place: int) -> str:
    """Name the fringes of a density, counted over all orientations without the density 0."""
    densities = [t for t in measurement.sequence.densities if t]
    orientation = measurement.sequence.orientations_rad[place // len(densities)]
    return f"{densities[place % len(densities)]} fringes along {degrees(orientation):g} deg"


def _phases(seen: WatchedFrames) -> str:
    """Say where the phases of the densities do not belong to one still surface; nothing where they do."""
    measurement = seen.measurement
    for k, (one, fit) in enumerate(zip(seen.told, seen.fits, strict=True)):
        first, accepted = k * len(one.densities), one.accepted_rad
        off = (np.abs(fit.shift) > accepted) & (np.abs(fit.shift) > _SURE * fit.shift_sigma)
        if not (fit.few_agree or off.any()):
            continue
        jump = find_jump(fit, one.densities)
        # A change that is hardly accepted would not make most pixels disagree.
        least = _DISTURBING * accepted if fit.few_agree else accepted
        if jump is not None and abs(jump.change_rad) > least:
            before, after = (_fringes(measurement, first + i) for i in (jump.before, jump.after))
            return (
                f"the phase of {max(one.densities)} fringes changes by {abs(jump.change_rad):.2g} rad "
                f"between {before} and {after}: keep camera and specimen still and record again"
            )
        if off.any() and not fit.few_agree:
            worst = int(np.argmax(np.abs(fit.shift)))
            return (
                f"the phases of {_fringes(measurement, first + worst)} lie {abs(fit.shift[worst]):.2g} rad "
                f"beside those of the others, and {accepted:g} rad are accepted: keep camera and specimen "
                "still and record again"
            )
        by_chance = share_by_chance(one)
        if fit.share <= min(_BY_CHANCE * by_chance, by_chance + _MORE * (1.0 - by_chance)):
            along = degrees(measurement.sequence.orientations_rad[k])
            return (
                f"the phases along {along:g} deg agree in {fit.share:.1%} of the lit pixels, which is "
                "hardly more than chance: see that densities, steps and order are right, that nothing moved, "
                "and that the projector is linear"
            )
    return ""
