"""A tuple of four megapixels and 508 frames: made, sealed in an archive, and reconstructed from it.

Run as `python -m sms_jobs.bench.large.tuples FOLDER THREADS`, it reconstructs what `seal` has put into the
folder and prints the seconds and the peak memory of that process alone.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sms_jobs
from sms_jobs.archive import Archive, FolderStore, Provenance
from sms_jobs.bench.peak_memory import peak_rss_mb
from sms_jobs.errors import SmsError
from sms_jobs.kinds.kind import DatasetOutput, Inputs
from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.metrology.arrays import Floats, Ints, Mask, Singles
from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.metrology.geometry.triangulation import camera_rays
from sms_jobs.metrology.phase.patterns import phase_gradient
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.sensors import Calibration, Rig
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import CAMERA_LENS, START, aimed, plate_and_mirror

PIXELS = 2048
FRINGES = 64
PARAMETERS = {"method": "fdr", "returns": 2}
_FULL_SCALE, GAIN, READ_NOISE = 4095, 0.1365, 1.4  # 12 bits, 30 000 electrons
_DARK = 60.0
_NORMALS = 1 << 22
_HINGE_MM = -30.0  # below it the plate is lit a second time


@dataclass(frozen=True)
class Scene:
    """What a plate in z = 0 shows a camera: omega of two returns, their amplitudes, and the mean level.

    Attributes
    ----------
    omega
        (orientations, returns, rows, columns) in rad.
    amplitude
        (returns, rows, columns) in grey levels.
    """

    omega: Singles
    amplitude: Singles


class SyntheticFrames:
    """Frames of two returns with shot and read noise; the steps of a density are made together and kept."""

    def __init__(self, scene: Scene, sequence: FringeSequence, threads: int) -> None:
        self._scene, self._sequence, self._threads = scene, sequence, threads
        self._patterns = list(sequence.patterns())
        self._normal = np.random.default_rng(2).standard_normal(_NORMALS, np.float32)
        self._made: tuple[tuple[float, float], NDArray[np.uint16]] | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(frames, rows, columns)."""
        _, rows, columns = self._scene.amplitude.shape
        return self._sequence.frames, rows, columns

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of one grey level."""
        return np.dtype(np.uint16)

    def frame(self, index: int) -> NDArray[np.uint16]:
        """Return one frame, (rows, columns)."""
        orientation, density, step = self._patterns[index]
        if self._made is None or self._made[0] != (orientation, density):
            self._made = (orientation, density), self._steps(orientation, density)
        made: NDArray[np.uint16] = self._made[1][step]
        return made

    def rows(self, start: int, stop: int) -> NDArray[np.uint16]:
        """Return a slab of every frame, (frames, stop - start, columns)."""
        return np.stack([self.frame(i)[start:stop] for i in range(len(self._patterns))])

    def _steps(self, orientation: float, density: float) -> NDArray[np.uint16]:
        number = self._sequence.orientations_rad.index(orientation)
        omega = self._scene.omega[number]
        steps = np.exp(2j * pi * np.arange(self._sequence.steps) / self._sequence.steps)
        out = np.empty((len(steps), *self.shape[1:]), np.uint16)
        draw = np.random.default_rng((number, int(density)))
        places = draw.integers(_NORMALS, size=(len(steps), out.shape[1]))

        def work(start: int, stop: int) -> None:
            block = slice(start, stop)
            light = (omega[:, block], self._scene.amplitude[:, block])
            _expose(*light, density, steps.real, steps.imag, self._normal, places[:, block], out[:, block])

        in_row_blocks(work, out.shape[1], self._threads)
        return out


@kernel
def _expose(
    omega: Singles,
    amplitude: Singles,
    density: float,
    cosines: Floats,
    sines: Floats,
    normal: Singles,
    places: Ints,
    out: NDArray[np.uint16],
) -> None:
    """Fill (steps, rows, columns); the noise of a row begins somewhere in a table of normal numbers."""
    for i in range(out.shape[1]):
        for j in range(out.shape[2]):
            steady, c, s = _DARK, 0.0, 0.0
            for r in range(amplitude.shape[0]):
                a = amplitude[r, i, j]
                if a > 0.0:
                    steady += a
                    c += a * np.cos(omega[r, i, j] * density)
                    s += a * np.sin(omega[r, i, j] * density)
            for k in range(out.shape[0]):
                level = steady + c * cosines[k] - s * sines[k]
                noise = np.sqrt(READ_NOISE * READ_NOISE + GAIN * level)
                level += noise * normal[(places[k, i] + j) & (_NORMALS - 1)]
                out[k, i, j] = int(min(max(level + 0.5, 0.0), float(_FULL_SCALE)))


def rig(pixels: int) -> Calibration:
    """Return the scanner of the plate and mirror with a camera of `pixels` x `pixels`."""
    calibration, _ = plate_and_mirror("plate", "small", FRINGES)
    z = float(calibration.rig.sensor("C1").pose.centre()[2])
    camera = aimed("C1", pixels, pixels, replace(CAMERA_LENS, focal=3.6), (-600.0, 40.0, z), 0.01)
    return replace(calibration, rig=Rig(calibration.rig.name, (camera, calibration.rig.sensor("P1"))))


def scene(calibration: Calibration, sequence: FringeSequence) -> Scene:
    """Return what the rig's camera sees of the plate."""
    camera, projector = calibration.rig.sensor("C1"), calibration.rig.sensor("P1")
    rays = camera_rays(camera.intrinsics, camera.pose, camera.rows, camera.columns)
    centre = camera.pose.centre()
    points = centre - rays * (centre[2] / rays[..., 2:])
    mirrored = points * [1.0, -1.0, 1.0] + [0.0, 2.0 * _HINGE_MM, 0.0]
    omega = np.empty((len(sequence.orientations_rad), 2, camera.rows, camera.columns), np.float32)
    for r, source in enumerate((points, mirrored)):
        pixels = project(projector.intrinsics, projector.pose, source)
        for k, orientation in enumerate(sequence.orientations_rad):
            omega[k, r] = phase_gradient(pixels, projector.columns, projector.rows, orientation)
    lit: Mask = np.asarray((np.abs(omega) < pi).all(axis=0))
    amplitude = np.empty((2, camera.rows, camera.columns), np.float32)
    amplitude[0] = np.where(lit[0], 700.0 + 200.0 * np.cos(points[..., 0] / 90.0), 0.0)
    amplitude[1] = np.where(lit[1] & (points[..., 1] < _HINGE_MM), 0.5 * amplitude[0], 0.0)
    return Scene(omega, amplitude)


def _provenance(kind: str, subject: Subject) -> Provenance:
    return Provenance(
        kind, 1, subject, "0" * 32, 1, START, {}, (), sms_jobs.__version__, "bench", "bench"
    )  # fmt: skip


def seal(folder: Path, name: str, pixels: int, threads: int) -> float:
    """Make a tuple and seal it and its calibration in an archive; return the size of its file in GB."""
    archive = Archive(FolderStore(folder / "archive"))
    sequence = FringeSequence(tuple(range(FRINGES)))
    calibration = rig(pixels)
    frames = SyntheticFrames(scene(calibration, sequence), sequence, threads)
    texture = frames.frame(0)
    measurement = Measurement(
        START, sequence, _FULL_SCALE, GAIN, float(np.hypot(READ_NOISE, 12**-0.5)), texture, frames
    )
    subject = Subject(name, "S00", "C1P1")
    sealed = archive.seal_dataset({"measurement": measurement}, _provenance("simulate", subject))
    known = archive.seal_dataset({"calibration": calibration}, _provenance("calibrate", subject))
    (folder / f"{name}.json").write_text(json.dumps([sealed.path, known.path]), encoding="utf-8")
    return sealed.size_bytes / 1e9


def reconstruct(folder: Path, name: str, threads: int) -> DatasetOutput:
    """Reconstruct a sealed tuple into the archive it lies in."""
    archive = Archive(FolderStore(folder / "archive"))
    paths = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    subject = Subject(name, "S00", "C1P1")
    with archive.open_unrecorded(paths[0]) as measurement, archive.open_unrecorded(paths[1]) as calibration:
        inputs = Inputs(subject, None, {"measurement": measurement, "calibration": calibration}, threads)
        parameters = ReconstructParameters(**PARAMETERS)
        (output,) = KIND.run(inputs, parameters, lambda fraction, message="": None)
        assert isinstance(output, DatasetOutput)
        archive.seal_dataset(output.records, _provenance(KIND.name, subject))
    return output


@dataclass(frozen=True)
class Taken:
    """What reconstructing a tuple took, and how much of it is valid."""

    wall_s: float
    cpu_s: float
    peak_rss_mb: float
    valid_fraction: float


def measure(folder: Path, threads: int) -> Taken:
    """Reconstruct the sealed `tiny` and `large` in a process of their own; return what `large` took."""
    command = [sys.executable, "-P", "-m", __name__, str(folder), str(threads)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise SmsError(f"the reconstruction of the large tuple failed: {reason[0]}")
    return Taken(**json.loads(done.stdout.splitlines()[-1]))


def main(folder: Path, threads: int) -> None:
    """Reconstruct the tiny tuple, which compiles the kernels, then the large one; print what that took."""
    reconstruct(folder, "tiny", threads)
    started, used = time.monotonic(), time.process_time()
    output = reconstruct(folder, "large", threads)
    taken = Taken(
        time.monotonic() - started,
        time.process_time() - used,
        peak_rss_mb(),
        output.statistics["valid_fraction_of_image"],
    )
    sys.stdout.write(json.dumps(vars(taken)) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
