"""Rigs: the instruments that are connected to the host that serves, and who holds them."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import Annotated, Any

from fastapi.responses import PlainTextResponse
from pydantic import Field

from sms_jobs.app.measuring import rigs
from sms_jobs.records.optical_instruments import RigFile
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import LongText, Name, RequestBody, Text
from sms_jobs.web.routes import Routes, answer, returned
from sms_jobs.web.sent_texts import text_as_file

ROUTES = Routes("rigs")


class NewRig(RequestBody):
    """A rig that is to be connected."""

    file: Annotated[LongText, Field(description="Text of the rig file, as of `sms rig add`.")]
    replace: bool = False


class Pose(RequestBody):
    """Where the stage is to stand."""

    pan_deg: Annotated[float, Field(ge=-360, le=360)]
    tilt_deg: Annotated[float, Field(ge=-360, le=360)]


class Held(RequestBody):
    """A device that somebody holds, or held."""

    device: Text


@dataclass(frozen=True)
class RigFacts:
    """A rig, by the names of its instruments."""

    rig: str
    cameras: tuple[str, ...]
    projectors: tuple[str, ...]
    devices: tuple[str, ...]


def _facts(rig: RigFile) -> RigFacts:
    return RigFacts(
        rig.name,
        tuple(camera.name for camera in rig.cameras),
        tuple(projector.name for projector in rig.projectors),
        tuple(device for device in rig.devices if device not in rig.sensors),
    )


@ROUTES.offer("GET", "/rigs", rigs.list_rigs, answers=list[RigFacts])
def list_rigs(services: Acting) -> Any:
    """Return the rigs."""
    return answer([_facts(rig) for rig in rigs.list_rigs(services)])


@ROUTES.offer("POST", "/rigs", rigs.add, answers=RigFacts, status=201)
def add(services: Acting, body: NewRig) -> Any:
    """Connect a rig by the text of its file."""
    with text_as_file(body.file, "rig.toml") as file:
        return answer(_facts(rigs.add(services, file, replace=body.replace)), 201)


@ROUTES.offer("GET", "/rigs/{rig}/file", rigs.file_text, media=("text/plain",))
def file_text(services: Acting, rig: Name) -> Any:
    """Return the file of a rig."""
    return PlainTextResponse(rigs.file_text(services, rig))


@ROUTES.offer("POST", "/rigs/{rig}/check", rigs.check)
def check(services: Acting, rig: Name) -> Any:
    """Talk to every instrument of a rig."""
    done = rigs.check(services, rig)
    return answer({"rig": rig, "check": done.check, "units": done.units})


@ROUTES.offer("POST", "/rigs/{rig}/home", rigs.home_stage, answers=dict[str, str | int])
def home_stage(services: Acting, rig: Name) -> Any:
    """Bring a rig's stage home."""
    rigs.home_stage(services, rig)
    return answer({"homed": rig})


@ROUTES.offer("POST", "/rigs/{rig}/move", rigs.move_stage, answers=dict[str, float])
def move_stage(services: Acting, rig: Name, body: Pose) -> Any:
    """Bring a rig's stage to a pose."""
    pan, tilt = rigs.move_stage(services, rig, radians(body.pan_deg), radians(body.tilt_deg))
    return answer({"pan_rad": pan, "tilt_rad": tilt})


@ROUTES.offer("POST", "/rigs/{rig}/stop", rigs.stop)
def stop(services: Acting, rig: Name) -> Any:
    """Stop a rig's stages at once."""
    return answer({"stopped": rigs.stop(services, rig)})


@ROUTES.offer("GET", "/devices", rigs.held_devices, answers=returned(rigs.held_devices))
def held_devices(services: Acting) -> Any:
    """Return which devices are held."""
    return answer(rigs.held_devices(services))


@ROUTES.offer("POST", "/devices/release", rigs.release, answers=returned(rigs.release))
def release(services: Acting, body: Held) -> Any:
    """Forget a lock whose holder is gone."""
    return answer(rigs.release(services, body.device))
