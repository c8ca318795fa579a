"""What a person sees of reuse and of failure; the same on every deployment, so tried on one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.command import answer, inside, service
from support.homes import make_home


@pytest.fixture
def plate(home: Path) -> Path:
    """A home with the small plate in it."""
    make_home(home, {})
    return home


def run(home: Path, *arguments: str) -> Any:
    return answer(*arguments, "--home", str(home))


def test_a_changed_parameter_computes_again_only_what_depends_on_it(plate: Path) -> None:
    with service(plate):
        first = run(plate, "job", "submit", "simulate", "pipeline", "-c", "plate")
        assert first["estimate"]["seconds"] is None  # nothing has run here yet
        run(plate, "job", "wait", *first["jobs"])
        again = ("job", "submit", "pipeline", "-c", "plate", "--set", "strain.gauge_length_mm=30")
        tried = run(plate, *again, "--dry-run")
        changed = run(plate, *again)
        run(plate, "job", "wait", *changed["jobs"])
    jobs = {job["id"]: job for job in run(plate, "job", "list", "--limit", "1000")}
    reused = {jobs[i]["kind"] for i in changed["jobs"] if jobs[i]["reused_from"]}
    computed = {jobs[i]["kind"] for i in changed["jobs"] if not jobs[i]["reused_from"]}
    assert {"reconstruct", "correlate"} <= reused
    assert "strain" in computed
    # A dry run submits nothing, and foretells what is reused and how long the rest takes.
    assert len(jobs) == len(first["jobs"]) + len(changed["jobs"])
    assert sum(tried["jobs"].values()) == len(changed["jobs"])
    assert tried["estimate"]["reused"] == sum(bool(jobs[i]["reused_from"]) for i in changed["jobs"])
    assert tried["estimate"]["seconds"] > 0.0
    assert tried["estimate"]["unknown"] == {}
    strain = next(i for i in changed["jobs"] if jobs[i]["kind"] == "strain")
    why = run(plate, "job", "explain", strain)["explanation"]
    assert any("gauge_length_mm was not given, now 30.0" in sentence for sentence in why)


def test_a_failed_job_says_why_and_the_rest_goes_on(plate: Path) -> None:
    with service(plate):
        run(plate, "job", "wait", *run(plate, "job", "submit", "simulate", "-c", "plate")["jobs"])
        (damaged,) = run(plate, "data", "find", "--kind", "measurement", "--state", "S01", "--view", "C1P1")
        path = plate / "archive" / damaged["path"]
        path.write_bytes(path.read_bytes()[:5000])
        jobs = run(plate, "job", "submit", "pipeline", "-c", "plate")["jobs"]
        done = inside("job", "wait", *jobs, "--home", str(plate))
    assert done.returncode == 5
    assert "reconstruct plate/S01/C1P1" in done.stderr
    assert done.stderr.count("\n") <= 2
    counted = run(plate, "status")["jobs"]
    assert counted["failed"] >= 1
    assert counted["skipped"] >= 1
    assert counted["succeeded"] > 3  # the reference state and the other view


def test_a_job_that_finds_nothing_says_so(plate: Path) -> None:
    blind = ("--set", "reconstruct.minimum_modulation_to_noise=1e6", "--state", "S00", "--view", "C1P1")
    with service(plate):
        run(plate, "job", "wait", *run(plate, "job", "submit", "simulate", "-c", "plate")["jobs"])
        done = inside("job", "submit", "reconstruct", "-c", "plate", *blind, "--wait", "--home", str(plate))
        again = run(plate, "job", "submit", "reconstruct", "-c", "plate", *blind)["jobs"]
        waited = run(plate, "job", "wait", *again)
    assert done.returncode == 0
    said = "reconstruct plate/S00/C1P1: nothing valid: of the lit pixels are lost 100% by low modulation"
    assert "1 ended with nothing valid" in done.stderr
    assert "succeeded" not in done.stderr
    assert said in done.stderr
    # A result that is reused is as empty.
    assert waited["nothing_valid"]["jobs"] == 1
    assert waited["nothing_valid"]["latest"].startswith(said)
    why = run(plate, "job", "explain", *again)["explanation"]
    assert any(sentence.startswith("nothing valid") for sentence in why)
    # Nobody waits for what a schedule submits: the list of jobs tells it, too.
    first = next(job for job in run(plate, "job", "list", "--kind", "reconstruct") if not job["reused_from"])
    assert f"s; {said.partition(': ')[2]}" in first["message"]


def test_what_is_not_there_to_be_done_or_shown_is_said_once(plate: Path) -> None:
    nothing = inside(
        "job", "submit", "relative", "-c", "plate", "--state", "S00", "--wait", "--home", str(plate)
    )
    assert nothing.returncode == 2
    assert "relative needs the parameter 'region': of the reference image" in nothing.stderr
    region = ("--region", "rectangle 30 30 60 60")
    nothing = inside(
        *("job", "submit", "relative", "-c", "plate", "--state", "S00", *region, "--wait"),
        *("--home", str(plate)),
    )
    assert (nothing.returncode, nothing.stderr) == (0, "there is nothing to do\n")
    missing = inside("data", "gauges", "-c", "plate", "--view", "C2P1", "--home", str(plate))
    assert missing.returncode == 3
    assert "campaign plate has no virtual gauges in view C2P1; 'sms job submit gauges" in missing.stderr


def test_who_waits_for_a_rig_that_nobody_has_is_told(plate: Path) -> None:
    (job,) = run(plate, "acquire", "run", "plate", "--state", "S00", "--no-wait")["jobs"]
    waited = inside("job", "wait", job, "--timeout", "2", "--home", str(plate))
    assert waited.returncode == 124
    rig = run(plate, "campaign", "show", "plate")["campaign"]["rig"]
    said = f"no worker serves the queue rig-{rig}: start 'sms up', for a rig on its host\n"
    assert waited.stderr.count(f"waiting, with no end in sight: {said}") == 1


def test_a_match_that_finds_nothing_says_why_and_what_hides_the_rest(home: Path) -> None:
    folder = home.parent / "grid"
    folder.mkdir()
    rows, columns = np.mgrid[0:96, 0:96]
    for number in range(2):
        wave = np.cos(2.0 * np.pi * (rows + 0.3 * number) / 9.0) * np.cos(2.0 * np.pi * columns / 9.0)
        Image.fromarray(np.rint(128.0 + 90.0 * wave).astype(np.uint8)).save(folder / f"grid_{number}.png")
    run(home, "init")
    run(home, "import", "images", str(folder), "-c", "grid", "--camera", "C1", "--yes")
    with service(home):
        done = inside(
            "job", "submit", "plane", "correlate", "strain", "-c", "grid", "--wait", "--home", str(home)
        )
        (correlate,) = [job for job in run(home, "job", "list") if job["kind"] == "correlate"]
        written = run(home, "job", "submit", "merge", "export", "-c", "grid")["jobs"]
        first = run(home, "job", "wait", *written)
        assert first["jobs"]["succeeded"] == 2
        (export,) = [job for job in run(home, "job", "list") if job["kind"] == "export"]
        again = inside("job", "submit", "export", "-c", "grid", "--wait", "--home", str(home))
    # The strain that is made of it is as empty, and its own result knows no reason.
    assert "2 ended with nothing valid" in done.stderr
    assert "correlate grid/1/C1: nothing valid: of the points are lost" in done.stderr
    assert "by ambiguous texture" in done.stderr
    why = run(home, "job", "explain", correlate["id"])["explanation"]
    assert any("by ambiguous texture" in sentence for sentence in why)
    # Nor has it anything for other programs, which is no failure.
    said = "nothing to export of grid-1-C1, where no square of pixels has values"
    assert f"; note: {said}" in export["message"]
    # Who waits is told so without looking for it, also where the result is reused.
    assert first["remarks"] == [{"kind": "export", "jobs": 1, "first": [f"grid/1: {said}"]}]
    assert f"note: export grid/1: {said}\n" in again.stderr
    assert run(home, "data", "find", "--kind", "export") == []
