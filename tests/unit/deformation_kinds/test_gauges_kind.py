"""Virtual gauges on the stretched plate, from stored fields alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from sms_jobs.formats.profiles import GaugeRow, draw_gauges
from sms_jobs.kinds.deformation import gauges
from sms_jobs.kinds.deformation.gauges import GaugesParameters

ALONG, ACROSS, AWAY = (
    "along x=5 y=-10 length=40 width=30",
    "across x=5 y=-10 length=40 width=30 angle=90",
    "away x=500 y=0 length=10",
)


def test_gauges_read_the_strain_of_the_plate_in_its_own_frame(plate: Any) -> None:
    output = plate.run(
        gauges.KIND, plate.subject("S01", "C1P1"), GaugesParameters(gauge=(ALONG, ACROSS, AWAY))
    )
    found = output.records["gauges"]
    # 0.5 % and -0.15 %, Green-Lagrange; the plate's x axis is turned in the world.
    truth = np.array([0.005 + 0.5 * 0.005**2, -0.0015 + 0.5 * 0.0015**2])
    assert found.names == ("along", "across", "away")
    # Four standard deviations of a value that was predicted to about 20 %.
    assert (np.abs(found.strain[:2] - truth) < 5.0 * found.sigma[:2]).all()
    assert (found.sigma[:2] < 5e-4).all()
    np.testing.assert_allclose(found.place[:2, :2], [[5.0, -10.0]] * 2, atol=1.0)
    assert np.isnan(found.strain[2])
    assert output.statistics["gauges_read"] == 2.0


def test_gauges_are_drawn() -> None:
    rows = [GaugeRow(f"S0{k}", "C1P1", "G1", 1e-4 * k, 1e-5, 9, 1.1e-4 * k, 1e-5 * k) for k in (1, 2)]
    assert draw_gauges(rows).startswith(b"\x89PNG")
