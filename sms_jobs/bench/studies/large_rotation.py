"""How far a surface may turn and stretch before its reference is lost, and what following it is worth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.correlated.speckle_pairs import affine_speckle
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    Matches,
    MatchSettings,
    Noise,
    PreparedImages,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import GridSettings, match_nodes
from sms_jobs.metrology.deformation.matching.incremental import Followed, follow, match_in_steps
from sms_jobs.metrology.deformation.matching.sampling import Nodes, sample_nodes
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings

STATES = 6
TURN_DEG, STRETCH = 8.0, 0.03  # more in each state
RADIUS = 16
_SIZE, _SPACING = 320, 10
_NOISE = 10.0  # grey levels, a fortieth of the speckle's contrast
_THREADS = 2
WAYS = ("first", "auto", "previous")


@dataclass(frozen=True)
class Outcomes:
    """What a way of matching found in a state: part of the points, rms error and rms sigma in px."""

    matched: float
    rms: float
    stated: float


def forward(state: int) -> Floats:
    """Return how a state has carried the reference."""
    angle, stretch = np.radians(TURN_DEG * state), STRETCH * state
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(turn @ np.diag([1.0 + stretch, 1.0 - 0.3 * stretch]))


@dataclass(frozen=True)
class _Disc:
    """The images of all states, and which pixels show the disc that is measured."""

    size: int
    images: list[Floats]

    @classmethod
    def recorded(cls, size: int, states: int) -> _Disc:
        rng = np.random.default_rng(8)
        images = [affine_speckle(size, forward(k), 3) for k in range(states + 1)]
        return cls(size, [image + rng.normal(0.0, _NOISE, image.shape) for image in images])

    def place(self) -> Floats:
        return np.mgrid[0 : self.size, 0 : self.size][::-1] - (self.size - 1) / 2.0

    def labels(self, state: int) -> NDArray[np.int32]:
        shown = np.tensordot(np.linalg.inv(forward(state)), self.place(), axes=1)
        return np.asarray(np.hypot(*shown) < 0.36 * self.size).astype(np.int32)

    def prepared(self, first: int, second: int) -> PreparedImages:
        model = Noise(_NOISE**2, 0.0)
        return prepare_images(self.images[first], self.images[second], self.labels(first), (model, model))

    def outcomes(self, found: Matches, nodes: Nodes, state: int) -> Outcomes:
        place = self.place()[:, nodes.y, nodes.x]
        truth = ((forward(state) - np.eye(2)) @ place).T
        good = found.ending == CONVERGED
        if not good.any():
            return Outcomes(0.0, np.nan, np.nan)
        error = (found.warp[:, [0, 3]] - truth)[good]
        stated = np.sqrt(np.mean(np.square(found.sigma[good])))
        return Outcomes(float(good.mean()), float(np.sqrt(np.mean(error**2))), float(stated))


def series(
    say: Callable[[str], None], size: int = _SIZE, states: int = STATES, radius: int = RADIUS
) -> dict[str, list[Outcomes]]:
    """Match every state by every way; return the outcomes of states 1 .. by way."""
    disc = _Disc.recorded(size, states)
    nodes = sample_nodes(disc.labels(0), _SPACING)
    how = (MatchSettings(radius), GridSettings(_SPACING), SearchSettings(60, 60), _THREADS)
    found: dict[str, list[Outcomes]] = {way: [] for way in WAYS}
    before: dict[str, Followed] = {}
    for state in range(1, states + 1):
        say(f"state {state}: turned by {TURN_DEG * state:g} degrees")
        direct, image = disc.prepared(0, state), disc.images[state]
        alone = match_nodes(direct, image, nodes, *how).matches
        steps = (alone.ending == CONVERGED).astype(np.int32)
        matches = {"first": (alone, steps), "auto": (alone, steps), "previous": (alone, steps)}
        if state > 1:
            last = disc.prepared(state - 1, state)
            grid, steps = match_in_steps(direct, last, image, nodes, before["auto"], *how)
            matches["auto"] = (grid.matches, steps)
            matches["previous"] = follow(last, image, nodes, before["previous"], *how)
        for way, (one, steps) in matches.items():
            found[way].append(disc.outcomes(one, nodes, state))
            known = np.where(steps[:, None] > 0, one.warp[:, :6], np.nan)
            before[way] = Followed(known, one.sigma, steps)
    return found


def run(say: Callable[[str], None]) -> Outcome:
    """Turn and stretch a disc of speckle step by step."""
    found = series(say)
    state = np.arange(1, STATES + 1)
    figure = new_figure(9.5, 4.2)
    matched, error = figure.subplots(1, 2)
    for number, (way, outcomes) in enumerate(found.items()):
        colour = f"C{number}"
        matched.plot(state * TURN_DEG, [100.0 * o.matched for o in outcomes], "o-", color=colour, label=way)
        error.plot(state * TURN_DEG, [o.rms for o in outcomes], "o-", color=colour, label=f"{way}: rms error")
        error.plot(state * TURN_DEG, [o.stated for o in outcomes], ":", color=colour, label=f"{way}: stated")
    for axes in (matched, error):
        axes.set_xlabel(f"rotation [degrees], with {100.0 * STRETCH / TURN_DEG:.2f} % of strain each")
        axes.legend(fontsize="small")
    matched.set_ylabel("points matched [%]")
    error.set_ylabel("error of u and v [px]")
    rows: list[tuple[Cell, ...]] = []
    for k in range(STATES):
        each = [(100.0 * o[k].matched, o[k].rms, o[k].stated) for o in found.values()]
        rows.append((k + 1, TURN_DEG * (k + 1), 100.0 * STRETCH * (k + 1), *np.concatenate(each).tolist()))
    columns = (
        "state", "rotation, degrees", "strain, %",
        *(f"{way}: {what}" for way in WAYS for what in ("matched, %", "rms, px", "stated, px")),
    )  # fmt: skip
    remarks = {
        "conditions": f"exact speckle of blobs of 1.8 px on a disc in an image of {_SIZE} px, noise of "
        f"{_NOISE / 400.0:.1%} of the contrast in every image, radius {RADIUS} px, first order, seeds within "
        "+-60 px and no rotation",
        "ways": "the parameter 'reference' of correlate",
    }
    return Outcome(Table(columns, rows, remarks), figure)


STUDY = Study("large-rotation", "surfaces that turn and stretch far, matched directly and by steps", run)
