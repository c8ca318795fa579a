"""What laser speckle is to matching beside printed speckle: thesis Fig. 35-37 on the thesis's own pattern."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sms_jobs.bench.correlated.half_and_half import AboutEdge, match_halves
from sms_jobs.bench.correlated.speckle_pairs import APERTURE, DOT_PX, Pattern, translated
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    MatchSettings,
    Noise,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import REFINEMENT, Method

MOVED = 39.25, 14.19
"""Translation of thesis Fig. 36, px."""
NOISES = 0.0, 0.025, 0.05  # of the contrast
PATTERNS: dict[Pattern, str] = {"laser": "laser", "blobs": "blobs", "dots": "printed dots"}

_RADIUS, _SIZE, _RIM, _STEP = 16, 256, 20, 11
_SEEDS: dict[Method, int] = {"gauss-newton": 6, "fourier-newton": 2}  # the latter takes long, and is far off
_FROM_EDGE = 0, 8  # rows of points: 0.5 and 8.5 px


@dataclass(frozen=True)
class Errors:
    """Errors of matches and their stated deviations, in px, (.., components); NaN where a match failed."""

    error: Floats
    sigma: Floats

    def matched(self) -> float:
        """Return the part of the points that have a match."""
        return float(np.isfinite(self.error).mean())

    def bias(self) -> float:
        """Return the mean error of the component for which it is larger."""
        return float(np.abs(np.nanmean(self.error, axis=0)).max())

    def rms(self) -> float:
        """Return the rms error."""
        return float(np.sqrt(np.nanmean(self.error**2)))

    def stated(self) -> float:
        """Return the rms of the stated deviations."""
        return float(np.sqrt(np.nanmean(self.sigma**2)))


def translation(pattern: Pattern, noise: float, method: Method, seeds: int) -> Errors:
    """Match a pattern that has moved as in thesis Fig. 36, (points, 2), from guesses right to a pixel.

    `noise` is the standard deviation of both images in parts of the contrast.
    """
    down, across = (np.arange(_RIM, _SIZE - _RIM - round(moved), _STEP) for moved in reversed(MOVED))
    y, x = (a.ravel() for a in np.meshgrid(down, across, indexing="ij"))
    guess = np.zeros((len(x), 6))
    guess[:, [0, 3]] = np.rint(MOVED)
    error, sigma = np.full((2, seeds, len(x), 2), np.nan)
    for seed in range(seeds):
        pair = translated(pattern, _SIZE, *MOVED, seed)
        level, rng = noise * pair[0].std(), np.random.default_rng(100 + seed)
        first, second = (image + rng.normal(0.0, level, image.shape) for image in pair)
        model = Noise(level**2, 0.0)
        images = prepare_images(first, second, np.ones(first.shape, np.int32), (model, model))
        found = REFINEMENT[method](images, x, y, guess, MatchSettings(_RADIUS))
        good = found.ending == CONVERGED
        error[seed, good] = found.warp[good][:, [0, 3]] - MOVED
        sigma[seed, good] = found.sigma[good]
    return Errors(error.reshape(-1, 2), sigma.reshape(-1, 2))


def _at(found: AboutEdge, row: int) -> Errors:
    """Return the errors of the points so many rows from the edge, both sides together."""
    both = found.folded()
    return Errors(both.error[:, row].reshape(-1, 1), both.sigma[:, row].reshape(-1, 1))


def _row(
    test: str, pattern: Pattern, noise: float, ours: Errors, peak: Errors, plain: Errors | None
) -> list[Cell]:
    return [
        test,
        PATTERNS[pattern],
        100.0 * noise,
        ours.matched(),
        ours.bias(),
        ours.rms(),
        ours.stated(),
        ours.stated() / ours.rms() if noise else None,
        peak.rms(),
        peak.stated() / peak.rms() if noise else None,
        None if plain is None else plain.rms(),
    ]


_COLUMNS = (
    "test",
    "speckle",
    "noise, %",
    "matched",
    "bias, px",
    "rms, px",
    "stated, px",
    "stated / rms",
    "thesis's peak: rms, px",
    "thesis's peak: stated / rms",
    "plain: rms, px",
)


def run(say: Callable[[str], None]) -> Outcome:
    """Move whole patterns and halves of them, and match them by our way and by the thesis's."""
    rows: list[list[Cell]] = []
    for pattern, name in PATTERNS.items():
        say(f"translation, {name}")
        for noise in NOISES:
            moved, its_peak = (translation(pattern, noise, way, seeds) for way, seeds in _SEEDS.items())
            rows.append(_row("translation", pattern, noise, moved, its_peak, None))
    figure = new_figure(9.5, 4.2)
    axes = figure.subplots(1, 2)
    for number, (pattern, name) in enumerate(PATTERNS.items()):
        say(f"halves, {name}")
        ours, plain = (match_halves(parted=p, noise=NOISES[1], pattern=pattern) for p in (True, False))
        peak = match_halves(parted=True, noise=NOISES[1], pattern=pattern, method="fourier-newton")
        for row in _FROM_EDGE:
            test = f"halves, {row + 0.5} px from the edge"
            rows.append(_row(test, pattern, NOISES[1], *(_at(one, row) for one in (ours, peak, plain))))
        for style, way, told in (
            ("-", ours, "regions"),
            ("--", peak, "thesis's peak"),
            (":", plain, "plain"),
        ):
            both = way.folded()
            axes[0].semilogy(both.distance, both.rms(), f"C{number}{style}", label=f"{name}, {told}")
    axes[0].set_xlabel("distance of the subset's centre from the edge [px]")
    axes[0].set_ylabel("rms error of u [px]")
    axes[0].legend(fontsize="x-small", ncols=3)
    shown = [translated(pattern, 128, 0.0, 0.0, 1)[0] for pattern in PATTERNS]
    axes[1].imshow(np.concatenate([(one - one.min()) / np.ptp(one) for one in shown], axis=1), cmap="gray")
    axes[1].set_title(", ".join(PATTERNS.values()), fontsize="small")
    axes[1].set_axis_off()
    remarks = {
        "conditions": f"translation of {MOVED[0]} and {MOVED[1]} px in images of {_SIZE} px, six patterns, "
        "two for the thesis's peak, bias and rms of both components; halves moved along x by (0.2, 0.4) .. "
        "(1.6, 3.2) px; laser speckle of roughness 20 um and wavelength 0.532 um behind an aperture of "
        f"{APERTURE:g} cycles a pixel, blobs of 1.8 px, printed dots of {DOT_PX:g} px by a lens of 0.5 px; "
        f"noise in parts of the contrast; subset radius {_RADIUS} px, first order; guesses right to a pixel",
        "thesis": "Fig. 37: 0.05 px with regions, N = 256 and r0 = N / 16 as here, in an unknown window",
    }
    return Outcome(Table(_COLUMNS, rows, remarks), figure)


STUDY = Study("laser-speckle", "bias and scatter of matches on laser speckle (thesis Fig. 35-37)", run)
