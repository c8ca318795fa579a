"""A campaign over HTTP and in Python: its states and views while the test runs, and the specimen's frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from support.homes import make_home
from support.over_http import app_of, served

import sms_jobs
from sms_jobs import bootstrap
from sms_jobs.errors import InvalidInput, NotFound

POINTS = {"origin": (0.0, 0.0, 0.0), "x": (9.0, 1.0, 0.0), "plane": (0.0, 5.0, 0.0)}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("campaigns") / "home"
    make_home(home, {})
    return home


@pytest.fixture(scope="module")
def web(home: Path) -> Iterator[httpx2.Client]:
    with bootstrap.services(home, "web") as services, served(app_of(services)) as client:
        yield client


def test_a_state_is_added(web: httpx2.Client) -> None:
    made = web.post("campaigns/plate/states", json={"label": "S02", "load_n": 1500.0})
    assert (made.status_code, made.json()["states"]) == (201, 3)
    states = web.get("campaigns/plate").json()["campaign"]["states"]
    assert (states[2]["label"], states[2]["load_n"]) == ("S02", 1500.0)
    again = web.post("campaigns/plate/states", json={"label": "S02"})
    assert (again.status_code, "choose another label" in again.json()["error"]) == (409, True)
    assert web.get("campaigns/plate/matrix").json() == []  # nothing is measured yet


@pytest.mark.parametrize(
    ("body", "status", "words"),
    [
        ({}, 422, "x"),
        ({"x": [9.0, 1.0]}, 422, "third point"),
        ({"x": [9.0, 1.0], "origin": [0.0, 0.0, 0.0], "plane": [1.0, 5.0]}, 422, "all points as pixels"),
        ({"x": [9.0, 1.0], "origin": [0.0, 0.0], "plane": [1.0, 5.0]}, 404, "no surface of plate/S00/C1P1"),
        ({"x": [9.0]}, 422, "x"),
        ({"x": [9.0, 2e6]}, 422, "x"),
    ],
)
def test_a_frame_that_cannot_be_found_is_refused(
    web: httpx2.Client, body: dict[str, Any], status: int, words: str
) -> None:
    refused = web.post("campaigns/plate/frame", json=body)
    assert (refused.status_code, words in refused.json()["error"]) == (status, True), refused.text
    assert web.get("campaigns/plate/frame").json()["frame"] is None


@pytest.mark.parametrize("where", ["home", "server"])
def test_a_frame_is_found_shown_and_taken_away(web: httpx2.Client, home: Path, where: str) -> None:
    site = str(web.base_url).removesuffix("/api/v1/")
    with sms_jobs.open(home) if where == "home" else sms_jobs.connect(site) as lab:
        before = lab.frame("plate")
        assert (before.frame, before.of_scene) == (None, True)
        found = lab.find_frame("plate", **POINTS)
        assert found.frame is not None
        # z is right-handed and out of the plane of the three points, of which the third has a positive y.
        assert found.frame.placement.matrix()[:, 2] == pytest.approx([0.0, 0.0, 1.0])
        assert lab.frame("plate") == found
        told = web.get("campaigns/plate/frame").json()["frame"]
        assert told["points"][1]["position_mm"] == [9.0, 1.0, 0.0]
        assert lab.drop_frame("plate") == before
        with pytest.raises(NotFound, match="no specimen frame that could be taken away"):
            lab.drop_frame("plate")
        with pytest.raises(NotFound, match="no campaign 'none'"):
            lab.frame("none")


@pytest.mark.parametrize(("where", "view"), [("home", "C1"), ("server", "C1P9")])
def test_a_view_is_added_or_refused_with_its_reason(
    web: httpx2.Client, home: Path, where: str, view: str
) -> None:
    site = str(web.base_url).removesuffix("/api/v1/")
    before = web.get("campaigns/plate").json()["campaign"]["views"]
    with sms_jobs.open(home) if where == "home" else sms_jobs.connect(site) as lab:
        if view == "C1":
            assert lab.add_view("plate", view) == ()
            assert web.get("campaigns/plate").json()["campaign"]["views"] == [*before, view]
        else:
            with pytest.raises(InvalidInput, match="has no P9, and so no view C1P9"):
                lab.add_view("plate", view)
            assert web.get("campaigns/plate").json()["campaign"]["views"] == before
    refused = web.post("campaigns/plate/views", json={"view": "C1P2"})
    assert (refused.status_code, "nothing more of C1P2" in refused.json()["error"]) == (409, True)


def test_provenance_is_a_document(web: httpx2.Client) -> None:
    found = web.get("data/provenance", params={"of": "1"})
    assert (found.status_code, len(found.json()["entity"]) > 0) == (200, True)
    assert web.get("data/provenance", params={"of": "none"}).status_code == 404


def test_a_system_test_is_planned_and_refused_without_what_it_needs(web: httpx2.Client) -> None:
    certified = {"length_mm": 60.0, "radius_mm": 5.0}
    bar = certified | {"length_sigma_mm": 0.005, "radius_sigma_mm": 0.002, "form_sigma_mm": 0.001}
    asked = {"rig": "small-virtual-rig", "name": "check", "bar": bar}
    assert "no calibration in use" in web.post("calibrations/tests", json=asked).json()["error"]
    assert web.post("calibrations/1/use", json={"in_use": True}).status_code == 200
    # A certificate without its uncertainties would count as exact.
    bare = web.post("calibrations/tests", json=asked | {"bar": certified})
    assert (bare.status_code, "length_sigma_mm" in bare.text) == (422, True)
    made = web.post("calibrations/tests", json=asked)
    assert made.status_code == 201, made.text
    assert {one["campaign"] for one in made.json()} == {"check-bar"}
    assert web.post("calibrations/tests", json=asked).status_code == 409
    assert "needs an artefact" in web.post("calibrations/tests", json=asked | {"bar": None}).json()["error"]
    limits = {"campaigns": ["check-bar"], "limits": {"length": 0.05}}
    assert web.post("calibrations/tests/judge", json=limits).status_code == 404  # nothing is measured
    assert web.post("calibrations/tests/judge", json=limits | {"risk": 0.5}).status_code == 422


def test_the_audit_is_listed(web: httpx2.Client) -> None:
    links = web.get("audit", params={"action": "campaigns.add_state"}).json()
    assert [one["arguments"]["label"] for one in links] == ["S02"]
