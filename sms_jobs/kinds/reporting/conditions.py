"""Conditions: what the iDICs Good Practices Guide asks to be reported, from what the archive knows."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sms_jobs.formats.report.conditions import conditions_csv, conditions_markup
from sms_jobs.formats.report.html import number
from sms_jobs.formats.report.origins import Origin, Traceable
from sms_jobs.formats.report.page import Section
from sms_jobs.formats.report.surface import speckle_within
from sms_jobs.kinds.documents import Document, DocumentOutput
from sms_jobs.kinds.kind import Inputs, Kind, Need, Output, Progress, Scope
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import CALIBRATED, MEASURED, MERGED, RECORDED, STRAIN, SURFACE
from sms_jobs.kinds.reporting import report
from sms_jobs.kinds.reporting.chapter import (
    CALIBRATION_SHOWN,
    DISPLACEMENTS,
    MERGED_STATES,
    RECORDINGS,
    STRAINS,
    SURFACES,
    Closing,
    as_recorded_in,
)
from sms_jobs.kinds.reporting.still_pairs import StillNoise, still_noise
from sms_jobs.kinds.surface_ports import textured_by
from sms_jobs.metrology.deformation.fields.displacement import pixel_pitch
from sms_jobs.metrology.geometry.planes import in_space
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import MergedField, StrainField, Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Sensor
from sms_jobs.records.shown.conditions import NOT_RECORDED, Condition
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

IMAGES, MATCHING, STRAINED, NOISE = "Images", "Correlation", "Strain", "Noise floor and bias"
_SHAPES = {0: "constant (shift)", 1: "affine", 2: "quadratic"}
_INTERPOLANTS = {
    "quintic": "quintic B-spline",
    "cubic": "cubic B-spline",
    "local-cubic": "local cubic, 4 x 4 pixels",
}
_CRITERIA = {
    "gauss-newton": "zero-normalised sum of squared differences, inverse-compositional Gauss-Newton",
    "fourier-newton": "peak of the zero-normalised cross-correlation",
}
_TOLD_BETWEEN_CAMERAS = ("subset size", "step size", "shape function", "image pre-filter")
_MICROSTRAIN = 1e6
_VSG = "virtual strain gauge (VSG) size"
_RESOLUTION = "spatial resolution"
_TABLE = Document("conditions", "text/csv")
_PLAIN = Document("conditions", "application/json")
_READ = (CALIBRATION_SHOWN, RECORDINGS, *SURFACES.all, DISPLACEMENTS, STRAINS, MERGED_STATES)


def conditions(inputs: Inputs, planned: Campaign) -> tuple[Condition, ...]:
    """Return every condition that is asked for, those without an answer too."""
    campaign = as_recorded_in(inputs, planned)
    found = list(_of_program(inputs))
    strained: dict[str, float] = {}
    for views in campaign.views_by_camera().values():
        for view in views:
            found += _of_images(inputs, campaign, view, strained)
    found += _of_matching(inputs)
    found += _of_displacement(inputs, campaign)
    found += _of_strain(inputs, strained)
    found += _of_noise(still_noise(inputs, planned, campaign))
    return tuple(sorted(found, key=lambda one: (IMAGES, MATCHING, STRAINED, NOISE).index(one.group)))


def _of_program(inputs: Inputs) -> Iterator[Condition]:
    made = [d.provenance for d in inputs.datasets.values() if isinstance(d, Traceable)]
    versions = sorted({one.program_version for one in made})
    kinds = sorted({(one.kind, one.kind_version) for one in made})
    named = ", ".join(f"{kind} {version}" for kind, version in kinds)
    value = f"sms_jobs {', '.join(versions)} (kinds and their versions: {named})" if made else NOT_RECORDED
    yield Condition(MATCHING, "software and version", "", value)


def _of_images(
    inputs: Inputs, campaign: Campaign, view: str, pitches: dict[str, float]
) -> Iterator[Condition]:
    """Yield what is known of the images of a view, and note the size of a pixel on its surface."""
    at_rest = Subject(campaign.name, campaign.reference.label, view)
    measurement = inputs.read(RECORDINGS, MEASURED, textured_by(at_rest))
    surface = inputs.read(SURFACES.port, SURFACE, at_rest)
    known = surface.reason == Reason.VALID
    geometry: dict[str, str] = {}
    if known.any():
        pitch = pixel_pitch(in_space(surface.position), known.astype(np.int32), 0.5)
        pitches[view] = pitch
        geometry = dict(_of_scale(surface, known, pitch)) | dict(_of_stand(inputs, view, surface, known))
    virtual = campaign.scene is not None
    sensor = _sensor(inputs, view_of(view).camera)
    lens = NOT_RECORDED if sensor is None else _principal(sensor)
    rows, columns = measurement.texture.shape
    depth = f"{columns} x {rows} px, grey levels to {measurement.full_scale}"
    noise = f"sqrt({measurement.read_noise:.3g}^2 + {measurement.gain:.3g} level) grey levels"
    answers = {
        "camera": "virtual" if virtual else NOT_RECORDED,
        "lens": lens,
        "image size": depth,
        "noise of a pixel": noise,
        "field of view": geometry.get("field of view", NOT_RECORDED),
        "image scale": geometry.get("image scale", NOT_RECORDED),
        "stereo angle": geometry.get("stereo angle", "none, a camera alone"),
        "stand-off distance": geometry.get("stand-off distance", NOT_RECORDED),
        "frame rate": _rate(inputs, textured_by(at_rest)),
        "exposure": _exposure(measurement),
        "patterning technique": _pattern(campaign),
        "feature size": _feature_size(measurement, known),
    }
    if view_of(view).measures_shape and "stereo angle" not in geometry:
        answers["stereo angle"] = NOT_RECORDED
    yield from (Condition(IMAGES, name, view, value) for name, value in answers.items())


def _of_scale(surface: Surface, known: Any, pitch: float) -> Iterator[tuple[str, str]]:
    if surface.unit != "mm":
        return
    rows, columns = known.shape
    seen = f"{number(columns * pitch)} x {number(rows * pitch)} mm, at the median scale"
    yield "field of view", seen
    yield "image scale", f"{number(1.0 / pitch)} px/mm ({number(pitch)} mm a pixel, median over the surface)"


def _of_stand(inputs: Inputs, view: str, surface: Surface, known: Any) -> Iterator[tuple[str, str]]:
    """Yield angle and distance at the middle of the surface, from the calibration."""
    camera = _sensor(inputs, view_of(view).camera)
    if camera is None or not surface.has_depth:
        return
    middle = np.median(surface.position[:, known], axis=1)
    towards = camera.pose.centre() - middle
    yield "stand-off distance", f"{number(float(np.linalg.norm(towards)))} mm, from pin-hole to surface"
    angles = []
    for name in view_of(view).triangulating[1:]:
        partner = _sensor(inputs, name)
        if partner is not None:
            other = partner.pose.centre() - middle
            cosine = towards @ other / (np.linalg.norm(towards) * np.linalg.norm(other))
            angles.append(f"{np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))):.1f} deg to {name}")
    if angles:
        yield "stereo angle", ", ".join(angles)


def _sensor(inputs: Inputs, name: str) -> Sensor | None:
    if not inputs.has(CALIBRATION_SHOWN):
        return None
    sensors = inputs.read(CALIBRATION_SHOWN, CALIBRATED).rig.sensors
    return next((one for one in sensors if one.name == name), None)


def _principal(sensor: Sensor) -> str:
    inner = sensor.intrinsics
    return f"principal distance {number(inner.fx)} x {number(inner.fy)} px, as calibrated; make not recorded"


def _rate(inputs: Inputs, subject: Subject) -> str:
    if not inputs.has(RECORDINGS, RECORDED, subject):
        return NOT_RECORDED
    times = np.sort(inputs.read(RECORDINGS, RECORDED, subject).times_s)
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if step <= 0.0:
        return "one image a state"
    return f"{number(1.0 / step)} 1/s within the {len(times)} frames of a state, one such set a state"


def _exposure(measurement: Measurement) -> str:
    ratios = ", ".join(f"{one:g}" for one in measurement.sequence.exposures)
    return f"{NOT_RECORDED} as a time; {ratios} times the camera's own"


def _pattern(campaign: Campaign) -> str:
    if campaign.scene is None:
        told = campaign.specimen.description
        return f"{NOT_RECORDED}; the specimen is described as: {told}" if told else NOT_RECORDED
    speckle = campaign.scene.speckle
    return "none" if speckle is None else f"virtual speckles of {number(speckle.diameter_mm)} mm"


def _feature_size(measurement: Measurement, known: Any) -> str:
    """Measure the texture of what has a shape: the outline before a dark background is no feature of it."""
    if not known.any():
        return NOT_RECORDED
    texture = measurement.texture.astype(np.float64)
    noise = float(measurement.noise(np.asarray(texture[known].mean(), np.float32)))
    width = speckle_within(texture, known, noise)
    return f"{width:.2g} px, full width at half maximum of the autocorrelation" if width else NOT_RECORDED


def _of_matching(inputs: Inputs) -> Iterator[Condition]:
    """Yield each parameter of the matches that are shown, with the tuples that share its value."""
    in_time = _told(inputs, "correlate", lambda made: _answers(_as_matched(made)))
    for name, values in (in_time or {name: {NOT_RECORDED: []} for name in _answers({})}).items():
        yield from (Condition(MATCHING, name, ", ".join(about), value) for value, about in values.items())
    for name, values in _told(inputs, "stereo", _between_cameras).items():
        yield from (Condition(MATCHING, name, ", ".join(about), value) for value, about in values.items())


def _told(
    inputs: Inputs, kind: str, answers: Callable[[Origin], Mapping[str, str]]
) -> dict[str, dict[str, list[str]]]:
    """Return what results of a kind answer: each name with its values, and the tuples that share one."""
    told: dict[str, dict[str, list[str]]] = {}
    for dataset in inputs.datasets.values():
        if isinstance(dataset, Traceable) and dataset.provenance.kind == kind:
            for name, value in answers(dataset.provenance).items():
                told.setdefault(name, {}).setdefault(value, []).append(str(dataset.provenance.subject))
    return told


def _between_cameras(made: Origin) -> dict[str, str]:
    """Return the parameters of a match between cameras, whose subsets are cut to the specimen."""
    answers = _answers({**made.parameters, "regions": "none"})
    answers["subset size"] += ", less what lies beside the specimen"
    return {f"{name} between cameras": answers[name] for name in _TOLD_BETWEEN_CAMERAS}


def _as_matched(made: Origin) -> Mapping[str, Any]:
    """Return the parameters of a match; where nothing showed fringes, no mean of them was matched."""
    fringes = made.subject.view is not None and view_of(str(made.subject.view)).projectors
    return made.parameters if fringes else {**made.parameters, "texture": "as recorded, without fringes"}


def _answers(parameters: Mapping[str, Any]) -> dict[str, str]:
    radius, order = parameters.get("subset_radius_px"), parameters.get("shape_order", -1)
    smoothing = parameters.get("smoothing_px")
    filtered = "none" if smoothing == 0 else f"Gaussian of {smoothing} px standard deviation"
    spacing, at_edges = parameters.get("spacing_px"), parameters.get("edge_spacing_px")
    step = f"{spacing} px" + (f", {at_edges} px at edges" if at_edges else "")
    whole = "" if parameters.get("regions") == "none" else ", less what lies on other regions"
    following = parameters.get("following", "each-state")
    partners = "" if following == "each-state" else f"; of the other cameras: {following}"
    return {
        "subset size": NOT_RECORDED if radius is None else f"{2 * radius + 1} px square{whole}",
        "step size": NOT_RECORDED if spacing is None else step,
        "shape function": _SHAPES.get(order, NOT_RECORDED),
        "interpolant": _INTERPOLANTS.get(parameters.get("interpolation", ""), NOT_RECORDED),
        "matching criterion": _CRITERIA.get(parameters.get("method", ""), NOT_RECORDED),
        "image pre-filter": NOT_RECORDED if smoothing is None else filtered,
        "image that is matched": str(parameters.get("texture", NOT_RECORDED)),
        "reference image": str(parameters.get("reference", NOT_RECORDED)) + partners,
    }


def _of_displacement(inputs: Inputs, campaign: Campaign) -> Iterator[Condition]:
    """Yield the spatial resolution of displacement: of the first state of each camera."""
    states = inputs.about(MERGED_STATES)
    for camera in campaign.views_by_camera() if states else ():
        merged = inputs.read(MERGED_STATES, MERGED.of(camera), states[0])
        yield Condition(MATCHING, _RESOLUTION, camera, _resolution(merged))
    if not states:
        yield Condition(MATCHING, _RESOLUTION, "", NOT_RECORDED)


def _resolution(field: MergedField | StrainField) -> str:
    """Return the spatial resolution in px and in mm where they are known, and what is meant by it."""
    if field.resolution_px is None or field.resolution is None or np.isnan(field.resolution).all():
        return NOT_RECORDED
    on_surface = (
        "" if field.unit == "px" else f" ({number(float(np.nanmedian(field.resolution)))} {field.unit})"
    )
    return (
        f"{number(field.resolution_px)} px{on_surface}, median; the period of a wave of which 90 % of the "
        "amplitude is left"
    )


def _of_strain(inputs: Inputs, pitches: Mapping[str, float]) -> Iterator[Condition]:
    """Yield window, gauge and formulation of strain: of the first state of each view."""
    seen: set[str] = set()
    for subject in inputs.about(STRAINS):
        view = subject.view or ""
        if view in seen:
            continue
        seen.add(view)
        field = inputs.read(STRAINS, STRAIN, subject)
        pitch = pitches.get(view)
        wide = None if pitch is None else field.gauge_length / pitch
        length = f"{number(field.gauge_length)} {field.unit}"
        window = f"disc of {length}" if wide is None else f"disc of {length} ({number(wide)} px)"
        fitted = "plane fitted to displacement in the tangent plane, least squares"
        if field.square_px is not None:
            wide = float(field.square_px)
            window = f"square of {field.square_px} x {field.square_px} px ({length})"
            fitted = "lines fitted to displacement along rows and columns, least squares, slopes averaged"
        yield Condition(STRAINED, "strain window", view, f"{window} over every pixel")
        yield Condition(STRAINED, _VSG, view, _gauge_size(inputs, subject, wide))
        yield Condition(STRAINED, _RESOLUTION, view, _resolution(field))
        yield Condition(STRAINED, "strain formulation", view, f"{field.measure}, {fitted}")
    if not seen:
        for name in ("strain window", _VSG, _RESOLUTION, "strain formulation"):
            yield Condition(STRAINED, name, "", NOT_RECORDED)


def _gauge_size(inputs: Inputs, subject: Subject, wide: float | None) -> str:
    """Return over how many pixels the images contribute to one strain."""
    made = [d.provenance for d in inputs.datasets.values() if isinstance(d, Traceable)]
    matched = [one for one in made if one.kind == "correlate" and one.subject.view == subject.view]
    radius = matched[0].parameters.get("subset_radius_px") if matched else None
    if wide is None or radius is None:
        return NOT_RECORDED
    subset = 2 * radius + 1
    # Displacement of a view with a projector is averaged in space before it is differentiated.
    radius_px = matched[0].parameters.get("averaging_radius_px", 0.0)
    averaged = 2.0 * radius_px if view_of(subject.view).projectors else 0.0
    parts = f"window {number(wide)} + subset {subset}" + (f" + averaging {averaged:g}" if averaged else "")
    return f"{number(wide + subset + averaged)} px ({parts} px)"


def _of_noise(found: Iterable[StillNoise]) -> Iterator[Condition]:
    some = False
    for one in found:
        some = True
        about = f"{one.seen_by}, {one.first} to {one.second}"
        yield Condition(NOISE, one.quantity, about, _noise(one))
    if not some:
        why = f"{NOT_RECORDED}: no two states that follow each other have the same known load"
        yield Condition(NOISE, "displacement and strain", "", why)


def _noise(one: StillNoise) -> str:
    if one.floor is None:
        return f"{NOT_RECORDED}: too few points have a value"
    scale, unit = (_MICROSTRAIN, "microstrain") if one.unit == "1" else (1.0, one.unit)
    bias, noise, stated = (scale * v for v in (one.floor.bias, one.floor.noise, one.floor.stated))
    return (
        f"noise {number(noise)} {unit}, bias {number(bias)} {unit}, "
        f"stated deviation {number(stated)} {unit}, {one.floor.points} points"
    )


def _section(inputs: Inputs, campaign: Campaign) -> Section:
    return Section("What to report", conditions_markup(conditions(inputs, campaign)))


def _write_json(found: tuple[Condition, ...], path: Path) -> None:
    path.write_text(json.dumps([asdict(one) for one in found], indent=1, ensure_ascii=False), "utf-8")


def _needs(campaign: Campaign, subject: Subject, parameters: Parameters) -> Iterable[Need]:
    """Need what a report does, but for what has no part in the table."""
    shown = report.needs(campaign, subject, report.PageParameters())
    return [need for need in shown if need.port in _READ]


def run(inputs: Inputs, parameters: Parameters, progress: Progress) -> Iterator[Output]:
    """Write the table for spreadsheets and for programs."""
    campaign: Campaign = inputs.context
    found = conditions(inputs, campaign)
    progress(0.9, "gathered the conditions")
    stem = f"{campaign.name}-conditions"
    yield DocumentOutput(inputs.subject, _TABLE, f"{stem}.csv", partial(conditions_csv, found))
    yield DocumentOutput(inputs.subject, _PLAIN, f"{stem}.json", partial(_write_json, found))
    progress(1.0, "wrote the conditions")


CLOSING = Closing("what to report", 0, _section)
KIND = Kind(
    name="conditions",
    summary="write what the iDICs Good Practices Guide asks to be reported, as a table",
    version=3,
    scope=Scope.CAMPAIGN,
    parameters=Parameters,
    inputs=_READ,
    outputs=(_TABLE, _PLAIN),
    needs=_needs,
    run=run,
    subjects=report.subjects,
    context=report.whole_campaign,
    in_pipeline=False,
)
