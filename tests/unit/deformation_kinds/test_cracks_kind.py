"""What a plate that broke has opened by, in space, from its stored displacement."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sms_jobs.kinds.deformation import correlate, cracks
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.deformation.cracks import CracksParameters

CHOSEN = CorrelateParameters(spacing_px=4, search_range_x_px=70)


@pytest.fixture(scope="module")
def broken(troubled_plate: Any) -> Any:
    plate = replace(troubled_plate, results=dict(troubled_plate.results))
    plate.keep(correlate.KIND, plate.subject("S01", "C1P1"), CHOSEN)
    return plate


def test_the_two_halves_of_a_plate_are_8_mm_apart(broken: Any) -> None:
    output = broken.run(cracks.KIND, broken.subject("S01", "C1P1"), CracksParameters(spacing_px=5))
    found = output.records["cracks"]
    assert output.statistics["cracks"] == 1.0
    assert len(found.opening) > 10
    # A pixel is 1.4 mm, the match's error some hundredths of it. The line is known to half the spacing of the
    # points, 2 px over 90: 0.02 rad, which make 0.2 mm of sliding out of 8 mm of opening.
    for value, sigma, true, off in (
        (found.opening, found.sigma_opening, 8.0, 0.1),
        (found.sliding, found.sigma_sliding, 0.0, 0.2),
        (found.tearing, found.sigma_tearing, 0.0, 0.1),
    ):
        assert abs(np.median(value) - true) < off
        # The line's error is one and the same along much of it: a median is no mean of chances.
        assert np.median(np.abs(value - true) / sigma) < 2.0
    assert (np.diff(found.along) > 0.0).all()
    assert set(found.right) | set(found.left) == {1, 2}
    assert output.statistics["longest_crack_mm"] == pytest.approx(found.along[-1], rel=0.2)
    assert output.statistics["largest_opening_mm"] == pytest.approx(8.0, abs=0.5)


def test_pieces_name_the_first_of_them(broken: Any) -> None:
    regions = broken.results["correlate", broken.subject("S01", "C1P1")]["regions"].regions
    assert [region.piece_of for region in regions] == [1, 1]


def test_a_plate_that_is_whole_has_no_cracks(plate: Any) -> None:
    output = plate.run(cracks.KIND, plate.subject("S01", "C1P1"))
    assert output.statistics == {"cracks": 0.0}
    assert output.records["cracks"].opening.shape == (0,)
