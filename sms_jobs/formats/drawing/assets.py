"""The scripts and the style that draw fields in a browser.

They ask whoever uses them for values only: a report has them inside its page, the console fetches them.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files

from sms_jobs.formats.drawing.colours import colours_text

_SCRIPTS = ("unpacking.js", "maps.js", "space.js", "following.js")


@cache
def drawing_script() -> str:
    """Return the script: colours, maps, surfaces in space, charts over the states."""
    return "\n".join([f"const COLOUR_MAPS = {_compact(colours_text())};", *map(_resource, _SCRIPTS)])


@cache
def drawing_style() -> str:
    """Return the style of what the script makes; the page says what colours ink, paper and lines have."""
    return _resource("drawing.css")


def _resource(name: str) -> str:
    return files("sms_jobs.formats.drawing").joinpath(name).read_text(encoding="utf-8")


def _compact(text: str) -> str:
    return json.dumps(json.loads(text))
