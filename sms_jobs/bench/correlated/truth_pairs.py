"""Pairs of images on which correlation breaks, with the exact displacement behind every pixel.

Speckle is a sum of blobs that is known at every real point (`speckle_pairs`), so that each pixel of the
deformed image shows what is there, however the specimen has cracked, bent or moved. Where the two images
show no one material point a pixel has no true displacement: NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.bench.correlated.lone_camera import FULL_SCALE
from sms_jobs.bench.correlated.speckle_pairs import Displacement, blobs, seen_through, shift, stamped
from sms_jobs.metrology.arrays import Floats

SIZE_PX = 512
_IMAGE = (SIZE_PX, SIZE_PX)
READ_NOISE = 20.0
"""Grey levels of 12 bits, normally distributed, the same at every level."""
_MEAN, _CONTRAST = 1600.0, 400.0
_GAP = 300.0
"""Grey level of what a crack uncovers."""
_TIP_OPENING = 2.0
"""In px, of a crack that ends in the image, half an image behind its tip."""
_KAPPA = (3.0 - 0.3) / (1.0 + 0.3)
"""Of plane stress with a Poisson's ratio of 0.3."""


@dataclass(frozen=True)
class TruthPair:
    """Two images of 12 bits, and what is true of each pixel of the first.

    Attributes
    ----------
    group
        What goes wrong, as the case is listed.
    name
        The case with its numbers.
    reference, deformed
        (rows, columns), uint16.
    displacement
        (2, rows, columns), u and v in px; NaN where there is none.
    slip
        Opening and sliding in px of a crack all through the image; None where there is no such crack.
    """

    group: str
    name: str
    reference: NDArray[np.uint16]
    deformed: NDArray[np.uint16]
    displacement: Floats
    slip: tuple[float, float] | None = None


def pairs(seed: int, *, quick: bool = False) -> Iterator[Callable[[], TruthPair]]:
    """Yield what makes each of the pairs; the same cases with other speckle and noise for every seed."""
    yield partial(_smooth, "clean", "shift of 0.3 px", shift(0.3, -0.2), seed)
    yield partial(_smooth, "clean", "stretch of 2000 microstrain", _stretch(2e-3), seed)
    for period in (80, 20) if quick else (80, 60, 40, 20):
        yield partial(_smooth, "sine", f"sine of 0.5 px, period {period} px", _sine(0.5, period), seed)
    for opening in (0.25, 3.0) if quick else (0.25, 1.0, 3.0, 10.0):
        yield partial(_crack, f"crack that opens by {opening:g} px", (opening, 0.0), seed)
    for sliding in (2.0,) if quick else (0.5, 2.0):
        yield partial(_crack, f"crack that slides by {sliding:g} px", (0.0, sliding), seed)
    yield partial(_tip, seed)
    yield partial(_periodic, seed)
    yield partial(_fixed_pattern, seed)
    yield partial(_bad_pixels, seed)
    yield partial(_falling_light, seed)
    yield partial(_blurred, seed)
    yield partial(_outline, seed)


def _stretch(strain: float) -> Displacement:
    return lambda x, y: (strain * (x - SIZE_PX / 2), -0.3 * strain * (y - SIZE_PX / 2))


def _sine(amplitude: float, period: float) -> Displacement:
    return lambda x, y: (amplitude * np.sin(2.0 * np.pi * x / period), np.zeros_like(y))


def _grid() -> tuple[Floats, Floats]:
    row, column = np.mgrid[0:SIZE_PX, 0:SIZE_PX].astype(np.float64)
    return column, row


def _speckle(seed: int, *fields: Displacement) -> tuple[Floats, list[Floats]]:
    """Return the speckle at rest, and as each field alone would show it; of mean 0 and equal contrast."""
    column, row = _grid()
    x, y, height = blobs(_IMAGE, seed)
    at_rest = stamped(_IMAGE, (x, y), height, (column, row), (x, y))
    moved = []
    for field in fields:
        u, v = field(x, y)
        through = seen_through(field, column, row)
        moved.append(stamped(_IMAGE, (x, y), height, through, (x + u, y + v)))
    scale = _CONTRAST / at_rest.std()
    return scale * at_rest, [scale * one for one in moved]


def _recorded(light: Floats, rng: np.random.Generator) -> NDArray[np.uint16]:
    return np.rint(light + rng.normal(0.0, READ_NOISE, light.shape)).clip(0, FULL_SCALE).astype(np.uint16)


def _pair(group: str, name: str, seed: int, images: tuple[Floats, Floats], truth: Floats) -> TruthPair:
    rng = np.random.default_rng(seed + 1_000_003)
    return TruthPair(group, name, _recorded(images[0], rng), _recorded(images[1], rng), truth)


def _smooth(group: str, name: str, field: Displacement, seed: int) -> TruthPair:
    at_rest, (moved,) = _speckle(seed, field)
    return _pair(group, name, seed, (_MEAN + at_rest, _MEAN + moved), np.stack(field(*_grid())))


def _crack(name: str, slip: tuple[float, float], seed: int) -> TruthPair:
    """Let the right half go by `slip` (opening, sliding) along a vertical crack between two pixels."""
    left, right = shift(0.1, 0.0), shift(0.1 + slip[0], slip[1])
    at_rest, (of_left, of_right) = _speckle(seed, left, right)
    column, row = _grid()
    edge = SIZE_PX / 2 - 0.5
    # The part of each pixel that the left side covers, and the right one: what is between them is the gap.
    covered = np.clip(edge + 0.1 - column + 0.5, 0.0, 1.0)
    uncovered = np.clip(column + 0.5 - (edge + 0.1 + slip[0]), 0.0, 1.0)
    deformed = covered * of_left + uncovered * of_right
    deformed += _MEAN * (covered + uncovered) + _GAP * (1.0 - covered - uncovered)
    truth = np.where(column < edge, np.stack(left(column, row)), np.stack(right(column, row)))
    return replace(_pair("crack", name, seed, (_MEAN + at_rest, deformed), truth), slip=slip)


def _tip(seed: int) -> TruthPair:
    """Let a crack that ends in the middle open to 2 px, with the field of a tip about it (Irwin 1957)."""
    middle = SIZE_PX / 2 - 0.5

    def of_side(side: float) -> Displacement:
        def field(x: Floats, y: Floats) -> tuple[Floats, Floats]:
            along, up = x - SIZE_PX / 2, middle - y
            angle = np.arctan2(up, along)
            # Each side's own field goes on beyond the crack.
            angle = np.where(side * angle < -np.pi / 2, angle + side * 2.0 * np.pi, angle)
            size = _TIP_OPENING / (2.0 * (_KAPPA + 1.0)) * np.sqrt(np.hypot(along, up) / (SIZE_PX / 2))
            u = size * np.cos(angle / 2) * (_KAPPA - 1.0 + 2.0 * np.sin(angle / 2) ** 2)
            return u, -size * np.sin(angle / 2) * (_KAPPA + 1.0 - 2.0 * np.cos(angle / 2) ** 2)

        return field

    upper, lower = of_side(1.0), of_side(-1.0)
    at_rest, (of_upper, of_lower) = _speckle(seed, upper, lower)
    column, row = _grid()
    above = np.clip(middle - seen_through(upper, column, row)[1] + 0.5, 0.0, 1.0)
    below = np.clip(seen_through(lower, column, row)[1] - middle + 0.5, 0.0, 1.0)
    gap = np.clip(1.0 - above - below, 0.0, 1.0)
    deformed = (1.0 - gap) * _MEAN + above * of_upper + below * of_lower + gap * _GAP
    truth = np.where(row < middle, np.stack(upper(column, row)), np.stack(lower(column, row)))
    return _pair("crack", "crack that ends in the image", seed, (_MEAN + at_rest, deformed), truth)


def _periodic(seed: int) -> TruthPair:
    """Print a grid in place of speckle, and move it by more than its period."""
    period, field = 16.0, shift(21.3, 0.4)
    column, row = _grid()

    def light(x: Floats, y: Floats) -> Floats:
        return _MEAN + _CONTRAST * (np.cos(2 * np.pi * x / period) + np.cos(2 * np.pi * y / period))

    u, v = field(column, row)
    images = (light(column, row), light(column - u, row - v))
    return _pair("grid", f"grid of {period:g} px moved by 21.3 px", seed, images, np.stack((u, v)))


def _fixed_pattern(seed: int) -> TruthPair:
    """Put dust on the sensor, and a gain of its own on every pixel, while the specimen moves."""
    field = shift(0.5, 0.3)
    at_rest, (moved,) = _speckle(seed, field)
    rng = np.random.default_rng(seed + 7)
    gain = rng.normal(1.0, 0.01, at_rest.shape)
    column, row = _grid()
    for x, y, radius, depth in rng.uniform((0, 0, 2, 0.1), (SIZE_PX, SIZE_PX, 8, 0.5), (60, 4)):
        gain *= 1.0 - depth * np.exp(-0.5 * ((column - x) ** 2 + (row - y) ** 2) / radius**2)
    images = (gain * (_MEAN + at_rest), gain * (_MEAN + moved))
    return _pair(
        "dust", "dust, and gains of pixels that differ by 1 %", seed, images, np.stack(field(*_grid()))
    )


def _bad_pixels(seed: int) -> TruthPair:
    """Let three pixels of ten thousand be dead, and three hot, by 1.5 contrasts in the mean."""
    field = shift(1.37, -0.24)
    at_rest, (moved,) = _speckle(seed, field)
    rng = np.random.default_rng(seed + 11)
    dead, hot = rng.random((2, *at_rest.shape)) < 3e-4
    more = hot * rng.exponential(1.5 * _CONTRAST, at_rest.shape)
    images = (~dead * (_MEAN + at_rest) + more, ~dead * (_MEAN + moved) + more)
    return _pair("bad_pixels", "dead and hot pixels", seed, images, np.stack(field(*_grid())))


def _falling_light(seed: int) -> TruthPair:
    """Let the light fall to a tenth within 60 px, where it lies on the scene and not on the specimen."""
    field = shift(1.7, 0.6)
    at_rest, (moved,) = _speckle(seed, field)
    column, row = _grid()
    light = 0.1 + 0.9 / (1.0 + np.exp((column - SIZE_PX / 2) / 15.0))
    images = (light * (_MEAN + at_rest), light * (_MEAN + moved))
    return _pair(
        "light", "light that falls to a tenth over 60 px", seed, images, np.stack(field(column, row))
    )


def _blurred(seed: int) -> TruthPair:
    """Lose the focus between the states: a Gaussian of 2 px."""
    field = shift(0.4, -0.3)
    at_rest, (moved,) = _speckle(seed, field)
    images = (_MEAN + at_rest, _MEAN + ndimage.gaussian_filter(moved, 2.0, mode="nearest"))
    return _pair("blur", "deformed image blurred by 2 px", seed, images, np.stack(field(*_grid())))


def _outline(seed: int) -> TruthPair:
    """Show a strip that moves in front of a background with a texture of its own, which does not."""
    field = shift(2.6, 0.8)
    at_rest, (moved,) = _speckle(seed, field)
    behind, _ = _speckle(seed + 500_009)
    column, row = _grid()

    def over(specimen: Floats, u: float, v: float) -> Floats:
        x, y = column - u, row - v
        part = _inside(x, 120.0, 390.0) * _inside(y, 60.0, 450.0)
        return np.asarray(part * (_MEAN + specimen) + (1.0 - part) * (600.0 + 0.15 * behind))

    inside = (column >= 121) & (column <= 389) & (row >= 61) & (row <= 449)
    truth = np.where(inside, np.stack(field(column, row)), np.nan)
    # Behind the specimen's way the background does not move.
    away = (column < 117) | (column > 395) | (row < 57) | (row > 453)
    truth[:, away] = 0.0
    return _pair(
        "outline",
        "strip before a resting background",
        seed,
        (over(at_rest, 0, 0), over(moved, 2.6, 0.8)),
        truth,
    )


def _inside(x: Floats, first: float, last: float) -> Floats:
    """Return the part of each pixel that lies between two edges."""
    return np.asarray(np.clip(x + 0.5 - first, 0.0, 1.0) * np.clip(last - x + 0.5, 0.0, 1.0))
