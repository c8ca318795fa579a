"""A backup that is taken while jobs run becomes a home in which they go on."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping
from contextlib import closing
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path

import pytest
from sqlalchemy import select
from support.command import answer, service, sms
from support.homes import make_home, stored
from support.jobs import claim
from support.sealing import regions

from sms_jobs import bootstrap
from sms_jobs import settings as settings_file
from sms_jobs.archive import Archive, FolderStore, layout
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import Conflict, InvalidInput, NotFound
from sms_jobs.jobs.asking import inquiry, standing
from sms_jobs.jobs.keeping import backups, verification
from sms_jobs.jobs.planning.chosen import by_ids
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.running import recovery
from sms_jobs.records.job import JobState

ROOT = Path(__file__).resolve().parents[2]
NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)


def script(name: str, *arguments: object, environment: Mapping[str, str]) -> None:
    """Run a script of `ops`, which must succeed."""
    done = subprocess.run(
        ["bash", str(ROOT / "ops" / name), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ | dict(environment),
        stdin=subprocess.DEVNULL,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def back_up(services: Services, folder: Path, now: datetime, shares: int = 30) -> list[backups.Progress]:
    return list(backups.back_up(services.catalogue, services.archive, services.settings, folder, now, shares))


def findings(home: Path) -> list[verification.Finding]:
    """Compare a restored home's archive with its catalogue."""
    archive = Archive(FolderStore(home / "archive"))
    with closing(Catalogue(f"sqlite:///{home / 'catalogue.sqlite'}")) as catalogue:
        known = [c.finding for c in verification.check_known(catalogue, archive) if c.finding]
        return known + list(verification.check_unknown(catalogue, archive))


def submit_recording(services: Services) -> tuple[str, ...]:
    with services.catalogue.writing() as session:
        return submit(session, "plate", [Request("simulate")], datetime.now(UTC)).job_ids


@pytest.mark.long
def test_every_snapshot_fits_its_files_whatever_jobs_seal_meanwhile(home: Path, tmp_path: Path) -> None:
    make_home(home, {})
    kept = tmp_path / "kept"
    stood = []
    with bootstrap.services(home) as services:
        with service(home):
            jobs = submit_recording(services)
            while not stood or standing.still_active(stood[-1]):
                with services.catalogue.reading() as session:
                    stood.append(inquiry.counts(session, by_ids(jobs)))
                back_up(services, kept, NOW + timedelta(seconds=len(stood)))
        assert stood[-1] == {"succeeded": len(jobs)}
    taken = backups.snapshots(kept)
    assert len(taken) == len(stood)
    # The first, the last, and some between: each has files of its own moment, and no others.
    numbers = []
    for snapshot in {taken[0], taken[len(taken) // 3], taken[2 * len(taken) // 3], taken[-1]}:
        restored = tmp_path / snapshot.stem
        numbers.append(len(list(backups.restore(kept, restored, snapshot.stem))))
        assert findings(restored) == []
    assert max(numbers) == len(set(backups_files(kept)))


def backups_files(folder: Path) -> list[str]:
    return list(Archive(FolderStore(folder / "archive")).files())


def test_a_job_that_was_running_is_recovered_after_the_scripts(
    home: Path, tmp_path: Path, fresh_postgresql_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = {"SMS_DATABASE_URL": fresh_postgresql_url}
    make_home(home, environment)
    (home / "sms.toml").write_text(
        'lease_s = 2.0\n# database_url = "postgresql+psycopg://sms:secret@host/sms"\n'
        'database_url = """\\\npostgresql+psycopg://sms:secret@host\\\n/sms"""\n',
        encoding="utf-8",
    )
    monkeypatch.setenv("SMS_DATABASE_URL", fresh_postgresql_url)
    with bootstrap.services(home) as services:
        jobs = submit_recording(services)
        with services.catalogue.writing() as session:
            recovery.register_worker(session, "w1", "another host", 1, ["acquisition"], 1, NOW)
        held = claim(services.catalogue)
        assert held is not None
    kept, restored = tmp_path / "kept", tmp_path / "restored"
    script("backup.sh", home, kept, environment=environment)
    assert "secret" not in "".join(f.read_text() for f in (kept / "snapshots").glob("*.toml"))
    script("restore.sh", kept, restored, environment=environment)
    monkeypatch.delenv("SMS_DATABASE_URL")
    assert (restored / "sms.toml").read_text(encoding="utf-8") == "lease_s = 2.0\n"
    with bootstrap.services(restored) as services:
        with services.catalogue.reading() as session:
            assert session.get_one(JobRow, held.job_id).state is JobState.RUNNING
        with service(restored):
            assert answer("job", "wait", *jobs, "--home", str(restored))["jobs"] == {"succeeded": len(jobs)}
        with services.catalogue.reading() as session:
            told = [event.state for event in inquiry.events(session, held.job_id)]
            assert told == ["queued", "running", "lost", "queued", "running", "succeeded"]
    assert findings(restored) == []


@pytest.fixture
def plate(home: Path) -> Path:
    """A home whose archive holds a definition or a calibration and nothing that was recorded."""
    make_home(home, {})
    return home


def test_what_has_been_copied_is_not_copied_again(plate: Path, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    with bootstrap.services(plate) as services:
        first = back_up(services, kept, NOW)
        again = back_up(services, kept, NOW + timedelta(days=1))
        assert all(step.copied for step in first)
        assert [step.path for step in again] == [step.path for step in first]
        assert not any(step.copied for step in again)
        assert first[-1].done_bytes == first[-1].total_bytes > 0
        # A copy that was cut short, by whatever, is made whole.
        cut = kept / "archive" / first[0].path
        cut.chmod(0o644)
        cut.write_bytes(cut.read_bytes()[:-1])
        third = back_up(services, kept, NOW + timedelta(days=2))
        assert [step.copied for step in third] == [step.path == first[0].path for step in third]
        with pytest.raises(Conflict, match="already"):
            back_up(services, kept, NOW)
    list(backups.restore(kept, tmp_path / "restored"))
    assert findings(tmp_path / "restored") == []


def flip(file: Path) -> bytes:
    """Flip a bit in the middle of a file; return what it was."""
    good = file.read_bytes()
    middle = len(good) // 2
    file.chmod(0o644)
    file.write_bytes(good[:middle] + bytes([good[middle] ^ 4]) + good[middle + 1 :])
    return good


def kinds_of(services: Services) -> dict[str, str]:
    """Return the path of a dataset, of a document and of what lies beside a document."""
    stored(services, "segment", "plate/S00/C1P1", {"regions": regions()})
    stored(services, "report", "plate", None, 1)
    with services.catalogue.reading() as session:
        dataset, document = (
            session.scalars(select(FileRow.path).where(FileRow.source == source)).one()
            for source in ("segment", "report")
        )
    return {"dataset": dataset, "document": document, "beside": layout.sidecar(document)}


@pytest.mark.parametrize("kind", ["dataset", "document", "beside"])
def test_rot_is_found_wherever_it_is_and_good_takes_the_place_of_bad(
    plate: Path, tmp_path: Path, kind: str
) -> None:
    kept, days = tmp_path / "kept", count()

    def told(shares: int = 1) -> tuple[list[str], list[str]]:
        """Back up; return the paths of what was copied and of what was found."""
        steps = back_up(services, kept, NOW + timedelta(days=next(days)), shares)
        return [s.path for s in steps if s.copied], [s.path for s in steps if s.finding]

    with bootstrap.services(plate) as services:
        paths = kinds_of(services)
        known = layout.without_sidecar(paths[kind])
        source, copy = services.archive.store.path(paths[kind]), kept / "archive" / paths[kind]
        # Before its first copy: what is damaged never comes into the backup, and is told every time.
        good = flip(source)
        copied, found = told(30)
        assert found == [known]
        assert known not in copied
        assert not (kept / "archive" / known).exists()
        assert told(30)[1] == [known]
        source.write_bytes(good)
        assert told() == ([known], [])
        # In the backup: replaced.
        flip(copy)
        assert told() == ([known], [known])
        assert copy.read_bytes() == good
        assert told() == ([], [])
        # In the archive, later: told, and the good copy stays.
        flip(source)
        assert told() == ([], [known])
        assert copy.read_bytes() == good
        # In both.
        flip(copy)
        assert told() == ([], [known])
        # The share goes round: whatever was damaged is found within as many backups.
        source.write_bytes(good)
        assert sum(known in told(3)[1] for _ in range(3)) == 1
        assert copy.read_bytes() == good


def test_findings_are_an_exit_code_and_name_the_files(plate: Path, tmp_path: Path) -> None:
    with bootstrap.services(plate) as services:
        damaged = kinds_of(services)["dataset"]
        flip(services.archive.store.path(damaged))
    done = sms("db", "backup", str(tmp_path / "kept"), "--home", str(plate))
    assert done.returncode == 6
    assert damaged in done.stdout
    assert "is not what was sealed" in done.stdout


def test_rigs_and_frames_that_no_archive_has_come_along(plate: Path, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    rig, frames = plate / "rigs" / "rig.toml", plate / "spool" / "job1" / "C1P1.frames"
    for file, content in ((rig, b"name = 'rig'\n"), (frames, bytes(range(256)) * 100)):
        file.parent.mkdir(parents=True)
        file.write_bytes(content)
    with bootstrap.services(plate) as services:
        back_up(services, kept, NOW)
        with frames.open("ab") as growing:
            growing.write(b"one more")
        steps = back_up(services, kept, NOW + timedelta(days=1))
        assert [Path(s.path).name for s in steps if s.copied] == ["C1P1.frames"]
        # A copy that changed by itself is replaced; a file that did is told, and its copy stays.
        (copy,) = kept.rglob("C1P1.frames")
        good = flip(copy)
        steps = back_up(services, kept, NOW + timedelta(days=2), 1)
        assert [(s.path, s.copied) for s in steps if s.finding] == [(str(copy), True)]
        assert copy.read_bytes() == good
        times = frames.stat()
        flip(frames)
        os.utime(frames, ns=(times.st_atime_ns, times.st_mtime_ns))
        steps = back_up(services, kept, NOW + timedelta(days=3), 1)
        assert [(s.path, s.copied) for s in steps if s.finding] == [(str(copy), False)]
        assert copy.read_bytes() == good
    restored = tmp_path / "restored"
    assert not [step.finding for step in backups.restore(kept, restored) if step.finding]
    assert (restored / "rigs" / "rig.toml").read_bytes() == rig.read_bytes()
    assert (restored / "spool" / "job1" / "C1P1.frames").read_bytes() == good
    # When the frames have been archived, the next backup lets its copy go.
    frames.unlink()
    with bootstrap.services(plate) as services:
        back_up(services, kept, NOW + timedelta(days=4))
    assert not list(kept.rglob("C1P1.frames"))


def test_settings_are_kept_without_secrets_however_they_are_written(plate: Path, tmp_path: Path) -> None:
    archive = plate / "archive"
    (plate / "sms.toml").write_text(
        "threads = 2\n"
        f'"archive" = "{archive}"\n'
        'broker_url = """\\\n  redis://:hidden@\\\n  localhost/0"""\n'
        "# redis://:hidden@elsewhere\nlease_s = 2.5\n",
        encoding="utf-8",
    )
    with bootstrap.services(plate) as services:
        back_up(services, tmp_path / "kept", NOW)
    (settings,) = (tmp_path / "kept" / "snapshots").glob("*.toml")
    assert settings.read_text(encoding="utf-8") == "threads = 2\nlease_s = 2.5\n"
    list(backups.restore(tmp_path / "kept", tmp_path / "restored"))
    assert settings_file.load(tmp_path / "restored").lease_s == 2.5


def test_a_file_that_is_missing_is_told_and_the_others_are_kept(plate: Path, tmp_path: Path) -> None:
    with bootstrap.services(plate) as services:
        with services.catalogue.reading() as session:
            path = session.scalars(select(FileRow.path)).first()
        assert path is not None
        services.archive.store.path(path).unlink()
        steps = back_up(services, tmp_path / "kept", NOW)
    assert [step.path for step in steps if step.finding] == [path]
    assert backups.snapshots(tmp_path / "kept")


def test_what_cannot_be_is_refused(plate: Path, tmp_path: Path) -> None:
    with bootstrap.services(plate) as services:
        with pytest.raises(InvalidInput, match="is inside the archive"):
            back_up(services, plate / "archive" / "kept", NOW)
        back_up(services, tmp_path / "kept", NOW)
    before = sorted(plate.rglob("*"))
    with pytest.raises(Conflict, match="not empty"):
        list(backups.restore(tmp_path / "kept", plate))
    assert sorted(plate.rglob("*")) == before
    with pytest.raises(NotFound, match=r"1999\*"):
        list(backups.restore(tmp_path / "kept", tmp_path / "new", "1999"))
    assert not (tmp_path / "new").exists()
