"""Quick look: what can be told of a state seconds after it was recorded, before anybody computes results.

Shape at some pixels only, displacement and extension at the gauges only, and what is wrong, by fringes, by
several cameras, or by one alone in the plane of its image. It is for the person at the rig, who holds the
load meanwhile; no result is made of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sms_jobs.errors import MeasurementFailed
from sms_jobs.formats.gauge_descriptions import described_gauge
from sms_jobs.kinds.deformation.gauges import KIND as GAUGES_KIND
from sms_jobs.kinds.deformation.gauges import GaugesParameters, frame_of_gauges, place_on, read_by
from sms_jobs.kinds.kind import (
    CALIBRATION,
    MEASUREMENT,
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    is_deformed,
    tuples,
    tuples_alone,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.port_names import AT_REST, FRAMES_AT_REST
from sms_jobs.kinds.products import CALIBRATED, MEASURED, QUICK_LOOK, RECORDED, SURFACE, UNCERTAINTY, Product
from sms_jobs.kinds.shape.plane import KIND as PLANE
from sms_jobs.kinds.shape.plane import PlaneParameters
from sms_jobs.kinds.shape.sparse_plane import plane_with_regions, scale_of, sparse_plane
from sms_jobs.kinds.shape.sparse_surface import (
    sparse_stereo_fringes_surface,
    sparse_stereo_surface,
    sparse_surface,
    with_regions,
)
from sms_jobs.kinds.shape.stereo import KIND as STEREO
from sms_jobs.kinds.shape.stereo_parameters import StereoParameters
from sms_jobs.kinds.shape.textures import white_texture
from sms_jobs.kinds.surface_ports import textured_by
from sms_jobs.kinds.valid_parts import fractions, losses
from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.deformation.matching.correlation import (
    LEFT_IMAGE,
    MatchSettings,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import GridSettings, is_sure
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings, repeats_itself, seed_warps
from sms_jobs.metrology.deformation.strain.gauge_points import (
    MovedPoint,
    SparseSurface,
    extension,
    fitted_point,
    moved_point,
    place_of,
)
from sms_jobs.metrology.deformation.strain.gauges import GaugePlace
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import turn_covariance
from sms_jobs.metrology.images.sharpness import texture_width
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.quick_look import QuickLook
from sms_jobs.records.reasons import Reason
from sms_jobs.records.remarks import remarked
from sms_jobs.records.statistic_names import (
    DOUBTS,
    GAUGE_QUANTITIES,
    GAUGES,
    GAUGES_READ,
    SATURATED_FRACTION,
    of_gauge,
    with_sigma,
)
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

_SMOOTHING_PX = 0.6
"""As `correlate` filters textures."""
_SEED_SCORE = 0.4
_SATURATED = 0.02
"""Of the lit region, as `acquire` allows it: what was imported nobody has judged before."""
_SHAPE_PART = 0.6
"""Of the work."""
_OF_A_GAUGE = 3
"""Points: its ends and its middle."""


class QuickLookParameters(Parameters):
    """How much is looked at; the gauges are those of [processing.gauges]."""

    places: int = Field(
        256, ge=64, le=2048, description="along the longer side of the image that get a position, at most"
    )
    subset_radius_px: int = Field(
        10, ge=3, le=100, description="of the subsets at a gauge's ends and middle, as of correlate"
    )
    search_range_px: int = Field(
        40, ge=1, le=1000, description="largest displacement in the image that is looked for"
    )
    blur_px: float = Field(
        0.7,
        gt=0.0,
        description="standard deviation of the spot beyond which an image is doubted that is less sharp than "
        "the reference's",
    )
    alone: bool = Field(
        False, description="whether the state is compared with none: its shape is shown, and no gauge"
    )


@dataclass(frozen=True)
class Compared:
    """With what a state is compared.

    Attributes
    ----------
    reference
        Label of the reference state.
    gauges
        As they are described.
    frame
        See `gauges.frame_of_gauges`.
    stereo
        How several cameras are matched.
    plane
        How large a pixel of a camera alone is, and where the specimen ends.
    """

    reference: str
    gauges: tuple[str, ...]
    frame: Pose
    stereo: StereoParameters
    plane: PlaneParameters


_FRAMES = Port("measurement", MEASUREMENT, (MEASURED, RECORDED), several=True)
_CALIBRATION = Port("calibration", CALIBRATION, (CALIBRATED, UNCERTAINTY))
_REFERENCE = Port(AT_REST, "quick-look", (SURFACE,))
_REFERENCE_FRAMES = Port(FRAMES_AT_REST, MEASUREMENT, (MEASURED,))


def _needs(campaign: Campaign, subject: Subject, parameters: QuickLookParameters) -> Iterable[Need]:
    yield from map(_FRAMES.of, subject.recordings)
    if view_of(subject.view).measures_shape:
        yield _CALIBRATION.of(subject)
    at_rest = replace(subject, state=campaign.reference.label)
    if is_deformed(campaign, subject) and not parameters.alone:
        yield _REFERENCE.of(at_rest)
        yield _REFERENCE_FRAMES.of(textured_by(at_rest))


def subjects_looked_at(campaign: Campaign) -> tuple[Subject, ...]:
    """Return every tuple that can be looked at: of a camera alone, where the size of a pixel is known."""
    return (*tuples(campaign), *(tuples_alone(campaign) if scale_of(campaign) is not None else ()))


def declared_gauges(campaign: Campaign, view: str) -> tuple[str, ...]:
    """Return the gauges of a campaign that a view can read, as they are described: a surface has no px."""
    given: dict[str, Any] = campaign.processing.get(GAUGES_KIND.name, {})
    if not given.get("gauge"):
        return ()
    return read_by(view, GaugesParameters.model_validate(given).gauge)


def _context(campaign: Campaign, subject: Subject) -> Compared:
    return Compared(
        campaign.reference.label,
        declared_gauges(campaign, subject.view or ""),
        frame_of_gauges(campaign, subject),
        StereoParameters.model_validate(campaign.processing.get(STEREO.name, {})),
        PlaneParameters.model_validate(campaign.processing.get(PLANE.name, {})),
    )


def run(inputs: Inputs, parameters: QuickLookParameters, progress: Progress) -> Iterator[Output]:
    """Measure the shape at some pixels and match the texture at the gauges, and say what is doubted."""
    measurement = inputs.read(_FRAMES, MEASURED, textured_by(inputs.subject))
    step = max(1, -(-max(measurement.frames.shape[1:]) // parameters.places))
    doubts = _doubts_of_recording(inputs)
    records: dict[Product[Any], object] = {}
    statistics: dict[str, float] = {}
    surface = None
    try:
        surface = _surface(inputs, measurement, step, _first_part(progress))
    except MeasurementFailed as error:
        doubts.append(str(error))
    progress(_SHAPE_PART, "measured the shape")
    look = QuickLook("", step, (), (), *_nothing(0))
    if surface is not None:
        records[SURFACE] = surface
        statistics |= _of_shape(surface)
        if not _is_judged(inputs) and statistics[SATURATED_FRACTION] > _SATURATED:
            doubts.append(f"{statistics[SATURATED_FRACTION]:.0%} of the lit pixels are saturated")
        if inputs.has(_REFERENCE, SURFACE):
            look, blur = _compared(inputs, parameters, measurement, surface, step)
            if blur > parameters.blur_px:
                doubts.append(
                    f"the image is blurred: its spot is {blur:.1f} px wider than the reference's, and "
                    f"{parameters.blur_px:g} px are accepted; look at focus, and at what shakes"
                )
            if np.isfinite(blur):
                statistics["blur_px"] = blur
    look = replace(look, doubts=tuple(doubts))
    statistics |= {DOUBTS: float(len(doubts)), **_of_gauges(look)}
    progress(1.0, remarked(*doubts, *_without_value(look)) or "nothing is doubted")
    yield DatasetOutput(inputs.subject, {QUICK_LOOK: look, **records}, statistics)


def _first_part(progress: Progress) -> Progress:
    """Return what tells the progress of the shape, the first part of the work."""
    return lambda fraction, message="": progress(_SHAPE_PART * fraction, message)


def _surface(inputs: Inputs, measurement: Measurement, step: int, progress: Progress) -> Surface:
    """Return the shape at every `step`-th pixel."""
    if inputs.view.projectors and inputs.view.other_cameras:
        return sparse_stereo_fringes_surface(inputs, step, progress)
    if inputs.view.projectors:
        return sparse_surface(inputs, _CALIBRATION, measurement, step, progress)
    if not inputs.view.measures_shape:
        return sparse_plane(str(inputs.view), measurement, inputs.context.plane, step)
    return sparse_stereo_surface(inputs, inputs.context.stereo, step, progress)


def _is_judged(inputs: Inputs) -> bool:
    """Say whether everything was judged while it was recorded."""
    return all(inputs.has(_FRAMES, RECORDED, own) for own in inputs.subject.recordings)


def _doubts_of_recording(inputs: Inputs) -> list[str]:
    """Return what was doubted while it was recorded: saturation, light, and channels that went too far."""
    return [
        doubt if len(inputs.subject.recordings) == 1 else f"{own.view}: {doubt}"
        for own in inputs.subject.recordings
        if inputs.has(_FRAMES, RECORDED, own)
        for doubt in inputs.read(_FRAMES, RECORDED, own).verdict.doubts
    ]


def _compared(
    inputs: Inputs, parameters: QuickLookParameters, measurement: Measurement, surface: Surface, step: int
) -> tuple[QuickLook, float]:
    """Return what the gauges read, and by how much the image is less sharp, in px; NaN where nobody knows."""
    context: Compared = inputs.context
    before = inputs.read(_REFERENCE_FRAMES, MEASURED)
    surfaces = inputs.read(_REFERENCE, SURFACE), surface
    rest, moved = (_in_frame(_parted(inputs, one, step), context.frame) for one in surfaces)
    shape = before.texture.shape
    widths = [
        texture_width(one.texture, on.spread(*shape) > 0, one.read_noise**2, one.gain)
        for one, on in ((before, rest), (measurement, moved))
    ]
    blur = float(np.sqrt(max(widths[1] ** 2 - widths[0] ** 2, 0.0))) if np.isfinite(widths).all() else np.nan
    described = [described_gauge(text) for text in context.gauges]
    points = [point for text in context.gauges for point in _points(place_on(surface, text))]
    found, reason = _moved(
        inputs.threads, parameters, (before, measurement), (rest, moved), np.reshape(points, (-1, 2))
    )
    place, displacement, sigma, longer, longer_sigma, why = _nothing(len(described))
    for k in range(len(described)):
        own = slice(_OF_A_GAUGE * k, _OF_A_GAUGE * (k + 1))
        why[k] = np.bitwise_or.reduce(reason[own])
        ends_and_middle = [one for one in found[own] if one is not None]
        if why[k] or len(ends_and_middle) < _OF_A_GAUGE:
            continue
        one, other, middle = ends_and_middle
        place[k], displacement[k] = middle.start, middle.end - middle.start
        sigma[k] = np.sqrt(np.diag(middle.covariance))
        longer[k], longer_sigma[k] = extension(one, other)
    names = tuple(one.name for one in described)
    look = QuickLook(
        context.reference, step, (), names, place, displacement, sigma, longer, longer_sigma, why
    )
    return look, blur


def _parted(inputs: Inputs, surface: Surface, step: int) -> SparseSurface:
    """Return a sparse surface with its continuous regions."""
    if surface.has_depth:
        return with_regions(inputs, _CALIBRATION, surface, step)
    return plane_with_regions(surface, step)


def _moved(
    threads: int,
    parameters: QuickLookParameters,
    recorded: tuple[Measurement, Measurement],
    surfaces: tuple[SparseSurface, SparseSurface],
    points: Floats,
) -> tuple[list[MovedPoint | None], NDArray[np.uint32]]:
    """Return where points (n, 2) of the frame have come to, None where nobody knows, and why not (n,)."""
    rest, now = surfaces
    radius = float(parameters.subset_radius_px)
    places = [place_of(rest, x, y, radius) for x, y in points]
    reason = np.array([Reason.VALID if one else Reason.TOO_FEW_NEIGHBOURS for one in places], np.uint32)
    found: list[MovedPoint | None] = [None] * len(places)
    seen = [k for k, one in enumerate(places) if one is not None]
    labels = rest.spread(*recorded[0].texture.shape)
    # A place at the rim may lie off all regions.
    exact = np.array([places[k] for k in seen], np.float64).reshape(-1, 2)
    x, y = np.rint(exact).astype(np.int64).T
    inside = (x >= 0) & (y >= 0) & (x < labels.shape[1]) & (y < labels.shape[0])
    inside[inside] = labels[y[inside], x[inside]] > 0
    reason[np.array(seen, np.int64)[~inside]] = np.uint32(Reason.TOO_FEW_NEIGHBOURS)
    seen, x, y, exact = (
        [k for k, ok in zip(seen, inside, strict=True) if ok],
        x[inside],
        y[inside],
        exact[inside],
    )
    if not seen:
        return found, reason
    (first, noise), (second, later) = (white_texture(one, _SMOOTHING_PX, labels > 0) for one in recorded)
    reach = parameters.search_range_px
    search = SearchSettings(reach, reach)
    guess, score = seed_warps(first, second, labels, x, y, search, threads)
    again = repeats_itself(first, labels, x, y, search, threads)
    images = prepare_images(first, second, labels, (noise, later))
    matches = match_points(images, x, y, guess, MatchSettings(parameters.subset_radius_px), threads)
    sure = is_sure(matches, GridSettings()) & (score >= _SEED_SCORE) & ~again
    for i, k in enumerate(seen):
        if not sure[i]:
            left = matches.ending[i] == LEFT_IMAGE
            why = Reason.AMBIGUOUS_TEXTURE if again[i] else Reason.LEFT_IMAGE if left else Reason.NO_MATCH
            reason[k] = np.uint32(why)
            continue
        # The subset about the nearest pixel tells how the place beside its middle has moved, too.
        u, v = matches.warp[i].reshape(2, 3) @ [1.0, *(exact[i] - (x[i], y[i]))]
        start = fitted_point(rest, exact[i, 0], exact[i, 1], radius)
        end = fitted_point(now, exact[i, 0] + u, exact[i, 1] + v, radius)
        if start is None or end is None:
            missing = Reason.TOO_FEW_NEIGHBOURS if start is None else Reason.NO_SHAPE_AT_END
            reason[k] = np.uint32(missing)
            continue
        found[k] = moved_point(start, end, matches.sigma[i])
    return found, reason


def _points(place: GaugePlace) -> Iterator[tuple[float, float]]:
    """Yield the ends of a gauge and its middle, x and y in mm."""
    half = 0.5 * place.length * np.array([np.cos(place.angle_rad), np.sin(place.angle_rad)])
    for part in (-1.0, 1.0, 0.0):
        yield place.x + part * half[0], place.y + part * half[1]


def _in_frame(surface: SparseSurface, frame: Pose) -> SparseSurface:
    """Return a surface in the frame of the gauges."""
    turn = frame.matrix().T
    moved = surface.xyz - np.array(frame.translation)[:, None, None]
    return replace(
        surface,
        xyz=np.einsum("ij,jrc->irc", turn, moved),
        covariance=turn_covariance(turn, surface.covariance),
    )


def _nothing(gauges: int) -> tuple[Floats, Floats, Singles, Floats, Singles, Any]:
    """Return room for what gauges read: place, displacement, sigma, extension, its sigma, and why not."""
    vector, number = np.full((gauges, 3), np.nan), np.full(gauges, np.nan)
    single = np.float32
    return (
        vector,
        vector.copy(),
        vector.astype(single),
        number,
        number.astype(single),
        np.zeros(gauges, np.uint32),
    )


def _of_shape(surface: Surface) -> dict[str, float]:
    """Return what people search by of the shape."""
    reason = surface.reason
    lit = (reason & (Reason.LOW_MODULATION | Reason.NO_TEXTURE | Reason.OUT_OF_VOLUME)) == 0
    saturated = (reason & np.uint32(Reason.SATURATED)) != 0
    part = float(saturated.sum()) / max(float(lit.sum()), 1.0)
    return {**fractions(reason == Reason.VALID, lit), **losses(reason), SATURATED_FRACTION: part}


def _without_value(look: QuickLook) -> Iterator[str]:
    """Say which gauges have no value, and why."""
    for name, why in zip(look.names, look.reason, strict=True):
        if why != Reason.VALID:
            told = ", ".join(str(one.name).lower().replace("_", " ") for one in Reason if one and one & why)
            yield f"gauge {name} has no value: {told}"


def _of_gauges(look: QuickLook) -> dict[str, float]:
    """Return what people search by of the gauges, and plans are stopped by: those that have a value."""
    found = {GAUGES: float(len(look.names)), GAUGES_READ: float(np.count_nonzero(look.reason == 0))}
    for k, name in enumerate(look.names):
        if look.reason[k] != Reason.VALID:
            continue
        values = (look.extension[k], *look.displacement[k])
        sigmas = (look.extension_sigma[k], *look.sigma[k])
        for quantity, value, sigma in zip(GAUGE_QUANTITIES, values, sigmas, strict=True):
            found[of_gauge(name, quantity)] = float(value)
            found[of_gauge(name, with_sigma(quantity))] = float(sigma)
    return found


KIND = Kind(
    name="quick-look",
    summary="seconds after a recording: shape at some pixels, displacement at the gauges, what is wrong",
    version=30,
    scope=Scope.TUPLE,
    parameters=QuickLookParameters,
    inputs=(_FRAMES, _CALIBRATION, _REFERENCE, _REFERENCE_FRAMES),
    outputs=(QUICK_LOOK, SURFACE),
    needs=_needs,
    run=run,
    subjects=subjects_looked_at,
    context=_context,
    in_pipeline=False,
)
