"""A gauge that no view can read is refused when it is declared, and no other is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.gauge_descriptions import described_gauge
from sms_jobs.kinds.gauges_in_images import ImageAlone, check_declared, check_gauges, surface_there, unread
from sms_jobs.metrology.deformation.strain.gauges import read_gauge
from sms_jobs.records.fields import Surface
from sms_jobs.records.reasons import Reason
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


def test_what_is_refused_of_a_surface_reads_nothing_on_it(rng: np.random.Generator) -> None:
    y, x = np.mgrid[-30:30:1.0, -40:40:1.0]
    position = np.stack([x, y, 0.01 * x**2])
    reason = np.where(np.hypot(x, y) < 12.0, Reason.NO_TEXTURE, Reason.VALID).astype(np.uint32)
    covariance = np.zeros((6, 60, 80))
    covariance[[0, 3, 5]] = 1e-6
    surface = Surface("C1C2", "mm", np.where(reason == Reason.VALID, position, np.nan), reason)
    campaign = replace(small_plate("plate")[1], scene=None)
    sight = surface_there(campaign, surface, sparse=False)
    frame = campaign.placement
    own = np.einsum(
        "ij,jrc->irc", frame.matrix().T, surface.position - np.array(frame.translation)[:, None, None]
    )
    told = []
    for _ in range(300):
        at = rng.uniform((-60.0, -50.0), (60.0, 50.0))
        length, width = rng.uniform(1.0, 20.0, 2)
        gauge = f"G x={at[0]:.3f} y={at[1]:.3f} length={length:.3f} width={width:.3f}"
        place = described_gauge(gauge).place
        found = read_gauge(
            place, own, np.zeros_like(own), covariance, (reason == Reason.VALID).astype(np.int32)
        )
        told.append(unread(described_gauge(gauge), {"C1C2": sight}) is not None)
        assert not told[-1] or np.isnan(found.strain), gauge
    assert 60 < sum(told) < 240
    for gauge, why in (
        ("G x=0 y=0 length=10", "lies off the surface of C1C2: from its middle at x=0 y=0 mm the nearest"),
        (
            "G x=20 y=0 length=2 width=1",
            "has at most 9 pixels of the surface of C1C2 under it, and 12 are needed",
        ),
        (
            "G x=20 y=0 length=200 width=1",
            "is 200 mm long and 1 mm wide, and the surface of C1C2 is 99",
        ),
        (
            "G x=20px y=0px length=9px",
            "is in pixels, which only cameras alone read, and there is none beside C1C2",
        ),
    ):
        with pytest.raises(InvalidInput, match=why):
            check_gauges([gauge], {"C1C2": sight})
    check_gauges(["G x=20px y=0px length=9px"], {"C1C2": sight, "C1": IMAGE})
    with pytest.raises(InvalidInput, match=r"is 101 px long and 50[.]5 px wide, and the image of C1 is 98"):
        check_gauges(["G x=20px y=0px length=101px"], {"C1": IMAGE})


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
    assert refused("G x=30 y=20 length=10", replace(IMAGE, made=True))
    assert not refused("G x=30 y=20 length=10", replace(IMAGE, made=True), None)
    assert not refused("G x=30px y=20px length=10px", replace(IMAGE, made=True))
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
