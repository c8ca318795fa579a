"""What goes wrong with the images of two cameras: lenses, light, dust, haze, knocks; and what comes of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np

from sms_jobs.bench.two_cameras.errors import PointErrors, displacement_errors, shape_errors
from sms_jobs.errors import MeasurementFailed
from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT
from sms_jobs.kinds.products import CALIBRATED, MEASURED, UNCERTAINTY
from sms_jobs.kinds.shape import stereo
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS
from sms_jobs.records.calibration import CalibrationUncertainty
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import CameraResponse, Surface
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign, stereo_rig

Images: TypeAlias = dict[tuple[str, str], Floats]
"""What cameras see, as a part of full scale, (rows, columns), by state and camera."""

REST, LATER, OTHER = "S00", "S02", "S01"
_EXACT = CameraResponse(bits=16, full_well=1e12, read_noise=0.0)
_FULL_SCALE, _FULL_WELL, _READ_NOISE = 4095, 30_000.0, 10.0
_JPEG_QUALITY = 40


@dataclass(frozen=True)
class Seen:
    """A specimen before two cameras at two states, without noise, and what is true of it."""

    calibration: Calibration
    exact: Shelf
    light: Images
    threads: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of an image."""
        camera = self.calibration.rig.sensor("C1")
        return camera.rows, camera.columns

    def subject(self, state: str) -> Subject:
        """Return the tuple of both cameras at a state."""
        return Subject(self.exact.campaign.name, state, self.exact.campaign.views[0])


@dataclass(frozen=True)
class Outcome:
    """Errors of what was measured in spite of a mishap, and why something was not."""

    shapes: tuple[PointErrors, ...]
    displacement: PointErrors | None
    shelf: Shelf
    refused: str


def specimen_seen(specimen: Callable[[float], Surface], columns: int, seed: int, threads: int) -> Seen:
    """Render a specimen that fills most of the images at rest, in another state and in a later one."""
    rig = stereo_rig(columns, columns * 4 // 5)
    field_mm = 500.0 * columns / rig.sensor("C1").intrinsics.fx
    calibration, campaign = stereo_campaign(
        "mishaps", rig=rig, surface=specimen(field_mm), camera=_EXACT, seed=seed
    )
    exact, light = Shelf(campaign, threads), {}
    for state in (REST, OTHER, LATER):
        subject = Subject(campaign.name, state, campaign.views[0])
        exact.record(subject)
        for own in subject.recordings:
            texture = exact.records[MEASUREMENT, own][MEASURED.stored_as].texture
            light[state, str(own.view)] = texture / 65535.0
    return Seen(calibration, exact, light, threads)


def measured(
    seen: Seen, images: Images, random: np.random.Generator, known: CalibrationUncertainty | None = None
) -> Outcome:
    """Measure shape at both states and the displacement between them, with default parameters."""
    shelf, partner = Shelf(seen.exact.campaign, seen.threads), seen.calibration.rig.sensor("C2")
    shapes: list[PointErrors] = []
    for state in (REST, LATER):
        subject = seen.subject(state)
        shelf.records[CALIBRATION, subject] = {CALIBRATED.stored_as: seen.calibration}
        if known is not None:
            shelf.records[CALIBRATION, subject][UNCERTAINTY.stored_as] = known
        for own in subject.recordings:
            exact = seen.exact.records[MEASUREMENT, own][MEASURED.stored_as]
            shown = _with_noise(exact, images[state, str(own.view)], random)
            shelf.records[MEASUREMENT, own] = {MEASURED.stored_as: shown}
        try:
            shelf.run(stereo.KIND, subject, stereo.KIND.parameters())
        except MeasurementFailed as error:
            return Outcome(tuple(shapes), None, shelf, str(error))
        surface = shelf.records["stereo", subject]["surface"]
        shapes.append(shape_errors(surface, seen.exact.shape(subject), partner))
    try:
        shelf.run(correlate.KIND, subject, correlate.KIND.parameters())
    except MeasurementFailed as error:
        return Outcome(tuple(shapes), None, shelf, str(error))
    field = shelf.records["correlate", subject]["displacement"]
    return Outcome(tuple(shapes), displacement_errors(field, seen.exact.truth(subject), partner), shelf, "")


def _with_noise(exact: Measurement, light: Floats, random: np.random.Generator) -> Measurement:
    """Return what a camera of 12 bit records, with noise of photons and of reading."""
    gain = _FULL_SCALE / _FULL_WELL
    level, read = _FULL_SCALE * np.clip(light, 0.0, None), _READ_NOISE * gain
    level = level + np.sqrt(read**2 + gain * level) * random.standard_normal(level.shape)
    levels = np.clip(np.rint(level), 0, _FULL_SCALE).astype(np.uint16)
    return replace(exact, full_scale=_FULL_SCALE, gain=gain, read_noise=read, texture=levels)


def known_to(sigma_px: float) -> CalibrationUncertainty:
    """Return what a calibration says that knows to so many px where either camera looks, along x and y."""
    covariance = np.zeros((2 * PER_SENSOR, 2 * PER_SENSOR))
    for sensor in range(2):
        for name in ("cx", "cy"):
            place = PER_SENSOR * sensor + SENSOR_PARAMETERS.index(name)
            covariance[place, place] = 0.5 * sigma_px**2
    return CalibrationUncertainty(("C1", "C2"), SENSOR_PARAMETERS, covariance)


def total_z(seen: Seen, outcome: Outcome) -> Floats:
    """Return errors of displacements over all that is stated of them, the calibration's part included."""
    subject = seen.subject(LATER)
    field, truth = outcome.shelf.records["correlate", subject]["displacement"], seen.exact.truth(subject)
    known = (field.reason == Reason.VALID) & np.isfinite(truth.displacement[0])
    error = (field.displacement - truth.displacement)[:, known]
    variance = field.covariance[[0, 3, 5]][:, known]
    if field.sigma_calibration is not None:
        variance = variance + np.square(field.sigma_calibration[:, known])
    return np.asarray(np.linalg.norm(error, axis=0) / np.sqrt(variance.sum(axis=0)))


def mishaps(seen: Seen, random: np.random.Generator) -> Iterator[tuple[str, Images]]:
    """Yield what both cameras see when something is not as it should be, by name; nothing first."""
    yield "nothing", seen.light
    yield from _lenses(seen)
    yield from _lights(seen, random)
    yield from _sensors(seen, random)
    yield from _views(seen, random)


def shifted(image: Floats, x: Floats | float, y: Floats | float) -> Floats:
    """Return an image whose pixels show what lies so many px beside them."""
    rows, columns = np.indices(image.shape)
    across, down = (np.asarray(one, np.float32) for one in (columns + x, rows + y))
    return np.asarray(cv2.remap(image.astype(np.float32), across, down, cv2.INTER_LANCZOS4), np.float64)


def _changed(seen: Seen, change: Callable[[Floats], Floats], state: str = "", camera: str = "") -> Images:
    """Return images of which some are changed: those of a state or camera, or all."""
    return {
        (s, c): change(image) if state in ("", s) and camera in ("", c) else image
        for (s, c), image in seen.light.items()
    }


def _blurred(image: Floats, sigma_px: float) -> Floats:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.float64)


def _smeared(image: Floats) -> Floats:
    return np.asarray(cv2.blur(image, (5, 1)), np.float64)


def _lenses(seen: Seen) -> Iterator[tuple[str, Images]]:
    """Yield lenses out of focus, and motion while the shutter is open."""
    across = np.linspace(0.0, 2.0, seen.shape[1])

    def tilted(image: Floats) -> Floats:
        """Return an image as sharp as it was on the left, with a spot of 3 px on the right."""
        half, whole = _blurred(image, 1.5), _blurred(image, 3.0)
        left, right = (1.0 - across) * image + across * half, (2.0 - across) * half + (across - 1.0) * whole
        return np.asarray(np.where(across < 1.0, left, right))

    yield "partner out of focus, 1 px", _changed(seen, lambda one: _blurred(one, 1.0), camera="C2")
    yield "partner out of focus, 2 px", _changed(seen, lambda one: _blurred(one, 2.0), camera="C2")
    yield "reference out of focus later, 1.5 px", _changed(seen, lambda one: _blurred(one, 1.5), LATER, "C1")
    yield "both out of focus later, 2 px", _changed(seen, lambda one: _blurred(one, 2.0), LATER)
    yield "tilted lens", _changed(seen, tilted, camera="C2")
    yield "motion blur later, 5 px", _changed(seen, _smeared, LATER)
    yield "motion blur later, 5 px, partner", _changed(seen, _smeared, LATER, "C2")


def _lights(seen: Seen, random: np.random.Generator) -> Iterator[tuple[str, Images]]:
    """Yield light that falls off, glares, is reflected by a window, is too much or too little."""
    rows, columns = seen.shape
    y, x = np.indices(seen.shape) / np.array([rows, columns])[:, None, None]

    def glaring(image: Floats, place: float) -> Floats:
        away = ((x - place) * columns) ** 2 + ((y - 0.5) * rows) ** 2
        return np.asarray(np.minimum(image + 0.9 * np.exp(-0.5 * away / (0.04 * columns) ** 2), 1.0))

    yield "light falls across the partner", _changed(seen, lambda one: one * np.exp(-3.0 * x), camera="C2")
    yield "light falls off later", _changed(seen, lambda one: one * np.exp(-3.0 * y), LATER)
    places = {"C1": 0.4, "C2": 0.5}
    yield "glare at other places", {key: glaring(one, places[key[1]]) for key, one in seen.light.items()}
    moving = {key: glaring(one, 0.4 + 0.05 * int(key[0][1:])) for key, one in seen.light.items()}
    yield (
        "glare that moves, reference",
        {k: moving[k] if k[1] == "C1" else one for k, one in seen.light.items()},
    )
    reflected = {camera: 0.3 * (1.0 + np.tanh(_texture(seen, random, 2.0))) for camera in places}
    yield (
        "a window reflected, 15 %",
        {key: 0.85 * one + 0.15 * reflected[key[1]] for key, one in seen.light.items()},
    )
    yield "overexposed", _changed(seen, lambda one: np.minimum(2.2 * one, 1.0))
    yield "a twentieth of the light", _changed(seen, lambda one: 0.05 * one)


def _texture(seen: Seen, random: np.random.Generator, size_px: float) -> Floats:
    """Return a random texture of deviation 1."""
    rough = _blurred(random.standard_normal(seen.shape), size_px)
    return np.asarray(rough / rough.std())


def _sensors(seen: Seen, random: np.random.Generator) -> Iterator[tuple[str, Images]]:
    """Yield dust, fixed patterns, curves, few bits and lossy files."""
    rows, columns = seen.shape
    y, x = np.indices(seen.shape)

    def dusty() -> Floats:
        kept = np.ones(seen.shape)
        for column, row in random.uniform(0.0, 1.0, (60, 2)) * (columns, rows):
            kept -= 0.5 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / 8.0)
        return np.maximum(kept, 0.0)

    def jpeg(image: Floats) -> Floats:
        grey = np.clip(np.rint(255.0 * image), 0, 255).astype(np.uint8)
        _, packed = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        found = cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE)
        assert found is not None
        return np.asarray(found / 255.0)

    dust = {camera: dusty() for camera in ("C1", "C2")}
    yield "dust on both sensors", {key: one * dust[key[1]] for key, one in seen.light.items()}
    yield "dust on the partner's", _changed(seen, lambda one: one * dust["C2"], camera="C2")
    pattern = {camera: 1.0 + 0.15 * _texture(seen, random, 1.0) for camera in ("C1", "C2")}
    yield "fixed pattern, 15 %", {key: one * pattern[key[1]] for key, one in seen.light.items()}
    yield "exponent of 1.8, partner", _changed(seen, lambda one: 0.8 * (one / 0.8) ** 1.8, camera="C2")
    yield "five bits", _changed(seen, lambda one: np.rint(31.0 * one) / 31.0)
    yield f"JPEG, quality {_JPEG_QUALITY}", _changed(seen, jpeg)


def _views(seen: Seen, random: np.random.Generator) -> Iterator[tuple[str, Images]]:
    """Yield a cable before the specimen, images that do not belong together, knocks across rays, and haze."""
    rows, columns = seen.shape
    y, x = np.indices(seen.shape).astype(np.float64)

    def behind_a_cable(image: Floats, place: float) -> Floats:
        shade = np.clip(
            0.015 * columns + 0.5 - np.abs(x - place * columns - 0.2 * (y - 0.5 * rows)), 0.0, 1.0
        )
        return np.asarray(image * (1.0 - shade) + 0.25 * shade)

    places = {"C1": 0.6, "C2": 0.45}
    yield (
        "a cable before it",
        {
            (state, camera): behind_a_cable(one, places[camera] + 0.02 * (state == LATER))
            for (state, camera), one in seen.light.items()
        },
    )
    yield "partner of another state", {**seen.light, (LATER, "C2"): seen.light[OTHER, "C2"]}
    yield (
        "partner knocked later across rays, 2 px",
        _changed(seen, lambda one: shifted(one, 0.0, 2.0), LATER, "C2"),
    )
    for camera in ("C1", "C2"):
        for length in (31.0, 94.0, 188.0):
            along, down = random.uniform(0.0, 2.0 * np.pi, 2)
            by = (
                0.5 * np.sin(2.0 * np.pi * y / length + along),
                0.5 * np.cos(2.0 * np.pi * x / length + down),
            )
            yield (
                f"haze later before {camera}, 0.5 px, {length:g} px long",
                _changed(seen, lambda one, by=by: shifted(one, *by), LATER, camera),  # type: ignore[misc]
            )
