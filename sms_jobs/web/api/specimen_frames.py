"""The specimen's own frame of a campaign: shown, found on its measured surface, and taken away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field

from sms_jobs.app.specimens import specimen_frames
from sms_jobs.app.specimens.frame_choice import Choice
from sms_jobs.records.specimen_frame import SpecimenFrame
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Name, RequestBody, Text
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("campaigns")

_Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Point = Annotated[
    list[_Coordinate],
    Field(
        min_length=2,
        max_length=3,
        description="Column and row in px of the reference image, or X, Y, Z of the world in mm.",
    ),
]


@dataclass(frozen=True)
class FrameAnswer:
    """The specimen frame of a campaign, or whether its scene has one, and what lies along another now."""

    campaign: str
    frame: SpecimenFrame | None
    of_scene: bool
    in_image: bool
    stale: dict[str, int]


class NewFrame(RequestBody):
    """How a frame is found: by three points, or by two and the plane of a region."""

    x: Annotated[Point, Field(description="A point of the x axis.")]
    origin: Annotated[Point | None, Field(description="The middle of the region if not given.")] = None
    plane: Annotated[Point | None, Field(description="A third point, of the xy plane.")] = None
    fit: Annotated[
        Text,
        Field(
            description="In place of a third point: a region whose plane is the xy plane, as rectangle LEFT "
            "TOP RIGHT BOTTOM or polygon X Y X Y X Y, in px."
        ),
    ] = ""
    view: Annotated[
        Text | None, Field(description="Whose image; the first that measures shape if not given.")
    ] = None
    markers: Annotated[bool, Field(description="The pixels lie in round marks, whose middles are taken.")] = (
        False
    )

    @property
    def choice(self) -> Choice:
        """The same, as the use case takes it."""
        return Choice(
            tuple(self.x),
            None if self.origin is None else tuple(self.origin),
            None if self.plane is None else tuple(self.plane),
            self.fit,
            self.view,
            self.markers,
        )


@ROUTES.offer("GET", "/campaigns/{name}/frame", specimen_frames.show, answers=FrameAnswer)
def show(services: Acting, name: Name) -> Any:
    """Return the specimen frame of a campaign."""
    return answer(specimen_frames.show(services, name))


@ROUTES.offer("POST", "/campaigns/{name}/frame", specimen_frames.find, answers=FrameAnswer)
def find(services: Acting, name: Name, body: NewFrame) -> Any:
    """Find the specimen frame of a campaign."""
    return answer(specimen_frames.find(services, name, body.choice))


@ROUTES.offer("DELETE", "/campaigns/{name}/frame", specimen_frames.drop, answers=FrameAnswer)
def drop(services: Acting, name: Name) -> Any:
    """Take the specimen frame of a campaign away."""
    return answer(specimen_frames.drop(services, name))
