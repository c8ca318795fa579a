"""A gauge that no view can read is refused when it is declared, and no other is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.gauge_descriptions import described_gauge
from sms_jobs.kinds.gauges_in_images import ImageAlone, check_declared, check_gauges
from sms_jobs.metrology.deformation.strain.gauges import read_gauge
from sms_jobs.virtual_rig.campaigns import small_plate

IMAGE = ImageAlone("C1", 80, 60)


def refused(gauge: str, *images: ImageAlone | None) -> bool:
    views = ("C1", "C2P1") if None in images else ("C1", "C2")
    try:
        check_gauges([gauge], dict(zip(views, images, strict=False)))
    except InvalidInput:
        return True
    return False


def test_what_is_refused_reads_nothing_and_what_is_not_reads_something(rng: np.random.Generator) -> None:
    y, x = np.mgrid[0:60, 0:80].astype(float)
    position, still = np.stack([x, -y, 0 * x]), np.zeros((3, 60, 80))
    covariance = np.zeros((6, 60, 80))
    covariance[[0, 3, 5]] = 1e-6
    told = []
    for _ in range(100):
        place = rng.uniform((-12.0, -12.0), (92.0, 72.0))
        gauge = (
            f"G x={place[0]:.3f}px y={place[1]:.3f}px length=16px width=12px angle={rng.uniform(0, 180):.0f}"
        )
        there = described_gauge(gauge).place
        found = read_gauge(
            replace(there, y=-there.y), position, still, covariance, np.ones((60, 80), dtype=np.int32)
        )
        told.append(refused(gauge, IMAGE))
        assert told[-1] == bool(np.isnan(found.strain)), gauge
    assert 20 < sum(told) < 80


def test_a_gauge_that_any_view_may_read_is_none_to_refuse() -> None:
    beside = "G x=100px y=30px length=10px"
    assert refused(beside, IMAGE)
    assert refused(beside, IMAGE, IMAGE)
    assert not refused(beside, IMAGE, replace(IMAGE, view="C2", columns=200))
    # A surface reads mm alone, and nobody knows yet where it lies.
    assert refused(beside, IMAGE, None)
    assert not refused("G x=100 y=30 length=10", replace(IMAGE, mm_per_px=0.5), None)
    assert not refused("G x=100 y=30 length=10", None)
    # In mm means nothing before a pixel has a size.
    assert not refused("G x=100 y=30 length=10", IMAGE)
    assert not refused("G x=30 y=20 length=10", replace(IMAGE, mm_per_px=0.5))
    assert refused("G x=50 y=20 length=10", replace(IMAGE, mm_per_px=0.5))


def test_a_plan_with_a_gauge_outside_of_the_image_of_its_rig_is_refused() -> None:
    calibration, plate = small_plate("plate")
    camera = calibration.rig.sensor("C1")
    alone = replace(plate, views=("C1",))

    def declare(x: int, more: dict[str, float]) -> None:
        given = {"gauges": {"gauge": (f"G x={x} y=20 length=10",)}, "plane": {**more}}
        check_declared(replace(alone, processing=given), calibration.rig)

    declare(camera.columns + 50, {"mm_per_px": 2.0})
    with pytest.raises(
        InvalidInput, match=f"G lies outside of the image of C1: its x is {camera.columns} mm"
    ):
        declare(camera.columns, {"mm_per_px": 0.5})
