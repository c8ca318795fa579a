"""A campaign's specimen frame: what it makes stale, what it leaves, and what comes back with it."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from support.archives import PLAN, Clock, rebuilt, registered, run_jobs, work_again
from support.command import inside
from support.deployments import Deployment
from support.sessions import small_session

from sms_jobs import bootstrap
from sms_jobs.app.holdings import reading
from sms_jobs.archive import Archive
from sms_jobs.catalogue import campaigns, subject_files
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import NotFound
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.asking import campaign_matrix
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate

KINDS = ("simulate", "reconstruct", "correlate", "strain", "merge")
STRAINED = Subject("plate", "S01", "C1P1")
POINTS = ("--origin", "64,60", "--x", "100,57", "--plane", "60,90")


@pytest.fixture
def measured(catalogue: Catalogue, archive: Archive, clock: Clock) -> None:
    """Compute a campaign of one deformed state and view, strain and merged surface too."""
    registered(catalogue, archive, clock)
    run_jobs(catalogue, archive, clock, [Request(kind) for kind in KINDS])


def said(deployment: Deployment, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    done = inside(*words, "--home", str(deployment.home), environment=deployment.environment)
    assert done.returncode == code, done.stderr
    return done


def frame(deployment: Deployment, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    return said(deployment, "campaign", "frame", "plate", *words, code=code)


def conditions(catalogue: Catalogue) -> dict[str, str]:
    with catalogue.reading() as session:
        row = campaigns.campaign_row(session, "plate")
        cells = campaign_matrix.matrix(session, row, datetime.now(UTC))
    return {cell.kind: cell.condition for cell in cells if cell.state != "S00" and cell.kind != "measurement"}


def defined(catalogue: Catalogue) -> Campaign:
    with catalogue.reading() as session:
        return campaigns.definition(campaigns.campaign_row(session, "plate"))


@pytest.mark.usefixtures("measured")
def test_a_frame_makes_stale_what_lies_along_it_and_nothing_else(
    deployment: Deployment, catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    assert set(conditions(catalogue).values()) == {"computed"}
    told = json.loads(frame(deployment, *POINTS, "--json").stdout)
    assert told["stale"] == {"strain": 1}
    assert told["frame"]["view"] == "C1P1"
    assert len(told["frame"]["surface"]) == 64
    after = conditions(catalogue)
    assert after == {"reconstruct": "computed", "correlate": "computed", "strain": "stale", "merge": "stale"}
    with catalogue.reading() as session:
        strains = subject_files.newest_file(session, "strain", STRAINED, "application/x-hdf5")
    found = json.loads(said(deployment, "data", "states", "frame = points", "--format", "json").stdout)
    assert len(found["states"]) == 2

    run_jobs(catalogue, archive, clock, [Request("strain"), Request("merge")])
    assert set(conditions(catalogue).values()) == {"computed"}
    with catalogue.reading() as session:
        again = subject_files.newest_file(session, "strain", STRAINED, "application/x-hdf5")
    assert again != strains
    exported = deployment.home / "merged.csv"
    said(
        deployment,
        *("data", "export", "--kind", "merge", "-c", "plate", "-o", str(exported), "--frame", "specimen"),
    )
    assert '"x [mm]","y [mm]","z [mm]","displacement x [mm]"' in exported.read_text().splitlines()[0]

    # Without the frame the first results hold again, and nothing is computed to say so.
    frame(deployment, "--drop")
    assert conditions(catalogue)["strain"] == "stale"
    run_jobs(catalogue, archive, clock, [Request("strain"), Request("merge")])
    assert set(conditions(catalogue).values()) == {"computed"}
    with catalogue.reading() as session:
        row = campaigns.campaign_row(session, "plate")
        cells = campaign_matrix.matrix(session, row, datetime.now(UTC))
    assert [cell.file for cell in cells if cell.kind == "strain"] == [strains]


@pytest.mark.usefixtures("measured")
def test_what_is_read_and_built_on_is_of_the_frame_that_the_campaign_has(
    deployment: Deployment,
    catalogue: Catalogue,
    archive: Archive,
    clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in deployment.environment.items():
        monkeypatch.setenv(name, value)

    def newest() -> list[int]:
        with bootstrap.services(deployment.home) as services:
            subjects = {"strain": str(STRAINED), "merge": "plate/S01", "displacement": str(STRAINED)}
            return [reading.newest_file(services, one, what).file.id for what, one in subjects.items()]

    first = newest()
    frame(deployment, *POINTS)
    with (
        bootstrap.services(deployment.home) as services,
        pytest.raises(NotFound, match=f"of another frame.* by its number, {first[0]}"),
    ):
        reading.newest_file(services, str(STRAINED), "strain")
    run_jobs(catalogue, archive, clock, [Request("strain"), Request("merge")])
    second = newest()
    assert (second[0] > first[0], second[1] > first[1], second[2]) == (True, True, first[2])

    frame(deployment, "--drop")
    assert newest() == first
    # Merged alone, it takes the strain that lies along the world's axes again, and so is there already.
    run_jobs(catalogue, archive, clock, [Request("merge")])
    assert newest() == first
    assert conditions(catalogue)["merge"] == "computed"


@pytest.mark.usefixtures("measured")
def test_a_lost_catalogue_comes_back_with_the_frame(
    deployment: Deployment, catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    frame(deployment, *POINTS)
    frame(deployment, "--fit", "rectangle 30 30 100 100", "--x", "100,57")
    before = defined(catalogue)
    assert before.frame is not None
    assert before.frame.method == "plane"
    z = np.array(before.frame.placement.rotation)[:, 2]
    assert before.scene is not None
    # The plane of 70 x 70 pixels with 20 um of noise; a degree is far more.
    assert z @ before.scene.placement.matrix()[:, 2] > np.cos(np.radians(0.5))
    stale = conditions(catalogue)
    rebuilt(catalogue, archive)
    work_again(catalogue, clock)
    assert defined(catalogue) == before
    assert conditions(catalogue) == stale


@pytest.mark.usefixtures("measured")
def test_what_tells_no_frame_is_refused(deployment: Deployment, catalogue: Catalogue) -> None:
    before = defined(catalogue)
    for words, told in (
        (("--x", "100,57"), "plane, a third point"),
        (("--origin", "64,60"), "point of the x axis by --x"),
        (("--origin", "64,60", "--x", "100,57,3", "--plane", "60,90"), "all points as pixels"),
        (("--origin", "64,60", "--x", "9", "--plane", "60,90"), "--x 9 is not a point"),
        (("--origin", "64,60", "--x", "900,57", "--plane", "60,90"), "not in the image"),
        (("--origin", "64,60", "--x", "100,57", "--plane", "82,58.5"), "nearly on one line"),
        (("--x", "100,57", "--fit", "circle 3"), "write 'rectangle LEFT TOP"),
        (("--x", "100,57", "--fit", "rectangle 3 3 6 6"), "needs 100"),
        ((*POINTS, "--view", "C1"), "choose a view that measures shape"),
        ((*POINTS, "--markers"), "in no round mark"),
        ((*POINTS, "--drop"), "leave the other options out"),
    ):
        assert told in frame(deployment, *words, code=2).stderr
    assert defined(catalogue) == before


def test_a_camera_alone_has_no_shape_to_find_a_frame_on(
    deployment: Deployment, catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    calibration, campaign = small_plate("plate")
    register_campaign(catalogue, archive, replace(campaign, views=("C1",)), calibration, clock(), PLAN)
    for points in (POINTS, ("--origin", "0,0,0", "--x", "9,1,0", "--plane", "0,5,0")):
        told = frame(deployment, *points, code=2).stderr
        assert "plate has no shape on which a frame could be found: by C1 it measures in the plane" in told
    assert frame(deployment).stderr == (
        "campaign plate has no specimen frame, and none can be found: its cameras measure in the plane of "
        "the image, along whose axes its results lie\n"
    )
    shown = json.loads(frame(deployment, "--json").stdout)
    assert (shown["frame"], shown["of_scene"], shown["in_image"]) == (None, False, True)


def test_a_calibration_session_has_no_specimen(
    deployment: Deployment, catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    register_campaign(catalogue, archive, small_session("plate"), None, clock(), PLAN)
    assert "plate is a calibration session, which has no specimen" in frame(deployment, code=2).stderr


def test_a_campaign_without_a_surface_says_what_is_missing(
    deployment: Deployment, catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    assert "there is no surface of plate/S00/C1P1" in frame(deployment, *POINTS, code=3).stderr
    assert "those of the scene" in frame(deployment).stderr
    assert "no specimen frame" in frame(deployment, "--drop", code=3).stderr
    told = frame(deployment, "--origin", "0,0,0", "--x", "9,1,0", "--plane", "0,5,0")
    assert "not known of points of the world" in told.stdout
