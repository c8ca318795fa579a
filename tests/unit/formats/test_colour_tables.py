"""The tables of colours are those of the library that they were taken from."""

from __future__ import annotations

import json

import matplotlib as mpl
import numpy as np
import pytest

from sms_jobs.formats.drawing.colours import GREYS, VALUES, coloured, colours_text


@pytest.mark.parametrize(
    ("name", "original"), [(VALUES, "viridis"), (GREYS, "gray"), ("bluered", "coolwarm")]
)
def test_numbers_have_the_colours_of_the_original(name: str, original: str, rng: np.random.Generator) -> None:
    edges = np.arange(257) / 256.0
    near = np.concatenate([np.nextafter(edges, -1.0), edges, np.nextafter(edges, 2.0)])
    for numbers in (near, rng.normal(0.5, 1.0, (40, 50)), near.astype(np.float32)):
        assert (coloured(numbers, name) == mpl.colormaps[original](numbers, bytes=True)[..., :3]).all()


def test_groups_begin_with_the_colour_of_what_is_valid() -> None:
    groups = json.loads(colours_text())["groups"]
    own = mpl.colormaps["tab20"](np.arange(20), bytes=True)[:, :3].tobytes().hex()
    assert groups == "ebebeb" + own
