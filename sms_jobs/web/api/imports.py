"""Imports: what was uploaded becomes measurements, readings, points, surfaces and calibrations.

They take what the commands `sms import` and `sms calibration import` take; a folder or file is named by its
path in the upload, and a layout, a plan or a board is sent as text.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any

from fastapi import Request
from fastapi.responses import PlainTextResponse
from pydantic import Field

from sms_jobs.app.calibrating import calibrations
from sms_jobs.app.importing import boards, frames, images, points, readings, surface, uploads
from sms_jobs.app.importing.image_entry import EntryOptions
from sms_jobs.app.importing.outcomes import Outcome
from sms_jobs.app.importing.points import ImportedPoints
from sms_jobs.app.importing.surface import ImportedSurface
from sms_jobs.app.progress import Tell
from sms_jobs.bootstrap import Services
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.records.sensors import Box
from sms_jobs.records.supplements import Supplement
from sms_jobs.web.identity import Acting
from sms_jobs.web.long_work import MEDIA, followed
from sms_jobs.web.request_bodies import LongText, Moment, RequestBody, Text, Texts
from sms_jobs.web.routes import Routes, answer
from sms_jobs.web.sent_texts import text_as_file

ROUTES = Routes("imports")

UploadId = Annotated[str, Field(pattern=r"^u[0-9a-f]{24}$", description="Id of the upload.")]
Size = Annotated[list[Annotated[int, Field(ge=1, le=65536)]], Field(min_length=2, max_length=2)]
Sizes = Annotated[dict[Text, Size], Field(max_length=64, description="Columns and rows of sensors, by name.")]
Corner = Annotated[float, Field(ge=-1e7, le=1e7)]
Volume = Annotated[
    list[Corner], Field(min_length=6, max_length=6, description="Lower, then upper corner, in mm.")
]
Positive = Annotated[float, Field(gt=0, le=1e9)]
PitchSigma = Annotated[
    float | None,
    Field(gt=0, le=0.1, description="How well the pitch is known; if unknown, scale is nominal."),
]
Flatness = Annotated[
    float | None, Field(ge=0, le=1e3, description="Standard deviation of bow and twist, mm.")
]
FileName = Annotated[Text, Field(min_length=1, description="Path of the file in the upload.")]


class FromFolder(RequestBody):
    """Images of a folder of an upload."""

    upload: UploadId
    folder: Annotated[Text, Field(description="In the upload; all of it if empty.")] = ""
    campaign: Text
    only: Annotated[Text | None, Field(description="Only files whose path has this form.")] = None
    recorded_at: Annotated[Moment | None, Field(description="When; the files' times if not given.")] = None
    add_states: bool = False
    newer: bool = False
    dry_run: Annotated[bool, Field(description="Read and check all, and change nothing.")] = False


class FromCameras(FromFolder):
    """Images of cameras in a folder of an upload."""

    pattern: Annotated[Text | None, Field(description="File names; guessed if not given.")] = None
    cameras: Annotated[Text | None, Field(description="As 'left=C1 right=C2'.")] = None
    camera: Text | None = None


class Images(FromCameras):
    """Images that become the states of a campaign."""

    views: Text | None = None
    alone: bool = False
    reference: Text | None = None
    rig: Text | None = None
    specimen: Text | None = None
    full_scale: Annotated[int | None, Field(ge=1, le=2**31)] = None
    gain: Annotated[float | None, Field(ge=0)] = None
    read_noise: Annotated[float | None, Field(ge=0)] = None
    raw: Text | None = None


class Boards(FromCameras):
    """Images of a calibration board that become the poses of a session."""

    rig: Text | None = None
    board: Annotated[LongText | None, Field(description="Text of the file that describes the board.")] = None
    chessboard: Annotated[Text | None, Field(description="Inner corners, as 9x6.")] = None
    pitch_mm: Positive | None = None
    pitch_relative_sigma: PitchSigma = None
    flatness_mm: Flatness = None
    volume: Volume | None = None


class Frames(FromFolder):
    """Fringe frames that become the measurements of a campaign."""

    layout: Annotated[LongText | None, Field(description="Text of a layout file.")] = None
    given: Annotated[
        dict[Text, Any], Field(description="Of a layout, by table and name, as 'sequence.steps'.")
    ] = {}
    rig: Text | None = None
    specimen: Text | None = None
    plan: Annotated[LongText | None, Field(description="Text of the plan of a new campaign.")] = None


class Readings(RequestBody):
    """A table of readings that become channels of a campaign's states."""

    upload: UploadId
    file: FileName
    campaign: Text
    maps: Annotated[Texts, Field(description="As COLUMN=CHANNEL[UNIT].")] = []
    state_column: Text | None = None
    time_column: Text | None = None
    time_zone: Text | None = None
    within: Annotated[float, Field(ge=0, le=1e7, description="Seconds.")] = 2.0
    delimiter: Text | None = None
    decimal: Text | None = None
    unit: Annotated[Text, Field(description="Of columns that say none: um/m for strain gauges.")] = ""
    replace: bool = False
    dry_run: bool = False


class Points(RequestBody):
    """Points of a board that another program has found."""

    upload: UploadId
    file: FileName
    session: Text
    rig: Text
    view: Text
    sizes: Sizes
    sigma_px: Annotated[float, Field(ge=1e-4, le=1e4)] = 0.1
    pitch_relative_sigma: PitchSigma = None
    flatness_mm: Flatness = None
    recorded_at: Moment | None = None
    dry_run: bool = False


class ReferenceSurface(RequestBody):
    """The surface that a campaign is compared with."""

    upload: UploadId
    file: FileName
    campaign: Text
    unit: Text = "mm"
    turn_over: bool = False


class ForeignCalibration(RequestBody):
    """A calibration that was made elsewhere."""

    upload: UploadId
    files: Annotated[list[FileName], Field(min_length=1, max_length=20)]
    rig: Text | None = None
    valid_from: Moment | None = None
    volume: Volume | None = None
    names: Annotated[Texts, Field(description="Of sensors, in the order of the files.")] = []
    sizes: Sizes = {}
    unit_mm: Positive = 1.0


@ROUTES.offer("POST", "/imports/images", images.enter, media=(MEDIA,))
async def import_images(request: Request, services: Acting, body: Images) -> Any:
    """Let images become the states of a campaign."""

    def work(tell: Tell) -> dict[str, Any]:
        with _folder(services, body) as folder:
            made_by = images.Camera(body.raw, body.full_scale, body.gain, body.read_noise)
            own = body.model_dump(include=_SHARED | {"views", "alone", "reference", "rig", "specimen"})
            found = images.arrange_images(services, images.Task(folder, made_by=made_by, **own))
            done = images.enter(services, found, _how(body), tell)
            return _outcome(found.pattern, replace(done, remarks=(*found.remarks, *done.remarks)))

    return await followed(request, work)


@ROUTES.offer("POST", "/imports/boards", boards.enter, media=(MEDIA,))
async def import_boards(request: Request, services: Acting, body: Boards) -> Any:
    """Let images of a board become a calibration session."""

    def work(tell: Tell) -> dict[str, Any]:
        with _folder(services, body) as folder, _texts() as lay:
            own = body.model_dump(include=_SHARED - {"campaign"} | _OF_CHESSBOARD)
            task = boards.Task(
                folder, body.campaign, volume=_box(body.volume), board=lay(body.board, "board.toml"), **own
            )
            found = boards.arrange_boards(services, task)
            return _outcome(found.pattern, boards.enter(services, found, _how(body), tell))

    return await followed(request, work)


@ROUTES.offer("POST", "/imports/frames/layout", frames.guess, media=("text/plain",))
def guess_layout(services: Acting, body: Frames) -> Any:
    """Say what frames may be, as a layout file to correct and send back."""
    with _folder(services, body) as folder, _texts() as lay:
        return PlainTextResponse(frames.guess(services, _frames(folder, body, lay)).layout_text)


@ROUTES.offer("POST", "/imports/frames", frames.enter, media=(MEDIA,))
async def import_frames(request: Request, services: Acting, body: Frames) -> Any:
    """Let frames become the measurements of a campaign."""

    def work(tell: Tell) -> dict[str, Any]:
        with _folder(services, body) as folder, _texts() as lay:
            found = frames.arrange_frames(services, frames.guess(services, _frames(folder, body, lay)))
            done = frames.enter(services, found, dry_run=body.dry_run, tell=tell)
            remarks = (*found.guessed.guess.remarks, *done.remarks)
            return _outcome(found.layout.pattern.text, replace(done, remarks=remarks))

    return await followed(request, work)


@ROUTES.offer("POST", "/imports/readings", readings.enter)
def import_readings(services: Acting, body: Readings) -> Any:
    """Let a table of readings become channels of states."""
    with _file(services, body.upload, body.file) as file:
        own = body.model_dump(exclude={"upload", "file", "maps", "within", "dry_run"})
        task = readings.Task(file, maps=tuple(body.maps), within=timedelta(seconds=body.within), **own)
        found = readings.arrange_readings(services, task)
        if not body.dry_run:
            readings.enter(services, found)
    return answer(
        {
            "campaign": body.campaign,
            "dry_run": body.dry_run,
            "states": [reading.state for reading in found.readings],
            "changes": found.changes,
            "left_out": found.left_out,
            "remarks": [*found.remarks, *(f"{c.header} becomes {c.target}" for c in found.columns)],
        }
    )


@ROUTES.offer("POST", "/imports/points", points.import_points)
def import_points(services: Acting, body: Points) -> Any:
    """Let points of a board become a calibration session."""
    with _file(services, body.upload, body.file) as file:
        sizes = {name: (columns, rows) for name, (columns, rows) in body.sizes.items()}
        known = body.recorded_at, body.pitch_relative_sigma, body.flatness_mm
        task = points.Task(file, body.session, body.rig, body.view, sizes, body.sigma_px, *known)
        done: ImportedPoints = points.import_points(services, task, dry_run=body.dry_run)
    return answer({"session": body.session, "board": done.board, "points": done.counts})


@ROUTES.offer("POST", "/imports/surface", surface.import_surface, answers=ImportedSurface)
def import_surface(services: Acting, body: ReferenceSurface) -> Any:
    """Store the surface that a campaign is compared with."""
    with _file(services, body.upload, body.file) as file:
        return answer(
            surface.import_surface(services, body.campaign, file, unit=body.unit, turn_over=body.turn_over)
        )


@ROUTES.offer("POST", "/imports/calibration", calibrations.import_files)
def import_calibration(services: Acting, body: ForeignCalibration) -> Any:
    """Bring in a calibration that was made elsewhere."""
    given = Supplement(
        rig=body.rig,
        valid_from=body.valid_from,
        volume=_box(body.volume),
        names=tuple(body.names),
        sizes={name: (columns, rows) for name, (columns, rows) in body.sizes.items()},
        millimetres_per_unit=body.unit_mm,
    )
    with uploads.opened(services, body.upload) as folder:
        done = calibrations.import_files(services, [_below(folder, name) for name in body.files], given)
    return answer(
        {
            "calibration": done.registered.number,
            "new": done.registered.new,
            "in_use": done.registered.in_use,
            "rig": done.calibration.rig.name,
            "sensors": [sensor.name for sensor in done.calibration.rig.sensors],
            "valid_from": done.calibration.valid_from,
            "remarks": done.remarks,
        }
    )


_SHARED = {"campaign", "only", "pattern", "cameras", "camera", "add_states"}
_OF_CHESSBOARD = {"rig", "chessboard", "pitch_mm", "pitch_relative_sigma", "flatness_mm"}

Lay = Callable[[str | None, str], Path | None]


def _how(body: FromFolder) -> EntryOptions:
    return EntryOptions(body.recorded_at, body.newer, body.dry_run)


def _outcome(pattern: str, done: Outcome) -> dict[str, Any]:
    return {
        "pattern": pattern,
        "tuples": done.tuples,
        "remarks": done.remarks,
        "left_out": done.left_out,
        "refused": done.bad,
    }


def _frames(folder: Path, body: Frames, lay: Lay) -> frames.Task:
    own = body.model_dump(
        include={"campaign", "only", "rig", "specimen", "recorded_at", "add_states", "newer"}
    )
    own["given"] = {n: tuple(v) if isinstance(v, list) else v for n, v in body.given.items()}
    return frames.Task(
        folder, plan=lay(body.plan, "plan.toml"), layout=lay(body.layout, "layout.toml"), **own
    )


def _box(volume: list[float] | None) -> Box | None:
    if volume is None:
        return None
    (x, y, z), (to_x, to_y, to_z) = volume[:3], volume[3:]
    if x >= to_x or y >= to_y or z >= to_z:
        raise InvalidInput(
            f"volume has the lower corner {volume[:3]} and the upper {volume[3:]}: every coordinate of the "
            "first has to be below that of the second"
        )
    return Box((x, y, z), (to_x, to_y, to_z))


@contextmanager
def _folder(services: Services, body: FromFolder) -> Iterator[Path]:
    with uploads.opened(services, body.upload) as files:
        yield _below(files, body.folder) if body.folder else files


@contextmanager
def _file(services: Services, upload: str, name: str) -> Iterator[Path]:
    with uploads.opened(services, upload) as files:
        yield _below(files, name)


def _below(folder: Path, name: str) -> Path:
    path = folder / uploads.checked_path(name)
    if not path.exists():
        raise NotFound(f"there is no '{name:.80}' in the upload; send it first")
    return path


@contextmanager
def _texts() -> Iterator[Lay]:
    """Give what lays texts into files for a while."""
    with ExitStack() as stack:
        yield lambda text, name: None if text is None else stack.enter_context(text_as_file(text, name))
