"""Rig files: which instruments a host has, and how they are connected."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Annotated

from sms_jobs.formats.interchange.text_files import read_text
from sms_jobs.formats.nested_tables import nested
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
from sms_jobs.records.optical_instruments import CameraInstrument, ProjectorInstrument, RigFile

HINT = "`sms rig add --example` prints a valid file"


class RigTable(Table):
    """The whole of a rig file."""

    name: str
    cameras: tuple[Annotated[CameraInstrument, nested(CameraInstrument)], ...]
    projectors: tuple[Annotated[ProjectorInstrument, nested(ProjectorInstrument)], ...] = ()
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


def load_rig(path: Path) -> RigFile:
    """Read a rig file.

    Raises
    ------
    NotFound
        There is no such file.
    ConfigurationError
        It does not describe a rig; the message names the file, the line and the key.
    """
    return parse_rig(read_text(path, "rig file"), str(path))


def parse_rig(text: str, source: str) -> RigFile:
    """Read the text of a rig file; `source` names it in messages. Raises `ConfigurationError`."""
    content, places = read_toml(text, source)
    return validated(RigTable, content, places, HINT, RigTable.record)


def example_rig() -> str:
    """Return the text of a commented, valid file: simulated instruments of a virtual rig."""
    return files("sms_jobs.formats").joinpath("example_rig.toml").read_text("utf-8")
