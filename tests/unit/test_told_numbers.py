"""How many there are of something, as people read it."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.command import inside
from support.homes import initialised, make_home

from sms_jobs.app.specimens.campaigns import example
from sms_jobs.records.sizes import number_of


@pytest.mark.parametrize(("count", "told"), [(0, "0 views"), (1, "1 view"), (2, "2 views")])
def test_one_thing_is_told_in_the_singular(count: int, told: str) -> None:
    assert number_of(count, "view") == told


def test_a_campaign_of_one_state_and_view_says_so(home: Path, tmp_path: Path) -> None:
    initialised(home)
    text = example().replace('["C1P1", "C2P1"]', '["C1P1"]')
    first, second = text.index("[[states]]"), text.index("# Parameters of job kinds")
    one = text[first : text.index("[[states]]", first + 1)]
    (tmp_path / "plan.toml").write_text(text[:first] + one + text[second:])
    made = inside("campaign", "create", str(tmp_path / "plan.toml"), "--home", str(home))
    assert made.stderr.startswith("campaign plate-tension has 1 state and 1 view; next: ")
    submitted = inside("job", "submit", "simulate", "-c", "plate-tension", "--home", str(home))
    assert submitted.stderr.startswith("submitted 1 job: 1 simulate\n")
    listed = inside("job", "list", "-c", "plate-tension", "--home", str(home))
    assert listed.stderr.startswith("1 job of plate-tension has not ended: ")
    cancelled = inside("job", "cancel", "-c", "plate-tension", "--home", str(home))
    assert cancelled.stderr == "cancelled 1 job\n"


def test_a_list_without_jobs_says_whether_some_were_left_out(home: Path) -> None:
    initialised(home)
    listed = inside("job", "list", "--home", str(home))
    assert listed.stderr == "there are no jobs yet; 'sms job submit' makes some\n"
    make_home(home, {})
    listed = inside("job", "list", "-c", "plate", "--home", str(home))
    assert listed.stderr == "there are no jobs of plate yet; 'sms job submit' makes some\n"
    assert inside("job", "list", "--kind", "mesh", "--home", str(home)).stderr == "there is no such job\n"


def test_who_has_no_home_yet_is_told_how_to_make_that_one(home: Path, tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.touch()
    for at, said in (
        (home, f"there is no catalogue at {home}/catalogue.sqlite; run 'sms init --home {home}'"),
        (tmp_path / "none", f"run 'sms init --home {tmp_path}/none'"),
        (plan, f"{plan} is no folder, and a home is one; give another --home"),
    ):
        refused = inside("campaign", "list", "--home", str(at))
        assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
        assert refused.stderr.endswith(f"{said}\n")


def test_an_archive_without_files_says_so(home: Path) -> None:
    initialised(home)
    found = inside("data", "find", "--home", str(home))
    assert found.stderr == "there is no file yet; 'sms campaign create' and 'sms import' make some\n"
    assert inside("data", "find", "--kind", "mesh", "--home", str(home)).stderr == "there is no such file\n"


def test_a_kind_that_there_is_not_is_no_empty_list(home: Path) -> None:
    initialised(home)
    refused = inside("job", "list", "--kind", "meshes", "--home", str(home))
    assert refused.returncode == 2
    assert "there is no job kind 'meshes'; did you mean 'mesh'; choose one of acquire, " in refused.stderr


def test_waiting_for_what_has_ended_does_not_say_that_there_is_nothing(home: Path) -> None:
    make_home(home, {})
    waited = inside("job", "wait", "-c", "plate", "--home", str(home))
    assert (waited.returncode, waited.stderr) == (0, "no job is active\n")


def test_a_worker_that_there_is_not_is_said_to_be_none(home: Path) -> None:
    initialised(home)
    refused = inside("worker", "drain", "3f2a", "--home", str(home))
    assert refused.returncode == 3
    assert "there is no worker '3f2a'; 'sms worker list' shows them" in refused.stderr
