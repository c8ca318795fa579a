"""Other programs on the same images of two cameras: a folder a case, a process a run."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sms_jobs.bench.peers import run_script
from sms_jobs.bench.two_cameras.plane_meshes import field_at
from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT
from sms_jobs.kinds.shape import stereo
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.fields import ImageMatches
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import Role
from sms_jobs.testing.shelf import Shelf

Image8: TypeAlias = NDArray[np.uint8]

SUBSET_PX, SPACING_PX = 31, 5
_AT = datetime(2026, 1, 1, tzinfo=UTC)
_ROUNDING = 0.29  # grey levels

_COLUMNS, _ROWS = 1040, 1540
_FOCAL_PX = 50.0 / 3.45e-3
_MM_PER_PX = 0.1
_MIDDLE = (0.5 * (_COLUMNS - 1), 0.5 * (_ROWS - 1))
_PLATE_MM = (100.0, 150.0)
_ANGLE_RAD = np.radians(20.0)
_SHIFT_MM = 5.0


@dataclass(frozen=True)
class Given:
    """States of a specimen that two cameras see, and how all programs are to measure them.

    Attributes
    ----------
    images
        Of each state and camera, (rows, columns); the first state is the reference.
    calibration
        Cameras C1 and C2.
    specimen
        (rows, columns), what of C1's image at rest is to be measured.
    search_px
        How far displacements are looked for.
    subset_px, spacing_px
        Width of a subset, and the distance of the points where a program leaves that to us.
    disparity_px
        Where C2's image shows what C1's does, x and y, within 40 px.
    noise
        Standard deviation of a pixel, in grey levels.
    """

    images: tuple[tuple[Image8, Image8], ...]
    calibration: Calibration
    specimen: Mask
    search_px: int
    subset_px: int = SUBSET_PX
    spacing_px: int = SPACING_PX
    disparity_px: tuple[float, float] = (0.0, 0.0)
    noise: float = _ROUNDING


@dataclass(frozen=True)
class Case:
    """Two states of a flat specimen that two cameras see, in the frame of the first.

    Attributes
    ----------
    images
        Of each state and camera, (rows, columns).
    calibration
        Cameras C1 and C2; the frame of C1 is the world's.
    truth
        (3, rows, columns), displacement in mm of what each pixel of C1 sees; NaN where it sees no specimen.
    search_px
        How far displacements are looked for.
    """

    images: tuple[tuple[Image8, Image8], tuple[Image8, Image8]]
    calibration: Calibration
    truth: Floats
    search_px: int

    @property
    def given(self) -> Given:
        """What programs are given of it."""
        return Given(self.images, self.calibration, np.isfinite(self.truth[0]), self.search_px)


@dataclass(frozen=True)
class Outcome:
    """What a program found at the points of its grid.

    Attributes
    ----------
    pixels
        (2, n), x and y in the image of C1.
    displacement
        (states, 3, n) in mm in C1's frame, of all states but the reference; NaN where it found none.
    cpu_s
        What it took, without loading and compiling.
    spacing_px
        Of its grid.
    """

    pixels: Floats
    displacement: Floats
    cpu_s: float
    spacing_px: int

    def points_per_cpu_s(self) -> float:
        """Return how many points with all displacements a CPU-second gives."""
        return float(np.isfinite(self.displacement).all(axis=(0, 1)).sum() / self.cpu_s)

    def errors_mm(self, case: Case) -> Floats:
        """Return the lengths of the errors of the last state at all points on the specimen that have one."""
        x, y = np.rint(self.pixels).astype(np.int64)
        error = self.displacement[-1] - case.truth[:, y, x]
        return np.asarray(np.linalg.norm(error[:, np.isfinite(error).all(axis=0)], axis=0))

    def valid_part(self, case: Case) -> float:
        """Return for which part of the grid's points on the specimen there is a displacement."""
        on_grid = np.isfinite(case.truth[0]).sum() / self.spacing_px**2
        return float(len(self.errors_mm(case)) / on_grid)


def rendered_plates(peers: Path, folder: Path) -> dict[str, Case]:
    """Let riley render pyvale's examples: a plate shifted along x and y, and a stretched one with a hole."""
    run_script(peers, "render_plates.py", folder)
    mesh = np.load(folder / "mesh.npz")
    row, column = np.mgrid[0:_ROWS, 0:_COLUMNS].astype(np.float64)
    x, y = (column - _MIDDLE[0]) * _MM_PER_PX, -(row - _MIDDLE[1]) * _MM_PER_PX
    places = np.stack([x.ravel(), y.ravel()], axis=1) + 0.5 * np.array(_PLATE_MM)
    stretched = 1e3 * field_at(1e3 * mesh["nodes"], mesh["elements"], mesh["displacement"], places)
    on_plate = (np.abs(x) < 0.5 * _PLATE_MM[0]) & (np.abs(y) < 0.5 * _PLATE_MM[1])
    shifted = np.where(on_plate.reshape(-1, 1), _SHIFT_MM, np.nan) * np.ones(2)
    return {
        "shift": _plate(folder, "rigid", 50, shifted, 64),
        "hole": _plate(folder, "platehole", 10, stretched, 16),
    }


def _plate(folder: Path, name: str, last: int, moved: Floats, search_px: int) -> Case:
    """Return a rendered case; `moved` (pixels, 2) is the displacement along the mesh's x and y."""

    def image(state: int, camera: int) -> Image8:
        where = folder / "pyvale-output" / "dic_images" / name / f"{name}_cam{camera}_frame{state:02d}.tiff"
        return np.array(Image.open(where), dtype=np.uint8)

    images = ((image(0, 0), image(0, 1)), (image(last, 0), image(last, 1)))
    # The image's y points down, as the first camera's does.
    truth = np.stack([moved[:, 0], -moved[:, 1], 0.0 * moved[:, 0]]).reshape(3, _ROWS, _COLUMNS)
    return Case(images, _rendered_rig(), truth, search_px)


def _rendered_rig() -> Calibration:
    """Return the cameras of pyvale's examples, in the frame of the first."""
    far = _FOCAL_PX * _MM_PER_PX
    s, c = float(np.sin(_ANGLE_RAD)), float(np.cos(_ANGLE_RAD))
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    lens = Intrinsics(_FOCAL_PX, _FOCAL_PX, *_MIDDLE)
    poses = (
        Pose.from_arrays(np.eye(3), np.zeros(3)),
        Pose.from_arrays(turn, -turn @ (far * np.array([s, 0.0, 1.0 - c]))),
    )
    sensors = tuple(
        Sensor(f"C{number}", Role.CAMERA, _COLUMNS, _ROWS, lens, pose)
        for number, pose in enumerate(poses, start=1)
    )
    volume = Box((-60.0, -85.0, far - 30.0), (60.0, 85.0, far + 30.0))
    return Calibration(Rig("rendered", sensors), volume, _AT, "exact")


def prepare(given: Given, folder: Path) -> None:
    """Write what the scripts of the others read."""
    folder.mkdir()
    for state, pair in enumerate(given.images):
        for camera, image in enumerate(pair):
            Image.fromarray(image).save(folder / f"{camera}_{state}.tiff")
    Image.fromarray(np.where(given.specimen, 255, 0).astype(np.uint8)).save(folder / "roi.png")
    first, second = (given.calibration.rig.sensor(name) for name in ("C1", "C2"))
    turn = second.pose.matrix() @ first.pose.matrix().T
    shift = np.array(second.pose.translation) - turn @ np.array(first.pose.translation)
    rows, columns = given.specimen.shape
    written = {
        "states": len(given.images),
        "matrices": [camera.intrinsics.matrix().tolist() for camera in (first, second)],
        "distortions": [
            [getattr(camera.intrinsics, name) for name in ("k1", "k2", "p1", "p2", "k3")]
            for camera in (first, second)
        ],
        "rotation": turn.tolist(),
        "translation": shift.tolist(),
        "seed": [columns // 5, rows // 3],
        "subset_px": given.subset_px,
        "spacing_px": given.spacing_px,
        "search_px": given.search_px,
        "disparity_px": given.disparity_px,
    }
    (folder / "case.json").write_text(json.dumps(written), encoding="utf-8")


def measured_by(peers: Path, script: str, folder: Path) -> Outcome:
    """Let another program measure what was prepared in a folder."""
    run_script(peers, f"run_{script}.py", folder)
    found = np.load(folder / f"{script}.npz")
    return Outcome(found["pixels"], found["displacement"], float(found["cpu_s"]), int(found["spacing_px"]))


def measured_here(given: Given) -> Outcome:
    """Measure with one thread: points of the grid, with the displacement of their pixel."""
    moved, matches, used = fields_here(given)
    x, y = matches.x.astype(np.int64), matches.y.astype(np.int64)
    return Outcome(np.stack([matches.x, matches.y]), moved[:, :, y, x], used, given.spacing_px)


def fields_here(given: Given) -> tuple[Floats, ImageMatches, float]:
    """Measure all states with one thread.

    Returns
    -------
    displacement, matches, cpu_s
        (states, 3, rows, columns) in mm in C1's frame, of all states but the reference; the points of the
        last; and the CPU time that it took.
    """
    states = tuple(LoadState(f"S{n:02d}", float(n), time=_AT) for n in range(len(given.images)))
    specimen = Specimen("plate", "unknown", "rendered")
    campaign = Campaign("peers", specimen, "rendered", states, ("C1C2",), FringeSequence(), None)
    shelf, last = Shelf(campaign, 1), Subject("peers", states[-1].label, "C1C2")
    radius = given.subset_px // 2
    between = stereo.KIND.parameters(subset_radius_px=radius, spacing_px=given.spacing_px)
    in_time = correlate.KIND.parameters(
        subset_radius_px=radius,
        spacing_px=given.spacing_px,
        search_range_x_px=given.search_px,
        search_range_y_px=given.search_px,
    )
    turn = given.calibration.rig.sensor("C1").pose.matrix()
    used, moved = 0.0, []
    for state, pair in zip(states, given.images, strict=True):
        subject = replace(last, state=state.label)
        shelf.records[CALIBRATION, subject] = {"calibration": given.calibration}
        for own, image in zip(subject.recordings, pair, strict=True):
            shelf.records[MEASUREMENT, own] = {"measurement": _recorded(image, given.noise)}
        used += _cpu_seconds(lambda s=subject: shelf.run(stereo.KIND, s, between))  # type: ignore[misc]
        if state is not campaign.reference:
            used += _cpu_seconds(lambda s=subject: shelf.run(correlate.KIND, s, in_time))  # type: ignore[misc]
            found = shelf.records["correlate", subject]
            moved.append(np.einsum("ij,jyx->iyx", turn, found["displacement"].displacement))
    return np.stack(moved), found["matches"], used


def _recorded(image: Image8, noise: float) -> Measurement:
    levels = image.astype(np.uint16)
    return Measurement(_AT, FringeSequence(), 255, 0.0, noise, levels, ArrayStack(levels[None]))


def _cpu_seconds(work: Callable[[], object]) -> float:
    started = time.process_time()
    work()
    return time.process_time() - started
