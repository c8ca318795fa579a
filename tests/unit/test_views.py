"""What measures is read and written in one place."""

from __future__ import annotations

import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.records.views import Role, View, is_view, place_of, place_of_view, role_of, sensor_name, view_of


@pytest.mark.parametrize(
    "view",
    [
        View("C1"),
        View("C12", ("P3",)),
        View("C999", ("P999",)),
        View("C2", ("C1",)),
        View("C1", ("C2", "C3")),
        View("C1", ("C2", "P1")),
    ],
)
def test_a_view_is_read_as_it_was_written(view: View) -> None:
    assert view_of(str(view)) == view
    assert view.sensors == (view.camera, *view.other_cameras, *view.projectors)
    assert view.measures_shape is bool(view.projectors or view.other_cameras)


def test_fringes_are_recorded_as_they_are_seen_and_several_cameras_by_themselves() -> None:
    recorded = {text: [*map(str, view_of(text).recordings)] for text in ("C1", "C1P2", "C2C1C3", "C2C1P3")}
    assert recorded == {
        "C1": ["C1"],
        "C1P2": ["C1P2"],
        "C2C1C3": ["C2", "C1", "C3"],
        "C2C1P3": ["C2P3", "C1P3"],
    }


def test_a_projector_beside_several_cameras_needs_no_calibration() -> None:
    needed = {text: view_of(text).triangulating for text in ("C1", "C1P2", "C2C1C3", "C2C1P3")}
    assert needed == {
        "C1": ("C1",),
        "C1P2": ("C1", "P2"),
        "C2C1C3": ("C2", "C1", "C3"),
        "C2C1P3": ("C2", "C1"),
    }


@pytest.mark.parametrize(
    "text",
    [
        None,
        "",
        "P1",
        "C0",
        "C1P",
        "C01",
        "C1P1P2",
        "P1C1",
        "C1C1",
        "C1C2P1P2",
        "C1P1C2",
        "C1C2C3P1",
        "C1C2C3C4C5",
        "C1P1 ",
        "c1",
        "C1000",
    ],
)
def test_what_is_no_view_is_refused(text: str | None) -> None:
    with pytest.raises(InvalidInput, match="is not a view; write a camera and a projector like C1P2"):
        view_of(text)
    assert not is_view(text or "")


def test_a_camera_alone_has_no_projector() -> None:
    with pytest.raises(InvalidInput, match="'C1' is not a camera with a projector"):
        _ = View("C1").projector


def test_a_name_says_a_role_and_a_place() -> None:
    names = [sensor_name(role, number) for role in Role for number in (1, 2, 10)]
    assert names == ["C1", "C2", "C10", "P1", "P2", "P10"]
    assert sorted(["P10", "C10", "P2", "C2", "P1", "C1"], key=place_of) == names
    views = ["C1", "C1C2", "C1C10", "C1P1", "C2P1", "C10P1"]
    assert sorted(["C10P1", "C2P1", "C1P1", "C1C10", "C1C2", "C1"], key=place_of_view) == views
    assert [role_of(name) for name in ("C2", "P2")] == [Role.CAMERA, Role.PROJECTOR]
    with pytest.raises(InvalidInput, match="'left' cannot be the name of a sensor"):
        role_of("left")
