"""Observe a ball bar: points on its two spheres, by a first calibration and where the stage says they are.

Three special poses of the pan-tilt stage are searched as whole images; from them every other pose is
predicted, and only the pixels that may show a sphere are looked at (thesis section 3.3).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.kinds.calibration.projector_maps import ProjectorMaps, projector_maps
from sms_jobs.kinds.calibration.sessions import (
    OBSERVE_BAR,
    START,
    START_OF_BOARDS,
    angles,
    bar_states,
    board_states,
    every_view,
    sensor_format,
    session_of,
)
from sms_jobs.kinds.kind import MEASUREMENT, DatasetOutput, Inputs, Kind, Need, Output, Port, Progress, Scope
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import BAR, CALIBRATED, MEASURED, QUALITY
from sms_jobs.kinds.shape.phases import sensor_pair
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.estimates import Estimated
from sms_jobs.metrology.calibration.stage.pan_tilt import (
    label_special_poses,
    predict_centres,
    prediction_covariance,
    special_poses,
    stage_from_special_poses,
)
from sms_jobs.metrology.calibration.stage.pan_tilt_refinement import (
    refine_stage,
    search_margin_mm,
    sphere_regions,
)
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.phase.seen_texture import relative_gradient
from sms_jobs.metrology.targets.sphere_blur import blur_shift
from sms_jobs.metrology.targets.sphere_layout import SphereLayout
from sms_jobs.metrology.targets.spheres import SphereSearch, find_spheres
from sms_jobs.records.artefacts import BallBar
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.observations import BarObservation
from sms_jobs.records.sensors import Sensor, SensorFormat
from sms_jobs.records.sizes import number_of
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

_FRAMES = Port("measurement", MEASUREMENT, (MEASURED,))
_SPECIAL = tuple(Port(name, OBSERVE_BAR, (BAR,)) for name in ("home", "pan", "tilt"))


class ObserveBarParameters(Parameters):
    """How spheres are searched."""

    points_per_sphere: int = Field(
        500, ge=50, le=100_000, description="most points of a sphere that are kept for the calibration"
    )
    reduced_regions: bool = Field(
        True, description="whether spheres are looked for only where the stage says that they are"
    )
    blur_px: float | None = Field(
        None,
        ge=0.0,
        description="standard deviation of the spot that a pixel sees, whose pull on the phase of a sphere "
        "is taken back; what the edges of the board's dots show if not given",
    )
    search_margin_mm: float = Field(
        5.0, gt=0.0, description="how far a sphere may be from where it is predicted, at least"
    )


@dataclass(frozen=True)
class BarShown:
    """What a view is shown: a bar, at which angles, and at which angles the special poses stand."""

    name: str
    bar: BallBar
    projector: SensorFormat
    angles_rad: tuple[float, float] | None
    special_rad: tuple[tuple[float, float], ...]


def special_labels(campaign: Campaign) -> tuple[str, ...]:
    """Return the states of the home, the pan and the tilt pose; none where angles are not known."""
    posed = [(s.label, a) for s in bar_states(campaign) if (a := angles(s)) is not None]
    if not posed:
        return ()
    try:
        chosen = special_poses(np.array([a for _, a in posed]))
    except InvalidInput:
        return ()
    return tuple(posed[k][0] for k in chosen)


def bar_shown(campaign: Campaign, subject: Subject) -> BarShown:
    """Return what a tuple of a session shows."""
    session = session_of(campaign)
    projector = view_of(subject.view).projector
    state = campaign.state(subject.state or "")
    name = state.artefact or ""
    bar = session.artefacts[name]
    assert isinstance(bar, BallBar)
    special = tuple(a for label in special_labels(campaign) if (a := angles(campaign.state(label))))
    return BarShown(name, bar, sensor_format(session, projector), angles(state), special)


def _subjects(campaign: Campaign) -> Iterable[Subject]:
    return every_view(campaign, bar_states(campaign))


def _needs(campaign: Campaign, subject: Subject, parameters: ObserveBarParameters) -> Iterable[Need]:
    yield _FRAMES.of(subject)
    if board_states(campaign):
        yield START_OF_BOARDS.of(Subject(campaign.name))
    else:
        yield START.of(subject)
    labels = special_labels(campaign)
    state = campaign.state(subject.state or "")
    if subject.state not in labels and angles(state) is not None:
        for port, label in zip(_SPECIAL, labels, strict=False):
            yield port.of(replace(subject, state=label))


def run(inputs: Inputs, parameters: ObserveBarParameters, progress: Progress) -> Iterator[Output]:
    """Triangulate what may show a sphere, find both, and keep evenly spread points of them."""
    shown: BarShown = inputs.context
    measurement = inputs.read(_FRAMES, MEASURED)
    start = inputs.read(START, CALIBRATED)
    camera_name, projector_name = inputs.view.camera, inputs.view.projector
    camera, projector = start.rig.sensor(camera_name), start.rig.sensor(projector_name)
    maps = projector_maps(inputs.subject, measurement, shown.projector, inputs.threads, progress)
    predicted, region = None, None
    if parameters.reduced_regions:
        predicted, region = _expected(inputs, shown, camera, parameters.search_margin_mm)
    if region is not None:
        maps.phase.omega[:, ~region] = np.nan
    pair = sensor_pair(camera, projector, measurement.sequence, inputs.threads)
    points = pair.meet(maps.phase.omega, maps.phase.omega_sigma)
    progress(0.9, "looking for the spheres")
    sigma = np.sqrt(trace(points.covariance))
    search = find_spheres(
        points.xyz,
        sigma,
        shown.bar.radius_mm,
        camera.pose.centre(),
        layout=SphereLayout(bar_length_mm=shown.bar.length_mm, predicted=predicted),
        region=region,
        select=parameters.points_per_sphere,
        threads=inputs.threads,
    )
    blur = start_blur(inputs, camera_name) if parameters.blur_px is None else parameters.blur_px
    observation = _observation(shown, camera, projector, maps, search, blur)
    progress(1.0, f"found {number_of(len(search.spheres), 'sphere')}")
    yield DatasetOutput(inputs.subject, {BAR: observation}, _statistics(observation, search))


def start_blur(inputs: Inputs, camera: str) -> float:
    """Return the blur of a camera that the first calibration found on the board; 0 where it found none."""
    if not inputs.has(START, QUALITY):
        return 0.0
    blur = inputs.read(START, QUALITY).estimate(Estimated.BLUR, camera)
    return 0.0 if blur is None else blur.value


def _expected(
    inputs: Inputs, shown: BarShown, camera: Sensor, margin_mm: float
) -> tuple[Floats | None, Mask | None]:
    """Return where the spheres should be, and which pixels may show them; None where nobody can tell."""
    if shown.angles_rad is None or not all(inputs.has(port) for port in _SPECIAL):
        return None, None
    seen = [inputs.read(port, BAR) for port in _SPECIAL]
    if not all(np.isfinite(one.centre).all() for one in seen):
        return None, None
    home = seen[0].centre
    pan, tilt = shown.special_rad[1][0], shown.special_rad[2][1]
    try:
        panned, tilted = label_special_poses(home, seen[1].centre, seen[2].centre, pan, tilt)
        first, _ = stage_from_special_poses(home, panned, tilted, pan, tilt)
        centres = np.stack([home, panned, tilted])
        stage = refine_stage(first, np.array(shown.special_rad), centres, _covariances(seen, centres)).stage
    except (CalibrationFailed, InvalidInput):
        return None, None
    centres = predict_centres(stage, *shown.angles_rad)
    margin = max(margin_mm, search_margin_mm(prediction_covariance(stage, *shown.angles_rad)))
    region = sphere_regions(
        camera.intrinsics, camera.pose, (camera.rows, camera.columns), centres, shown.bar.radius_mm, margin
    )
    return centres, region


def _covariances(seen: list[BarObservation], centres: Floats) -> Floats:
    """Return the covariances (3, 2, 3, 3) of centres (3, 2, 3) that may be numbered otherwise than seen."""
    found = np.empty((*centres.shape, 3))
    for k, one in enumerate(seen):
        as_seen = np.array_equal(one.centre, centres[k])
        sigma = one.centre_sigma if as_seen else one.centre_sigma[::-1]
        found[k] = sigma[..., None] ** 2 * np.eye(3)
    return found


def _observation(
    shown: BarShown,
    camera: Sensor,
    projector: Sensor,
    maps: ProjectorMaps,
    search: SphereSearch,
    blur_px: float,
) -> BarObservation:
    slope = relative_gradient(maps.phase.modulation.mean(axis=0))
    shifts = [np.empty((0, 2))]
    numbers, pixels = [np.empty(0, np.int32)], [np.empty((0, 2), np.int32)]
    centre, centre_sigma = np.full((2, 3), np.nan), np.full((2, 3), np.nan)
    refused = dict(search.refused)
    for sphere in search.spheres:
        chosen = sphere.pixels[sphere.selected]
        pixels.append(chosen)
        shifts.append(
            blur_shift(
                (camera.intrinsics, camera.pose),
                (projector.intrinsics, projector.pose),
                sphere.centre,
                shown.bar.radius_mm,
                chosen[:, ::-1].astype(np.float64),
                np.asarray(slope[:, chosen[:, 0], chosen[:, 1]].T, dtype=np.float64),
                blur_px,
            )
        )
        numbers.append(np.full(len(chosen), sphere.number, np.int32))
        centre[sphere.number - 1] = sphere.centre
        centre_sigma[sphere.number - 1] = np.sqrt(np.diag(sphere.covariance))
        for why, count in sphere.refused.items():
            refused[why] = refused.get(why, 0) + count
    for problem in search.problems:
        refused[problem] = 1
    row, column = np.concatenate(pixels).T
    projected = maps.pixel[:, row, column].T - np.concatenate(shifts)
    finite = np.isfinite(projected).all(axis=1)
    if not finite.all():
        refused["at the limb"] = int(np.count_nonzero(~finite))
    row, column = row[finite], column[finite]
    return BarObservation(
        camera.name,
        projector.name,
        shown.name,
        refused,
        search.searched_fraction,
        np.concatenate(numbers)[finite],
        np.stack([column, row], axis=-1).astype(np.float64),
        np.ascontiguousarray(projected[finite]),
        np.ascontiguousarray(maps.sigma[:, row, column].T, dtype=np.float64),
        centre,
        centre_sigma,
    )


def _statistics(observation: BarObservation, search: SphereSearch) -> dict[str, float]:
    statistics = {
        "spheres_count": float(len(search.spheres)),
        "points_count": float(len(observation.sphere)),
        "searched_fraction": observation.searched_fraction,
        "problems_count": float(len(search.problems)),
    }
    if np.isfinite(search.separation_mm):
        statistics["separation_mm"] = search.separation_mm
    return statistics


KIND = Kind(
    name=OBSERVE_BAR,
    summary="find the spheres of a ball bar and points on them",
    version=6,
    scope=Scope.TUPLE,
    parameters=ObserveBarParameters,
    inputs=(_FRAMES, START, START_OF_BOARDS, *_SPECIAL),
    outputs=(BAR,),
    needs=_needs,
    run=run,
    subjects=_subjects,
    context=bar_shown,
)
