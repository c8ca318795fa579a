"""What `sms archive repair` mends, sets aside and leaves to a person, on both deployments."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import pytest
from support.archives import Clock, everything, registered, run_jobs
from support.command import inside
from support.deployments import Deployment

from sms_jobs.archive import Archive
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.keeping import repair, retention, verification
from sms_jobs.jobs.keeping.repair import Repair
from sms_jobs.jobs.planning.graph import Request


@pytest.fixture
def made(catalogue: Catalogue, archive: Archive, clock: Clock) -> Archive:
    registered(catalogue, archive, clock)
    run_jobs(catalogue, archive, clock, [Request("simulate"), Request("reconstruct")])
    return archive


def planned(catalogue: Catalogue, archive: Archive) -> list[Repair]:
    checked = verification.check_known(catalogue, archive)
    findings = [done.finding for done in checked if done.finding is not None]
    findings += verification.check_unknown(catalogue, archive)
    return repair.planned(catalogue, archive, findings)


def on_disk(archive: Archive) -> dict[str, bytes]:
    """Return the contents of all files that lie anywhere in the archive's folder."""
    return {
        str(p.relative_to(archive.store.root)): p.read_bytes()
        for p in archive.store.root.rglob("*")
        if p.is_file()
    }


def paths(catalogue: Catalogue, source: str) -> list[str]:
    return [row[0] for row in everything(catalogue)["files"] if row[1] == source]


def damage(path: Path) -> None:
    """Change a bit of the positions: elsewhere a file has bytes that nobody reads."""
    with h5py.File(path) as opened:
        chunk = opened["entry/surface/position"].id.get_chunk_info(0)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset + chunk.size // 2] ^= 1
    path.chmod(0o644)
    path.write_bytes(data)


def test_nothing_is_lost_and_what_can_be_mended_is(
    catalogue: Catalogue, made: Archive, clock: Clock, deployment: Deployment
) -> None:
    recorded, shapes = paths(catalogue, "measurement"), paths(catalogue, "reconstruct")
    (definition,) = paths(catalogue, "campaign")
    before = everything(catalogue)
    # The catalogue forgets a shape; another is damaged, a recording is lost, a stranger and a half lie about.
    with catalogue.writing() as session:
        numbers = {row.path: row.file_id for row in retention.superseded(session)}
        assert numbers == {}
    forgotten, damaged, lost = shapes[0], shapes[1], recorded[1]
    _forget(catalogue, forgotten)
    damage(made.store.path(damaged))
    made.discard(lost)
    made.discard(definition)
    stranger = recorded[0].replace("-1.h5", "-7.h5")
    shutil.copy(made.store.path(recorded[0]), made.store.root / stranger)
    half = f"plate/.{Path(recorded[0]).name}.0123456789abcdef.tmp"
    (made.store.root / half).write_bytes(b"half")
    note, beside = "plate/note.txt", f"plate/{Path(recorded[0]).stem}-page.txt.provenance.json"
    (made.store.root / note).write_bytes(b"a note")
    (made.store.root / beside).write_bytes(b"{}")
    contents = on_disk(made)
    plan = planned(catalogue, made)
    steps = {(one.path, one.problem): one for one in plan}
    assert {key: one.step for key, one in steps.items()} == {
        (forgotten, "unknown"): "index",
        (stranger, "unknown"): "set-aside",
        (half, "unfinished"): "set-aside",
        (note, "stray"): "set-aside",
        (beside, "stray"): "set-aside",
        (damaged, "corrupt"): "set-aside",
        (lost, "missing"): "nothing",
        (definition, "missing"): "seal-again",
    }
    assert "backup" in steps[lost, "missing"].then
    assert steps[damaged, "corrupt"].then.startswith(
        "sms job submit reconstruct -c plate --state S01 --view "
    )
    # Planning has changed nothing, and the command alone does not either.
    done = inside("archive", "repair", "--home", str(deployment.home), environment=deployment.environment)
    assert done.returncode == 6, done.stderr
    assert on_disk(made) == contents
    assert repair.apply(catalogue, made, plan, clock()) == []
    # Every byte is still somewhere.
    kept = on_disk(made)
    assert sorted(contents.values()) == sorted(v for v in kept.values() if v in set(contents.values()))
    assert {Path(p).name for p in kept if p.startswith(".set-aside")} == {
        Path(p).name for p in (stranger, half, note, beside, damaged)
    }
    after = everything(catalogue)
    for table in ("statistics", "provenance", "campaigns", "jobs"):
        assert after[table] == before[table], table
    # What is left needs a person: a recording from the backup, and a job.
    left = planned(catalogue, made)
    assert {(one.path, one.step) for one in left} == {(lost, "nothing"), (damaged, "nothing")}


def test_a_damaged_result_that_a_newer_one_replaces_is_forgotten(
    catalogue: Catalogue, made: Archive, clock: Clock
) -> None:
    damaged = paths(catalogue, "reconstruct")[1]
    damage(made.store.path(damaged))
    repair.apply(catalogue, made, planned(catalogue, made), clock())
    # What was set aside is not reused.
    run_jobs(catalogue, made, clock, [Request("reconstruct")])
    (left,) = planned(catalogue, made)
    assert (left.path, left.step) == (damaged, "forget")
    repair.apply(catalogue, made, [left], clock())
    assert planned(catalogue, made) == []
    assert len(paths(catalogue, "reconstruct")) == 2


def _forget(catalogue: Catalogue, path: str) -> None:
    from sqlalchemy import select

    from sms_jobs.catalogue.tables.files import FileRow

    with catalogue.writing() as session:
        retention.forget(session, [session.scalars(select(FileRow.id).where(FileRow.path == path)).one()])
