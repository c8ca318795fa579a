"""What a camera of the virtual rig records: fringe frames made as they are asked for, and the texture.

Grey levels are the sub-samples' light, blurred by the lens and averaged over each pixel, plus shot and
read noise, rounded and cut off at full scale. Shot noise is taken as Gaussian, which differs from
Poisson's law only where a pixel holds a few tens of electrons or fewer.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from math import ceil, pi, sqrt
from threading import Lock
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.phase.patterns import direction, fringe_harmonics, span_px
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import CameraResponse, Simulation
from sms_jobs.records.sensors import Sensor
from sms_jobs.virtual_rig.gloss import dimmed, shining
from sms_jobs.virtual_rig.light import SUBSAMPLES, Floats, Light, Singles, sensor_named

Image: TypeAlias = NDArray[np.uint16]

_NOISE_ROWS = 64


@dataclass(frozen=True)
class Rendering:
    """What one view records of a simulated state; the fields are those of `Measurement`."""

    texture: Image
    frames: SimulatedImage
    full_scale: int
    gain: float
    read_noise: float


@dataclass(frozen=True)
class Noise:
    """The noise of a camera in grey levels: variance = read_noise^2 + gain * level."""

    full_scale: int
    gain: float
    read_noise: float

    @classmethod
    def of(cls, camera: CameraResponse) -> Noise:
        """Return the noise of a camera, without that of rounding."""
        full_scale = 2**camera.bits - 1
        gain = full_scale / camera.full_well
        return cls(full_scale, gain, camera.read_noise * gain)


def render(
    simulation: Simulation, sequence: FringeSequence, *, threads: int = 1, dimming: Singles | None = None
) -> Rendering:
    """Render what a view records of a simulated state.

    Parameters
    ----------
    simulation
        Scene, view and deformation.
    sequence
        The patterns that are projected; without a projector nothing asks for them.
    threads
        Number of threads; the images do not depend on it.
    dimming
        (projector rows, projector columns): what every pattern is multiplied by; None for 1.

    Returns
    -------
    The texture, and the frames, which are rendered when they are asked for. `read_noise` includes the
    rounding to whole grey levels, 1/12 of a grey level squared. Of a camera alone the texture is the only
    frame.

    Raises
    ------
    InvalidInput
        When a projector is to be dimmed and there is none.
    """
    light = shining(simulation, threads)
    if dimming is not None:
        if simulation.projector is None:
            raise InvalidInput(
                f"camera {simulation.camera} of state {simulation.state} is recorded without a projector, so "
                "nothing can be dimmed: leave dimming out"
            )
        light = dimmed(light, dimming.astype(np.float64))
    frames = (
        SimulatedImage(simulation, light, threads)
        if simulation.projector is None
        else SimulatedFrames(simulation, sequence, light, threads)
    )
    noise = Noise.of(simulation.scene.camera)
    read_noise = sqrt(noise.read_noise**2 + 1.0 / 12.0)
    return Rendering(frames.texture(), frames, noise.full_scale, noise.gain, read_noise)


class SimulatedImage:
    """The one frame of a camera alone, white; it is the same however often it is rendered."""

    def __init__(self, simulation: Simulation, light: Light, threads: int, count: int = 1) -> None:
        self._count = count
        self._light = light
        self._threads = threads
        self._noise = Noise.of(simulation.scene.camera)
        self._white_level = simulation.scene.camera.exposure * self._noise.full_scale
        self._ambient = simulation.scene.camera.ambient
        self._spread = _pixel_weights(simulation.scene.camera.blur_px)
        self._seed = _noise_seed(simulation)
        self._steady = self._whole(self._steady_rows)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(frames, rows, columns)."""
        _, rows, columns = self._light.x.shape
        return self._count, rows // SUBSAMPLES, columns // SUBSAMPLES

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of one grey level."""
        return np.dtype(np.uint16)

    def texture(self, exposure: float = 1.0) -> Image:
        """Return the white frame, (rows, columns), of an exposure in units of the camera's own."""
        return self._recorded(np.float32(exposure) * self._white(), self._count, 0)

    def frame(self, index: int) -> Image:
        """Return one frame, (rows, columns); raise `IndexError` for a frame that there is not."""
        _ = range(self._count)[index]
        return self.texture()

    def rows(self, start: int, stop: int) -> Image:
        """Return a slab of every frame, (frames, stop - start, columns)."""
        return self._recorded(self._white()[start:stop], self._count, start)[None]

    def expected(self, index: int) -> Singles:
        """Return the grey levels of a frame before noise and rounding, (rows, columns)."""
        _ = range(self._count)[index]
        return self._white()

    def _white(self) -> Singles:
        """Return the grey levels of the white frame before noise and rounding, (rows, columns)."""
        return np.asarray(self._steady[0] + self._steady[1])

    def _whole(self, rows_of: Callable[[int, int], Singles]) -> Singles:
        """Return the images that `rows_of(start, stop)` gives, made in row blocks."""
        rows = self.shape[1]
        blocks: dict[int, Singles] = {}

        def work(start: int, stop: int) -> None:
            blocks[start] = rows_of(start, stop)

        in_row_blocks(work, rows, self._threads)
        return np.asarray(np.concatenate([blocks[start] for start in sorted(blocks)], axis=1))

    def _steady_rows(self, start: int, stop: int) -> Singles:
        """Return rows of the images of full projector brightness and of ambient light."""
        first, last = self._subsample_rows(start, stop)
        white = self._light.strength[:, first:last].sum(axis=0)
        ambient = np.float32(self._ambient) * self._light.ambient[first:last]
        return self._imaged(np.stack([white, ambient]), start, stop)

    def _subsample_rows(self, start: int, stop: int) -> tuple[int, int]:
        """Return the rows of sub-samples that rows of pixels draw on."""
        reach = (len(self._spread) - SUBSAMPLES) // 2
        return max(start * SUBSAMPLES - reach, 0), min(stop * SUBSAMPLES + reach, self._light.x.shape[1])

    def _imaged(self, images: Singles, start: int, stop: int) -> Singles:
        """Blur sub-sampled images, average them over pixels and bring them to grey levels."""
        first, _ = self._subsample_rows(start, stop)
        out = np.empty((len(images), stop - start, images.shape[2] // SUBSAMPLES), np.float32)
        _average_over_pixels(images, self._spread, self._white_level, start * SUBSAMPLES - first, out)
        return out

    def _recorded(self, levels: Singles, index: int, start: int) -> Image:
        """Return what the camera makes of rows `start` and on of frame `index`."""
        rows, columns = levels.shape
        out = np.empty((rows, columns), np.uint16)

        def work(first: int, last: int) -> None:
            for block in range((start + first) // _NOISE_ROWS, -(-(start + last) // _NOISE_ROWS)):
                stream = np.random.SeedSequence((self._seed, index, block))
                random = np.random.Generator(np.random.SFC64(stream))
                normal = random.standard_normal((_NOISE_ROWS, columns), dtype=np.float32)
                top = block * _NOISE_ROWS - start
                low, high = max(top, first), min(top + _NOISE_ROWS, last)
                noise = self._noise
                drawn, here = normal[low - top : high - top], out[low:high]
                _expose(levels[low:high], drawn, noise.read_noise**2, noise.gain, noise.full_scale, here)

        in_row_blocks(work, rows, self._threads)
        return out


class SimulatedFrames(SimulatedImage):
    """The frames of a simulated measurement; every frame is the same however often it is rendered."""

    def __init__(self, simulation: Simulation, sequence: FringeSequence, light: Light, threads: int) -> None:
        super().__init__(simulation, light, threads, sequence.frames)
        self._sequence = sequence
        self._patterns = list(sequence.patterns())
        self._projector: Sensor = sensor_named(simulation, simulation.projector or "")
        self._response = simulation.scene.projector
        self._lock = Lock()
        self._fringes: tuple[tuple[float, int], Singles] | None = None

    def frame(self, index: int) -> Image:
        """Return one frame, (rows, columns); raise `IndexError` for a frame that there is not."""
        index = range(self._sequence.frames)[index]
        return self._recorded(self.expected(index), index, 0)

    def rows(self, start: int, stop: int) -> Image:
        """Return a slab of every frame, (frames, stop - start, columns)."""
        count, _, columns = self.shape
        slab = np.empty((count, stop - start, columns), np.uint16)
        for (orientation, density), frames in groupby(enumerate(self._patterns), key=lambda f: f[1][:2]):
            fringes = self._fringe_rows(orientation, density, start, stop)
            for index, (_, _, step) in frames:
                levels = self._levels(self._steady[:, start:stop], fringes, step)
                for number, exposure in enumerate(self._sequence.exposures):
                    place = number * len(self._patterns) + index
                    slab[place] = self._recorded(np.float32(exposure) * levels, place, start)
        return slab

    def expected(self, index: int) -> Singles:
        """Return the grey levels of a frame before noise and rounding, (rows, columns)."""
        number, pattern = divmod(index, len(self._patterns))
        orientation, density, step = self._patterns[pattern]
        shown = (orientation, density)
        with self._lock:
            if self._fringes is None or self._fringes[0] != shown:
                fringes = self._whole(lambda start, stop: self._fringe_rows(*shown, start, stop))
                self._fringes = (shown, fringes)
            fringes = self._fringes[1]
        return np.float32(self._sequence.exposures[number]) * self._levels(self._steady, fringes, step)

    def _levels(self, steady: Singles, fringes: Singles, step: int) -> Singles:
        """Return grey levels from the steady light and the cosine and sine images of each harmonic.

        Image 0 of `fringes` is the mean brightness of the patterns; then c_n cos(n w t) and c_n sin(n w t).
        """
        levels: Singles = steady[1] + fringes[0]
        for n in range(1, (len(fringes) + 1) // 2):
            angle = 2.0 * pi * n * step / self._sequence.steps
            levels += np.float32(np.cos(angle)) * fringes[2 * n - 1]
            levels -= np.float32(np.sin(angle)) * fringes[2 * n]
        return levels

    def _fringe_rows(self, orientation: float, density: int, start: int, stop: int) -> Singles:
        """Return rows of the images that every step of one density is made of, see `_levels`."""
        columns, rows = self._projector.columns, self._projector.rows
        span = span_px(columns, rows, orientation)
        harmonics = fringe_harmonics(
            density,
            span,
            visibility=self._response.visibility,
            gamma=self._response.gamma,
            defocus_px=self._response.defocus_px,
        )
        a, b = direction(orientation)
        # The phase is a x + b y + c in projector pixels.
        scale = 2.0 * pi * density / span
        phase = np.array([a, b, a * (0.5 - columns / 2.0) + b * (0.5 - rows / 2.0)]) * scale
        first, last = self._subsample_rows(start, stop)
        light = self._light
        images = np.empty((2 * len(harmonics) - 1, last - first, light.x.shape[2]), np.float32)
        x, y = light.x[:, first:last], light.y[:, first:last]
        _fringe_light(x, y, light.strength[:, first:last], phase, harmonics, images)
        return self._imaged(images, start, stop)


def _noise_seed(simulation: Simulation) -> int:
    """Return a number that names a measurement: the same in every process and on every machine."""
    name = f"{simulation.scene.seed}/{simulation.state}/{simulation.camera}{simulation.projector or ''}"
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8])


def _pixel_weights(blur_px: float) -> Floats:
    """Return the weights, along one axis, with which sub-samples enter a pixel: its box, blurred."""
    sigma = blur_px * SUBSAMPLES
    reach = ceil(4.0 * sigma)
    offsets = np.arange(-reach, reach + 1)
    gauss = np.exp(-0.5 * (offsets / sigma) ** 2) if sigma > 0.0 else np.ones(1)
    weights = np.convolve(gauss, np.ones(SUBSAMPLES))
    return np.asarray(weights / weights.sum())


@kernel
def _fringe_light(
    x: Floats, y: Floats, strength: Singles, phase: Floats, harmonics: Floats, out: Singles
) -> None:
    """Fill `out` with strength x c_0, then c_n cos(n phase) and c_n sin(n phase), summed over returns."""
    out[:] = 0.0
    for r in range(x.shape[0]):
        for i in range(x.shape[1]):
            for j in range(x.shape[2]):
                light = strength[r, i, j]
                if light == 0.0:
                    continue
                angle = phase[0] * x[r, i, j] + phase[1] * y[r, i, j] + phase[2]
                out[0, i, j] += light * harmonics[0]
                for n in range(1, harmonics.shape[0]):
                    out[2 * n - 1, i, j] += light * harmonics[n] * np.cos(n * angle)
                    out[2 * n, i, j] += light * harmonics[n] * np.sin(n * angle)


@kernel
def _average_over_pixels(images: Singles, weights: Floats, scale: float, first: int, out: Singles) -> None:
    """Blur and thin out images; the sub-sample row `first` is the first of the first pixel.

    Beyond the image's edge the light goes on as it came, turned about the last sub-sample: repeating that
    would bend fringes which in life go on.
    """
    reach = (weights.shape[0] - SUBSAMPLES) // 2
    height, width = images.shape[1], images.shape[2]
    line = np.empty(width)
    for c in range(images.shape[0]):
        for i in range(out.shape[1]):
            line[:] = 0.0
            for k in range(weights.shape[0]):
                row = first + i * SUBSAMPLES + k - reach
                last = min(max(row, 0), height - 1)
                weight = weights[k] * scale
                for j in range(width):
                    line[j] += weight * images[c, last, j]
                if row != last:
                    for j in range(width):
                        line[j] += weight * (images[c, last, j] - images[c, 2 * last - row, j])
            for j in range(out.shape[2]):
                total = 0.0
                for k in range(weights.shape[0]):
                    column = j * SUBSAMPLES + k - reach
                    last = min(max(column, 0), width - 1)
                    total += weights[k] * line[last]
                    if column != last:
                        total += weights[k] * (line[last] - line[2 * last - column])
                out[c, i, j] = total


@kernel
def _expose(
    levels: Singles, normal: Singles, read_variance: float, gain: float, full_scale: int, out: Image
) -> None:
    """Add noise to grey levels, round them and cut them off at 0 and full scale."""
    for i in range(levels.shape[0]):
        for j in range(levels.shape[1]):
            level = max(levels[i, j], 0.0)  # beyond a dark edge of the image less than none may be seen
            level += np.sqrt(read_variance + gain * level) * normal[i, j]
            out[i, j] = int(min(max(level + 0.5, 0.0), float(full_scale)))
