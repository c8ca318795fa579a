"""`sms data advise`: what a texture is worth, and what to choose for it."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from sms_jobs import bootstrap
from sms_jobs.catalogue import search
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.records.measurement import Measurement

if TYPE_CHECKING:
    from sms_jobs.metrology.images.texture_quality import Texture

_RADII_PX = (7, 10, 13, 16, 20, 26, 32)
_GAUGES_PX = (30.0, 60.0, 90.0, 120.0)
_PICTURES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".pgm")


def advise(
    image: Annotated[str, typer.Argument(help="Image file, or number of a measurement in the archive.")],
    again: Annotated[
        str | None, typer.Argument(help="The same state once more, of which the noise is taken.")
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option(help="Standard deviation of a pixel in grey levels, if it is known.", min=0.0),
    ] = None,
    mm_per_px: Annotated[
        float | None,
        typer.Option(help="Size of a pixel on the specimen, mm: gauges are then in mm.", min=1e-6),
    ] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Say how coarse and how noisy a texture is, and what subsets and gauge lengths it is good for.

    The middle half of the image is examined, each way, since a specimen seldom fills its rim.

    The noise of a measurement is that of its camera; of image files it comes from a second image of the same
    state or from --noise. Strain is what matches alone make of it: shape adds its own noise in 3D.

    Example: sms data advise reference.tif again.tif --mm-per-px 0.3
    """
    # Other commands of this group load without what this one computes with.
    from sms_jobs.metrology.images.texture_quality import examine_texture, noise_of_pair

    texture, full_scale, known = _texture(image, home)
    sigma = known if noise is None else noise
    if again is not None:
        second, _, _ = _texture(again, home)
        if second.shape != texture.shape:
            raise InvalidInput(
                f"{again} has {second.shape[1]} x {second.shape[0]} px, {image} has "
                f"{texture.shape[1]} x {texture.shape[0]}; give two images of one camera and state"
            )
        sigma = noise_of_pair(_middle(texture), _middle(second))
    found = examine_texture(_middle(texture), sigma or 0.0, full_scale)
    scale, unit = (1.0, "px") if mm_per_px is None else (mm_per_px, "mm")
    choices = _choices(found, sigma, scale, unit)
    remarks = _remarks(found, full_scale, sigma)
    if as_json:
        facts = _facts(found, full_scale, sigma) | {"remarks": remarks}
        output.print_json({"texture": facts, "gauges_in": unit, "choices": choices})
        return
    output.print_facts(_words(found, full_scale, sigma))
    gauges = [f"µε at {gauge * scale:g} {unit}" for gauge in _GAUGES_PX]
    output.print_table(
        ["radius [px]", "spacing [px]", f"resolution [{unit}]", "sigma of a match [px]", *gauges],
        [tuple(row.values()) for row in choices],
        empty="",
    )
    for remark in remarks:
        output.say(remark)


def _choices(found: Texture, sigma: float | None, scale: float, unit: str) -> list[dict[str, float | None]]:
    """Return what each subset radius resolves, and the noise of its matches and of gauges made of them."""
    from sms_jobs.metrology.images.texture_quality import gauge_sigma, match_sigma

    return [
        {
            "subset_radius_px": radius,
            "spacing_px": max(1, radius // 2),
            f"resolution_{unit}": round((2 * radius + 1) * scale, 3),
            "sigma_px": _known(match_sigma(found, radius), sigma),
        }
        | {
            f"{gauge * scale:g}": _known(1e6 * gauge_sigma(found, radius, gauge), sigma)
            for gauge in _GAUGES_PX
        }
        for radius in _RADII_PX
    ]


def _facts(found: Texture, full_scale: float, sigma: float | None) -> dict[str, object]:
    """Return a texture's quality for programs."""
    from sms_jobs.metrology.images.texture_quality import suggested_radius

    return {
        "speckle_px": round(found.speckle_px, 2) if isfinite(found.speckle_px) else None,
        "grey_levels": [found.low, found.high],
        "use_of_range": round((found.high - found.low) / full_scale, 3),
        "saturated": found.saturated,
        "contrast": round(found.contrast, 1),
        "noise": None if sigma is None else round(sigma, 3),
        "subset_radius_px": suggested_radius(found),
    }


def _words(found: Texture, full_scale: float, sigma: float | None) -> dict[str, object]:
    """Return a texture's quality for readers."""
    from sms_jobs.metrology.images.texture_quality import suggested_radius

    return {
        "speckle": f"{found.speckle_px:.1f} px (width of the autocorrelation)"
        if isfinite(found.speckle_px)
        else "none",
        "grey levels": f"{found.low:.0f} to {found.high:.0f} of {full_scale:.0f} (1 % to 99 %)",
        "saturated": f"{found.saturated:.2%}",
        "noise": "not known: give a second image or --noise" if sigma is None else f"{sigma:.2f}",
        "least subset radius": f"{suggested_radius(found)} px",
    }


def _middle(image: NDArray[np.generic]) -> NDArray[np.generic]:
    rows, columns = image.shape
    return image[rows // 4 : rows - rows // 4, columns // 4 : columns - columns // 4]


def _known(value: float, sigma: float | None) -> float | None:
    return float(f"{value:.3g}") if sigma and isfinite(value) else None


def _remarks(found: Texture, full_scale: float, noise: float | None) -> list[str]:
    """Return what is wrong with a texture, in words, and what to do about it."""
    said = []
    if not isfinite(found.speckle_px):
        said.append("the image has no speckle that could be told from its shading")
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


def _texture(which: str, home: Path | None) -> tuple[NDArray[np.generic], float, float | None]:
    """Return an image, the grey level at which it saturates, and its noise where that is known."""
    if Path(which).suffix.lower() in _PICTURES:
        from sms_jobs.formats.importers.image_files import read_image

        levels, _ = read_image(Path(which))
        return levels, float(np.iinfo(levels.dtype).max), None
    with bootstrap.services(home) as services:
        with services.catalogue.reading() as session:
            view = search.file_view(session, which)
        if view.source != "measurement":
            raise InvalidInput(f"file {which} is a {view.source}, which has no texture; choose a measurement")
        with services.archive.open(view) as dataset:
            measurement = dataset.read("measurement", Measurement)
    mean = float(_middle(measurement.texture).astype(np.float64).mean())
    noise = float(np.sqrt(measurement.read_noise**2 + measurement.gain * mean))
    return measurement.texture, float(measurement.full_scale), noise
