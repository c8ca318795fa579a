"""Pairs of states between which nothing was done to the specimen: what they differ by is the noise floor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.kind import Inputs, tested_states
from sms_jobs.kinds.products import MERGED, STRAIN
from sms_jobs.kinds.reporting.chapter import MERGED_STATES, STRAINS
from sms_jobs.metrology.deformation.fields.noise_floor import NoiseFloor, noise_floor
from sms_jobs.metrology.geometry.planes import covariance_in_space
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.field_names import DISPLACEMENT_XYZ, STRAIN_VALUES
from sms_jobs.records.subject import Subject

SAME = 1e-3
"""Part of a campaign's range by which two readings of one load or displacement may differ."""
_DIAGONAL = (0, 3, 5)

Values: TypeAlias = dict[str, tuple[str, NDArray[np.floating], NDArray[np.floating]]]
"""By quantity its unit, values and standard deviations over an image."""


@dataclass(frozen=True)
class StillNoise:
    """The noise floor of one quantity.

    Attributes
    ----------
    first, second
        The still pair.
    seen_by
        The camera, for displacement, or the view, for strain.
    quantity, unit
        What, in which unit.
    floor
        None where too few points have a value in both states.
    """

    first: str
    second: str
    seen_by: str
    quantity: str
    unit: str
    floor: NoiseFloor | None


def still_pairs(planned: Campaign, recorded: Campaign) -> tuple[tuple[LoadState, LoadState], ...]:
    """Return states of one load that follow each other.

    A load or displacement must be known of both, what is known must agree within `SAME` of its range over
    the campaign, and the plan may tell no other difference: no other channel, such as a count of cycles, and
    on the virtual rig no other deformation.

    Parameters
    ----------
    planned, recorded
        The campaign as it was defined, and with what was read while its states were recorded.
    """
    states = tested_states(recorded)
    ranges = [_range([of(s) for s in states]) for of in (_load, _displacement)]
    plan = {state.label: state for state in tested_states(planned)}

    def same(a: LoadState, b: LoadState) -> bool:
        known = [
            (abs(x - y), spread)
            for x, y, spread in (
                (_load(a), _load(b), ranges[0]),
                (_displacement(a), _displacement(b), ranges[1]),
            )
            if x is not None and y is not None
        ]
        told = [(plan[s.label].channels, plan[s.label].deformation) for s in (a, b)]
        return bool(known) and told[0] == told[1] and all(off <= SAME * spread for off, spread in known)

    return tuple((a, b) for a, b in pairwise(states) if same(a, b))


def _load(state: LoadState) -> float | None:
    return state.known_load_n


def _displacement(state: LoadState) -> float | None:
    return state.known_displacement_mm


def _range(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None]
    return max(known) - min(known) if known else 0.0


def still_noise(inputs: Inputs, planned: Campaign, recorded: Campaign) -> Iterator[StillNoise]:
    """Yield the noise floor of every quantity of every still pair.

    Fields are read one state after the other. All are measured from the campaign's reference; where that is
    one of the pair its field is 0, else two fields are subtracted.
    """
    for first, second in still_pairs(planned, recorded):
        for place in _places(recorded):
            later = _fields(inputs, recorded, second, *place)
            at_rest = first.label == recorded.reference.label
            earlier = None if at_rest else _fields(inputs, recorded, first, *place)
            for name, (unit, values, sigma) in later.items():
                change = values if earlier is None else values - earlier[name][1]
                yield StillNoise(first.label, second.label, place[0], name, unit, noise_floor(change, sigma))


def _places(campaign: Campaign) -> Iterator[tuple[str, bool]]:
    """Yield (camera, False) for displacement and (view, True) for strain."""
    for camera, views in campaign.views_by_camera().items():
        yield camera, False
        yield from ((view, True) for view in views)


def _fields(inputs: Inputs, campaign: Campaign, state: LoadState, seen_by: str, strain: bool) -> Values:
    own = Subject(campaign.name, state.label)
    if strain:
        field = inputs.read(STRAINS, STRAIN, replace(own, view=seen_by))
        return {name: ("1", field.strain[k], field.sigma[k]) for k, name in enumerate(STRAIN_VALUES)}
    merged = inputs.read(MERGED_STATES, MERGED.of(seen_by), own)
    deviation = np.sqrt(covariance_in_space(merged.covariance)[list(_DIAGONAL)])
    return {
        name: (merged.unit, merged.displacement[k], deviation[k])
        for k, name in enumerate(DISPLACEMENT_XYZ[: len(merged.displacement)])
    }
