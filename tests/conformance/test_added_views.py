"""A view that is added while a test runs: what it sees, what it measures, and what stays as it was."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from datetime import UTC, datetime

import pytest
from sqlalchemy import select
from support.archives import Clock, rebuilt, registered, run_jobs, work_again
from support.command import inside
from support.deployments import Deployment
from support.sessions import small_session

from sms_jobs import bootstrap
from sms_jobs.app.specimens import campaigns as app_campaigns
from sms_jobs.archive import Archive
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.valid_calibrations import ValidCalibrations
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.jobs.archiving.importing import with_view
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.asking import campaign_matrix
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.kinds.kind import deformed_tuples, tuples
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.campaigns import small_plate

KINDS = ("simulate", "reconstruct", "correlate", "strain", "merge", "assess", "report")


class Now(Clock):
    """The time that commands have, too."""

    def __call__(self) -> datetime:
        return datetime.now(UTC)


def said(deployment: Deployment, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    environment = {**deployment.environment, "COLUMNS": "200"}
    done = inside(*words, "--home", str(deployment.home), environment=environment)
    assert done.returncode == code, done.stderr
    return done


def defined(catalogue: Catalogue) -> Campaign:
    with catalogue.reading() as session:
        return campaigns.definition(campaigns.campaign_row(session, "plate"))


def cells(catalogue: Catalogue) -> dict[tuple[str | None, str | None, str], str]:
    with catalogue.reading() as session:
        row = campaigns.campaign_row(session, "plate")
        found = campaign_matrix.matrix(session, row, datetime.now(UTC))
    return {(one.state, one.view, one.kind): one.condition for one in found}


def test_a_late_view_measures_shape_and_changes_nothing_that_was_there(
    deployment: Deployment, catalogue: Catalogue, archive: Archive
) -> None:
    clock = Now()
    registered(catalogue, archive, clock)
    run_jobs(catalogue, archive, clock, [Request(kind) for kind in KINDS])
    before = cells(catalogue)
    told = json.loads(said(deployment, "campaign", "add-view", "plate", "C1P2", "--json").stdout)
    assert told["views"] == ["C1P1", "C1P2"]
    assert told["unseen"] == ["S00", "S01"]
    assert cells(catalogue) == before  # nothing is stale
    said(deployment, "campaign", "add-state", "plate", "S02", "--load", "2kN")

    run_jobs(catalogue, archive, clock, [Request(kind) for kind in KINDS])
    after = cells(catalogue)
    assert {condition for condition in after.values() if condition not in ("measured", "computed")} == set()
    new = {kind for state, view, kind in after if view == "C1P2"}
    assert new == {"measurement", "reconstruct", "assess"}
    assert {state for state, view, _ in after if view == "C1P2"} == {"S02"}
    assert after["S02", "C1P1", "strain"] == "computed"
    assert after["S02", None, "merge"] == "computed"
    with catalogue.reading() as session:
        path = session.scalars(select(FileRow.path).where(FileRow.source == "report")).all()[-1]
    page = next(deployment.home.rglob(path)).read_text(encoding="utf-8")
    assert "S02/C1P2" in page

    # The catalogue is rebuilt from files alone, and says the same.
    kept = defined(catalogue)
    rebuilt(catalogue, archive)
    work_again(catalogue, clock)
    assert defined(catalogue) == kept
    assert cells(catalogue) == after


def test_a_view_that_is_added_in_time_is_one_like_the_others(
    deployment: Deployment, catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    assert "measured by C1P1, C1P2" in said(deployment, "campaign", "add-view", "plate", "C1P2").stderr
    run_jobs(catalogue, archive, clock, [Request(kind) for kind in ("simulate", "reconstruct", "correlate")])
    assert cells(catalogue)["S01", "C1P2", "correlate"] == "computed"


def test_what_cannot_be_seen_is_refused_and_changes_nothing(
    deployment: Deployment, catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    before = defined(catalogue)
    for view, code, words in (
        ("C1P1", 4, "nothing more of C1P1 is there"),
        ("C2P1", 2, "the scene of the virtual rig has no C2, and so no view C2P1; it has C1, P1, P2"),
        ("C2", 2, "has no C2"),
        ("P1C1", 2, "is not a view"),
        ("cam", 2, "is not a view"),
    ):
        assert words in said(deployment, "campaign", "add-view", "plate", view, code=code).stderr
    assert "no campaign 'none'" in said(deployment, "campaign", "add-view", "none", "C1P2", code=3).stderr
    with catalogue.writing() as session:
        submit(session, "plate", [Request("acquire", {}, ("S00",))], clock())
    refused = said(deployment, "campaign", "add-view", "plate", "C1P2", code=4)
    assert "or waits for an operator" in refused.stderr
    assert defined(catalogue) == before


def test_a_view_of_sensors_at_one_point_is_refused(
    deployment: Deployment, catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    calibration, campaign = small_plate("plate")
    camera, first, second = calibration.rig.sensors
    rig = replace(calibration.rig, sensors=(camera, first, replace(second, pose=camera.pose)))
    assert campaign.scene is not None
    one_place = replace(campaign, views=("C1P1",), scene=replace(campaign.scene, rig=rig))
    register_campaign(catalogue, archive, one_place, replace(calibration, rig=rig), clock())
    refused = said(deployment, "campaign", "add-view", "plate", "C1P2", code=2).stderr
    assert "C1 and P2 stand at one point in the scene of the virtual rig" in refused
    assert defined(catalogue) == one_place


def test_a_recording_that_begins_meanwhile_keeps_the_view_out(
    deployment: Deployment,
    catalogue: Catalogue,
    archive: Archive,
    clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    registered(catalogue, archive, clock)
    before = defined(catalogue)

    def begin(*_: object) -> None:
        with catalogue.writing() as session:
            submit(session, "plate", [Request("acquire", {}, ("S00",))], clock())

    for name, value in deployment.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(app_campaigns, "_require_sensors", begin)
    with (
        bootstrap.services(deployment.home) as services,
        pytest.raises(Conflict, match="records plate, or waits"),
    ):
        app_campaigns.add_view(services, "plate", "C1P2")
    assert defined(catalogue) == before


def test_a_view_without_a_calibration_is_refused(
    deployment: Deployment, catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    with catalogue.reading() as session:
        number = ValidCalibrations(session, campaigns.campaign_id(session, "plate"), clock()).used[0].number
    said(deployment, "calibration", "withdraw", str(number), "--campaign", "plate", "--reason", "moved")
    refused = said(deployment, "campaign", "add-view", "plate", "C1P2", code=2)
    assert "none of rig small-virtual-rig is in use" in refused.stderr


def test_frames_that_were_brought_in_make_it_a_view_like_the_others() -> None:
    campaign = replace(small_plate("plate")[1], views=("C1P1",))
    late = with_view(campaign, "C1P2", {"S00": {"C1P1"}, "S01": {"C1P1"}})
    assert late.unseen("C1P2") == ("S00", "S01")
    assert (late.late_views, late.measured_views) == ({"C1P2"}, ("C1P1",))
    assert late.recordings_at("S00") == ("C1P1",)
    one = with_view(late, "C1P2", {"S00": {"C1P1", "C1P2"}, "S01": {"C1P1"}})
    assert one.unseen("C1P2") == ("S01",)
    assert [str(each) for each in tuples(one) if each.view == "C1P2"] == ["plate/S00/C1P2"]
    assert {each.view for each in deformed_tuples(one)} == {"C1P1"}  # a gap is in the way still
    whole = with_view(one, "C1P2", {label: {"C1P1", "C1P2"} for label in ("S00", "S01")})
    assert whole == replace(campaign, views=("C1P1", "C1P2"))
    with pytest.raises(Conflict, match="nothing more of C1P2 is there"):
        with_view(whole, "C1P2", {"S00": {"C1P1", "C1P2"}})


def test_images_of_cameras_that_are_there_are_seen_by_both_together() -> None:
    campaign = replace(small_plate("plate")[1], views=("C1", "C2"))
    recorded = {label: {"C1", "C2"} for label in ("S00", "S01")}
    together = with_view(campaign, "C1C2", recorded)
    assert together.late_views == frozenset()
    assert view_of("C1C2").recordings == (view_of("C1"), view_of("C2"))


def test_a_session_has_the_views_of_its_plan() -> None:
    with pytest.raises(InvalidInput, match="views are those of its plan"):
        with_view(small_session("session"), "C1P2", {})
