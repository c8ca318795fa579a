"""What others bring, and what is calibrated later, changes nothing that was measured before."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import select
from support.archives import Clock, everything, rebuilt, registered, run_jobs, runner

from sms_jobs import bootstrap
from sms_jobs.archive import Archive, Checker, FolderStore, InputReference
from sms_jobs.catalogue import search
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.errors import Conflict, InvalidInput, NotFound
from sms_jobs.instruments.simulated.rig import SimulatedRig
from sms_jobs.jobs.archiving import acceptances, calibration_choice
from sms_jobs.jobs.archiving.importing import import_measurement
from sms_jobs.jobs.archiving.registration import Registered, register_calibration, register_campaign
from sms_jobs.jobs.asking import explanation
from sms_jobs.jobs.keeping import repair
from sms_jobs.jobs.keeping.verification import check_known
from sms_jobs.jobs.planning.chosen import by_ids
from sms_jobs.jobs.planning.estimates import estimate
from sms_jobs.jobs.planning.foreseen import foreseen_reuse
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.portable import packing, unpacking
from sms_jobs.jobs.portable.packing import PackOptions
from sms_jobs.jobs.running import recovery
from sms_jobs.records.calibration import Signed
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate

MORNING = datetime(2026, 3, 1, 8, 0, tzinfo=UTC)  # of the day at whose noon the clock of these tests begins
SHAPES = [Request("reconstruct", states=("S00",))]


@pytest.fixture(scope="module")
def checker() -> Iterator[Checker]:
    with Checker() as reader:
        yield reader


def other(calibration: Calibration, number: int, **changes: object) -> Calibration:
    """Return a calibration of the same sensors with other lenses."""
    sensors = tuple(
        replace(s, intrinsics=replace(s.intrinsics, fx=s.intrinsics.fx * (1.01 + 0.001 * number)))
        for s in calibration.rig.sensors
    )
    return replace(calibration, rig=replace(calibration.rig, sensors=sensors), **changes)  # type: ignore[arg-type]


def larger(calibration: Calibration) -> Calibration:
    """Return a calibration whose camera has more pixels."""
    first, *others = calibration.rig.sensors
    sensors = (replace(first, columns=2 * first.columns), *others)
    return replace(calibration, rig=replace(calibration.rig, sensors=sensors))


def real_test(name: str, states: int = 2) -> tuple[Calibration, Campaign]:
    """Return a test on a rig that has its calibration from elsewhere; its states are held when they are."""
    calibration, campaign = small_plate(name)
    labels = tuple(replace(campaign.states[0], label=f"S{n:02}", time=None) for n in range(states))
    return (
        replace(calibration, valid_from=MORNING - timedelta(days=1)),
        replace(campaign, states=labels, views=campaign.views[:1]),
    )


def record(
    catalogue: Catalogue, archive: Archive, campaign: Campaign, label: str, minutes: float, clock: Clock
) -> None:
    """Bring in what a view recorded so many minutes after eight."""
    assert campaign.scene is not None
    at = MORNING + timedelta(minutes=minutes)
    rig = SimulatedRig(campaign.scene, label, (), at, 1)
    subject = Subject(campaign.name, label, campaign.views[0])
    measurement = rig.record(campaign.views[0], campaign.sequence)
    import_measurement(catalogue, archive, subject, measurement, f"{subject} {at}", {}, clock())


def calibrations_of(catalogue: Catalogue, jobs: tuple[str, ...]) -> set[str]:
    """Return the contents of the calibrations that jobs were given."""
    with catalogue.reading() as session:
        query = (
            select(FileRow.content_hash)
            .join(DependencyRow, DependencyRow.file_id == FileRow.id)
            .where(DependencyRow.source == "calibration", DependencyRow.job_id.in_(jobs))
        )
        return set(session.scalars(query))


def stale(catalogue: Catalogue, jobs: tuple[str, ...], clock: Clock) -> list[str]:
    """Return what is said of jobs whose result is not the newest any more."""
    now = clock()
    with catalogue.reading() as session:
        rows = [session.get_one(JobRow, job) for job in jobs]
        told = [line for row in rows for line in explanation.explain(session, row, now)]
    return [line for line in told if "stale" in line]


def reused(
    catalogue: Catalogue, archive: Archive, clock: Clock, campaign: str, jobs: tuple[str, ...]
) -> None:
    """Submit a campaign's shapes again, and see that estimate and runner both come to no work at all."""
    assert stale(catalogue, jobs, clock) == []
    with catalogue.writing() as session:
        again = submit(session, campaign, SHAPES, clock()).job_ids
        assert foreseen_reuse(session, again) == set(again)
        assert estimate(session, by_ids(again), clock(), 1).reused == len(again)
    runner(catalogue, archive, clock).run_queued()
    with catalogue.reading() as session:
        assert all(session.get_one(JobRow, job).reused_from for job in again)
    assert calibrations_of(catalogue, again) == calibrations_of(catalogue, jobs)


def work(catalogue: Catalogue, clock: Clock) -> None:
    with catalogue.writing() as session:
        recovery.register_worker(session, "w1", "here", 1, ["cpu", "io", "acquisition"], 2, clock())


def packed(folder: Path, number: int, checker: Checker) -> Path:
    """Return a folder that a stranger has packed: a campaign of a rig of the same name as ours."""
    bootstrap.initialise(folder / "theirs")
    calibration, campaign = real_test(f"stranger-{number}")
    catalogue, archive = (
        Catalogue(f"sqlite:///{folder}/theirs/catalogue.sqlite"),
        Archive(FolderStore(folder / "theirs/archive")),
    )
    at = MORNING + timedelta(seconds=number)
    register_campaign(catalogue, archive, campaign, None, at)
    register_calibration(catalogue, archive, other(calibration, number), at)
    options = PackOptions(campaign.name)
    with catalogue.reading() as session:
        parts = packing.chosen(session, options, MORNING)
    out = folder / "packed"
    packing.begin(out, options, parts)
    files = [one for part in parts for one in packing.bring(archive, out, options, part, checker)]
    packing.finish(catalogue, archive, out, options, files, MORNING)
    catalogue.close()
    return out


def unpack(
    catalogue: Catalogue, archive: Archive, folder: Path, now: datetime, checker: Checker
) -> list[str]:
    manifest = unpacking.manifest_of(folder)
    done = unpacking.enter(catalogue, archive, folder, manifest, now, checker=checker)
    return [f"{one.outcome} {one.detail}".strip() for one in done]


def bring_foreign(
    catalogue: Catalogue, archive: Archive, folder: Path, number: int, now: datetime, checker: Checker
) -> None:
    """Make a plan of a rig of the same name, import a calibration of it, or unpack a folder with one."""
    calibration, campaign = small_plate(f"foreign-{number}")
    changed = other(calibration, number, valid_from=MORNING + timedelta(seconds=number))
    if number % 3 == 0:
        assert campaign.scene is not None
        plan = replace(campaign, scene=replace(campaign.scene, rig=changed.rig))
        register_campaign(catalogue, archive, plan, changed, now)
    elif number % 3 == 1:
        assert not register_calibration(catalogue, archive, changed, now).in_use
    else:
        done = unpack(catalogue, archive, packed(folder / str(number), number, checker), now, checker)
        assert set(done) == {"indexed"}


@pytest.mark.parametrize("many", [6, pytest.param(100, marks=pytest.mark.long)])
def test_plans_imports_and_folders_of_others_change_no_result(
    many: int, catalogue: Catalogue, archive: Archive, clock: Clock, tmp_path: Path, checker: Checker
) -> None:
    registered(catalogue, archive, clock, "virtual")
    calibration, campaign = real_test("real", states=1)
    register_campaign(catalogue, archive, campaign, None, clock())
    assert register_calibration(catalogue, archive, calibration, clock()).in_use
    record(catalogue, archive, campaign, "S00", 0, clock)
    run_jobs(catalogue, archive, clock, [Request("simulate", states=("S00",))], "virtual")
    ours = {name: run_jobs(catalogue, archive, clock, SHAPES, name) for name in ("virtual", "real")}
    before = {name: calibrations_of(catalogue, jobs) for name, jobs in ours.items()}
    changed = 0
    for number in range(many):
        bring_foreign(catalogue, archive, tmp_path, number, clock(), checker)
        for name in ours:
            with catalogue.writing() as session:
                planned = submit(session, name, SHAPES, clock()).job_ids
                changed += foreseen_reuse(session, planned) != set(planned)
                session.rollback()
            changed += stale(catalogue, ours[name], clock) != []
    assert changed == 0
    for name, jobs in ours.items():
        assert len(before[name]) == 1
        reused(catalogue, archive, clock, name, jobs)
    # A catalogue that is rebuilt comes to the same decisions.
    told = everything(catalogue)
    rebuilt(catalogue, archive, checker)
    again = everything(catalogue)
    for name in ("acceptances", "calibrations"):
        # Numbers are given in the order of age, and what was unpacked is older than it is here.
        assert sorted(row[1:] for row in again[name]) == sorted(row[1:] for row in told[name])
    work(catalogue, clock)
    for name in ours:
        again = run_jobs(catalogue, archive, clock, SHAPES, name)
        assert calibrations_of(catalogue, again) == before[name]
        with catalogue.reading() as session:
            assert all(session.get_one(JobRow, job).reused_from for job in again)


def test_what_was_recorded_before_a_calibration_keeps_the_one_of_its_time(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    calibration, campaign = real_test("real")
    register_campaign(catalogue, archive, campaign, None, clock())
    register_calibration(catalogue, archive, calibration, clock())
    record(catalogue, archive, campaign, "S00", 15, clock)
    before = run_jobs(catalogue, archive, clock, SHAPES, "real")
    later = other(calibration, 1, valid_from=MORNING + timedelta(minutes=18))
    register_calibration(catalogue, archive, later, clock(), accepted=True)
    reused(catalogue, archive, clock, "real", before)
    with catalogue.reading() as session:
        times = session.execute(select(LoadStateRow.label, LoadStateRow.time).order_by(LoadStateRow.label))
        assert [time for _, time in times] == [MORNING + timedelta(minutes=15), None]
    # What is recorded afterwards has the later one.
    record(catalogue, archive, campaign, "S01", 20, clock)
    new = run_jobs(catalogue, archive, clock, [Request("reconstruct", states=("S01",))], "real")
    assert not calibrations_of(catalogue, new) & calibrations_of(catalogue, before)
    told = everything(catalogue)
    rebuilt(catalogue, archive)
    again = everything(catalogue)
    assert [again[name] for name in ("states", "acceptances")] == [
        told[name] for name in ("states", "acceptances")
    ]
    work(catalogue, clock)
    reused(catalogue, archive, clock, "real", before)


def test_what_is_recorded_after_a_job_was_planned_decides_its_calibration(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    calibration, campaign = real_test("real", states=1)
    register_campaign(catalogue, archive, campaign, None, clock())
    register_calibration(catalogue, archive, calibration, clock())
    record(catalogue, archive, campaign, "S00", 15, clock)
    with catalogue.writing() as session:
        (job,) = submit(session, "real", SHAPES, clock()).job_ids
    later = other(calibration, 1, valid_from=MORNING + timedelta(minutes=10))
    register_calibration(catalogue, archive, later, clock(), accepted=True)
    runner(catalogue, archive, clock).run_queued()
    assert stale(catalogue, (job,), clock) == []
    with catalogue.reading() as session:
        newest = search.list_calibrations(session)[0]
        used = session.scalars(
            select(FileRow.path)
            .join(DependencyRow, DependencyRow.file_id == FileRow.id)
            .where(DependencyRow.job_id == job, DependencyRow.source == "calibration")
        ).one()
    assert used == newest.path


def test_a_measurement_older_than_every_calibration_is_told_so(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    calibration, campaign = real_test("real", states=1)
    register_campaign(catalogue, archive, campaign, None, clock())
    register_calibration(
        catalogue, archive, replace(calibration, valid_from=MORNING + timedelta(minutes=18)), clock()
    )
    record(catalogue, archive, campaign, "S00", 15, clock)
    with (
        catalogue.writing() as session,
        pytest.raises(NotFound, match=r"08:15:00.*1, is valid from .*08:18:00"),
    ):
        submit(session, "real", SHAPES, clock())


def test_a_calibration_waits_until_it_is_accepted(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    calibration, campaign = real_test("real", states=1)
    register_campaign(catalogue, archive, campaign, None, clock())
    assert register_calibration(catalogue, archive, calibration, clock()) == Registered(1, True, True)
    later = other(calibration, 1)
    assert register_calibration(catalogue, archive, later, clock()) == Registered(2, True, False)
    assert register_calibration(catalogue, archive, later, clock()) == Registered(2, False, False)
    record(catalogue, archive, campaign, "S00", 15, clock)
    jobs = run_jobs(catalogue, archive, clock, SHAPES, "real")
    with catalogue.reading() as session:
        assert [(v.id, v.in_use, v.inactive) for v in search.list_calibrations(session)] == [
            (2, False, True),
            (1, True, False),
        ]
    assert acceptances.accept(catalogue, archive, 2, None, clock())
    assert not acceptances.accept(catalogue, archive, 2, None, clock())
    assert len(stale(catalogue, jobs, clock)) == 1
    assert acceptances.accept(catalogue, archive, 2, None, clock(), in_use=False)
    assert stale(catalogue, jobs, clock) == []
    # For one campaign alone it takes the place of all of its rig.
    why = Signed("ada", "its own session")
    assert acceptances.accept(catalogue, archive, 2, "real", clock(), signed=why)
    assert len(stale(catalogue, jobs, clock)) == 1
    before, known = everything(catalogue)["acceptances"], acceptances.about(catalogue, archive, 2)
    assert [(d.campaign, d.in_use, d.by, d.reason) for d in known] == [
        (None, False, "", ""),
        ("real", True, "ada", "its own session"),
    ]
    rebuilt(catalogue, archive)
    assert everything(catalogue)["acceptances"] == before
    assert acceptances.about(catalogue, archive, 2) == known


def test_other_sensors_are_refused(catalogue: Catalogue, archive: Archive, clock: Clock) -> None:
    calibration, campaign = real_test("real", states=1)
    register_campaign(catalogue, archive, campaign, None, clock())
    register_calibration(catalogue, archive, calibration, clock())
    files = set(archive.files())
    fewer = replace(calibration.rig, sensors=calibration.rig.sensors[:2])
    for wrong in (larger(calibration), replace(calibration, rig=fewer)):
        for accepted in (False, True):
            with pytest.raises(Conflict, match=r"C1 \(.*128 px.*calibration 1, .*a name of its own"):
                register_calibration(catalogue, archive, wrong, clock(), accepted=accepted)
    assert set(archive.files()) == files
    # One that came along with a plan is known, and refused for what has other sensors.
    assert campaign.scene is not None
    plan = replace(campaign, name="plan", scene=replace(campaign.scene, rig=larger(calibration).rig))
    register_campaign(catalogue, archive, plan, larger(calibration), clock())
    for whom, told in ((None, "calibration 1"), ("real", "campaign real is measured by C1")):
        with pytest.raises(Conflict, match=told):
            acceptances.accept(catalogue, archive, 2, whom, clock())
    elsewhere = replace(campaign, name="elsewhere", rig="hall-3")
    register_campaign(catalogue, archive, elsewhere, None, clock())
    with pytest.raises(InvalidInput, match="is of rig small-virtual-rig, and campaign elsewhere"):
        acceptances.accept(catalogue, archive, 1, "elsewhere", clock())


def test_a_session_does_not_begin_with_what_it_gave(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    calibration, campaign = real_test("session", states=1)
    register_campaign(catalogue, archive, campaign, None, clock())
    register_campaign(catalogue, archive, replace(campaign, name="test"), None, clock())
    record(catalogue, archive, campaign, "S00", 15, clock)
    register_calibration(catalogue, archive, calibration, clock())
    (path, content), *_ = [
        (row[0], row[2]) for row in everything(catalogue)["files"] if row[1] == "measurement"
    ]
    given = InputReference("session", "measurement", path, content)
    later = other(calibration, 1)
    register_calibration(catalogue, archive, later, clock(), inputs=(given,), accepted=True)
    with catalogue.reading() as session:
        for name, number in (("session", 1), ("test", 2)):
            used = calibration_choice.chosen(session, Subject(name), clock())
            assert used is not None
            assert used.number == number


def test_two_plans_of_one_text_share_what_is_the_same_and_no_more(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock, "first")
    registered(catalogue, archive, clock, "second")
    with catalogue.reading() as session:
        (view,) = search.list_calibrations(session)
    assert (view.in_use, view.campaigns) == (False, ("first", "second"))


def test_a_decision_whose_file_is_lost_is_sealed_again(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    told = everything(catalogue)["acceptances"]
    archive.discard(told[0][4])
    found = [one.finding for one in check_known(catalogue, archive) if one.finding is not None]
    steps = repair.planned(catalogue, archive, found)
    assert [one.step for one in steps] == ["seal-again"]
    assert repair.apply(catalogue, archive, steps, clock()) == []
    assert everything(catalogue)["acceptances"] == told
    assert [one.finding for one in check_known(catalogue, archive) if one.finding is not None] == []


def test_an_unpacking_that_was_interrupted_comes_to_the_same_decisions(
    catalogue: Catalogue, archive: Archive, clock: Clock, tmp_path: Path, checker: Checker
) -> None:
    folder = packed(tmp_path, 1, checker)
    manifest = unpacking.manifest_of(folder)
    begun = unpacking.enter(catalogue, archive, folder, manifest, clock(), checker=checker)
    next(begun)  # the campaign is known, and nothing else of the folder yet
    begun.close()
    assert set(unpack(catalogue, archive, folder, clock(), checker)) == {"indexed"}
    with catalogue.reading() as session:
        (view,) = search.list_calibrations(session)
    assert (view.in_use, view.campaigns) == (False, ("stranger-1",))
    assert unpack(catalogue, archive, folder, clock(), checker) == []
