"""A region that leaves no pixel of its image is refused when it is given, and so are values of no export."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.command import answer, inside
from support.homes import make_home, stored
from support.report_results import records_for

from sms_jobs import bootstrap
from sms_jobs.kinds.kind import MEASUREMENT, Port
from sms_jobs.records.subject import Subject

USAGE = 2
SCHEDULED = ("schedule", "add", "nightly", "--every", "1h")


@pytest.fixture
def home(home: Path) -> Path:
    make_home(home, {})
    return home


def refused(home: Path, *given: str) -> set[str]:
    """Submit and schedule; return what is said, where nothing is there afterwards."""
    said = set()
    for words in (("job", "submit"), SCHEDULED):
        done = inside(*words, *given, "-c", "plate", "--home", str(home))
        assert done.returncode == USAGE
        said.add(done.stderr.strip())
    for what in ("job", "schedule"):
        assert answer(what, "list", "--home", str(home)) == []
    return said


def test_a_region_outside_of_the_image_is_refused(home: Path) -> None:
    region = "rectangle 5000 10 6000 20"
    # What nobody has recorded yet is as large as the virtual rig's camera.
    given = ("simulate", "pipeline", "--set", f"correlate.region_of_interest={region}")
    (said,) = refused(home, *given)
    assert f"the region of interest '{region}' leaves no pixel of plate/S01/C1P1, whose image has " in said
    assert said.endswith(" px; give outlines inside it")
    inside_it = [word.replace("5000", "5") for word in given]
    done = inside("job", "submit", *inside_it, "-c", "plate", "--dry-run", "--home", str(home))
    assert done.returncode == 0


def test_what_is_recorded_says_how_large_the_image_is(home: Path) -> None:
    at_rest = Subject("plate", "S00", "C1P1")
    measured = records_for(Port("", MEASUREMENT, ()).of(at_rest), (45, 60))["measurement"]
    with bootstrap.services(home) as services:
        stored(services, MEASUREMENT, str(at_rest), {"measurement": measured})
    # Of the 60 x 45 px nothing is left.
    given = ("--view", "C1P1", "--set", "correlate.region_of_interest=- rectangle 0 0 59 44")
    (said,) = refused(home, "simulate", "pipeline", *given)
    assert "leaves no pixel of plate/S01/C1P1, whose image has 60 x 45 px; give outlines inside it" in said


def test_values_of_no_export_are_refused(home: Path) -> None:
    (said,) = refused(home, "simulate", "pipeline", "--set", "export.fields=displacement X,strian xx")
    assert "there is no value 'strian xx'; did you mean 'strain xx'; choose among displacement X," in said


def test_a_schedule_with_a_question_is_refused_where_no_campaign_can_do_it(home: Path) -> None:
    region = "correlate.region_of_interest=rectangle 5000 10 6000 20"
    given = ("simulate", "pipeline", "--where", "campaign = plate", "--home", str(home), "--set")
    done = inside(*SCHEDULED, *given, region)
    assert done.returncode == USAGE
    assert "leaves no pixel of plate/S01/C1P1" in done.stderr
    assert inside(*SCHEDULED, *given, region.replace("5000", "5")).returncode == 0
