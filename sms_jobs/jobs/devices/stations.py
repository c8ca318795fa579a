"""The rigs that are connected to this host: their files, their queues, and where their frames come in."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sms_jobs.errors import Conflict, NotFound
from sms_jobs.kinds.kind import Station, rig_queue
from sms_jobs.records.subject import checked_name
from sms_jobs.settings import Settings

if TYPE_CHECKING:
    from sms_jobs.formats.rig_configuration import SensorRecords
    from sms_jobs.records.optical_instruments import RigFile

EVERY_RIG = "rigs"
"""Among the queues that a worker is to serve: those of every rig of its host, whenever it is connected."""


@dataclass(frozen=True)
class Stations:
    """The rigs of a host.

    Attributes
    ----------
    rigs
        Folder of their files, `<rig>.toml`.
    spool
        Folder for frames as they come in, one folder a job.
    """

    rigs: Path
    spool: Path

    @classmethod
    def of(cls, settings: Settings) -> Stations:
        """Return those of a home."""
        return cls(settings.rig_folder, settings.spool_folder)

    def names(self) -> tuple[str, ...]:
        """Return the names of the rigs that are connected here."""
        return tuple(sorted(path.stem for path in self.rigs.glob("*.toml")))

    def queues(self) -> tuple[str, ...]:
        """Return the queues of the jobs that work with these rigs."""
        return tuple(rig_queue(name) for name in self.names())

    def served(self, queues: Sequence[str]) -> tuple[str, ...]:
        """Return the queues that a worker serves now which is to serve these."""
        return tuple(q for queue in queues for q in (self.queues() if queue == EVERY_RIG else (queue,)))

    def rig(self, name: str) -> RigFile:
        """Return what the file of a rig says.

        Raises
        ------
        NotFound
            When no such rig is connected here.
        ConfigurationError
            When its file cannot be used.
        """
        path = self._path(name)
        if not path.is_file():
            connected = ", ".join(self.names()) or "none"
            raise NotFound(
                f"no rig '{name}' is connected to this host (there: {connected}); 'sms rig add' connects one"
            )
        return _read(path)

    def unit(self, rig: str, channel: str) -> str:
        """Return the unit of a channel of a rig; raises as `rig` does, and `NotFound` without the channel."""
        channels = self.rig(rig).serial.channels
        found = next((one for one in channels if one.name == channel), None)
        if found is None:
            known = ", ".join(one.name for one in channels) or "none"
            raise NotFound(f"rig {rig} has no channel '{channel}'; it has {known}")
        return found.unit

    def add(self, file: Path, replace: bool) -> RigFile:
        """Take the file of a rig over; raise `Conflict` when there is one and it is not to be replaced."""
        rig = _read(file)
        path = self._path(rig.name)
        if path.exists() and not replace:
            raise Conflict(
                f"a rig '{rig.name}' is already connected, by {path}; set `replace` to use the new file"
            )
        self.rigs.mkdir(parents=True, exist_ok=True)
        beside = path.with_suffix(".new")
        shutil.copyfile(file, beside)
        beside.replace(path)
        return rig

    def station(self, rig: str, job_id: str) -> Station:
        """Return where a job works; raises as `rig` does."""
        return Station(self.rig(rig), self.spool_of(job_id))

    def spool_of(self, job_id: str) -> Path:
        """Return the folder for the frames of a job."""
        return self.spool / checked_name(job_id, "job")

    def empty(self, job_id: str) -> None:
        """Remove the frames of a job whose measurements lie in the archive."""
        shutil.rmtree(self.spool_of(job_id), ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self.rigs / f"{checked_name(name, 'rig')}.toml"


def _read(file: Path) -> RigFile:
    from sms_jobs.formats.rig_configuration import load_rig

    return load_rig(file, known_sensors())


def known_sensors() -> SensorRecords:
    """Return what rig files may say of the cameras and projectors that there are drivers for."""
    from sms_jobs.formats.rig_configuration import SensorRecords
    from sms_jobs.instruments.optical_drivers import camera_drivers, projector_drivers

    return SensorRecords(
        {name: driver.record for name, driver in camera_drivers().items()},
        {name: driver.record for name, driver in projector_drivers().items()},
    )
