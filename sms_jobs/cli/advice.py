"""`sms data advise`: what a texture is worth, and what to choose for it."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.fields import textures
from sms_jobs.app.fields.textures import GAUGES_PX, Advice, Choice, Image
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json


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
    found = textures.advise(_image(image, home), None if again is None else _image(again, home), noise)
    scale, unit = (1.0, "px") if mm_per_px is None else (mm_per_px, "mm")
    choices = [_choice(one, scale, unit) for one in found.choices]
    if as_json:
        facts = _facts(found) | {"remarks": found.remarks}
        output.print_json({"texture": facts, "gauges_in": unit, "choices": choices})
        return
    output.print_facts(_words(found))
    gauges = [f"µε at {gauge * scale:g} {unit}" for gauge in GAUGES_PX]
    output.print_table(
        ["radius [px]", "spacing [px]", f"resolution [{unit}]", "sigma of a match [px]", *gauges],
        [tuple(row.values()) for row in choices],
        empty="",
    )
    for remark in found.remarks:
        output.say(remark)


def _image(which: str, home: Path | None) -> Image:
    if textures.is_image_file(which):
        return textures.image_file(Path(which))
    with bootstrap.services(home) as services:
        return textures.measured_image(services, which)


def _choice(one: Choice, scale: float, unit: str) -> dict[str, float | None]:
    """Return what a subset radius resolves, and the noise of its matches and of gauges made of them."""
    return {
        "subset_radius_px": one.radius_px,
        "spacing_px": one.spacing_px,
        f"resolution_{unit}": round((2 * one.radius_px + 1) * scale, 3),
        "sigma_px": _rounded(one.sigma_px),
    } | {
        f"{gauge * scale:g}": _rounded(None if sigma is None else 1e6 * sigma)
        for gauge, sigma in zip(GAUGES_PX, one.strain_sigma, strict=True)
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.3g}")


def _facts(advice: Advice) -> dict[str, object]:
    """Return a texture's quality for programs."""
    found = advice.texture
    return {
        "speckle_px": round(found.speckle_px, 2) if isfinite(found.speckle_px) else None,
        "grey_levels": [found.low, found.high],
        "use_of_range": round((found.high - found.low) / advice.full_scale, 3),
        "saturated": found.saturated,
        "contrast": round(found.contrast, 1),
        "noise": None if advice.noise is None else round(advice.noise, 3),
        "subset_radius_px": advice.least_radius_px,
    }


def _words(advice: Advice) -> dict[str, object]:
    """Return a texture's quality for readers."""
    found, noise = advice.texture, advice.noise
    return {
        "speckle": f"{found.speckle_px:.1f} px (width of the autocorrelation)"
        if isfinite(found.speckle_px)
        else "none",
        "grey levels": f"{found.low:.0f} to {found.high:.0f} of {advice.full_scale:.0f} (1 % to 99 %)",
        "saturated": f"{found.saturated:.2%}",
        "noise": "not known: give a second image or --noise" if noise is None else f"{noise:.2f}",
        "least subset radius": "none" if advice.least_radius_px is None else f"{advice.least_radius_px} px",
    }
