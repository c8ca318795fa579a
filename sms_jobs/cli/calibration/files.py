"""`sms calibration export` and `import`: calibrations in the files of other programs."""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from sms_jobs import bootstrap
from sms_jobs.app import writing
from sms_jobs.app.calibrating import calibrations
from sms_jobs.app.calibrating.calibrations import STYLES, Imported
from sms_jobs.cli import output
from sms_jobs.cli.options import Force
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.records.times import parsed_time

_SIZE = re.compile(r"(?P<name>\w{1,8})=(?P<columns>\d{1,6})x(?P<rows>\d{1,6})")

_Six = tuple[float, float, float, float, float, float]


def export(
    number: Annotated[int, typer.Argument(help="Number of a calibration; see 'sms calibration list'.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")],
    style: Annotated[
        str | None,
        typer.Option(
            "--as",
            help=f"One of {', '.join(STYLES)}; the suffix of --out decides if not given, but for .xml.",
            show_default=False,
        ),
    ] = None,
    pixel_pitch_um: Annotated[
        float,
        typer.Option(
            "--pixel-pitch-um",
            help="thesis-xml: width of a pixel in micrometres, which sets the scale of its millimetres.",
            min=0.01,
            max=1000.0,
        ),
    ] = 5.0,
    force: Force = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Write a calibration for other programs.

    opencv-yaml, opencv-xml and opencv-json are files of OpenCV's FileStorage with a table for every sensor:
    image_width, image_height, camera_matrix, distortion_coefficients, R and T in mm, x = R X + T. thesis-xml
    has millimetres on the chip, angles and pin-holes.

    Example: sms calibration export 3 --as opencv-yaml --out hall-3.yml
    """
    style = calibrations.style_for(out, style)
    writing.check_new_file(out, force)
    with bootstrap.services(home) as services:
        found = calibrations.export(services, number, style, pixel_pitch_um=pixel_pitch_um)
    writing.write_file(out, found.text, force)
    if as_json:
        output.print_json({"calibration": number, "style": style, "file": out, "remarks": found.remarks})
        return
    for remark in found.remarks:
        output.say(remark)
    output.say(f"wrote {out}")


Files: TypeAlias = Annotated[
    list[Path], typer.Argument(help="Calibration file, or several that complete each other.")
]
Rig: TypeAlias = Annotated[str | None, typer.Option(help="Rig that it is of.", show_default=False)]
ValidFrom: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--valid-from", help="From when it holds, as in 2026-05-04T10:00:00+02:00.", show_default=False
    ),
]
Volume: TypeAlias = Annotated[
    _Six | None,
    typer.Option(
        help="Measurement volume in the world's frame, in mm: its lower corner, then its upper. Of "
        "cameras without projectors it is what they see together, if not given.",
        metavar="X Y Z X Y Z",
        show_default=False,
    ),
]
Cameras: TypeAlias = Annotated[
    list[str] | None, typer.Option(help="Name of a camera, in the order of the file.", show_default=False)
]
Projectors: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(help="Name of a projector, in the order of the file.", show_default=False),
]
Sizes: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        help="Image size of a sensor whose size the file does not say, as in P1=1920x1080.",
        show_default=False,
    ),
]
UnitMm: TypeAlias = Annotated[
    float, typer.Option("--unit-mm", help="Millimetres in the file's unit of length: 1000 for metres.")
]


def import_(
    files: Files,
    rig: Rig = None,
    valid_from: ValidFrom = None,
    volume: Volume = None,
    camera: Cameras = None,
    projector: Projectors = None,
    size: Sizes = None,
    unit_mm: UnitMm = 1.0,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Bring in a calibration that was made elsewhere.

    Reads what 'sms calibration export' writes, and files of OpenCV with one camera or two, as OpenCV's
    samples, SLStudio, SLMaster and others write them; the world is then the frame of the first sensor. Reads
    the cameras of DICe (camera system file), VIC-3D (project) and MatchID (.caldat) too. What the file does
    not say has to be added. Nothing is changed unless everything is right.

    The first calibration of a rig is used at once. Where the rig has one in use, nothing is computed with
    this one before 'sms calibration accept'; one of other sensors is refused.

    Example: sms calibration import calibration.xml --rig desk --valid-from 2026-05-04T10:00:00+02:00
    --volume -200 -200 500 200 200 900

    Example: sms calibration import cal.caldat --rig stereo --valid-from 2026-05-04T10:00:00+02:00
    --size C1=1920x1200 --size C2=1920x1200

    Example: sms calibration import intrinsics.yml extrinsics.yml --camera C1 --projector P1
    --size C1=1280x1024 --size P1=1920x1080 --unit-mm 1000 --rig desk --valid-from 2026-05-04T10:00:00+02:00
    --volume -200 -200 500 200 200 900
    """
    from sms_jobs.records.sensors import Box
    from sms_jobs.records.supplements import Supplement

    supplement = Supplement(
        rig=rig,
        valid_from=_time(valid_from),
        volume=None if volume is None else Box(volume[:3], volume[3:]),
        names=(*(camera or ()), *(projector or ())),
        sizes=_sizes(size or []),
        millimetres_per_unit=unit_mm,
    )
    with bootstrap.services(home) as services:
        found = calibrations.import_files(services, files, supplement)
    registered, calibration = found.registered, found.calibration
    if as_json:
        output.print_json(
            {
                "calibration": registered.number,
                "new": registered.new,
                "in_use": registered.in_use,
                "rig": calibration.rig.name,
                "sensors": [s.name for s in calibration.rig.sensors],
                "valid_from": calibration.valid_from,
                "remarks": found.remarks,
            }
        )
        return
    for remark in found.remarks:
        output.say(remark)
    names = " ".join(s.name for s in calibration.rig.sensors)
    said = "is entered" if registered.new else "is in the catalogue already"
    output.say(
        f"calibration {registered.number} of rig {calibration.rig.name} ({names}) {said}; {_next(found)}"
    )


def _next(found: Imported) -> str:
    registered = found.registered
    if registered.in_use:
        return f"next: sms calibration show {registered.number}"
    return (
        "it is inactive, since the rig has another in use: "
        f"'sms calibration accept {registered.number}' takes it into use"
    )


def _time(text: str | None) -> datetime | None:
    return None if text is None else parsed_time(text, "--valid-from")


def _sizes(texts: list[str]) -> dict[str, tuple[int, int]]:
    found: dict[str, tuple[int, int]] = {}
    for text in texts:
        said = _SIZE.fullmatch(text)
        if said is None:
            raise InvalidInput(f"--size should be as in P1=1920x1080, not '{text}'")
        if said["name"] in found:
            raise InvalidInput(f"--size says the size of {said['name']} twice")
        found[said["name"]] = (int(said["columns"]), int(said["rows"]))
    return found
