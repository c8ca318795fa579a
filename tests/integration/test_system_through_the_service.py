"""A measuring system is tested as a person does it: planned, recorded, measured, judged, signed."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from support.command import answer, inside, service
from support.sessions import small_session

from sms_jobs import bootstrap
from sms_jobs.app.calibrating import calibrations
from sms_jobs.jobs.archiving.registration import register_calibration, register_campaign
from sms_jobs.records.campaign import Specimen
from sms_jobs.records.sensors import Calibration
from sms_jobs.virtual_rig.sessions import BEGIN

USAGE, NOT_FOUND, CONFLICT, FINDINGS = 2, 3, 4, 6
CERTIFICATES = (
    *("--bar", "150,22", "--bar-sigma", "0.005,0.002", "--bar-form-sigma", "0.001"),
    *("--plate", "120,100", "--plate-form-sigma", "0.002"),
)
OF_BAR = ("--bar-sigma", "0.005,0.002", "--bar-form-sigma", "0.001")
OF_PLATE = ("--plate-form-sigma", "0.002")


@pytest.fixture(scope="module")
def tested(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Plan, record and measure a test of the small session's rig; return the home."""
    home = tmp_path_factory.mktemp("tested")
    assert inside("init", "--home", str(home)).returncode == 0
    session = small_session("session")
    assert session.scene is not None
    assert session.session is not None
    assert session.session.volume is not None
    exact = Calibration(session.scene.rig, session.session.volume, BEGIN - timedelta(days=1), "exact")
    states = (replace(session.states[0], artefact=None, time=None),)
    like = replace(
        session, name="like", specimen=Specimen("board"), states=states, session=None, views=("C1P1",)
    )
    with bootstrap.services(home) as services:
        register_calibration(services.catalogue, services.archive, exact, datetime.now(UTC))
        register_campaign(services.catalogue, services.archive, like, None, datetime.now(UTC))
    plan = ("calibration", "test", "plan", "small-session-rig", "--name", "check", "--like", "like")
    planned = answer(*plan, *CERTIFICATES, "--home", str(home))
    assert [one["state"] for one in planned if one["campaign"] == "check-bar"] == [
        f"B{k:02d}" for k in range(1, 8)
    ]
    with service(home):
        for campaign in ("check-bar", "check-plate"):
            work = ("job", "submit", "simulate", "reconstruct", "system-test", "-c", campaign)
            answer("job", "wait", *answer(*work, "--home", str(home))["jobs"], "--home", str(home))
    return home


def test_the_page_says_what_is_decided(tested: Path, tmp_path: Path) -> None:
    out = tmp_path / "check.html"
    report = ("calibration", "test", "report", "check-bar", "check-plate", "--home", str(tested))
    wide = ("--limit", "sphere-distance=0.1", "--limit", "flatness=0.5", "--limit", "probing-form=0.5")
    done = inside(*report, *wide, "-o", str(out))
    assert done.returncode == 0, done.stderr
    assert "conform" in done.stdout
    page = out.read_text(encoding="utf-8")
    for words in ("No conformity with a standard is claimed", "Conform:", "sphere-distance", "check-bar/B01"):
        assert words in page
    numbers = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    assert numbers["whole"]["decision"] == "conform"
    # 4 quantities at 7 positions of a bar, and one at 6 of a plate.
    assert len(numbers["values"]) == 4 * 7 + 6
    assert all(one["missing"] == "" for one in numbers["values"])
    assert [one["values"] for one in numbers["judgements"]] == [7, 6, 7]
    # Whoever signs knows which calibration was tested.
    tested_with = [one["number"] for source in numbers["sources"] for one in source["calibrations"]]
    assert tested_with == [1, 1]
    assert numbers["doubts"] == []
    assert "calibration tested" in page
    assert "What to look at before this is signed" not in page


def test_limits_decide(tested: Path) -> None:
    report = ("calibration", "test", "report", "check-bar", "--home", str(tested))
    # Spans of noise are tens of micrometres: not within one.
    refused = inside(*report, "--limit", "probing-form=0.001", "--json")
    assert refused.returncode == FINDINGS
    assert json.loads(refused.stdout)["whole"]["decision"] == "not conform"
    # What was not measured at all has no value, and so is undecided.
    open_ = inside(*report, "--limit", "flatness=0.5", "--json")
    assert open_.returncode == FINDINGS
    assert json.loads(open_.stdout)["whole"]["decision"] == "undecided"


def test_what_makes_no_sense_is_refused(tested: Path) -> None:
    report = ("calibration", "test", "report", "check-bar", "--home", str(tested))
    plan = ("calibration", "test", "plan", "small-session-rig", "--home", str(tested))
    for words, code, why in (
        ((*report, "--limit", "roundness=1"), USAGE, "no 'roundness' is tested"),
        ((*report, "--limit", "flatness"), USAGE, "a limit is a name and mm"),
        # Of a bar flatness has no value: its limit is looked at all the same.
        ((*report, "--limit", "flatness=nan"), USAGE, "the limit of flatness is above 0 mm, not nan"),
        ((*report, "--limit", "flatness=-1"), USAGE, "the limit of flatness is above 0 mm, not -1"),
        ((*report, "--limit", "length=0"), USAGE, "the limit of length is above 0 mm, not 0"),
        (
            (*report, "--limit", "length=0.05", "--limit", "length=1"),
            USAGE,
            "length has two limits, 0.05 and 1 mm; give it one",
        ),
        ((*report, "--limit", "flatness=1", "--risk", "0.9"), USAGE, "a risk is between 0 and 0.5"),
        ((*plan, "--name", "check", *CERTIFICATES), CONFLICT, "there is a campaign check-bar already"),
        ((*plan, "--name", "long", "--bar", "900,22", *OF_BAR), USAGE, "does not fit along X"),
        ((*plan, "--name", "none"), USAGE, "a test needs an artefact"),
        ((*plan, "--name", "odd", "--bar", "900"), USAGE, "--bar takes two numbers in mm"),
        (
            (*plan, "--name", "odd", "--bar", "150,22", "--bar-sigma", "0.005"),
            USAGE,
            "--bar-sigma takes two numbers in mm, as 0.005,0.002, not '0.005'",
        ),
        ((*plan, "--name", "odd", "--bar", "inf,22", *OF_BAR), USAGE, "not 22 and inf mm"),
        (
            (*plan, "--name", "odd", "--bar", "40,22", *OF_BAR),
            USAGE,
            "a distance above twice that, not 22 and 40 mm",
        ),
        ((*plan, "--name", "odd", "--plate", "0,0", *OF_PLATE), USAGE, "higher than 0 mm, not 0 x 0 mm"),
        ((*plan, "--name", "odd", "--plate=-10,20", *OF_PLATE), USAGE, "higher than 0 mm, not -10 x 20 mm"),
        (
            (*plan, "--name", "odd", "--plate", "nan,20", *OF_PLATE),
            USAGE,
            "higher than 0 mm, not nan x 20 mm",
        ),
        # What a certificate says of its own uncertainty cannot be left out: the artefact would be exact.
        ((*plan, "--name", "odd", "--bar", "150,22"), USAGE, "--bar needs --bar-sigma, the standard"),
        (
            (*plan, "--name", "odd", "--bar", "150,22", "--bar-sigma", "0.005,0.002"),
            USAGE,
            "--bar needs --bar-form-sigma, the standard uncertainty in mm that its certificate states",
        ),
        ((*plan, "--name", "odd", "--plate", "120,100"), USAGE, "--plate needs --plate-form-sigma, the"),
        (
            (*plan, "--name", "odd", "--plate", "120,100", "--bar-sigma", "0.005,0.002"),
            USAGE,
            "--bar-sigma 0.005,0.002 belongs to --bar, which is not given",
        ),
        (
            (*plan, "--name", "odd", "--bar", "150,22", "--plate-form-sigma", "0.002"),
            USAGE,
            "--plate-form-sigma 0.002 belongs to --plate, which is not given",
        ),
    ):
        done = inside(*words)
        assert done.returncode == code, (words, done.stderr)
        assert why in " ".join(done.stderr.split())


def test_an_artefact_that_counts_as_exact_is_told_before_anybody_signs(tested: Path) -> None:
    """An uncertainty of 0, as of plans that were made without, leaves a part out of u."""
    home = ("--home", str(tested))
    report = ("calibration", "test", "report", "check-bar", *home, "--limit", "sphere-distance=0.1", "--json")
    submit = ("job", "submit", "system-test", "-c", "check-bar", *home)
    before = json.loads(inside(*report).stdout)
    with service(tested):
        answer("job", "wait", *answer(*submit, "--set", "system-test.length_sigma_mm=0")["jobs"], *home)
        exact = inside(*report)
        answer("job", "wait", *answer(*submit)["jobs"], *home)
    assert exact.returncode == FINDINGS
    told = json.loads(exact.stdout)
    assert told["doubts"] == [
        (
            "the artefact of check-bar counts as exact in sphere-distance: length_sigma_mm is 0; submit "
            "system-test again with what its certificate states"
        )
    ]
    assert (
        "distance of spheres 150 mm taken as exact, radius 22 mm ± 0.002 mm"
        in told["sources"][0]["certificate"]
    )
    # A limit that rests on nothing certified as exact is judged without a word.
    again = json.loads(inside(*report).stdout)
    assert (again["doubts"], again["judgements"]) == ([], before["judgements"])


def test_another_calibration_is_told_before_anybody_signs(tested: Path, tmp_path: Path) -> None:
    """What was measured with the one before is no test of what holds now, whatever its errors are."""
    home, out = ("--home", str(tested)), tmp_path / "check.html"
    wide = ("--limit", "sphere-distance=0.1", "--limit", "flatness=0.5")
    report = ("calibration", "test", "report", "check-bar", "check-plate", *wide, *home)
    assert inside(*report).returncode == 0
    with bootstrap.services(tested) as services:
        before = calibrations.show(services, 1).calibration
        again = replace(before, valid_from=BEGIN, origin="of another day")
        register_calibration(services.catalogue, services.archive, again, datetime.now(UTC))
    # One that nobody has accepted changes nothing.
    assert inside(*report).returncode == 0
    assert inside("calibration", "accept", "2", "--reason", "newer", *home).returncode == 0

    stale = inside(*report, "-o", str(out))
    assert stale.returncode == FINDINGS
    for campaign in ("check-bar", "check-plate"):
        assert f"what is judged of {campaign} is not what would be measured now" in stale.stderr
    numbers = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    assert numbers["whole"]["decision"] == "conform"
    assert len(numbers["doubts"]) == 2
    assert "What to look at before this is signed" in out.read_text(encoding="utf-8")

    with service(tested):
        work = ("job", "submit", "reconstruct", "system-test", "-c", "check-plate", *home)
        answer("job", "wait", *answer(*work)["jobs"], *home)
    mixed = inside(*report)
    assert mixed.returncode == FINDINGS
    assert "what is judged of check-plate" not in mixed.stderr
    assert "the errors were measured with calibrations 1, 2" in mixed.stderr
