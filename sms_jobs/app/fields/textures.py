"""How good a texture is, and textures to print; regions of interest from masks."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.products import MEASURED
from sms_jobs.records.people import Right

if TYPE_CHECKING:
    from sms_jobs.formats.masks import MaskRegion
    from sms_jobs.metrology.images.texture_quality import Texture

_RADII_PX = (7, 10, 13, 16, 20, 26, 32)
_LIKE_NOISE = 0.3
"""How alike neighbours may differ between two images of one state; of noise over 1000 px it is 0 to 0.1."""
_LOOKED_AT = 5
"""Places each way at which it is asked whether the texture repeats itself."""
GAUGES_PX = (30.0, 60.0, 90.0, 120.0)
_PICTURES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".pgm")


@dataclass(frozen=True)
class Choice:
    """What a subset radius gives.

    Attributes
    ----------
    radius_px, spacing_px
        Of the subsets.
    sigma_px
        Standard deviation of a match; None where the noise is not known.
    strain_sigma
        Of a gauge of each of the lengths `GAUGES_PX`.
    """

    radius_px: int
    spacing_px: int
    sigma_px: float | None
    strain_sigma: tuple[float | None, ...]


@dataclass(frozen=True)
class Advice:
    """How good a texture is.

    Attributes
    ----------
    texture
        Speckle, contrast and range of grey levels.
    full_scale
        Grey level at which the image saturates.
    noise
        Standard deviation of a pixel in grey levels; None where it is not known.
    least_radius_px
        From which on subsets hold enough of the texture; None where there is none.
    choices
        One for each of some subset radii.
    remarks
        What is wrong with the texture, in words, and what to do about it.
    """

    texture: Texture
    full_scale: float
    noise: float | None
    least_radius_px: int | None
    choices: tuple[Choice, ...]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class Image:
    """An image whose texture is examined.

    Attributes
    ----------
    name
        As people call it.
    levels
        (rows, columns), in grey levels.
    full_scale
        Grey level at which it saturates.
    noise
        Standard deviation of a pixel in the middle, in grey levels; None where it is not known.
    """

    name: str
    levels: NDArray[np.generic]
    full_scale: float
    noise: float | None


def is_image_file(name: str) -> bool:
    """Say whether a name is that of an image file, and no number of a measurement."""
    return Path(name).suffix.lower() in _PICTURES


def image_file(path: Path) -> Image:
    """Read an image; raises `InvalidInput` for anything else."""
    from sms_jobs.formats.importers.image_files import read_image

    levels, _ = read_image(path)
    return Image(str(path), levels, float(np.iinfo(levels.dtype).max), None)


@use_case(Right.READ)
def measured_image(services: Services, key: str) -> Image:
    """Return the texture of a measurement, with the noise that its camera is known to have.

    Raises `NotFound` where there is no such file, and `InvalidInput` for what is no measurement.
    """
    with services.catalogue.reading() as session:
        view = search.file_view(session, key)
    if view.source != "measurement":
        raise InvalidInput(f"file {key} ({view.source}) has no texture; choose a measurement")
    with services.archive.open(view) as dataset:
        measurement = MEASURED.read(dataset)
    mean = float(_middle(measurement.texture).astype(np.float64).mean())
    noise = float(np.sqrt(measurement.read_noise**2 + measurement.gain * mean))
    return Image(key, measurement.texture, float(measurement.full_scale), noise)


def advise(image: Image, again: Image | None = None, noise: float | None = None) -> Advice:
    """Examine the middle half of an image, each way, since a specimen seldom fills its rim.

    Parameters
    ----------
    again
        The same state once more, of which the noise is taken.
    noise
        Standard deviation of a pixel in grey levels, if it is known better than from the image.

    Raises `InvalidInput` where the two are not of one size.
    """
    # Many of those who load this module examine nothing.
    from sms_jobs.metrology.images.texture_quality import (
        examine_texture,
        gauge_sigma,
        likeness_of_neighbours,
        match_sigma,
        noise_of_pair,
        suggested_radius,
    )

    texture = image.levels
    sigma, alike = image.noise if noise is None else noise, 0.0
    if again is not None:
        second = again.levels
        if second.shape != texture.shape:
            raise InvalidInput(
                f"{again.name} has {second.shape[1]} x {second.shape[0]} px, {image.name} has "
                f"{texture.shape[1]} x {texture.shape[0]}; give two images of one camera and state"
            )
        sigma = noise_of_pair(_middle(texture), _middle(second))
        alike = likeness_of_neighbours(_middle(texture), _middle(second))
        if np.array_equal(texture, second):
            sigma = None
    found = examine_texture(_middle(texture), sigma or 0.0, image.full_scale)
    choices = tuple(
        Choice(
            radius,
            max(1, radius // 2),
            _known(match_sigma(found, radius), sigma),
            tuple(_known(gauge_sigma(found, radius, gauge), sigma) for gauge in GAUGES_PX),
        )
        for radius in _RADII_PX
    )
    remarks = [*_remarks(found, image.full_scale, sigma), *_repeats(_middle(texture))]
    if again is not None and sigma is None:
        remarks.append(f"{again.name} is the same image pixel for pixel: record the state a second time")
    if alike > _LIKE_NOISE:
        remarks.append(
            f"neighbouring pixels differ alike between the two images (correlation {alike:.2f}; noise has 0, "
            f"at most {_LIKE_NOISE:g} is taken for it): the noise is not that of the camera. Take two images "
            "of one state at rest, without compression"
        )
    least = suggested_radius(found) if isfinite(found.speckle_px) else None
    return Advice(found, image.full_scale, sigma, least, choices, tuple(remarks))


def _known(value: float, sigma: float | None) -> float | None:
    return value if sigma and isfinite(value) else None


def _middle(image: NDArray[np.generic]) -> NDArray[np.generic]:
    rows, columns = image.shape
    return image[rows // 4 : rows - rows // 4, columns // 4 : columns - columns // 4]


def _remarks(found: Texture, full_scale: float, noise: float | None) -> list[str]:
    """Return what is wrong with a texture, in words, and what to do about it."""
    said = []
    if not isfinite(found.speckle_px):
        said.append("the image has no speckle that can be distinguished from its shading")
    elif found.speckle_px < 1.5:
        said.append(
            f"the speckle is {found.speckle_px:.1f} px wide, finer than the 1.5 px that pixels can show "
            "without aliasing: print it coarser or move the camera nearer"
        )
    elif found.speckle_px > 6.0:
        said.append(f"the speckle is {found.speckle_px:.1f} px wide: at 2 to 4 px smaller subsets would do")
    use = (found.high - found.low) / full_scale
    if use < 0.3:
        said.append(f"only {use:.0%} of the grey levels are used: open the lens or expose longer")
    if found.saturated > 1e-3:
        said.append(f"{found.saturated:.1%} of the pixels are saturated and carry nothing: expose shorter")
    if noise is None:
        said.append("the noise is not known, so neither are standard deviations")
    return said


def _repeats(image: NDArray[np.generic]) -> list[str]:
    """Return a remark on a texture that is found again within the range in which jobs search."""
    from sms_jobs.metrology.deformation.matching.seeding import SearchSettings, repeats_itself

    search = SearchSettings()
    margin = search.template_radius
    if min(image.shape) <= 2 * margin:
        return []
    rows, columns = (np.linspace(margin, n - 1 - margin, _LOOKED_AT).astype(int) for n in image.shape)
    y, x = (place.ravel() for place in np.meshgrid(rows, columns, indexing="ij"))
    again = repeats_itself(image, np.ones(image.shape, dtype=np.int32), x, y, search)
    if not again.any():
        return []
    remark = (
        f"the texture repeats itself within {search.range_x} px, the range that is searched, at "
        f"{np.count_nonzero(again)} of {len(x)} places, where no match would be certain: print speckle at "
        "random or, if the specimen moves by less than half a period, set search_range_x_px and _y_px to less"
    )
    return [remark]


def outline(mask: Path, above: float | None = None, least_px: int = 0) -> MaskRegion:
    """Return the outlines of a mask image, whose text jobs take for a region of interest.

    Parameters
    ----------
    above
        Pixels brighter than this count; half of the brightest if it is None.
    least_px
        Pieces and holes of fewer pixels are left out.

    Raises `InvalidInput` for what is no image, or shows nothing.
    """
    from sms_jobs.formats.masks import region_of_mask

    return region_of_mask(mask, above, least_px)


def speckle(
    suffix: str,
    *,
    width_mm: float,
    height_mm: float,
    speckle_mm: float,
    dpi: int = 600,
    seed: int = 1,
    mirrored: bool = False,
    pattern: Literal["dots", "laser"] = "dots",
) -> bytes:
    """Return a speckle pattern of exact physical size as the file of a suffix, `.pdf` or `.png`.

    Parameters
    ----------
    speckle_mm
        Mean diameter of a dot; of laser speckle the full width at half maximum of the autocorrelation.
    dpi
        Dots an inch of the printer.
    seed
        Another gives another pattern.
    mirrored
        Exchange left and right, for transfer paper.
    pattern
        Round black dots, or laser speckle.

    Raises `InvalidInput` for a pattern that has too many dots, and for speckles too small or too large.
    """
    from sms_jobs.formats.printed_speckle import Sheet, as_pdf, as_png

    sheet = Sheet(width_mm, height_mm, speckle_mm, dpi, seed, mirrored, pattern)
    return as_pdf(sheet) if suffix == ".pdf" else as_png(sheet)
