"""The colours of maps, as tables: the library that they come from takes 12 MB of a process."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

VALUES: Final = "viridis"
GREYS: Final = "grey"


@cache
def colours_text() -> str:
    """Return the tables as JSON: by name the colours, six letters each, as scripts take them.

    They are Matplotlib's viridis, coolwarm, gray and tab20, as a test compares; the first of the last is of
    what is valid.
    """
    return files("sms_jobs.formats.drawing").joinpath("colours.json").read_text(encoding="utf-8")


@cache
def _table(name: str) -> NDArray[np.uint8]:
    """Return the colours of a map, (colours, 3)."""
    return np.frombuffer(bytes.fromhex(json.loads(colours_text())[name]), np.uint8).reshape(-1, 3)


def coloured(numbers: NDArray[Any], name: str) -> NDArray[np.uint8]:
    """Return the colours of numbers between 0 and 1, with a last axis of three; NaN has that of 0."""
    table = _table(name)
    places = np.clip(np.nan_to_num(numbers) * len(table), 0, len(table) - 1)
    found: NDArray[np.uint8] = table[places.astype(np.intp)]
    return found
