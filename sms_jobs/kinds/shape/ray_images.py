"""How far beside the images of their rays cameras see what they see: how far to look, and what it tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sms_jobs.errors import MeasurementFailed
from sms_jobs.kinds.calibration_factors import known_view
from sms_jobs.metrology.arrays import Floats, Ints, Ints32, Mask
from sms_jobs.metrology.calibration.missed_rays import MissedRays, missed_rays
from sms_jobs.metrology.calibration.point_factor import economical, line_sigma_px
from sms_jobs.metrology.deformation.matching.correlation import CONVERGED
from sms_jobs.metrology.deformation.matching.epipolar_search import Width
from sms_jobs.metrology.deformation.matching.grid import GridMatches
from sms_jobs.metrology.deformation.matching.ray_scatter import matches_off_rays
from sms_jobs.metrology.geometry.camera import Camera
from sms_jobs.metrology.geometry.several_cameras import meet_rays
from sms_jobs.metrology.images.coarse_maps import sample_blocks
from sms_jobs.records.calibration import CalibrationFactor
from sms_jobs.records.fields import Surface
from sms_jobs.records.reasons import Reason
from sms_jobs.records.remarks import remarked
from sms_jobs.records.views import View

_LINE_SIGMAS = 6.0
"""How far off the image of a ray to look, in standard deviations that the calibration states."""
_LINE_PX = 3.0
"""The same where it states none."""
_FAR_PX = 0.1
"""Rms distance from the images of rays that a usual calibration does not leave."""
_SWAPPED = 5.0
"""How much better cameras the other way round have to explain the matches to be believed."""
_SHARED_BY = 9.0
"""Pixels of fringes whose correction for the texture is one, as `missed_rays` counts them."""
_MOST_LOOKED_AT = 20_000
_MOST_PARTED = 0.5
"""Part of the points of three cameras whose rays may miss each other: of usual ones hardly any do."""


def line_width(factor: CalibrationFactor, partner: int, given_px: float | None) -> Width:
    """Return how far off the images of their rays a partner, from 1 on, may see points.

    As it is given, or six standard deviations of what the calibration says, or 3 px where it says nothing.
    """
    if not factor.is_stated or given_px is not None:
        return lambda points: np.full(len(points), _LINE_PX if given_px is None else given_px)
    view = economical(known_view(factor))
    return lambda points: _LINE_SIGMAS * line_sigma_px(view, partner, points)


def told_by_rays(
    factor: CalibrationFactor,
    surface: Surface,
    rms_px: float,
    noise_px: float,
    missed: Sequence[MissedRays | None],
) -> CalibrationFactor:
    """Return how well sensors are known, by what partners miss the images of rays by, too.

    Parameters
    ----------
    factor
        As the calibration states it.
    surface
        The points.
    rms_px
        By how much single places miss the images of their rays, all partners together.
    noise_px
        Deviation of such a place.
    missed
        By each partner.

    Notes
    -----
    Where rays are missed by far more than is stated, place by place or on the whole, nothing is seen all the
    same of what moves points along these images. Whatever has turned the sensors since has hardly turned them
    about one axis alone, so that all that the calibration states is taken to be as many times too small
    (Birge's ratio).
    """
    rows, columns = sample_blocks(surface.reason == Reason.VALID).pixels
    if not len(rows):
        return factor
    points, view = surface.position[:, rows, columns].T, economical(known_view(factor))
    stated = tuple(_rms(line_sigma_px(view, partner, points)) for partner in range(1, len(view.sensors)))
    seen = [(rms_px, noise_px, _rms(np.array(stated)))]
    seen += [(one.off_px, one.sigma, own) for one, own in zip(missed, stated, strict=True) if one is not None]
    far = (off / own for off, sigma, own in seen if own and off > _LINE_SIGMAS * np.hypot(sigma, own))
    times = max([1.0, *far])
    known = tuple(one for one in missed if one is not None)
    if len(known) < len(stated):
        known = ()
    return replace(factor, root=times * factor.root, missed=known, stated_px=stated, times=times)


def stated_by(factor: CalibrationFactor) -> dict[str, float]:
    """Return, for people, what a calibration lets rays be missed by; empty where it does not say."""
    known = factor.is_stated and factor.stated_px
    return {"epipolar_stated_px": _rms(np.array(factor.stated_px))} if known else {}


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def contradiction(factor: CalibrationFactor, misses: str, sensors: str, off_px: float = 0.0) -> str:
    """Return in words that rays are missed by more than the calibration states, and what of it.

    What misses what, and the sensors, are in words. `off_px` is by how much where nothing is stated, beyond
    what noise explains. Empty where there is nothing to tell.
    """
    if factor.times > 1.0:
        stated = _rms(np.array(factor.stated_px))
        return (
            f"{misses} by {factor.times * stated:.2g} px (rms), and the calibration states {stated:.2g} px, "
            f"far less: the {sensors} may have moved since, or be swapped, or it is another rig's; its part "
            f"of all deviations is taken to be {factor.times:.2g} times what it states"
        )
    if off_px <= _FAR_PX or factor.is_stated:
        return ""
    return (
        f"{misses} by {off_px:.2g} px (rms), and the calibration does not say how well it is known: points "
        "may be off by as much in every direction, and no deviation includes that; calibrate the "
        f"{sensors} as they stand"
    )


def lines_summary(factor: CalibrationFactor, rms_px: float, noise_px: float) -> str:
    """Return in a sentence how far matches lie off the images of their rays, and what was to be expected."""
    off_px = rms_px if rms_px > _LINE_SIGMAS * noise_px else 0.0
    told = contradiction(factor, "the matches miss the images of their rays", "cameras", off_px)
    if told:
        return remarked(told)
    stated = "".join(f"the calibration states {one:.2g} px" for one in stated_by(factor).values())
    return (
        f"met the rays, whose images the matches miss by {rms_px:.2g} px (rms); "
        f"{stated or 'the calibration does not say how well it is known'}"
    )


def some_pixels(where: Mask) -> tuple[Ints, slice]:
    """Return pixels of a mask (rows, columns) that tell what rays miss, and which of all of them they are.

    (2, n), x and y: 20,000 to 40,000, or all where they are fewer.
    """
    rows, columns = np.nonzero(where)
    some = slice(None, None, max(1, len(rows) // _MOST_LOOKED_AT))
    return np.stack([columns[some], rows[some]]), some


def gaps_missed(pixels: Ints, gap_px: Floats) -> MissedRays | None:
    """Return by how much a partner's fringes miss the rays of pixels (2, n); `gap_px` (n,) has a sign."""
    return missed_rays(pixels.astype(np.float64), gap_px, _SHARED_BY)


def why_nothing(view: View, off_px: float, swapped: tuple[str, float] = ("", np.inf)) -> str:
    """Return in words why textures do not match along the rays.

    `swapped` is a partner, and how far off they are with its place and that of the reference swapped.
    """
    cameras = " and ".join(view.sensors)
    if not np.isfinite(off_px):
        return (
            f"{cameras} see nothing together: their textures do not overlap within the measurement volume, "
            "or are too weak; look at both images, examine them by 'sms data advise', and compare the volume "
            "of the calibration with where the specimen stood"
        )
    told = (
        f"the textures of {cameras} match, but {off_px:.2g} px (median) beside the images of their rays: the "
        "calibration is not that of these images; the cameras may be swapped, or have moved since"
    )
    partner, other_px = swapped
    if not off_px > max(_SWAPPED * other_px, _FAR_PX):
        return told
    return (
        f"{told}. With {view.camera} and {partner} swapped it is {other_px:.2g} px: import the images or the "
        "calibration again with the cameras in the other order"
    )


def refuse_far_from_rays(
    view: View, cameras: list[Camera], found: list[GridMatches], most_px: float, threads: int
) -> float:
    """Return the rms distance of the matches from the images of their rays, in px, robustly.

    Raises `MeasurementFailed` where it is so large that the calibration is not theirs, where they lie on
    those of the cameras the other way round, and where no rays meet.
    """
    middle = _distance_from_rays(cameras, found, threads)
    swapped = _distance_from_rays([cameras[1], cameras[0], *cameras[2:]], found, threads)
    if not np.isfinite(middle):
        raise MeasurementFailed(_why_none_meet(view, cameras, swapped))
    if middle > max(_SWAPPED * swapped, _FAR_PX):
        raise MeasurementFailed(why_nothing(view, middle, (view.other_cameras[0], swapped)))
    if middle > most_px:
        raise MeasurementFailed(f"{why_nothing(view, middle)}; maximum_epipolar_px allows {most_px:g}")
    return 1.4826 * middle


def refuse_parted_rays(view: View, surface: Surface, freedom: Ints32) -> None:
    """Raise `MeasurementFailed` where rays of three cameras or more miss each other at most of their points.

    `freedom` is that of the pixels, (n,). A camera that turns along the images of its rays leaves them no gap
    with the reference alone: what only these two see would be off, and nothing would show it.
    """
    several = (freedom > 1).reshape(surface.reason.shape)
    parted = surface.reason[several] & np.uint32(Reason.LARGE_RAY_GAP) > 0
    if parted.size and parted.mean() > _MOST_PARTED:
        raise MeasurementFailed(
            f"rays of {' and '.join(view.sensors)} miss each other at {parted.mean():.0%} of the points that "
            f"three cameras or more see, though those of {view.camera} meet each partner's: a camera has "
            "turned, or its image is of another moment; calibrate again, or import the images with the views "
            "of two cameras each, to see which"
        )


def matches_missed(
    cameras: list[Camera], found: list[GridMatches], each: float, threads: int
) -> list[MissedRays | None]:
    """Return by how much each partner's matches miss the images of their rays; `each` as in `missed_rays`."""
    planes = []
    for partner, one in zip(cameras[1:], found, strict=True):
        off, _ = matches_off_rays(cameras[0], partner, one, threads)
        planes.append(missed_rays(np.stack([one.x, one.y]).astype(np.float64), off, each))
    return planes


def _why_none_meet(view: View, cameras: list[Camera], swapped_px: float) -> str:
    """Return in words why the rays of what textures match nowhere meet."""
    one, *others = (-camera.pose.matrix().T @ np.array(camera.pose.translation) for camera in cameras)
    apart = min(float(np.linalg.norm(other - one)) for other in others)
    told = (
        f"the textures of {' and '.join(view.sensors)} match, and their rays meet nowhere: by the "
        f"calibration the cameras are {apart:.3g} mm apart, and it is not that of these images"
    )
    if np.isfinite(swapped_px):
        return (
            f"{told}; with {view.camera} and {view.other_cameras[0]} swapped they do: import the images or "
            "the calibration again with the cameras in the other order"
        )
    return f"{told}; bring in that of the rig as it stood"


def _distance_from_rays(cameras: list[Camera], found: list[GridMatches], threads: int) -> float:
    """Return the median distance in px of matches from the images of their rays, of the worst partner.

    All together would hide one camera that has moved among others that have not. Infinite where none meet.
    """
    worst = 0.0
    for partner, one in zip(cameras[1:], found, strict=True):
        good = one.matches.ending == CONVERGED
        pixels = np.stack([one.x[good], one.y[good]]).astype(np.float64)
        sigma = one.matches.sigma[good].T[None]
        places, slopes = _places(one, good)[None], _slopes(one, good)[None]
        met = meet_rays(cameras[0], [partner], pixels, places, sigma, slopes, threads)
        distance = np.sqrt(met.chi_square * np.mean(sigma[0] ** 2, axis=0))
        if good.any():
            worst = max(worst, float(np.nanmedian(distance)) if np.isfinite(distance).any() else np.inf)
    return worst


def _places(found: GridMatches, chosen: Mask) -> Floats:
    """Return where points were found, (2, n)."""
    at = np.stack([found.x[chosen], found.y[chosen]])
    return np.asarray(at + found.matches.warp[chosen][:, [0, 3]].T)


def _slopes(found: GridMatches, chosen: Mask) -> Floats:
    """Return how places change with the point, (2, 2, n)."""
    by_place = found.matches.warp[chosen][:, [1, 2, 4, 5]].T.reshape(2, 2, -1)
    return np.asarray(by_place + np.eye(2)[..., None])
