"""Patterns of other people: phases of their own, a Gray code beside the fringes, one modulation for all."""

from __future__ import annotations

from math import degrees, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.special import chdtri

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.kinds.shape.streaming import some_rows
from sms_jobs.metrology.arrays import Mask, Singles
from sms_jobs.metrology.phase.gray_code import (
    UNREAD,
    gradient_at,
    gradient_of_stripes,
    order_mishap,
    read_stripes,
)
from sms_jobs.metrology.phase.joint_fit import JointCode, with_transfer
from sms_jobs.metrology.phase.temporal_unwrapping import CoarseGradient, PhaseGradient
from sms_jobs.records.fields import PhaseMaps
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.subject import Subject

DOUBT = 3.0  # standard deviations of the noise from the threshold, within which a bit may be misread
_SURE = 4.0  # the same without fringes, which a wrong bit would contradict
_WRONG_SIGN = 0.35  # of the modulation: a pattern that is seen with less may be seen with the wrong sign
_CLEAR, _NEAR_PX = 0.75, 5  # of the modulation, and the pixels across in which a clear pattern has to show it
_LIT = 5.0  # standard deviations of the noise
_LEAST_LIT = 200  # pixels
_UNEVEN = 0.1  # of the modulation: what light from elsewhere may add to one pattern
_UNLIKE = 0.25  # of the lit pixels: an exchanged pattern is wrong in half of them
_MOST_ASIDE = 0.3  # of what patterns differ by, for the middle of white and black: at 0.5 no code is read
_ROWS, _COLUMNS = 24, 200  # of the pixels that tell what blur leaves


def refuse_foreign_patterns(subject: Subject, measurement: Measurement, instead: str) -> None:
    """Raise `InvalidInput` where patterns are not this program's own; `instead` says what can use them."""
    foreign = {
        "a Gray code": measurement.sequence.gray is not None,
        "one modulation for all densities": measurement.sequence.joint,
        "phases of their own": any(measurement.phase_offsets_rad),
    }
    what = next((name for name, is_so in foreign.items() if is_so), None)
    if what is not None:
        raise InvalidInput(f"the patterns of {subject} have {what}, which only {instead} can use")


def offsets_of(measurement: Measurement) -> tuple[float, ...]:
    """Return what the patterns add to the phase of each density above 0; empty for nothing."""
    if not measurement.phase_offsets_rad:
        return ()
    each = zip(measurement.sequence.densities, measurement.phase_offsets_rad, strict=True)
    return tuple(offset for density, offset in each if density)


def joint_codes(measurement: Measurement) -> tuple[JointCode, ...]:
    """Return what the frames of each orientation show, of a sequence whose densities share a modulation.

    What blur leaves of each density is found in some of the pixels; empty for any other sequence.
    """
    sequence = measurement.sequence
    if not sequence.joint:
        return ()
    told, levels = stated_code(sequence, offsets_of(measurement)), measurement.grey_levels
    some = some_rows(measurement, _ROWS).pixels(_COLUMNS)
    each = range(len(sequence.orientations_rad))
    return tuple(with_transfer(some[sequence.frames_of(k)], told, levels) for k in each)


def stated_code(sequence: FringeSequence, offsets: tuple[float, ...] = ()) -> JointCode:
    """Return what the frames of an orientation show; `offsets` in rad are added to each density's phase."""
    shown = [
        (density, offset + 2.0 * pi * step / sequence.steps)
        for density, offset in zip(
            sequence.densities, offsets or (0.0,) * len(sequence.densities), strict=True
        )
        for step in sequence.steps_of(density)
    ]
    densities, turns = np.array(shown, np.float64).T.copy()
    return JointCode(densities, turns, sequence.frames_of_anchor(0), np.ones(len(shown)))


def stated_by_what_is_left(
    sigma: Singles,
    phase_error: Singles,
    noise: Singles,
    code: JointCode,
) -> Singles:
    """Return sigma, larger by what the joint model of an image leaves beyond noise.

    A projector that is not linear makes the squares of all pixels larger: the ratio of their median to that
    of the chi-square distribution tells how much. What is left repeats itself in frames of like phase, so
    that the excess does not become less in the mean over them: only the anchor's steps count as different.

    Parameters
    ----------
    sigma
        (pixels,), of the pixels that are trusted.
    phase_error, noise
        (pixels,): of one phase, as the frames leave it and as the camera's noise makes it.
    """
    if not sigma.size:
        return sigma
    expected = float(chdtri(code.freedom, 0.5)) / code.freedom
    excess = max(float(np.median(np.square(phase_error / noise))) / expected - 1.0, 0.0)
    return np.asarray(sigma * np.sqrt(1.0 + excess * len(code.densities) / code.steps), np.float32)


def coarse_gradient(
    measurement: Measurement, orientation: int, frames: NDArray[Any]
) -> CoarseGradient | None:
    """Return what a Gray code says of some rows of an orientation, before its fringes are unwrapped.

    Parameters
    ----------
    frames
        (frames, rows, columns): all of one exposure.
    """
    code = measurement.sequence.gray
    if code is None:
        return None
    above, _, noise = pattern_contrast(measurement, orientation, frames)
    stripes = code.stripes_of(orientation)
    return gradient_of_stripes(read_stripes(above, DOUBT * noise, stripes).nearly_sure, stripes)


def striped_gradient(measurement: Measurement, orientation: int, frames: NDArray[Any]) -> PhaseGradient:
    """Return the phase gradient of some rows of an orientation by their Gray code alone.

    Parameters
    ----------
    frames
        (frames, rows, columns): all of one exposure.

    Notes
    -----
    A pixel's gradient is the middle of the stripes that agree with its bits, and sigma their width over the
    root of 12, as of a uniform distribution. A bit is in doubt within four standard deviations of the noise.
    Of a pattern that no pixel near by shows with three quarters of the modulation it is in doubt below 0.35
    of that, too: what a pixel sees may be as wide as one and a half periods, and then has up to a third of
    the contrast with the wrong sign. Where it is shown, as c sin(pi x / 2) at x stripes from a border with c
    of 0.75 at least, less than 0.35 is found within half a stripe of the border alone.
    """
    sequence = measurement.sequence
    code = sequence.gray
    assert code is not None
    above, threshold, noise = pattern_contrast(measurement, orientation, frames)
    if code.threshold == "inverse":
        modulation, mean = np.median(np.abs(above), axis=0), threshold.mean(axis=0)
    else:
        white, black = frames[-2:].astype(np.float32)
        modulation, mean = 0.5 * (white - black), threshold
    near = maximum_filter(np.abs(above), (1, _NEAR_PX, _NEAR_PX)) >= _CLEAR * modulation
    noisy, faint = _SURE * noise, _WRONG_SIGN * modulation
    doubt = np.where(near, noisy, np.maximum(noisy, faint))
    stripes = code.stripes_of(orientation)
    found = read_stripes(above, doubt, stripes, near & (noisy <= faint))
    used = [frames[sequence.code_frames_of(orientation)], frames[sequence.frames_of_anchor(orientation)]]
    shape = modulation.shape
    return PhaseGradient(
        omega=gradient_at(found.middle, stripes),
        omega_sigma=np.asarray(2.0 * pi / stripes / sqrt(12.0) * found.width, np.float32),
        modulation=np.asarray(modulation, np.float32),
        phase_error=np.zeros(shape, np.float32),
        mean_intensity=np.asarray(mean, np.float32),
        fitted=np.ones(shape, np.uint8),
        saturated=np.logical_or.reduce([(f >= measurement.full_scale).any(axis=0) for f in used]),
        ambiguous=found.stripe == UNREAD,
    )


def pattern_contrast(
    measurement: Measurement, orientation: int, frames: NDArray[Any]
) -> tuple[Singles, Singles, Singles]:
    """Return how far patterns are above their threshold, (bits, rows, columns), the threshold, and its noise.

    Of inverses the noise is that of half the difference, of white and black that of a pattern and their mean.
    """
    sequence = measurement.sequence
    assert sequence.gray is not None
    own = frames[sequence.code_frames_of(orientation)].astype(np.float32)
    if sequence.gray.threshold == "inverse":
        # Half way between a pattern and its inverse: what is above it in the one is below it in the other.
        threshold = 0.5 * (own[::2] + own[1::2])
        return own[::2] - threshold, threshold, measurement.noise(threshold) / np.float32(sqrt(2.0))
    if sequence.gray.threshold == "white-black":
        threshold = frames[-2:].mean(axis=0, dtype=np.float32)
        return own - threshold, threshold, measurement.noise(threshold) * np.float32(sqrt(1.5))
    fringes = frames[sequence.frames_of(orientation, uniform=False)]
    threshold = fringes.mean(axis=0, dtype=np.float32)
    return own - threshold, threshold, measurement.noise(threshold)


def check_stripes(
    subject: Subject,
    measurement: Measurement,
    patches: NDArray[Any],
    phase: PhaseMaps,
    trusted: Mask,
) -> None:
    """Check that frames are the Gray code that is told, where it is all there is.

    Parameters
    ----------
    patches
        (frames, ...): of one exposure, some of the pixels.
    phase, trusted
        Of the whole image, and where it can be.

    Raises
    ------
    MeasurementFailed
        Patterns and inverses do not add up to one brightness, patterns do not lie between black and white, or
        stripes that should be neighbours are not: it names the bits.
    """
    sequence = measurement.sequence
    code = sequence.gray
    assert code is not None
    for k, angle in enumerate(sequence.orientations_rad):
        along = f" along {degrees(angle):g} deg"
        finding = levels_mishap(measurement, k, patches.reshape(len(patches), -1)) if patches.size else None
        if finding is None:
            stripes = code.stripes_of(k)
            place = (phase.omega[k] / (2.0 * pi) + 0.5) * stripes
            sure = trusted & (phase.omega_sigma[k] < 1.5 * 2.0 * pi / stripes / sqrt(12.0))
            sure &= np.abs(place % 1.0 - 0.5) < 0.25  # not the middle of two
            stripe = np.where(sure, np.floor(np.where(sure, place, 0.0)), UNREAD).astype(np.int32)
            finding = order_mishap(stripe, code.bits)
        if finding is not None:
            raise MeasurementFailed(
                f"the frames of {subject} are not what they are said to be{along}: {finding}"
            )


def levels_mishap(measurement: Measurement, orientation: int, frames: NDArray[Any]) -> str | None:
    """Say which patterns do not go with their threshold, frames (frames, pixels); None for none."""
    sequence = measurement.sequence
    assert sequence.gray is not None
    above, threshold, noise = pattern_contrast(measurement, orientation, frames[:, None, :])
    otherwise = None
    if sequence.gray.threshold == "inverse":
        # Every pattern and its inverse are as bright together as all others are.
        off, within = np.abs(threshold - np.median(threshold, axis=0)), 1.0
        lit = np.median(np.abs(above), axis=0) > _LIT * noise[0]
        what = "patterns and inverses of bits {} do not add up to the brightness of the others"
    else:
        white, black = frames[-2:].astype(np.float32)
        if np.count_nonzero(black - white > _LIT * noise[0]) > np.count_nonzero(
            white - black > _LIT * noise[0]
        ):
            return "the black frame is brighter than the white one: they have changed places"
        half = 0.5 * (white - black)
        off, within = np.abs(above) - half, 2.0
        lit = half[None] > _LIT * noise
        what = "bit {} is brighter than white or darker than black"
        otherwise = _exposed_otherwise(above, noise)
    limit = within * _SURE * noise + _UNEVEN * np.median(np.abs(above), axis=0)
    if np.count_nonzero(lit) < _LEAST_LIT:
        return otherwise
    wrong = [b for b, one in enumerate(off > limit) if one[lit].mean() > _UNLIKE]
    if len(wrong) > 2 and sequence.gray.threshold == "inverse":
        return "patterns and inverses do not go together: see if frames are gray+inverse or gray inverse"
    return what.format(", ".join(map(str, wrong))) if wrong else otherwise


def _exposed_otherwise(above: Singles, noise: Singles) -> str | None:
    """Say so where the middle of white and black is far from that of the patterns' two levels.

    Light that comes from all over the specimen brightens white more than a pattern, of which half is dark: by
    how much white and black differ tells nothing, but both middles are the same.
    """
    contrast = np.ptp(above, axis=0)
    seen = contrast > 2.0 * _LIT * noise[0]
    if np.count_nonzero(seen) < _LEAST_LIT:
        return None
    middle = 0.5 * (above.max(axis=0) + above.min(axis=0))
    aside = abs(float(np.median(middle[seen] / contrast[seen])))
    if aside <= _MOST_ASIDE:
        return None
    return (
        f"the middle of white and black lies {aside:.2g} of what the patterns differ by from theirs (at most "
        f"{_MOST_ASIDE}): white and black are other frames, or have another exposure"
    )
