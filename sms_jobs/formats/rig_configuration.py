"""Rig files: which instruments a host has, and how they are connected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from pydantic import create_model

from sms_jobs.formats.interchange.text_files import read_text
from sms_jobs.formats.nested_tables import nested, one_of
from sms_jobs.formats.record_tables import Table
from sms_jobs.formats.written_files import read_toml, validated
from sms_jobs.records.instruments import (
    FileChannel,
    Instruments,
    SerialChannel,
    Stage,
    TriggerController,
    VideoSplitter,
)
from sms_jobs.records.optical_instruments import (
    SIMULATED,
    CameraInstrument,
    ProjectorInstrument,
    RigFile,
    VirtualCamera,
    VirtualProjector,
)

HINT = "`sms rig add --example` prints a valid file"


class RigTable(Table):
    """The whole of a rig file; what its cameras and projectors may say depends on the known drivers."""

    name: str
    cameras: tuple[Any, ...]
    projectors: tuple[Any, ...] = ()
    stages: tuple[Annotated[Stage, nested(Stage)], ...] = ()
    triggers: tuple[Annotated[TriggerController, nested(TriggerController)], ...] = ()
    splitters: tuple[Annotated[VideoSplitter, nested(VideoSplitter)], ...] = ()
    channels: tuple[Annotated[SerialChannel, nested(SerialChannel)], ...] = ()
    file_channels: tuple[Annotated[FileChannel, nested(FileChannel)], ...] = ()

    def record(self) -> RigFile:
        """Return the record, checked as a whole."""
        serial = Instruments(
            self.stages, self.triggers, self.splitters, (*self.channels, *self.file_channels)
        )
        return RigFile(self.name, self.cameras, self.projectors, serial)


@dataclass(frozen=True)
class SensorRecords:
    """What may be said of cameras and projectors: a record for each driver, as its `driver` names it.

    Attributes
    ----------
    cameras, projectors
        By the names of their drivers.
    """

    cameras: Mapping[str, type[CameraInstrument]]
    projectors: Mapping[str, type[ProjectorInstrument]]


SIMULATED_SENSORS = SensorRecords({SIMULATED: VirtualCamera}, {SIMULATED: VirtualProjector})


def load_rig(path: Path, sensors: SensorRecords = SIMULATED_SENSORS) -> RigFile:
    """Read a rig file; its cameras and projectors are of the drivers that `sensors` knows.

    Raises
    ------
    NotFound
        There is no such file.
    ConfigurationError
        It does not describe a rig; the message names the file, the line and the key.
    """
    return parse_rig(read_text(path, "rig file"), str(path), sensors)


def parse_rig(text: str, source: str, sensors: SensorRecords = SIMULATED_SENSORS) -> RigFile:
    """Read the text of a rig file; `source` names it in messages. Raises `ConfigurationError`."""
    content, places = read_toml(text, source)
    cameras: Any = Annotated[CameraInstrument, one_of(sensors.cameras.values(), "driver")]
    projectors: Any = Annotated[ProjectorInstrument, one_of(sensors.projectors.values(), "driver")]
    seeing: Any = tuple.__class_getitem__((cameras, ...))
    lighting: Any = tuple.__class_getitem__((projectors, ...))
    table = create_model("RigTable", __base__=RigTable, cameras=(seeing, ...), projectors=(lighting, ()))
    return validated(table, content, places, HINT, RigTable.record)


def example_rig() -> str:
    """Return the text of a commented, valid file: simulated instruments of a virtual rig."""
    return files("sms_jobs.formats").joinpath("example_rig.toml").read_text("utf-8")
