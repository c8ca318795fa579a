"""Calibrations of rigs in the files of other programs: read, completed by a person, checked; and written."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC
from math import isfinite
from pathlib import Path

import numpy as np

from sms_jobs.errors import ConfigurationError, InvalidInput
from sms_jobs.formats.interchange.calibration_formats import document_of, format_of
from sms_jobs.formats.interchange.found_sensors import FoundCalibration, FoundSensor, image_size
from sms_jobs.formats.interchange.opencv_calibration import Dialect, find_opencv_calibration, opencv_text
from sms_jobs.formats.interchange.opencv_text import Table, parse_storage
from sms_jobs.formats.interchange.styles import Style
from sms_jobs.formats.interchange.text_files import read_text
from sms_jobs.formats.interchange.thesis_calibration import thesis_text
from sms_jobs.metrology.geometry.camera import Camera, Pose
from sms_jobs.metrology.geometry.common_view import common_field
from sms_jobs.metrology.geometry.lens import undistort
from sms_jobs.metrology.geometry.lens_field import fold_px
from sms_jobs.records.baselines import refuse_one_place
from sms_jobs.records.seen_volumes import corners, refuse_unseen, remarks_on_blind
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.subject import checked_name
from sms_jobs.records.supplements import Supplement
from sms_jobs.records.views import Role, role_of, sensor_name

_DIALECTS: dict[Style, Dialect] = {"opencv-yaml": "yml", "opencv-xml": "xml", "opencv-json": "json"}
_MOST_BLIND = 0.5
"""The part of an image that may have no ray before the coefficients are taken for those of another model."""
_GRID = 33
_MOST_ASIDE = 0.1
"""Of a side of a camera's image, from its middle to the principal point: beyond it the size is doubted."""
_MOST_ASPECT = 1.2
"""Between the focal lengths of a camera: its pixels are squares as a rule."""


@dataclass(frozen=True)
class ImportedCalibration:
    """A calibration as it was read, and what a person should know of the reading."""

    calibration: Calibration
    remarks: tuple[str, ...]


def read_calibration(paths: Sequence[Path], given: Supplement) -> ImportedCalibration:
    """Read a calibration from a file, or from several that complete each other.

    Raises
    ------
    NotFound
        There is no such file.
    ConfigurationError
        A file is malformed, says what cannot be, or what the camera model here does not hold.
    InvalidInput
        Something is said neither by the files nor by `given`, or the two contradict each other.
    """
    texts = [(path, read_text(path, "calibration file")) for path in paths]
    sources = ", ".join(str(path) for path, _ in texts)
    document = document_of(texts[0][1], sources) if len(texts) == 1 else None
    known = None if document is None else format_of(document)
    if document is None or known is None:
        found = find_opencv_calibration(_together(texts), sources)
    else:
        found = known.find(document)
    digest = hashlib.sha256("".join(text for _, text in texts).encode()).hexdigest()
    # A file's name may have bytes that are no text.
    names = ", ".join(path.name for path, _ in texts).encode("utf-8", "replace").decode()
    origin = f"imported from {names}, sha256 {digest[:16]}"
    return _completed(found, given, sources, found.origin or origin)


def calibration_text(
    calibration: Calibration, style: Style, pixel_pitch_mm: float
) -> tuple[str, tuple[str, ...]]:
    """Return a calibration in a style, and what a person should know of the conversion.

    `pixel_pitch_mm` is how wide a pixel is; the thesis's style counts in millimetres on the chip.

    Raises
    ------
    ConfigurationError
        The style cannot hold the distortion of a sensor.
    """
    if style == "thesis-xml":
        return thesis_text(calibration, pixel_pitch_mm)
    skewed = [s.name for s in calibration.rig.sensors if s.intrinsics.skew]
    remarks = (f"{', '.join(skewed)}: OpenCV's own functions leave the skew in camera_matrix out",)
    return opencv_text(calibration, _DIALECTS[style]), remarks if skewed else ()


def _together(texts: list[tuple[Path, str]]) -> Table:
    """Return what several files say, as if it stood in one."""
    whole: Table = {}
    for path, text in texts:
        table = parse_storage(text, str(path))
        twice = sorted(whole.keys() & table.keys())
        if twice:
            raise ConfigurationError(f"{path} repeats settings of another file: {', '.join(twice[:5])}")
        whole |= table
    return whole


def _completed(found: FoundCalibration, given: Supplement, sources: str, origin: str) -> ImportedCalibration:
    rig, valid_from, volume = (
        given.rig or found.rig,
        given.valid_from or found.valid_from,
        given.volume or found.volume,
    )
    to_ask = volume is None and not _several_cameras(found, given)
    if rig is None or valid_from is None or to_ask:
        missing = [
            name
            for name, absent in (
                ("the `rig`", rig is None),
                ("the time from which it is valid (`valid_from`)", valid_from is None),
                ("the `volume`", to_ask),
            )
            if absent
        ]
        raise InvalidInput(f"{sources} is incomplete: add {' and '.join(missing)}")
    if valid_from.tzinfo is None:
        raise InvalidInput(
            f"the time {valid_from.isoformat()} from which it is valid needs a zone, as in +02:00"
        )
    checked_name(rig, "rig")
    if volume is not None:
        _check_volume(volume)
    sensors = _sensors(found, given, sources)
    if all(sensor.role is Role.PROJECTOR for sensor in sensors):
        raise InvalidInput(
            f"{sources} has no camera, but {', '.join(s.name for s in sensors)}: nothing can be measured "
            "with projectors alone; add a camera, or name one with `camera`"
        )
    refuse_one_place(sensors, sources)
    if given.volume is not None:
        refuse_unseen(sensors, given.volume, sources)
    remarks = [*found.remarks, *_folds(sensors, sources), *_of_other_images(sensors)]
    if not found.in_millimetres and given.millimetres_per_unit == 1.0:
        remarks += _assumed_unit(sensors, sources)
    if volume is None:
        volume = _seen_together(sensors, sources)
        remarks.append(f"the volume is what the cameras see together, {corners(volume)}; `volume` changes it")
    else:
        remarks += remarks_on_blind(sensors, volume)
    calibration = Calibration(Rig(rig, sensors), volume, valid_from.astimezone(UTC), origin)
    return ImportedCalibration(calibration, tuple(remarks))


def _folds(sensors: tuple[Sensor, ...], sources: str) -> list[str]:
    """Say where distortions fold over in a part of the image; refuse those that do in most of it."""
    remarks = []
    for sensor in sensors:
        blind = _blind_part(sensor)
        folded = fold_px(sensor.intrinsics, sensor.columns, sensor.rows)
        where = "" if folded is None else f" {folded[0]:.0f} px from its principal point"
        if blind > _MOST_BLIND:
            raise ConfigurationError(
                f"the distortion of {sensor.name} in {sources} folds over{where}: {blind:.0%} of its image "
                f"has no ray, allowed is {_MOST_BLIND:.0%}; its coefficients may be those of another camera "
                "model"
            )
        if blind > 0.0 and sensor.intrinsics.fisheye and folded is None:
            remarks.append(
                f"{sensor.name}: {blind:.0%} of the image has no ray within 90 degrees of its axis"
            )
        elif blind > 0.0:
            remarks.append(
                f"{sensor.name}: {blind:.0%} of the image has no ray; its distortion folds over there{where}"
            )
    return remarks


def _of_other_images(sensors: tuple[Sensor, ...]) -> list[str]:
    """Say which cameras seem to have been calibrated with images of another size; projectors shift theirs."""
    remarks = []
    for sensor in (s for s in sensors if s.role is Role.CAMERA):
        lens, columns, rows = sensor.intrinsics, sensor.columns, sensor.rows
        aside = max(abs((lens.cx + 0.5) / columns - 0.5), abs((lens.cy + 0.5) / rows - 0.5))
        if aside > _MOST_ASIDE:
            at = f"{lens.cx:.5g}, {lens.cy:.5g} px"
            remarks.append(
                f"{sensor.name}: the principal point {at} lies {aside:.0%} of a side from the middle of an "
                f"image of {columns} x {rows} px (doubted beyond {_MOST_ASIDE:.0%}): was it calibrated with "
                "images of another size, or are its numbers not in pixels?"
            )
        if max(lens.fx / lens.fy, lens.fy / lens.fx) > _MOST_ASPECT:
            remarks.append(
                f"{sensor.name}: the focal lengths {lens.fx:.5g} and {lens.fy:.5g} px are those of pixels "
                "that are no squares: was an image binned along one side, or a number mistyped?"
            )
    return remarks


def _assumed_unit(sensors: tuple[Sensor, ...], sources: str) -> list[str]:
    """Say what lengths are taken for where the file says no unit: a wrong one makes every shape wrong."""
    if len(sensors) < 2:
        return []
    one, other = sensors[:2]
    apart_mm = float(np.linalg.norm(one.pose.centre() - other.pose.centre()))
    remark = (
        f"{sources} says no unit of length: taken for mm, {one.name} and {other.name} are {apart_mm:.4g} mm "
        "apart; `unit_mm` gives another"
    )
    return [remark]


def _several_cameras(found: FoundCalibration, given: Supplement) -> bool:
    roles = [role_of(name) for name in given.names] or [sensor.role for sensor in found.sensors]
    return len(roles) > 1 and Role.PROJECTOR not in roles


def _sensors(found: FoundCalibration, given: Supplement, sources: str) -> tuple[Sensor, ...]:
    """Return the sensors with name, size and millimetres: cameras first, each group by number."""
    if not found.sensors:
        raise ConfigurationError(f"{sources} has no sensor")
    names = _names(found, given, sources)
    if found.in_millimetres and given.millimetres_per_unit != 1.0:
        raise InvalidInput(f"{sources} is in millimetres; leave out the unit")
    if not (isfinite(given.millimetres_per_unit) and given.millimetres_per_unit > 0.0):
        raise InvalidInput(f"a unit of length has more than 0 mm, not {given.millimetres_per_unit}")
    strange = sorted(set(given.sizes) - set(names))
    if strange:
        raise InvalidInput(
            f"a size is given for {strange[0]}, but the sensors of {sources} are {', '.join(names)}"
        )
    mixed = found.sensors[0].role is not found.sensors[-1].role
    for name, sensor in zip(names, found.sensors, strict=True):
        if mixed and role_of(name) is not sensor.role:
            raise InvalidInput(
                f"{name} cannot be the name of a {sensor.role.value}, which it is in {sources}"
            )
    sizes = [_size(name, sensor, given, sources) for name, sensor in zip(names, found.sensors, strict=True)]
    unsized = [name for name, size in zip(names, sizes, strict=True) if size is None]
    if unsized:
        sizes_to_add = " ".join(f"{name}=COLUMNSxROWS" for name in unsized)
        raise InvalidInput(
            f"{sources} does not say the image size of {', '.join(unsized)}: add `size` {sizes_to_add}"
        )
    sensors = []
    for name, sensor, size in zip(names, found.sensors, sizes, strict=True):
        assert size is not None
        columns, rows = size
        pose = Pose.from_arrays(
            sensor.pose.matrix(), np.array(sensor.pose.translation) * given.millimetres_per_unit
        )
        sensors.append(Sensor(name, role_of(name), columns, rows, sensor.intrinsics, pose))
    return tuple(sorted(sensors, key=lambda s: (s.name[0], int(s.name[1:]))))


def _names(found: FoundCalibration, given: Supplement, sources: str) -> list[str]:
    own = [s.name for s in found.sensors if s.name is not None]
    if own and given.names:
        raise InvalidInput(f"{sources} names its sensors itself: {', '.join(own)}; leave out their names")
    if given.names and len(given.names) != len(found.sensors):
        raise InvalidInput(
            f"{sources} has {len(found.sensors)} sensors, but {len(given.names)} are named: "
            f"{', '.join(given.names)}"
        )
    names = own or list(given.names)
    if not names:
        roles = [s.role for s in found.sensors]
        names = [sensor_name(role, roles[: i + 1].count(role)) for i, role in enumerate(roles)]
    for name in names:
        role_of(name)
    if len(set(names)) < len(names):
        raise InvalidInput(f"two sensors of {sources} have one name: {', '.join(names)}")
    return names


def _size(name: str, sensor: FoundSensor, given: Supplement, sources: str) -> tuple[int, int] | None:
    said = given.sizes.get(name)
    if said is not None:
        said = image_size(*said, f"the size of {name}")
    if said is not None and sensor.size is not None and said != sensor.size:
        raise InvalidInput(
            f"the size given for {name} is {said[0]} x {said[1]} px, but {sources} says {sensor.size[0]} x "
            f"{sensor.size[1]} px"
        )
    return said or sensor.size


def _seen_together(sensors: tuple[Sensor, ...], sources: str) -> Box:
    """Return a volume about what several cameras see together."""
    found = common_field([Camera(s.intrinsics, s.pose, s.columns, s.rows) for s in sensors])
    if found is None:
        raise InvalidInput(
            f"{sources} does not say the measurement volume, and its cameras do not look at one place: add "
            "the volume"
        )
    low, high = (corner.tolist() for corner in found)
    return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def _check_volume(volume: Box) -> None:
    corners = [*volume.low, *volume.high]
    if not all(map(isfinite, corners)) or any(
        low >= high for low, high in zip(volume.low, volume.high, strict=True)
    ):
        raise InvalidInput(
            f"the volume from {list(volume.low)} to {list(volume.high)} mm is empty: give the lower corner "
            "first, every coordinate below that of the upper"
        )


def _blind_part(sensor: Sensor) -> float:
    """Return the part of a sensor's image that has no ray: where its distortion folds over."""
    inner = sensor.intrinsics
    x, y = np.meshgrid(np.linspace(0, sensor.columns - 1, _GRID), np.linspace(0, sensor.rows - 1, _GRID))
    with np.errstate(all="ignore"):
        distorted = np.stack([(x - inner.cx) / inner.fx, (y - inner.cy) / inner.fy], axis=-1)
        ideal = undistort(inner, distorted)
        # Beyond a fold there are solutions too, which lie on the other side.
        upright = np.sum(ideal * distorted, axis=-1) >= 0.0
    return float(np.mean(~(np.isfinite(ideal).all(axis=-1) & upright)))
