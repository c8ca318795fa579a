"""Named runs: what they name, keep and differ by, on both deployments."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from support.archives import Clock, runner
from support.deployments import Deployment
from support.homes import make_home
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.app.holdings import reading
from sms_jobs.app.work import found_work, jobs, new_jobs, run_comparison, runs, schedules
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.bootstrap import Services
from sms_jobs.cli.app import app
from sms_jobs.errors import Conflict, InvalidInput, NotFound, SmsError
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.keeping import retention
from sms_jobs.jobs.running import recovery
from sms_jobs.jobs.scheduling import firing
from sms_jobs.records.fields import DisplacementField
from sms_jobs.records.shown.runs import Difference
from sms_jobs.virtual_rig.campaigns import small_plate

VIEW = "C1P1"
TUPLE = f"plate/S01/{VIEW}"
KINDS = ("simulate", "reconstruct", "correlate", "strain", "gauges")
GAUGE = {"gauges.gauge": "G1 x=0 y=0 length=40 width=30"}
RADIUS = {"correlate.subset_radius_px": 8}
NO_AGE = timedelta(0)


@pytest.fixture
def desk(deployment: Deployment) -> Iterator[Services]:
    """A home of one campaign, for whose jobs nobody is there yet."""
    make_home(deployment.home, deployment.environment)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in deployment.environment.items():
            patch.setenv(name, value)
        with bootstrap.services(deployment.home) as services:
            with services.catalogue.writing() as session:
                queues = ["cpu", "io", "acquisition"]
                recovery.register_worker(session, "w1", "here", 1, queues, 1, datetime.now(UTC))
            yield services


def work(run: str | None, parameters: dict[str, Any] | None = None, kinds: tuple[str, ...] = KINDS) -> Work:
    given = GAUGE if "gauges" in kinds else {}
    return Work("plate", kinds, given | (parameters or {}), views=(VIEW,), run=run)


def computed(services: Services, *asked: Work) -> None:
    """Submit work and run all of it in this process."""
    for one in asked:
        new_jobs.submit(services, one)
        runner(services.catalogue, services.archive, Clock()).run_queued()


@pytest.fixture
def compared(desk: Services) -> Services:
    """A home with two runs, the second with other subsets."""
    computed(desk, work("today"), work("wider", RADIUS, KINDS[1:]))
    return desk


def files(services: Services, run: str) -> dict[tuple[str, str], tuple[int, ...]]:
    return {(one.kind, one.subject): one.files for one in runs.show(services, run).results}


def removable(services: Services) -> set[int]:
    with services.catalogue.reading() as session:
        return {one.file_id for one in retention.removable(session, datetime.now(UTC), NO_AGE)}


def test_a_run_names_what_was_made_and_what_was_reused(compared: Services) -> None:
    today, wider = files(compared, "today"), files(compared, "wider")
    assert len(today["correlate", TUPLE]) == 1
    shape = ("reconstruct", f"plate/S00/{VIEW}")
    assert today[shape] == wider[shape]
    for kind in ("correlate", "strain", "gauges"):
        assert set(today[kind, TUPLE]).isdisjoint(wider[kind, TUPLE])
    story = runs.show(compared, "wider")
    assert story.parameters == GAUGE | RADIUS
    assert story.missing == {}
    assert story.run.jobs == {"succeeded": len(story.results)}
    (reused,) = (one for one in story.results if (one.kind, one.subject) == shape)
    assert reused.made_by != reused.job
    assert reused.calibrations
    assert [one.name for one in runs.list_runs(compared)] == ["wider", "today"]


def test_what_differs_is_what_the_fields_say(compared: Services) -> None:
    found = run_comparison.compare_runs(compared, "today", "wider")
    (change,) = found.changes
    assert (change.what, change.kind, change.name) == ("parameter", "correlate", "subset_radius_px")
    assert (change.after, change.results, change.intended) == (8, 1, True)
    assert found.only_before == {"simulate": 2}
    by_name = {(one.subject, one.quantity): one for one in found.differences}
    assert {quantity for _, quantity in by_name} == {
        *(f"displacement {axis}" for axis in "XYZ"),
        *(f"strain {axis}" for axis in ("xx", "yy", "xy")),
        "gauge G1",
    }
    before, after = (_displacement(compared, run) for run in ("today", "wider"))
    for k, axis in enumerate("XYZ"):
        one = by_name[TUPLE, f"displacement {axis}"]
        old, new = before.displacement[k], after.displacement[k]
        # The variances of X, Y, Z are components 0, 3 and 5 of the packed tensor.
        place = (0, 3, 5)[k]
        spread = np.sqrt(before.covariance[place].astype(float) + after.covariance[place])
        known = np.isfinite(old) & np.isfinite(new)
        change_mm = (new - old)[known]
        assert one.points == np.count_nonzero(known) > 1000
        assert one.gained == np.count_nonzero(np.isfinite(new) & ~known)
        assert one.lost == np.count_nonzero(np.isfinite(old) & ~known)
        # Sums of up to 16384 float64 in another order: each rounding is 1.1e-16 of the partial sum.
        assert one.rms == pytest.approx(np.sqrt(np.mean(change_mm**2)), rel=1e-11)
        assert one.largest == np.abs(change_mm).max() > 0.0
        assert one.median == np.median(change_mm)
        # Standard deviations come as float32 roots: 6e-8 each.
        assert one.sigma == pytest.approx(np.sqrt(np.mean(spread[known] ** 2)), rel=1e-6)
        judged = np.abs(change_mm) > 2.0 * spread[known]
        assert one.beyond == pytest.approx(judged.mean(), abs=1.0 / one.points)


def _displacement(services: Services, run: str) -> DisplacementField:
    (number,) = files(services, run)["correlate", TUPLE]
    record = reading.of_file(services, str(number), "displacement")
    with services.archive.open(record.file) as dataset:
        return dataset.read("displacement", DisplacementField)


def test_a_page_shows_where(compared: Services) -> None:
    page = run_comparison.compare_runs_page(compared, "today", "wider")
    assert "change of displacement X" in page.html
    assert "change of strain xx" in page.html
    assert "correlate.subset_radius_px" in page.html
    assert page.html.count('class="view"') == 1
    assert page.comparison == run_comparison.compare_runs(compared, "today", "wider")
    assert run_comparison.table(page.comparison).count("\n") == 1 + len(page.comparison.differences)


def test_the_command_shows_changes_and_differences(compared: Services) -> None:
    home = compared.settings.home
    words = ["run", "compare", "today", "wider", "--home", str(home)]
    done = CliRunner(env={"COLUMNS": "200"}).invoke(
        app, [*words, "-o", str(home / "page.html"), "--limit", "4"]
    )
    assert done.exit_code == 0, (done.exception, done.stderr)
    titles, first = (
        line.split() for line in done.stdout.splitlines() if line.startswith(("changed", "parameter"))
    )
    assert titles[:2] == ["changed", "of"]
    assert first == ["parameter", "correlate.subset_radius_px", "10", "8", "1", "yes"]
    rows = [line.split() for line in done.stdout.splitlines() if line.startswith(TUPLE)]
    assert len(rows) == 4
    one = run_comparison.compare_runs(compared, "today", "wider").differences[0]
    assert rows[0][:4] == [TUPLE, "displacement", "X", "mm"]
    assert [float(cell) for cell in rows[0][4:7]] == [one.points, one.gained, one.lost]
    shown = [one.rms, one.median, one.largest, one.sigma, None if one.beyond is None else 100 * one.beyond]
    # Numbers are shown with four digits.
    assert [float(cell) for cell in rows[0][7:]] == [pytest.approx(value, rel=5e-4) for value in shown]
    assert "3 more differences" in done.stderr
    assert "only today has 2 simulate" in done.stderr
    assert (home / "page.html").stat().st_size > 10_000


def test_two_runs_of_one_result_do_not_differ(compared: Services) -> None:
    computed(compared, work("again", {}, KINDS[1:]))
    found = run_comparison.compare_runs(compared, "today", "again")
    assert (found.changes, found.differences, found.same) == ((), (), 3)
    with pytest.raises(InvalidInput, match="with itself"):
        run_comparison.compare_runs(compared, "today", "today")


def test_a_kept_run_is_not_removed_and_takes_no_more(compared: Services) -> None:
    computed(compared, work(None, {"correlate.subset_radius_px": 9}, KINDS[1:]))
    named = {number for some in files(compared, "wider").values() for number in some}
    older = removable(compared)
    assert older & named
    story = runs.keep(compared, "wider", "figure 4")
    assert (story.run.reason, story.removed) == ("figure 4", 0)
    assert not removable(compared) & named
    before = jobs.remaining(compared).active, len(jobs.list_jobs(compared))
    with pytest.raises(Conflict, match="takes no more jobs"):
        new_jobs.submit(compared, work("wider"))
    assert (jobs.remaining(compared).active, len(jobs.list_jobs(compared))) == before
    with pytest.raises(Conflict, match="already kept"):
        runs.keep(compared, "wider", "")
    runs.drop(compared, "wider")
    assert removable(compared) == older
    with pytest.raises(NotFound, match="the latest are today"):
        runs.show(compared, "wider")


def test_what_a_policy_removed_is_said_and_not_subtracted(compared: Services) -> None:
    computed(compared, work(None, {"correlate.subset_radius_px": 9}, KINDS[1:]))
    gone = retention.remove(compared.catalogue, compared.archive, datetime.now(UTC), NO_AGE)
    assert gone
    assert runs.show(compared, "wider").removed == 3
    found = run_comparison.compare_runs(compared, "today", "wider")
    assert found.differences == ()
    assert [one.name for one in found.changes] == ["subset_radius_px"]
    assert (found.same, len(found.unlike)) == (0, 3)
    assert all("removed by a policy" in why for why in found.unlike)


def test_what_cannot_be_changes_nothing(desk: Services) -> None:
    for name in ("", "a b", "../up", "-x", "x" * 65):
        with pytest.raises(InvalidInput, match="name of a run"):
            new_jobs.submit(desk, work(name))
    calls: list[Any] = [
        lambda: runs.show(desk, "none"),
        lambda: runs.keep(desk, "none", ""),
        lambda: runs.drop(desk, "none"),
        lambda: run_comparison.compare_runs(desk, "none", "other"),
    ]
    for call in calls:
        with pytest.raises(NotFound, match="there is no run 'none'"):
            call()
    assert jobs.list_jobs(desk) == []
    assert runs.list_runs(desk) == []
    new_jobs.submit(desk, work("some"), dry_run=True)
    assert runs.list_runs(desk) == []
    new_jobs.submit(desk, work("some"))
    with pytest.raises(Conflict, match="have not ended"):
        runs.keep(desk, "some", "")
    story = runs.show(desk, "some")
    assert story.results == ()
    assert len(story.missing) == sum(story.run.jobs.values())


def test_several_begin_one_run_together(desk: Services) -> None:
    with ThreadPoolExecutor(4) as pool:
        done = list(pool.map(lambda _: new_jobs.submit(desk, work("one")), range(4)))
    (run,) = runs.list_runs(desk)
    assert run.submissions == 4
    assert sum(run.jobs.values()) == sum(len(one.job_ids) for one in done)


@pytest.fixture
def two_campaigns(desk: Services) -> Services:
    calibration, other = small_plate("other")
    register_campaign(desk.catalogue, desk.archive, other, calibration, datetime.now(UTC))
    return desk


def test_what_meets_a_question_is_submitted_across_campaigns(two_campaigns: Services) -> None:
    asked = Work("", ("simulate",), run="both")
    done = found_work.submit_found(two_campaigns, "load > 1 kN", asked)
    assert set(done.campaigns) == {"plate", "other"}
    assert done.counted == {"simulate": 2}
    (run,) = runs.list_runs(two_campaigns)
    assert (set(run.campaigns), run.submissions) == ({"plate", "other"}, 2)
    # Of a campaign of which all states are meant, what is about the campaign comes with it.
    whole = found_work.submit_found(two_campaigns, "campaign = plate", Work("", ("simulate", "pipeline")))
    assert list(whole.campaigns) == ["plate"]
    assert whole.counted["report"] == 1
    part = found_work.submit_found(two_campaigns, "state = S01", Work("", ("simulate", "pipeline")))
    assert "report" not in part.counted


@pytest.mark.parametrize(
    ("where", "asked", "error"),
    [
        ("load > 1 MN", Work("", ("simulate",)), NotFound),
        ("nothing > 1", Work("", ("simulate",)), InvalidInput),
        ("load > 1 kN", Work("plate", ("simulate",)), InvalidInput),
        ("load > 1 kN", Work("", ("strain",)), NotFound),
        ("load > 1 kN", Work("", ("simulate",), run="a b"), InvalidInput),
    ],
)
def test_a_question_that_finds_nothing_submits_nothing(
    two_campaigns: Services, where: str, asked: Work, error: type[SmsError]
) -> None:
    with pytest.raises(error):
        found_work.submit_found(two_campaigns, where, asked)
    assert jobs.list_jobs(two_campaigns) == []


def test_a_schedule_has_a_run_for_each_time(two_campaigns: Services) -> None:
    asked = Work("", ("simulate",), run="nightly")
    schedules.add(two_campaigns, "n", "every 1h", asked, where="load > 1 kN")
    begun = datetime.now(UTC)
    for hours in (1.01, 2.01):
        (fired,) = firing.fire_due(two_campaigns.catalogue, begun + timedelta(hours=hours))
        assert fired.outcome == "submitted 2 jobs"
    found = runs.list_runs(two_campaigns)
    assert len(found) == 2
    assert all(one.name.startswith("nightly-2") and one.created_by == "schedule n" for one in found)
    assert all(one.jobs == {"queued": 2} for one in found)
    schedules.add(two_campaigns, "once", f"at {begun:%Y-%m-%dT%H:%M}", asked, zone="UTC", where="load > 1 kN")
    firing.fire_due(two_campaigns.catalogue, begun + timedelta(seconds=60))
    assert "nightly" in {one.name for one in runs.list_runs(two_campaigns)}
    with pytest.raises(InvalidInput, match="name of a run"):
        schedules.add(two_campaigns, "bad", "every 1h", Work("plate", ("simulate",), run="x" * 60))


def test_differences_are_told_with_all_that_a_row_has() -> None:
    one = Difference("a/b/c", "strain xx", "µε", (1, 2), 3, 0, 1, 0.5, -0.25, 1.0, None, None)
    found = run_comparison.RunComparison("a", "b", (), (one,), 0)
    assert run_comparison.table(found).splitlines() == [
        "subject,quantity,unit,points,gained,lost,rms,median,largest,sigma,beyond,file_before,file_after",
        "a/b/c,strain xx,µε,3,0,1,0.5,-0.25,1.0,,,1,2",
    ]
