"""What a camera of the virtual rig records: fringe frames made as they are asked for, and the texture.

Grey levels are the sub-samples' light, blurred by the lens and averaged over each pixel, plus shot and
read noise, rounded and cut off at full scale. Shot noise is taken as Gaussian, which differs from
Poisson's law only where a pixel holds a few tens of electrons or fewer.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from math import ceil, pi, sqrt
from threading import Lock
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.phase.patterns import direction, fringe_harmonics, span_px
from sms_jobs.records.gray_code import Stripes
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import Simulation
from sms_jobs.records.sensors import Sensor
from sms_jobs.virtual_rig.fringes import add_fringes
from sms_jobs.virtual_rig.gloss import dimmed, shining
from sms_jobs.virtual_rig.light import SUBSAMPLES, Light, sensor_named
from sms_jobs.virtual_rig.noise import Noise
from sms_jobs.virtual_rig.stripes import A_PIXEL, stripe_profile

Image: TypeAlias = NDArray[np.uint16]
Window: TypeAlias = tuple[int, int, int, int]
"""First and end row, first and end column."""

_NOISE_ROWS = 64


@dataclass(frozen=True)
class Rendering:
    """What one view records of a simulated state; the fields are those of `Measurement`."""

    texture: Image
    frames: SimulatedImage
    full_scale: int
    gain: float
    read_noise: float


def render(
    simulation: Simulation,
    sequence: FringeSequence,
    *,
    threads: int = 1,
    dimming: Singles | None = None,
    light: Light | None = None,
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
    light
        What `shining` gives for the simulation, if that is known.

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
    light = shining([simulation], threads)[0] if light is None else light
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
        self._steady = self._image(self._steady_light, np.zeros((2, *self.shape[1:]), np.float32), 0)

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
        return self._recorded(self._steady, (exposure, exposure), self._count, 0)

    def frame(self, index: int) -> Image:
        """Return one frame, (rows, columns); raise `IndexError` for a frame that there is not."""
        _ = range(self._count)[index]
        return self.texture()

    def rows(self, start: int, stop: int) -> Image:
        """Return a slab of every frame, (frames, stop - start, columns)."""
        return self._recorded(self._steady[:, start:stop], (1.0, 1.0), self._count, start)[None]

    def expected(self, index: int) -> Singles:
        """Return the grey levels of a frame before noise and rounding, (rows, columns)."""
        _ = range(self._count)[index]
        return np.asarray(self._steady[0] + self._steady[1])

    def _steady_light(self, samples: Window) -> Singles:
        """Return the light of full projector brightness and ambient light in a window of sub-samples."""
        top, bottom, left, right = samples
        white = self._light.strength[:, top:bottom, left:right].sum(axis=0)
        return np.stack([white, np.float32(self._ambient) * self._light.ambient[top:bottom, left:right]])

    def _image(self, light_in: Callable[[Window], Singles], out: Singles, start: int) -> Singles:
        """Fill rows `start` and on of images, in grey levels, where anything is lit; return them.

        `light_in` gives all of them in a window of sub-samples; they are blurred and averaged over pixels.
        """
        _, rows, columns = self.shape
        reach = (len(self._spread) - SUBSAMPLES) // 2
        margin = -(-reach // SUBSAMPLES)

        def work(first: int, last: int) -> None:
            for top, bottom, left, right in self._light.windows.tolist():
                top, bottom = max(top - margin, start + first), min(bottom + margin, start + last)
                left, right = max(left - margin, 0), min(right + margin, columns)
                if top >= bottom or left >= right:
                    continue
                samples = (
                    max(top * SUBSAMPLES - reach, 0),
                    min(bottom * SUBSAMPLES + reach, rows * SUBSAMPLES),
                    max(left * SUBSAMPLES - reach, 0),
                    min(right * SUBSAMPLES + reach, columns * SUBSAMPLES),
                )
                before = (top * SUBSAMPLES - samples[0], left * SUBSAMPLES - samples[2])
                window = (top - start, bottom - start, left, right)
                images = light_in(samples)
                _average_over_pixels(images, self._spread, self._white_level, before, window, out)

        in_row_blocks(work, out.shape[1], self._threads)
        return out

    def _recorded(self, images: Singles, weights: Sequence[float] | Floats, index: int, start: int) -> Image:
        """Return what the camera makes of a weighted sum of images, which are rows `start` and on of a frame.

        The noise is that of frame `index`.
        """
        _, rows, columns = images.shape
        out = np.empty((rows, columns), np.uint16)
        images, shares = np.ascontiguousarray(images), np.array(weights, dtype=np.float64)

        def work(first: int, last: int) -> None:
            for block in range((start + first) // _NOISE_ROWS, -(-(start + last) // _NOISE_ROWS)):
                stream = np.random.SeedSequence((self._seed, index, block))
                random = np.random.Generator(np.random.SFC64(stream))
                normal = random.standard_normal((_NOISE_ROWS, columns), dtype=np.float32)
                top = block * _NOISE_ROWS - start
                low, high = max(top, first), min(top + _NOISE_ROWS, last)
                noise = self._noise
                drawn, here = normal[low - top : high - top], out[low:high]
                _expose(images, shares, low, drawn, noise.read_noise**2, noise.gain, noise.full_scale, here)

        in_row_blocks(work, rows, self._threads)
        return out


class SimulatedFrames(SimulatedImage):
    """The frames of a simulated measurement; every frame is the same however often it is rendered."""

    def __init__(self, simulation: Simulation, sequence: FringeSequence, light: Light, threads: int) -> None:
        super().__init__(simulation, light, threads, sequence.frames)
        self._sequence = sequence
        self._patterns = list(sequence.patterns())
        self._code = list(sequence.code_patterns())
        self._projector: Sensor = sensor_named(simulation, simulation.projector or "")
        self._response = simulation.scene.projector
        self._lock = Lock()
        self._shown: tuple[tuple[float, float], Singles] | None = None

    def frame(self, index: int) -> Image:
        """Return one frame, (rows, columns); raise `IndexError` for a frame that there is not."""
        index = range(self._sequence.frames)[index]
        return self._recorded(*self._parts(index), index, 0)

    def rows(self, start: int, stop: int) -> Image:
        """Return a slab of every frame, (frames, stop - start, columns)."""
        count, _, columns = self.shape
        slab = np.empty((count, stop - start, columns), np.uint16)
        for (orientation, density), frames in groupby(enumerate(self._patterns), key=lambda f: f[1][:2]):
            images = self._pattern_images(orientation, density, start, stop)
            for index, (_, _, step) in frames:
                self._record(slab, images, self._weights(len(images), step), index, start)
        for index, stripes in enumerate(self._code, len(self._patterns)):
            images = self._stripe_images(stripes, start, stop)
            self._record(slab, images, np.ones(2), index, start)
        return slab

    def _record(self, slab: Image, images: Singles, weights: Floats, index: int, start: int) -> None:
        """Put a pattern in all exposures into its places of a slab."""
        for number, exposure in enumerate(self._sequence.exposures):
            place = number * self._sequence.frames_per_exposure + index
            slab[place] = self._recorded(images, exposure * weights, place, start)

    def expected(self, index: int) -> Singles:
        """Return the grey levels of a frame before noise and rounding, (rows, columns)."""
        images, weights = self._parts(index)
        return np.tensordot(weights.astype(np.float32), images, 1)

    def _parts(self, index: int) -> tuple[Singles, Floats]:
        """Return the images that a frame is a weighted sum of, and their weights."""
        number, pattern = divmod(index, self._sequence.frames_per_exposure)
        exposure = self._sequence.exposures[number]
        if pattern >= len(self._patterns):
            stripes = self._code[pattern - len(self._patterns)]
            return self._stripe_images(stripes, 0, self.shape[1]), exposure * np.ones(2)
        orientation, density, step = self._patterns[pattern]
        shown = (orientation, density)
        with self._lock:
            if self._shown is None or self._shown[0] != shown:
                self._shown = (shown, self._pattern_images(orientation, density, 0, self.shape[1]))
            images = self._shown[1]
        return images, exposure * self._weights(len(images), step)

    def _weights(self, count: int, step: int) -> Floats:
        """Return the weights of `_pattern_images` in a frame of exposure 1, (count,)."""
        angles = 2.0 * pi * step / self._sequence.steps * np.arange(1, (count + 1) // 2)
        fringes = np.stack([np.cos(angles), -np.sin(angles)], axis=-1)
        return np.concatenate([[1.0], fringes.ravel()])

    def _pattern_images(self, orientation: float, density: float, start: int, stop: int) -> Singles:
        """Return rows of the images of which every step of one density is a weighted sum.

        Image 0 is the mean of the steps; then come c_n cos(n w t) and c_n sin(n w t) for n = 1, 2, ..
        """
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
        # The phase, in turns, is a x + b y + c in projector pixels.
        turns = np.array([a, b, a * (0.5 - columns / 2.0) + b * (0.5 - rows / 2.0)]) * density / span

        def fringes(samples: Window) -> Singles:
            top, bottom, left, right = samples
            images = np.zeros((2 * len(harmonics) - 2, bottom - top, right - left), np.float32)
            light = self._light
            add_fringes(light.x, light.y, light.strength, samples, turns, harmonics, images)
            return images

        white, ambient = self._steady[:, start:stop]
        images = np.zeros((2 * len(harmonics) - 1, *white.shape), np.float32)
        np.multiply(np.float32(harmonics[0]), white, out=images[0])
        images[0] += ambient
        self._image(fringes, images[1:], start)
        return images

    def _stripe_images(self, stripes: Stripes, start: int, stop: int) -> Singles:
        """Return rows of the images whose sum is a pattern of a Gray code: its light and ambient light."""
        columns, rows = self._projector.columns, self._projector.rows
        span = span_px(columns, rows, stripes.orientation_rad)
        a, b = direction(stripes.orientation_rad)
        profile = stripe_profile(stripes, span, self._response)

        def light_of(samples: Window) -> Singles:
            top, bottom, left, right = samples
            window = slice(None), slice(top, bottom), slice(left, right)
            x, y = self._light.x[window], self._light.y[window]
            along = a * (x + 0.5 - columns / 2.0) + b * (y + 0.5 - rows / 2.0) + span / 2.0
            place = np.clip(np.rint(along * A_PIXEL - 0.5).astype(np.int64), 0, len(profile) - 1)
            shown = self._light.strength[window] * profile[place]
            return np.asarray(shown.sum(axis=0, dtype=np.float32)[None])

        images = self._steady[:, start:stop].copy()
        images[0] = 0.0
        self._image(light_of, images[:1], start)
        return images


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
def _average_over_pixels(
    images: Singles, weights: Floats, scale: float, before: tuple[int, int], window: Window, out: Singles
) -> None:
    """Blur and thin out images of sub-samples into a window of pixels; `before` it lie rows and columns.

    Beyond the edge of the images the light goes on as it came, turned about the last sub-sample: repeating
    that would bend fringes which in life go on.
    """
    reach = (weights.shape[0] - SUBSAMPLES) // 2
    height, width = images.shape[1], images.shape[2]
    top, bottom, left, right = window
    line = np.empty(width)
    # The sub-samples that pixels of the line are made of, every SUBSAMPLES-th in a row of its own.
    sorted_line = np.empty((SUBSAMPLES, right - left + weights.shape[0] // SUBSAMPLES))
    total = np.empty(right - left)
    for c in range(images.shape[0]):
        for i in range(top, bottom):
            line[:] = 0.0
            for k in range(weights.shape[0]):
                row = before[0] + (i - top) * SUBSAMPLES + k - reach
                last = min(max(row, 0), height - 1)
                weight = weights[k] * scale
                for j in range(width):
                    line[j] += weight * images[c, last, j]
                if row != last:
                    for j in range(width):
                        line[j] += weight * (images[c, last, j] - images[c, 2 * last - row, j])
            for q in range(sorted_line.shape[1]):
                for p in range(SUBSAMPLES):
                    column = before[1] + q * SUBSAMPLES + p - reach
                    last = min(max(column, 0), width - 1)
                    sorted_line[p, q] = line[last]
                    if column != last:
                        sorted_line[p, q] += line[last] - line[2 * last - column]
            total[:] = 0.0
            for k in range(weights.shape[0]):
                for j in range(right - left):
                    total[j] += weights[k] * sorted_line[k % SUBSAMPLES, j + k // SUBSAMPLES]
            for j in range(right - left):
                out[c, i, left + j] = total[j]


@kernel
def _expose(
    images: Singles,
    weights: Floats,
    first: int,
    normal: Singles,
    read_variance: float,
    gain: float,
    full_scale: int,
    out: Image,
) -> None:
    """Add noise to a weighted sum of images, of rows `first` and on; round it, cut it off at full scale."""
    levels = np.empty(out.shape[1])
    for i in range(out.shape[0]):
        levels[:] = 0.0
        for k in range(weights.shape[0]):
            for j in range(out.shape[1]):
                levels[j] += weights[k] * images[k, first + i, j]
        for j in range(out.shape[1]):
            level = max(levels[j], 0.0)  # beyond a dark edge of the image less than none may be seen
            level += np.sqrt(read_variance + gain * level) * normal[i, j]
            out[i, j] = np.int32(min(max(level + 0.5, 0.0), float(full_scale)))
