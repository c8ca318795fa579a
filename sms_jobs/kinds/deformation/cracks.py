"""Cracks: by how much what has come apart has opened and slid, along each crack."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from pydantic import Field

from sms_jobs.kinds.kind import (
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    deformed_views,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.port_names import AT_REST, MOVED
from sms_jobs.kinds.products import CRACKS, DISPLACEMENT, REGIONS, SURFACE
from sms_jobs.kinds.surface_ports import bias_in_space, surface_port
from sms_jobs.metrology.deformation.cracks import opening
from sms_jobs.metrology.deformation.cracks.opening import CrackOpening, crack_openings
from sms_jobs.metrology.deformation.cracks.polylines import way_along
from sms_jobs.metrology.geometry.planes import covariance_in_space, in_space
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.cracks import CrackOpenings
from sms_jobs.records.fields import DisplacementField, Surface
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sizes import number_of
from sms_jobs.records.subject import Subject

_OPEN = 3.0  # standard deviations from which on a crack is open


class CracksParameters(Parameters):
    """Where cracks are looked at."""

    spacing_px: int = Field(10, ge=1, le=1000, description="distance of the points along a crack")


_MOVED = Port(MOVED, "correlate", (DISPLACEMENT, REGIONS))
_REFERENCE = surface_port(AT_REST)


def _needs(campaign: Campaign, subject: Subject, parameters: CracksParameters) -> Iterable[Need]:
    yield _MOVED.of(subject)
    yield _REFERENCE.of(campaign, replace(subject, state=campaign.reference.label))


def run(inputs: Inputs, parameters: CracksParameters, progress: Progress) -> Iterator[Output]:
    """Take the stored displacement to the lines at which regions have parted; nothing is correlated again."""
    moved = inputs.read(_MOVED, DISPLACEMENT)
    regions = inputs.read(_MOVED, REGIONS)
    surface = inputs.read(_REFERENCE.port, SURFACE)
    covariance, bias = covariance_in_space(moved.covariance), bias_in_space(moved)
    field = opening.Field(
        in_space(surface.position),
        in_space(moved.displacement),
        covariance,
        np.zeros_like(covariance) if bias is None else bias,
        np.where(moved.reason == Reason.VALID, regions.labels, 0).astype(np.int32),
        moved.subset_radius_px,
    )
    origin = {region.label: region.piece_of or region.label for region in regions.regions}
    found = list(crack_openings(field, origin, parameters.spacing_px))
    record = _record(found, moved, surface)
    progress(1.0, number_of(len(found), "crack"))
    yield DatasetOutput(inputs.subject, {CRACKS: record}, _statistics(record))


def _record(found: list[CrackOpening], moved: DisplacementField, surface: Surface) -> CrackOpenings:
    def joined(values: list[np.ndarray], like: tuple[int, ...] = ()) -> np.ndarray:
        return np.concatenate(values) if values else np.zeros((0, *like))

    ways = [way_along(one.position) for one in found]
    counts = [len(way) for way in ways]
    jump, sigma = (
        joined([values.T for values in each], (3,)).T
        for each in ([one.opening for one in found], [one.sigma for one in found])
    )
    dimensions = len(surface.position)
    return CrackOpenings(
        moved.view,
        moved.reference_state,
        moved.unit,
        np.repeat(np.arange(1, len(found) + 1), counts).astype(np.int32),
        np.repeat([one.sides[0] for one in found], counts).astype(np.int32),
        np.repeat([one.sides[1] for one in found], counts).astype(np.int32),
        joined([one.pixel for one in found], (2,)),
        joined([one.position for one in found], (3,))[:, :dimensions],
        joined(ways),
        jump[0],
        sigma[0].astype(np.float32),
        jump[1],
        sigma[1].astype(np.float32),
        *((jump[2], sigma[2].astype(np.float32)) if surface.has_depth else (None, None)),
    )


def _statistics(record: CrackOpenings) -> dict[str, float]:
    """Return what people search by; where there is no crack, only that."""
    cracks = int(record.crack.max()) if len(record.crack) else 0
    statistics = {"cracks": float(cracks)}
    if cracks:
        most = int(np.argmax(record.opening))
        unit = record.unit
        is_open = (record.opening > _OPEN * record.sigma_opening) | (
            np.abs(record.sliding) > _OPEN * record.sigma_sliding
        )
        step = np.diff(record.along) * (is_open[1:] & is_open[:-1] & (np.diff(record.crack) == 0))
        lengths = np.bincount(record.crack[1:], step)
        statistics |= {
            f"longest_crack_{unit}": float(lengths.max()),
            f"largest_opening_{unit}": float(record.opening[most]),
            f"sigma_largest_opening_{unit}": float(record.sigma_opening[most]),
            f"largest_sliding_{unit}": float(np.abs(record.sliding).max()),
        }
    return statistics


KIND = Kind(
    name="cracks",
    summary="opening and sliding along cracks, from stored displacement",
    version=3,
    scope=Scope.TUPLE,
    parameters=CracksParameters,
    inputs=(_MOVED, *_REFERENCE.all),
    outputs=(CRACKS,),
    needs=_needs,
    run=run,
    subjects=deformed_views,
    in_pipeline=False,
)
