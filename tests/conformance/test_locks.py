"""Devices are held by one at a time, all or none, and by nobody who is gone; on both deployments."""

from __future__ import annotations

import random
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import pytest
from sqlalchemy import select
from support.jobs import NOW, claim, events, state, submit_pipeline

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import JobDeviceRow, LockRow
from sms_jobs.errors import Conflict, DevicesBusy, LeaseLost, NotFound
from sms_jobs.jobs.asking import explanation
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.running import lifecycle, recovery
from sms_jobs.jobs.running.lifecycle import Claim
from sms_jobs.records.job import JobState

LEASE = timedelta(seconds=30)
RIG = ("camera/C1", "projector/P1", "stage/A")


def claimed(catalogue: Catalogue) -> Claim:
    held = claim(catalogue)
    assert held is not None
    return held


def take(catalogue: Catalogue, held: Claim, *names: str) -> None:
    with catalogue.writing() as session:
        locks.acquire(session, names, held.job_id, held.fence, NOW)


def alive(catalogue: Catalogue, at: timedelta = timedelta()) -> dict[str, str | None]:
    """Return who holds what, by device."""
    with catalogue.reading() as session:
        return {k.device: k.job_id or k.holder for k in locks.held_devices(session, NOW + at) if k.alive}


def need(catalogue: Catalogue, job_ids: tuple[str, ...], *devices: str) -> None:
    with catalogue.writing() as session:
        session.add_all(JobDeviceRow(job_id=i, device=d) for i in job_ids for d in devices)


def test_all_are_taken_or_none(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    first, second = claimed(catalogue), claimed(catalogue)
    take(catalogue, first, "stage/A")
    with pytest.raises(
        DevicesBusy, match=rf"stage/A, which job {first.job_id[:8]} .* since .*sms job cancel"
    ):
        take(catalogue, second, *RIG)
    assert alive(catalogue) == {"stage/A": first.job_id}
    # Even if somebody catches that and goes on with the same transaction.
    with catalogue.writing() as session, pytest.raises(DevicesBusy):
        locks.acquire(session, RIG, second.job_id, second.fence, NOW)
    assert alive(catalogue) == {"stage/A": first.job_id}
    take(catalogue, first, *RIG)
    assert alive(catalogue) == dict.fromkeys(RIG, first.job_id)


def test_what_is_held_already_is_held_since_then(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    held = claimed(catalogue)
    take(catalogue, held, "stage/A")
    with catalogue.writing() as session:
        locks.acquire(session, RIG, held.job_id, held.fence, NOW + LEASE)
        since = {lock.device: lock.since for lock in locks.held_devices(session, NOW)}
    assert since == {"camera/C1": NOW + LEASE, "projector/P1": NOW + LEASE, "stage/A": NOW}


@pytest.mark.parametrize("end", [JobState.FAILED, JobState.CANCELLED, JobState.QUEUED, JobState.LOST])
def test_devices_are_free_however_a_job_ends(catalogue: Catalogue, end: JobState) -> None:
    submit_pipeline(catalogue)
    first, second = claimed(catalogue), claimed(catalogue)
    take(catalogue, first, *RIG)
    with catalogue.writing() as session:
        assert lifecycle.change(session, first.job_id, end, NOW, "it ends", fence=first.fence)
    assert alive(catalogue) == {}
    take(catalogue, second, *RIG)
    with catalogue.writing() as session:
        assert lifecycle.succeed(session, second, NOW, "done", reuse_key="k")
    assert alive(catalogue) == {}
    with catalogue.writing() as session:
        assert locks.release_dead(session, NOW) == list(RIG)
        assert session.scalars(select(LockRow)).all() == []


def test_the_reconciler_frees_what_a_lost_job_held(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    held = claimed(catalogue)
    take(catalogue, held, *RIG)
    with catalogue.writing() as session:
        assert recovery.recover(session, NOW, "w1", 3, set) == [held.job_id]
        assert locks.held_devices(session, NOW) == []
    # The late attempt, if its process lives on, gets nothing any more.
    with pytest.raises(LeaseLost):
        take(catalogue, held, *RIG)
    assert alive(catalogue) == {}


def test_a_person_holds_devices_for_as_long_as_the_lease(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    held = claimed(catalogue)
    with catalogue.writing() as session:
        locks.acquire_for(session, RIG, "anna at the console", NOW, LEASE)
    with pytest.raises(DevicesBusy, match=r"'anna at the console' .* until"):
        take(catalogue, held, "camera/C1")
    with catalogue.writing() as session:
        locks.acquire_for(session, RIG, "anna at the console", NOW + LEASE, LEASE)
    assert set(alive(catalogue, 2 * LEASE)) == set(RIG)
    assert alive(catalogue, 3 * LEASE) == {}
    with catalogue.writing() as session:
        assert locks.release(session, holder="anna at the console") == list(RIG)
    take(catalogue, held, "camera/C1")
    with catalogue.writing() as session:
        assert locks.release(session, job_id=held.job_id) == ["camera/C1"]


def test_only_a_lock_whose_holder_is_gone_can_be_released_by_hand(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    held = claimed(catalogue)
    take(catalogue, held, "stage/A")
    with catalogue.writing() as session, pytest.raises(Conflict, match="sms job cancel"):
        locks.release_device(session, "stage/A", NOW)
    with catalogue.writing() as session:
        lifecycle.change(session, held.job_id, JobState.FAILED, NOW, "no light", fence=held.fence)
        assert locks.release_device(session, "stage/A", NOW).job_id == held.job_id
        with pytest.raises(NotFound):
            locks.release_device(session, "stage/A", NOW)


def test_a_job_whose_devices_are_held_stays_queued_and_says_so(catalogue: Catalogue) -> None:
    ids = submit_pipeline(catalogue)
    with catalogue.reading() as session:
        acquiring = tuple(i for i in ids if session.get_one(JobRow, i).kind == "simulate")
    need(catalogue, acquiring, "camera/C1", "stage/A")
    first = claimed(catalogue)
    assert alive(catalogue) == dict.fromkeys(("camera/C1", "stage/A"), first.job_id)
    assert claim(catalogue) is None  # the other one needs the same camera
    (other,) = set(acquiring) - {first.job_id}
    with catalogue.reading() as session:
        why = explanation.explain(session, session.get_one(JobRow, other), NOW)
    assert any(f"it needs camera/C1, which job {first.job_id[:8]} (simulate plate/S" in line for line in why)
    with catalogue.writing() as session:
        lifecycle.succeed(session, first, NOW, "done", reuse_key="k")
    later = claim(catalogue)
    assert later is not None
    assert (later.job_id, later.attempt) == (other, 1)
    assert [e.state for e in events(catalogue, other)] == ["queued", "running"]


def test_two_workers_that_claim_for_one_device_at_once_get_it_one_after_the_other(
    catalogue: Catalogue,
) -> None:
    for n in range(4):
        submit_pipeline(catalogue, f"plate-{n}")
    with catalogue.reading() as session:
        ids = tuple(session.scalars(select(JobRow.id).where(JobRow.kind == "simulate")))
    need(catalogue, ids, "stage/A", "camera/C1")

    def work(_: int) -> list[str]:
        done = []
        while (held := claim(catalogue)) is not None:
            assert alive(catalogue)["stage/A"] == held.job_id
            with catalogue.writing() as session:
                assert lifecycle.change(session, held.job_id, JobState.FAILED, NOW, "", fence=held.fence)
            done.append(held.job_id)
        return done

    finished: list[str] = []
    with ThreadPoolExecutor(4) as pool:
        while len(finished) < len(ids):
            finished += [job_id for some in pool.map(work, range(4)) for job_id in some]
    assert sorted(finished) == sorted(ids)
    assert {state(catalogue, i) for i in ids} == {JobState.FAILED}
    with catalogue.reading() as session:
        assert set(session.scalars(select(JobRow.attempts).where(JobRow.id.in_(ids)))) == {1}


def test_overlapping_sets_in_any_order_never_wait_in_a_circle(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    first, second = claimed(catalogue), claimed(catalogue)
    devices = [f"device/{n}" for n in range(5)]

    def work(seed: int) -> int:
        chance = random.Random(seed)
        owner = f"person {seed}"
        taken = 0
        for _ in range(12):
            wanted = chance.sample(devices, 3)
            try:
                with catalogue.writing() as session:
                    if seed < 2:
                        held = (first, second)[seed]
                        locks.acquire(session, wanted, held.job_id, held.fence, NOW)
                    else:
                        locks.acquire_for(session, wanted, owner, NOW, LEASE)
            except DevicesBusy:
                continue
            taken += 1
            mine = (first, second)[seed].job_id if seed < 2 else owner
            assert [d for d, who in alive(catalogue).items() if who == mine] == sorted(wanted)
            with catalogue.writing() as session:
                if seed % 2:
                    locks.release_dead(session, NOW)
                released = (
                    locks.release(session, job_id=mine) if seed < 2 else locks.release(session, holder=mine)
                )
                assert released == sorted(wanted)
        return taken

    with ThreadPoolExecutor(6) as pool:
        assert sum(pool.map(work, range(6))) > 0
    assert alive(catalogue) == {}
