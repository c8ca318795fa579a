"""Values that are wrong and reported valid: correlation where its model breaks, against exact truth."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.shelf import Shelf
from sms_jobs.bench.truth_pairs import FULL_SCALE, READ_NOISE, SIZE_PX, TruthPair, pairs
from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.kinds.shape import plane
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.fields import DisplacementField
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.subject import Subject

_AT = datetime(2026, 1, 1, tzinfo=UTC)
_SILENT_SIGMA, _SILENT_PX = 6.0, 0.05
"""A value is silently wrong that is valid and off by more than both."""


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


def warm_up() -> None:
    """Compile what a pair goes through."""
    judged(next(pairs(0))(), 1)


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions; the seeds are new in every run."""
    seed = int(np.random.SeedSequence().generate_state(1)[0] % 1_000_000)
    of_group: dict[str, list[Judged]] = defaultdict(list)
    for make in pairs(seed, quick=run.quick):
        pair = make()
        run.say(f"matching {pair.name}")
        of_group[pair.group].append(judged(pair, run.threads))
    every = [one for some in of_group.values() for one in some]
    yield Figure("silent_per_million", _per_million(every), "1", 10.0, "at most")
    for group, some in of_group.items():
        yield Figure(f"silent_{group}_per_million", _per_million(some), "1")
        yield Figure(f"valid_{group}", sum(j.valid for j in some) / sum(j.seen for j in some), "1")
    yield Figure("reported_over_observed_clean", _stated_over_observed(of_group["clean"]), "1")
    yield Condition(
        "silent",
        f"camera alone, {len(every)} pairs of {SIZE_PX} px, 12 bit, read noise {READ_NOISE:g} levels, "
        f"contrast 400, default parameters, speckle from seed {seed}; valid pixels whose displacement is off "
        f"by more than {_SILENT_SIGMA:g} of its standard deviations and {_SILENT_PX} px, of a million valid",
    )


def _per_million(some: list[Judged]) -> float:
    return 1e6 * sum(one.silent for one in some) / max(sum(one.valid for one in some), 1)


def _stated_over_observed(some: list[Judged]) -> float:
    stated = np.sqrt(np.mean(np.concatenate([one.sigma.ravel() ** 2 for one in some])))
    return float(stated / np.sqrt(np.mean(np.concatenate([one.errors.ravel() ** 2 for one in some]))))


def judged(pair: TruthPair, threads: int) -> Judged:
    """Measure a pair of a camera alone with the defaults, and hold the result against its truth."""
    found = _measured(pair, threads)
    known = np.isfinite(pair.displacement[0])
    valid = known & (found.reason == 0)
    errors = (found.image_displacement - pair.displacement)[:, valid]
    variance = found.covariance[[0, 2]][:, valid].astype(np.float64)
    return Judged(int(known.sum()), errors, np.sqrt(variance))


def _measured(pair: TruthPair, threads: int) -> DisplacementField:
    states = (LoadState("S00", 0.0, time=_AT), LoadState("S01", 1.0, time=_AT))
    specimen = Specimen("plate", "unknown", "computed")
    shelf = Shelf(Campaign("pair", specimen, "computed", states, ("C1",), FringeSequence(), None), threads)
    last = Subject("pair", "S01", "C1")
    at_rest = Subject("pair", "S00", "C1")
    for own, image in ((at_rest, pair.reference), (last, pair.deformed)):
        recorded = Measurement(
            _AT, FringeSequence(), FULL_SCALE, 0.0, READ_NOISE, image, ArrayStack(image[None])
        )
        shelf.records[MEASUREMENT, own] = {"measurement": recorded}
    shelf.run(plane.KIND, at_rest, plane.KIND.parameters())
    shelf.run(correlate.KIND, last, correlate.KIND.parameters())
    field: DisplacementField = shelf.records["correlate", last]["displacement"]
    return field


GROUP = Group(
    "truth", "values that are wrong and reported valid, where correlation's model breaks", warm_up, measure
)
