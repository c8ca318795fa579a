"""Folders of frames as other people's rigs leave them: small, synthetic, with known phase gradients."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

ROWS, COLUMNS = 24, 40
PROJECTOR = 800
MEAN, MODULATION = 110.0, 70.0


def omega(orientation_deg: float = 0.0) -> NDArray[np.float64]:
    """Return the phase gradient that every pixel sees, (rows, columns), within what a projector covers."""
    across = np.linspace(-2.9, 2.7, COLUMNS)[None, :] * np.ones((ROWS, 1))
    down = np.linspace(-2.5, 2.8, ROWS)[:, None] * np.ones((1, COLUMNS))
    return across if orientation_deg == 0.0 else down


def texture() -> NDArray[np.float64]:
    """Return a brightness of every pixel, so that no two frames of a scene look alike."""
    return np.asarray(0.7 + 0.3 * np.random.default_rng(3).random((ROWS, COLUMNS)))


def fringes(
    densities: Sequence[int] = (16, 1),
    steps: int = 3,
    orientations_deg: Sequence[float] = (0.0,),
    *,
    direction: int = 1,
    edge: bool = False,
    offset_deg: float = 0.0,
    noise: float = 0.0,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Return frames in the order orientation, density, step, (frames, rows, columns)."""
    rng = np.random.default_rng(seed)
    frames = []
    for angle in orientations_deg:
        for t in densities:
            phase = omega(angle) * t + (pi * t if edge else 0.0) + np.radians(offset_deg)
            for k in range(steps):
                wave = np.cos(phase + direction * 2.0 * pi * k / steps)
                frames.append(texture() * (MEAN + MODULATION * wave))
    found = np.stack(frames)
    return found + rng.normal(0.0, noise, found.shape) if noise else found


def gray_pattern(stripe: Any, bit: int, bits: int) -> Any:
    """Return whether pattern `bit` of `bits`, 0 the coarsest, is bright: a bit of stripe xor stripe / 2."""
    return ((np.asarray(stripe) ^ (np.asarray(stripe) >> 1)) >> (bits - 1 - bit)) & 1 == 1


def gray_frames(bits: int) -> NDArray[np.float64]:
    """Return the patterns of a Gray code, the coarsest first, (bits, rows, columns)."""
    stripe = np.floor((omega() / (2.0 * pi) + 0.5) * 2**bits).astype(int)
    bright = np.stack([gray_pattern(stripe, b, bits) for b in range(bits)])
    return np.asarray(texture() * np.where(bright, MEAN + MODULATION, MEAN - MODULATION))


def save(
    folder: Path, frames: NDArray[Any], name: str = "frame_{:02d}.png", first: int = 0, dtype: Any = np.uint8
) -> list[Path]:
    """Write frames as files and return their paths; the name takes the number."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, frame in enumerate(frames, first):
        path = folder / name.format(number)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not cv2.imwrite(str(path), np.rint(frame).astype(dtype)):
            raise AssertionError(path)
        paths.append(path)
    return paths
