"""`sms campaign frame`: where the specimen's own axes lie."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.app.specimens import specimen_frames
from sms_jobs.app.specimens.frame_choice import Choice, Place
from sms_jobs.app.specimens.specimen_frames import FrameOf
from sms_jobs.cli import output
from sms_jobs.cli.options import CampaignArgument
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput

if TYPE_CHECKING:
    from sms_jobs.records.specimen_frame import FrameDeviation, SpecimenFrame


def frame(
    campaign: CampaignArgument,
    origin: Annotated[
        str | None,
        typer.Option(
            help="Origin: column,row in px of the reference image, or X,Y,Z of the world in mm; with --fit "
            "the middle of the region if not given.",
            show_default=False,
        ),
    ] = None,
    x: Annotated[
        str | None, typer.Option("--x", help="A point of the x axis, as --origin.", show_default=False)
    ] = None,
    plane: Annotated[
        str | None,
        typer.Option(
            help="A third point, of the xy plane, as --origin; of the world it has a positive y.",
            show_default=False,
        ),
    ] = None,
    fit: Annotated[
        str | None,
        typer.Option(
            help="In place of a third point: a region of the reference image whose plane is the xy plane, as "
            "'rectangle LEFT TOP RIGHT BOTTOM' or 'polygon X Y X Y X Y' in px.",
            show_default=False,
        ),
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(help="Whose image pixels are of; the first that measures shape if not given."),
    ] = None,
    markers: Annotated[
        bool, typer.Option("--markers", help="The pixels lie in round marks, whose middles are taken.")
    ] = False,
    drop: Annotated[bool, typer.Option("--drop", help="Take the frame away again.")] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Find the specimen's own frame on its measured surface, or show it.

    Strain and virtual gauges lie along its x axis from then on; those that were computed along another are
    stale. z points out of the surface, to the camera.

    Example: sms campaign frame wing --view C1P1 --origin 512,400 --x 900,410 --plane 480,300

    Example: sms campaign frame wing --fit 'rectangle 100 100 900 700' --origin 512,400 --x 900,410

    Example: sms campaign frame wing, which shows it with its deviations
    """
    given = (origin, x, plane, fit, view) != (None,) * 5 or markers
    if drop and given:
        raise InvalidInput("--drop takes the frame away and needs nothing else; leave the other options out")
    with bootstrap.services(home) as services:
        if drop:
            found = specimen_frames.drop(services, campaign)
        elif given:
            found = specimen_frames.find(services, campaign, _choice(origin, x, plane, fit, view, markers))
        else:
            found = specimen_frames.show(services, campaign)
    _tell(found, as_json)


def _choice(
    origin: str | None, x: str | None, plane: str | None, fit: str | None, view: str | None, markers: bool
) -> Choice:
    if x is None:
        raise InvalidInput("give a point of the x axis by --x, such as --x 900,410")
    third = None if plane is None else _place(plane, "--plane")
    start = None if origin is None else _place(origin, "--origin")
    return Choice(_place(x, "--x"), start, third, fit or "", view, markers)


def _place(text: str, option: str) -> Place:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (2, 3) or not all(abs(one) <= 1e6 for one in numbers):
        raise InvalidInput(
            f"{option} {text} is not a point; write column,row in px like 512,400, or X,Y,Z in mm like "
            "-20,35.5,4"
        )
    return numbers


def _tell(found: FrameOf, as_json: bool) -> None:
    if as_json:
        output.print_json(
            {
                "campaign": found.campaign,
                "frame": found.frame,
                "of_scene": found.of_scene,
                "in_image": found.in_image,
                "stale": found.stale,
            }
        )
        return
    if found.in_image:
        output.say(
            f"campaign {found.campaign} has no specimen frame, and none can be found: its cameras measure in "
            "the plane of the image, along whose axes its results lie"
        )
    elif found.frame is None:
        axes = "those of the scene" if found.of_scene else "the world's"
        output.say(
            f"campaign {found.campaign} has no specimen frame of its own: the specimen's axes are {axes}; "
            "'sms campaign frame --help' shows how one is found"
        )
    else:
        output.print_facts(_facts(found.frame))
    if found.stale:
        counts = " and ".join(f"{number} of {kind}" for kind, number in found.stale.items())
        output.say(
            f"stale by now: {counts}; 'sms job submit pipeline -c {found.campaign}' computes strain again"
        )


def _facts(frame: SpecimenFrame) -> dict[str, Any]:
    """Return what people ask of a frame, in mm and degrees."""
    turn = frame.placement.rotation
    x, y, z = zip(*turn, strict=True)
    by = {"points": "three points", "plane": f"the plane of {frame.region}"}[frame.method]
    facts: dict[str, Any] = {
        "found by": f"{by}{', middles of marks' if frame.markers else ''}",
        "on": f"the reference surface of {frame.view}" if frame.view else "points of the world",
        "origin [mm]": _three(frame.placement.translation, "8.3f"),
        "x axis": _three(x, "9.6f"),
        "y axis": _three(y, "9.6f"),
        "z axis": _three(z, "9.6f"),
    }
    if frame.rms_mm is not None:
        facts["rms off the plane [mm]"] = f"{frame.rms_mm:.3g}"
    facts |= _deviations("sigma", frame.deviation, "not known of points of the world")
    facts |= _deviations("calibration's sigma", frame.calibration, "not known; not zero")
    if frame.deviation is not None:
        share = 1e3 * frame.deviation.turn_rad[2]
        facts["shear that a turn about z feigns"] = f"{share:.2g} microstrain for every 1000 of xx - yy"
    return facts


def _deviations(name: str, deviation: FrameDeviation | None, unknown: str) -> dict[str, str]:
    if deviation is None:
        return {f"{name}": unknown}
    turns = [degrees(one) for one in deviation.turn_rad]
    return {
        f"{name} of turns about x, y, z [deg]": " ".join(f"{one:.2g}" for one in turns),
        f"{name} of the origin along x, y, z [mm]": " ".join(f"{one:.2g}" for one in deviation.origin_mm),
    }


def _three(values: tuple[float, float, float], form: str) -> str:
    return " ".join(f"{value:{form}}" for value in values)
