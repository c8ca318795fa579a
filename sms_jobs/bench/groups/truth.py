"""Values that are wrong and reported valid: correlation where its model breaks, against exact truth."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.correlated.lone_camera import DEFORMED, correlated
from sms_jobs.bench.correlated.star import star
from sms_jobs.bench.correlated.truth_pairs import READ_NOISE, SIZE_PX, TruthPair, pairs
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.studies.resolution import judge
from sms_jobs.kinds.deformation import cracks, strain
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.records.cracks import CrackOpenings
from sms_jobs.records.fields import DisplacementField, StrainField
from sms_jobs.testing.shelf import Shelf

_SILENT_SIGMA, _SILENT_PX = 6.0, 0.05
"""A value is silently wrong that is valid and off by more than both."""
_NEAR_PX = 60
"""Strain is near a crack within the default gauge length of it."""


@dataclass(frozen=True)
class Judged:
    """What became of the pixels of one pair that have a true displacement.

    Attributes
    ----------
    seen
        How many they are.
    errors, sigma
        (2, n), of the valid ones among them, u and v in px.
    """

    seen: int
    errors: NDArray[np.float64]
    sigma: NDArray[np.float64]

    @property
    def silent(self) -> int:
        """How many are valid and wrong."""
        off = np.abs(self.errors)
        return int(np.count_nonzero(((off > _SILENT_SIGMA * self.sigma) & (off > _SILENT_PX)).any(axis=0)))

    @property
    def valid(self) -> int:
        """How many are valid."""
        return int(self.errors.shape[1])


@dataclass(frozen=True)
class JudgedCrack:
    """What is told of a crack all through the image, of a specimen that is not strained.

    Attributes
    ----------
    opening, sliding
        (n,), errors along it in px.
    score
        (n,), those of opening in units of their standard deviation.
    strain
        (m,), strain near it in units of its standard deviation, all components.
    """

    opening: NDArray[np.float64]
    sliding: NDArray[np.float64]
    score: NDArray[np.float64]
    strain: NDArray[np.float64]


def warm_up() -> None:
    """Compile what a pair goes through."""
    judged_crack((0.0, 0.0), matched(next(pairs(0))(), 1))


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions; the seeds are new in every run."""
    seed = int(np.random.SeedSequence().generate_state(1)[0] % 1_000_000)
    of_group: dict[str, list[Judged]] = defaultdict(list)
    cracked: list[JudgedCrack] = []
    for make in pairs(seed, quick=run.quick):
        pair = make()
        run.say(f"matching {pair.name}")
        shelf = matched(pair, run.threads)
        of_group[pair.group].append(judged(pair, shelf))
        if pair.slip is not None:
            cracked.append(judged_crack(pair.slip, shelf))
    every = [one for some in of_group.values() for one in some]
    yield Figure("silent_per_million", _per_million(every), "1", 10.0, "at most")
    for group, some in of_group.items():
        yield Figure(f"silent_{group}_per_million", _per_million(some), "1")
        yield Figure(f"valid_{group}", sum(j.valid for j in some) / sum(j.seen for j in some), "1")
    yield Figure("reported_over_observed_clean", _stated_over_observed(of_group["clean"]), "1")
    yield Figure("crack_opening_rms_px", _rms([one.opening for one in cracked]), "px", 0.02, "at most")
    yield Figure("crack_opening_z", _rms([one.score for one in cracked]), "1")
    yield Figure("crack_sliding_rms_px", _rms([one.sliding for one in cracked]), "px")
    yield Figure("crack_strain_z", _rms([one.strain for one in cracked]), "1", 1.3, "at most")
    yield from _finer_subsets(run, seed)
    yield Condition(
        "crack",
        f"{len(cracked)} cracks all through these images, at points 10 px apart; strain within {_NEAR_PX} px "
        "of them, of specimens that are not strained, in units of its standard deviation",
    )
    yield Condition(
        "silent",
        f"camera alone, {len(every)} pairs of {SIZE_PX} px, 12 bit, read noise {READ_NOISE:g} levels, "
        f"contrast 400, default parameters, speckle from seed {seed}; valid pixels whose displacement is off "
        f"by more than {_SILENT_SIGMA:g} of its standard deviations and {_SILENT_PX} px, of a million valid",
    )


def _finer_subsets(run: Run, seed: int) -> Iterator[Found]:
    """Yield what adaptive subsets resolve on a star, beside the fixed ones of the defaults."""
    name = "resolution_90_px_ratio"
    if run.quick:
        yield Figure(name, None, "1", 0.7, "at most")
        yield Condition(name, "left out: --quick")
        return
    run.say("matching a star with adaptive subsets")
    images = star(seed)
    fixed, adaptive = (judge(images, CorrelateParameters(subsets=how)).field for how in ("fixed", "adaptive"))
    yield Figure(name, adaptive.mei / fixed.mei, "1", 0.7, "at most")
    yield Condition(
        name,
        f"a star with noise of 5 % of the contrast: adaptive subsets resolve {adaptive.resolution:.1f} px, "
        f"fixed ones of 21 px {fixed.resolution:.1f} px; times the noise of a still pair, "
        f"{adaptive.noise:.4f} over {fixed.noise:.4f} px, as noise times resolution is nearly the same for "
        "all sizes",
    )


def _per_million(some: list[Judged]) -> float:
    return 1e6 * sum(one.silent for one in some) / max(sum(one.valid for one in some), 1)


def _stated_over_observed(some: list[Judged]) -> float:
    stated = np.sqrt(np.mean(np.concatenate([one.sigma.ravel() ** 2 for one in some])))
    return float(stated / np.sqrt(np.mean(np.concatenate([one.errors.ravel() ** 2 for one in some]))))


def _rms(parts: list[NDArray[np.float64]]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def judged(pair: TruthPair, shelf: Shelf) -> Judged:
    """Hold what was measured of a pair of a camera alone against its truth."""
    found: DisplacementField = shelf.records["correlate", DEFORMED]["displacement"]
    known = np.isfinite(pair.displacement[0])
    valid = known & (found.reason == 0)
    errors = (found.image_displacement - pair.displacement)[:, valid]
    variance = found.covariance[[0, 2]][:, valid].astype(np.float64)
    return Judged(int(known.sum()), errors, np.sqrt(variance))


def judged_crack(slip: tuple[float, float], shelf: Shelf) -> JudgedCrack:
    """Hold what a crack all through a pair has opened by against its slip, and the strain about it."""
    found = crack_openings(shelf)
    shelf.run(strain.KIND, DEFORMED, strain.KIND.parameters())
    field: StrainField = shelf.records["strain", DEFORMED]["strain"]
    near = field.reason == 0
    near &= np.abs(np.arange(near.shape[1]) - 0.5 * (near.shape[1] - 1)) < _NEAR_PX
    return JudgedCrack(
        found.opening - slip[0],
        np.abs(found.sliding) - slip[1] if slip[1] else found.sliding,
        (found.opening - slip[0]) / found.sigma_opening,
        (field.strain[:, near] / field.sigma[:, near]).ravel(),
    )


def crack_openings(shelf: Shelf) -> CrackOpenings:
    """Measure what the cracks of a pair have opened by."""
    shelf.run(cracks.KIND, DEFORMED, cracks.KIND.parameters())
    found: CrackOpenings = shelf.records["cracks", DEFORMED]["cracks"]
    return found


def matched(pair: TruthPair, threads: int) -> Shelf:
    """Measure a pair with the defaults."""
    return correlated(pair.reference, pair.deformed, READ_NOISE, CorrelateParameters(), threads)


GROUP = Group(
    "truth", "values that are wrong and reported valid, where correlation's model breaks", warm_up, measure
)
