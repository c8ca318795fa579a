"""Observe a board: its points in the image of the camera and, through the phase, of the projector.

A camera alone has recorded no phase: the board is looked for in its picture, and there is no projector.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.calibration.projector_maps import projector_maps
from sms_jobs.kinds.calibration.sessions import (
    OBSERVE_BOARD,
    board_states,
    every_view,
    sensor_format,
    session_of,
)
from sms_jobs.kinds.kind import MEASUREMENT, DatasetOutput, Inputs, Kind, Need, Output, Port, Progress, Scope
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import BOARD, MEASURED
from sms_jobs.metrology.targets.boards import find_board
from sms_jobs.metrology.targets.chessboards import find_chessboard
from sms_jobs.metrology.targets.patterns import BoardPoints
from sms_jobs.metrology.targets.projector_points import ProjectorPoints, carry_to_projector
from sms_jobs.records.artefacts import Artefact, Chessboard, CircleBoard, DotCylinder
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.observations import BoardObservation
from sms_jobs.records.sensors import SensorFormat
from sms_jobs.records.sizes import number_of
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of


class ObserveBoardParameters(Parameters):
    """What there is to see follows from the session alone."""


@dataclass(frozen=True)
class BoardShown:
    """What a view is shown: a board, and the sizes of the images in which it is looked for.

    There is no projector for a camera alone.
    """

    name: str
    board: Artefact
    camera: SensorFormat
    projector: SensorFormat | None


def board_shown(campaign: Campaign, subject: Subject) -> BoardShown:
    """Return what a tuple of a session shows."""
    session = session_of(campaign)
    name = campaign.state(subject.state or "").artefact or ""
    sensors = [sensor_format(session, sensor) for sensor in view_of(subject.view).sensors]
    return BoardShown(name, session.artefacts[name], sensors[0], sensors[1] if len(sensors) > 1 else None)


def _subjects(campaign: Campaign) -> Iterable[Subject]:
    return every_view(campaign, board_states(campaign))


_FRAMES = Port("measurement", MEASUREMENT, (MEASURED,))


def _needs(campaign: Campaign, subject: Subject, parameters: ObserveBoardParameters) -> Iterable[Need]:
    yield _FRAMES.of(subject)


def run(inputs: Inputs, parameters: ObserveBoardParameters, progress: Progress) -> Iterator[Output]:
    """Find the board in the fringe-free picture, and carry its points to the projector by the phase."""
    shown: BoardShown = inputs.context
    measurement = inputs.read(_FRAMES, MEASURED)
    _, rows, columns = measurement.frames.shape
    if (columns, rows) != (shown.camera.columns, shown.camera.rows):
        raise InvalidInput(
            f"the frames of {inputs.subject} are {columns} x {rows} px, but the session says that "
            f"{shown.camera.name} has {shown.camera.columns} x {shown.camera.rows}; "
            "correct [[session.sensors]]"
        )
    if shown.projector is None:
        progress(0.1, "looking for the board")
        found = _found(measurement.texture, shown.board, inputs.threads)
        observation = _observation(shown, found, _no_projector(len(found.place)))
    else:
        maps = projector_maps(inputs.subject, measurement, shown.projector, inputs.threads, progress)
        progress(0.85, "looking for the board")
        found = _found(maps.phase.mean_intensity, shown.board, inputs.threads)
        both = np.sqrt(np.mean(np.square(maps.sigma), axis=0))
        carried = carry_to_projector(maps.pixel, both, found.centre_px, found.sigma_px, found.radius_px)
        observation = _observation(shown, found, carried)
    progress(1.0, f"found {number_of(len(observation.point), 'point')}")
    yield DatasetOutput(inputs.subject, {BOARD: observation}, _statistics(observation))


def _no_projector(count: int) -> ProjectorPoints:
    """Return images of points that no projector has."""
    return ProjectorPoints(np.full((count, 2), np.nan), np.full(count, np.nan), {})


def _observation(shown: BoardShown, found: BoardPoints, carried: ProjectorPoints) -> BoardObservation:
    """Return the points that all sensors of the view have, and why others were refused."""
    kept = np.ones(len(found.place), bool) if shown.projector is None else np.isfinite(carried.sigma)
    refused = dict(found.refused)
    for why, count in carried.refused.items():
        refused[f"in the projector: {why}"] = count
    return BoardObservation(
        shown.camera.name,
        "" if shown.projector is None else shown.projector.name,
        shown.name,
        found.blur_px,
        refused,
        found.place[kept],
        found.point[kept],
        found.centre_px[kept],
        found.sigma_px[kept],
        carried.pixel[kept],
        carried.sigma[kept],
        found.reason,
    )


def _found(picture: np.ndarray, board: Artefact, threads: int) -> BoardPoints:
    if isinstance(board, CircleBoard | DotCylinder):
        return find_board(picture, board, threads=threads)
    assert isinstance(board, Chessboard)
    return find_chessboard(picture, board.columns, board.rows, board.pitch_mm, threads=threads)


def _statistics(observation: BoardObservation) -> dict[str, float]:
    count = len(observation.point)
    statistics = {"points_count": float(count), "refused_count": float(sum(observation.refused.values()))}
    if count:
        statistics |= {
            "blur_px": observation.blur_px,
            "camera_sigma_median_px": float(np.median(observation.camera_sigma_px)),
        }
    if count and observation.projector:
        statistics["projector_sigma_median_px"] = float(np.median(observation.projector_sigma_px))
    return statistics


KIND = Kind(
    name=OBSERVE_BOARD,
    summary="find the points of a calibration board in camera and projector",
    version=9,
    scope=Scope.TUPLE,
    parameters=ObserveBoardParameters,
    inputs=(_FRAMES,),
    outputs=(BOARD,),
    needs=_needs,
    run=run,
    subjects=_subjects,
    context=board_shown,
)
