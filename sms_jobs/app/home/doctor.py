"""Examines a home: every examination in a thread of its own, so that none can fail or hang the others."""

from __future__ import annotations

import platform
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

import sms_jobs
from sms_jobs import bootstrap
from sms_jobs import settings as settings_file
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import schema
from sms_jobs.errors import SmsError
from sms_jobs.jobs.asking import standing
from sms_jobs.jobs.devices import disks
from sms_jobs.jobs.monitoring import health
from sms_jobs.jobs.running import liveness
from sms_jobs.jobs.running.origin import Origin
from sms_jobs.records.job import ALIVE_WITHIN
from sms_jobs.records.sizes import number_of, size
from sms_jobs.settings import Settings

_LITTLE_ROOM_BYTES = 10e9
_PATIENCE_S = 20.0
"""How long the catalogue, and then all examinations together, may take."""


@dataclass(frozen=True)
class Examined:
    """What an examination has found: what is wrong, in sentences, and what is there."""

    findings: tuple[str, ...] = ()
    what: str = ""


Examination = Callable[[], Examined]


@contextmanager
def diagnosed(home: Path | None) -> Iterator[dict[str, Examined]]:
    """Give what all examinations of a home have found, by name.

    The home is let go at the end, so that an examination that hangs keeps nobody from reading the others.
    """
    with ExitStack() as until_reported:
        yield _all_found(home, until_reported)


def _all_found(home: Path | None, until_reported: ExitStack) -> dict[str, Examined]:
    """Examine what can be examined: without a catalogue everything else, and without settings nothing."""
    try:
        settings = settings_file.load(home)
    except Exception as error:  # noqa: BLE001 - whatever it is, it is a finding
        return {"settings": Examined((_in_words(error),))}
    opened: list[Services] = []

    def open_all() -> Examined:
        opened.append(until_reported.enter_context(bootstrap.services(home)))
        return Examined((), str(settings.home))

    found = examine({"home and catalogue": open_all})
    examinations = _of_the_place(settings)
    if opened:
        examinations = _of_the_catalogue(opened[0]) | examinations | _of_the_service(opened[0])
    return found | examine(examinations)


def examine(examinations: Mapping[str, Examination], patience_s: float = _PATIENCE_S) -> dict[str, Examined]:
    """Run examinations beside each other; one that fails, or does not end in time, is a finding."""
    found: dict[str, Examined] = {}

    def run(name: str, examination: Examination) -> None:
        try:
            found[name] = examination()
        except Exception as error:  # noqa: BLE001 - whatever it is, it is a finding
            found[name] = Examined((_in_words(error),))

    # A thread that waits for a share that is gone cannot be ended: the program ends without it.
    threads = [threading.Thread(target=run, args=each, daemon=True) for each in examinations.items()]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + patience_s
    for thread in threads:
        thread.join(max(deadline - time.monotonic(), 0.0))
    late = f"gave no answer within {patience_s:g} s; look whether its disk, share or server answers"
    return {name: found.get(name, Examined((late,))) for name in examinations}


def _in_words(error: Exception) -> str:
    if isinstance(error, SmsError):
        return str(error)
    if isinstance(error, SQLAlchemyError):
        # Its text may repeat what was asked, and that whatever is in the catalogue.
        return f"the catalogue gave no answer ({type(error).__name__}); compare its schema by 'sms db check'"
    if isinstance(error, OSError):
        reason = error.strerror or type(error).__name__
        where = f" at {error.filename}" if error.filename else ""
        return f"could not be looked at{where} ({reason}); look at that place, and at its permissions"
    return f"could not be examined ({type(error).__name__}: {error}); report it with 'sms --version'"


def _of_the_place(settings: Settings) -> dict[str, Examination]:
    from sms_jobs.workers import broker

    root = settings.archive_root

    def messages() -> Examined:
        what, finding = broker.examine(settings)
        return _one(finding, what)

    def disk() -> Examined:
        free = size(shutil.disk_usage(root).free)
        finding = health.room(root, _LITTLE_ROOM_BYTES)
        spool_free = disks.spool_free_bytes(settings.spool_folder, root)
        if spool_free is None:
            return _one(finding, f"{free} free, shared with the spool")
        findings = (finding, health.room(disks.nearest(settings.spool_folder), _LITTLE_ROOM_BYTES))
        told = tuple(one for one in findings if one is not None)
        return Examined(told, f"{free} free; {size(spool_free)} free in the spool")

    return {
        "messages": messages,
        "archive": lambda: _one(health.archive_works(root) or health.other_file_systems(root), str(root)),
        "disk": disk,
    }


def _of_the_catalogue(services: Services) -> dict[str, Examination]:
    catalogue = services.catalogue
    lease = timedelta(seconds=services.settings.lease_s)

    def versions() -> Examined:
        with catalogue.reading() as session:
            return Examined((), _versions(health.database_version(session)))

    def drift() -> Examined:
        found = schema.differences_from_models(catalogue)
        return _one(
            f"{number_of(len(found), 'difference')} from this version's: {found[0]}" if found else None
        )

    def contents() -> Examined:
        with catalogue.reading() as session:
            return _one(health.damage(catalogue) or health.files_nobody_knows(session, services.archive))

    def counts() -> Examined:
        with catalogue.reading() as session:
            return _one(health.counts_of_jobs(session))

    return {
        "versions": versions,
        "schema": drift,
        "counts of jobs": counts,
        "contents of the catalogue": contents,
        "place of the catalogue": lambda: _one(
            health.database_on_network(catalogue) or health.held(catalogue), catalogue.describe()
        ),
        "clock": lambda: _one(health.clock(catalogue, lease)),
    }


def _of_the_service(services: Services) -> dict[str, Examination]:
    def asked(question: Callable[[Session, datetime], list[str]]) -> Examination:
        def answer() -> Examined:
            with services.catalogue.reading() as session:
                return Examined(tuple(question(session, datetime.now(UTC))))

        return answer

    def workers() -> Examined:
        with services.catalogue.reading() as session:
            now = datetime.now(UTC)
            alive = len(standing.workers(session, now - ALIVE_WITHIN))
            return Examined(tuple(liveness.workers(session, now)), f"{alive} alive")

    def queues(session: Session, now: datetime) -> list[str]:
        return [*health.pauses(session), *liveness.unserved(session, now)]

    def processes(session: Session, now: datetime) -> list[str]:
        return liveness.processes(session, now, Origin.own())

    return {
        "queues": asked(queues),
        "workers": workers,
        "processes": asked(processes),
        "hosts": asked(liveness.hosts),
    }


def _one(finding: str | None, what: str = "") -> Examined:
    return Examined(() if finding is None else (finding,), what)


def _versions(database: str) -> str:
    import h5py

    return (
        f"sms {sms_jobs.__version__}, Python {platform.python_version()}, HDF5 {h5py.version.hdf5_version}, "
        f"{database}"
    )
