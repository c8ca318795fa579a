"""What the instruments of a rig say of themselves, and what its cameras see of its projectors."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass

from sms_jobs.instruments.cameras.scanner import ScannerCamera
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.recording_sets import FRAME_TIMEOUT_S

DARK, NOW = "dark", "now"


@dataclass(frozen=True)
class RigCheck:
    """What was found.

    Attributes
    ----------
    sensors
        What each camera and projector says of itself, by name.
    views
        Mean grey level of each camera: when all projectors are dark, and with each at full brightness in
        turn; now, by whatever light there is, of a rig without any. None for simulated ones, which see a
        campaign's scene alone.
    full_scales
        Grey level at which each camera saturates.
    channels
        What they read.
    stage_rad
        Pan and tilt; None where there is no stage, or it does not know where it is.
    homed
        Whether it knows; None where there is no stage.
    """

    sensors: Mapping[str, str]
    views: Mapping[str, Mapping[str, float]]
    full_scales: Mapping[str, int]
    channels: Mapping[str, float]
    stage_rad: tuple[float, float] | None
    homed: bool | None


def checked(rig: ConnectedRig) -> RigCheck:
    """Ask every instrument, and let every camera look at every projector.

    A scanner that simulates its cameras has none while no campaign gives it a scene.

    Raises
    ------
    InstrumentError
        When one does not answer, or a camera delivers no frame.
    """
    stage_rad = None if rig.stage is None else rig.stage.known_angles()
    looking = all(c.there for c in rig.cameras.values() if isinstance(c, ScannerCamera))
    return RigCheck(
        rig.described,
        _views(rig) if looking else {},
        {name: camera.facts.full_scale for name, camera in rig.cameras.items()} if looking else {},
        rig.read_channels(),
        stage_rad,
        None if rig.stage is None else stage_rad is not None,
    )


def _views(rig: ConnectedRig) -> dict[str, dict[str, float]]:
    views: dict[str, dict[str, float]] = {name: {} for name in rig.cameras}

    def look(what: str) -> None:
        rig.fire(rig.cameras)
        for name, camera in rig.cameras.items():
            views[name][what] = float(camera.read(FRAME_TIMEOUT_S).image.mean())

    with ExitStack() as ending:
        for camera in rig.cameras.values():
            ending.callback(camera.disarm)
            camera.arm(1.0)
        for projector in rig.projectors.values():
            ending.callback(projector.dark)
            projector.dark()
        look(DARK if rig.projectors else NOW)
        for name, projector in rig.projectors.items():
            rig.video.feed(name)
            projector.white()
            look(name)
            projector.dark()
    return views
