"""The scripts and the style that draw fields in a browser.

They ask whoever uses them for values only: a report has them inside its page, the console fetches them.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files

import numpy as np

_SCRIPTS = ("unpacking.js", "maps.js", "space.js", "following.js")
_COLOURS = 256


@cache
def drawing_script() -> str:
    """Return the script: colours, maps, surfaces in space, charts over the states."""
    return "\n".join([f"const COLOUR_MAPS = {_colour_maps()};", *map(_resource, _SCRIPTS)])


@cache
def drawing_style() -> str:
    """Return the style of what the script makes; the page says what colours ink, paper and lines have."""
    return _resource("drawing.css")


def _resource(name: str) -> str:
    return files("sms_jobs.formats.drawing").joinpath(name).read_text(encoding="utf-8")


def _colour_maps() -> str:
    """Return the colours of maps, six letters each, for the script."""
    import matplotlib

    numbers = np.linspace(0.0, 1.0, _COLOURS)
    found = {
        name: matplotlib.colormaps[given](numbers, bytes=True)[:, :3].tobytes().hex()
        for name, given in (("viridis", "viridis"), ("bluered", "coolwarm"), ("grey", "gray"))
    }
    # The first is of what is valid.
    found["groups"] = (
        "ebebeb" + matplotlib.colormaps["tab20"](np.arange(20), bytes=True)[:, :3].tobytes().hex()
    )
    return json.dumps(found)
