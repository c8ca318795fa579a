"""Correlate: from two states of a view to the displacement of every point seen in the reference image."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.kind import (
    CALIBRATION,
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    deformed_tuples,
    tested_states,
)
from sms_jobs.kinds.point_matches import (
    match_settings,
    match_statistics,
    matches_record,
    search_settings,
    summary,
    trusted_points,
)
from sms_jobs.kinds.products import CALIBRATED, DISPLACEMENT, MATCHES, REGIONS
from sms_jobs.kinds.textured_state import TexturedState, interior_of, matched_labels, read_state, state_ports
from sms_jobs.kinds.valid_parts import fractions
from sms_jobs.metrology.deformation import correlation, displacement
from sms_jobs.metrology.deformation.correlation import PreparedImages, prepare_images
from sms_jobs.metrology.deformation.displacement import DenseDisplacement, displacement_field
from sms_jobs.metrology.deformation.incremental import Followed, follow, match_in_steps
from sms_jobs.metrology.deformation.matching import GridMatches, GridSettings, match_nodes
from sms_jobs.metrology.deformation.sampling import Nodes, sample_nodes
from sms_jobs.metrology.deformation.splitting import Split, split_regions
from sms_jobs.metrology.images.segmentation import ContinuousRegions, in_order
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import (
    DisplacementField,
    ImageMatches,
    Region,
    Regions,
)
from sms_jobs.records.reasons import Reason

_PIXEL_REASONS = {
    displacement.OUTSIDE_REGION: Reason.OUTSIDE_REGION,
    displacement.NO_MATCH_NEAR: Reason.NO_MATCH,
    displacement.LEFT_IMAGE: Reason.LEFT_IMAGE,
    displacement.NO_SHAPE_AT_END: Reason.NO_SHAPE_AT_END,
}


_CALIBRATION = Port("calibration", CALIBRATION, (CALIBRATED,))
_REFERENCE = state_ports("reference", "reference_measurement")
_DEFORMED = state_ports("deformed", "measurement")
_BEFORE = state_ports("previous_shape", "previous_measurement")
_MATCHED_BEFORE = Port("previous", "correlate", (MATCHES,))


def _needs(campaign: Campaign, subject: Subject, parameters: CorrelateParameters) -> Iterable[Need]:
    """Yield both states and, unless that is the reference, what the state before gives."""
    yield _CALIBRATION.of(subject)
    for ports, about in (
        (_REFERENCE, replace(subject, state=campaign.reference.label)),
        (_DEFORMED, subject),
    ):
        yield from (port.of(about) for port in ports)
    labels = [state.label for state in tested_states(campaign)]
    place = labels.index(subject.state) if subject.state in labels else 0
    if parameters.reference == "first" or place < 2:
        return
    before = Subject(subject.campaign, labels[place - 1], subject.view)
    yield from (port.of(before) for port in _BEFORE)
    yield _MATCHED_BEFORE.of(before)


def _reference_label(campaign: Campaign, subject: Subject) -> str:
    return campaign.reference.label


def run(inputs: Inputs, parameters: CorrelateParameters, progress: Progress) -> Iterator[Output]:
    """Match the textures region by region and look the displacement up in both states' shapes."""
    sensor = inputs.read(_CALIBRATION, CALIBRATED).rig.sensor(inputs.view.camera)
    before = read_state(inputs, _REFERENCE, sensor, parameters, of_interest=True)
    after = read_state(inputs, _DEFORMED, sensor, parameters, of_interest=False)
    interior = interior_of(before.regions.labels, parameters)
    labels = matched_labels(before, interior, parameters)
    progress(0.2, f"{len(before.regions.areas)} regions in the reference state")
    last = None
    if inputs.has(_MATCHED_BEFORE):
        last = read_state(inputs, _BEFORE, sensor, parameters, of_interest=False)
    grid, steps = _match(inputs, before, last, after, labels, parameters)
    apart = _come_apart(grid, before, after, parameters)
    if apart:
        # Subsets must not look across what has opened: its sides are regions of their own from here on.
        progress(0.5, f"{len(apart.pieces)} regions have come apart")
        before = replace(before, regions=in_order(apart.labels))
        interior = interior_of(before.regions.labels, parameters)
        labels = matched_labels(before, interior, parameters)
        grid, steps = _match(inputs, before, last, after, labels, parameters)
    progress(0.7, summary(grid.matches.ending, apart))
    found = displacement_field(
        trusted_points(grid, before.regions.labels),
        (before.cloud.xyz, before.cloud.covariance, before.regions.labels),
        (after.cloud.xyz, after.cloud.covariance, after.regions.labels),
        interior,
        subset_radius=parameters.subset_radius_px,
        averaging_radius=parameters.averaging_radius_px,
        threads=inputs.threads,
    )
    field = _displacement_record(found, before, inputs.context, parameters)
    matches = matches_record(grid, before.regions.labels, steps)
    progress(1.0, "looked up the displacement")
    yield DatasetOutput(
        inputs.subject,
        {DISPLACEMENT: field, MATCHES: matches, REGIONS: _regions_record(before.regions)},
        _statistics(field, matches, before) | {"regions_split": float(len(apart.pieces) if apart else 0)},
    )


def _come_apart(
    grid: GridMatches, before: TexturedState, after: TexturedState, parameters: CorrelateParameters
) -> Split | None:
    """Return the regions of the reference as the deformed state has parted them, if it has."""
    if parameters.regions == "none":
        return None
    good = grid.matches.ending == correlation.CONVERGED
    split = split_regions(
        before.regions.labels, after.regions.labels, grid.x[good], grid.y[good], grid.matches.warp[good, :6]
    )
    return split if split.pieces else None


def _match(
    inputs: Inputs,
    before: TexturedState,
    last: TexturedState | None,
    after: TexturedState,
    labels: NDArray[np.int32],
    parameters: CorrelateParameters,
) -> tuple[GridMatches, NDArray[np.int32] | None]:
    """Match the points of a grid, and count the steps where the reference is not always the first state."""
    nodes = sample_nodes(labels, parameters.spacing_px, parameters.edge_spacing_px)
    settings = match_settings(parameters, parameters.minimum_subset_part)
    grid = GridSettings(
        parameters.spacing_px,
        parameters.edge_spacing_px,
        parameters.minimum_score,
        parameters.maximum_sigma_px,
        method=parameters.method,
    )
    search = search_settings(parameters)
    how = (settings, grid, search, inputs.threads)

    def prepared(state: TexturedState, regions: NDArray[np.int32]) -> PreparedImages:
        noise = (state.noise, after.noise)
        return prepare_images(state.texture, after.texture, regions, noise, parameters.interpolation)

    if last is None:
        found = match_nodes(prepared(before, labels), after.texture, nodes, *how)
        if parameters.reference == "first":
            return found, None
        return found, (found.matches.ending == correlation.CONVERGED).astype(np.int32)
    followed = _followed(inputs.read(_MATCHED_BEFORE, MATCHES), nodes)
    between = prepared(last, matched_labels(last, interior_of(last.regions.labels, parameters), parameters))
    if parameters.reference == "auto":
        direct = prepared(before, labels)
        return match_in_steps(direct, between, after.texture, nodes, followed, *how)
    matches, steps = follow(between, after.texture, nodes, followed, *how)
    return GridMatches(nodes.x, nodes.y, matches), steps


def _followed(matches: ImageMatches, nodes: Nodes) -> Followed:
    """Return where nodes had come to by the state before; a node that was not matched then is lost."""
    place = {at: k for k, at in enumerate(zip(matches.x, matches.y, strict=True))}
    row = np.array([place.get(at, -1) for at in zip(nodes.x, nodes.y, strict=True)], dtype=np.int64)
    warp = np.stack([matches.u, *matches.gradient[:2], matches.v, *matches.gradient[2:]], axis=1)
    sigma = np.stack([matches.sigma_u, matches.sigma_v], axis=1).astype(np.float64)
    steps = (matches.reason == 0).astype(np.int32) if matches.steps is None else matches.steps
    known = row >= 0
    return Followed(
        np.where(known[:, None], warp[row], np.nan) if len(warp) else np.full((len(row), 6), np.nan),
        np.where(known[:, None], sigma[row], np.nan) if len(warp) else np.full((len(row), 2), np.nan),
        np.where(known, steps[row], 0) if len(warp) else np.zeros(len(row), dtype=np.int32),
    )


def _displacement_record(
    found: DenseDisplacement, before: TexturedState, reference: str, parameters: CorrelateParameters
) -> DisplacementField:
    reason = before.cloud.reason.copy()
    for status, why in _PIXEL_REASONS.items():
        reason[(found.status == status) & (reason == Reason.VALID)] = np.uint32(why)
    return DisplacementField(
        before.cloud.camera,
        before.cloud.projector,
        reference,
        found.displacement,
        found.covariance.astype(np.float32),
        found.image_displacement,
        reason,
        parameters.averaging_radius_px,
        parameters.subset_radius_px,
    )


def _regions_record(regions: ContinuousRegions) -> Regions:
    each = zip(regions.areas, regions.centroids, strict=True)
    described = tuple(
        Region(number, int(area), (float(x), float(y))) for number, (area, (x, y)) in enumerate(each, start=1)
    )
    return Regions(described, regions.labels)


def _statistics(field: DisplacementField, matches: ImageMatches, before: TexturedState) -> dict[str, float]:
    """Return what people search by; where nothing is valid, only the fractions."""
    valid = field.reason == Reason.VALID
    statistics = {
        **fractions(valid, (before.cloud.reason == Reason.VALID) & before.of_interest),
        "regions": float(len(before.regions.areas)),
        **match_statistics(matches),
    }
    if valid.any():
        sigma = np.sqrt(field.covariance[[0, 3, 5]][:, valid].sum(axis=0))
        length = np.linalg.norm(field.displacement[:, valid], axis=0)
        statistics |= {
            "median_sigma_mm": float(np.median(sigma)),
            "median_displacement_mm": float(np.median(length)),
            "maximum_displacement_mm": float(length.max()),
        }
    return statistics


KIND = Kind(
    name="correlate",
    summary="displacement from two states: texture matched region by region, looked up in both shapes",
    version=7,
    scope=Scope.TUPLE,
    parameters=CorrelateParameters,
    inputs=(_CALIBRATION, *_REFERENCE, *_DEFORMED, *_BEFORE, _MATCHED_BEFORE),
    outputs=(DISPLACEMENT, MATCHES, REGIONS),
    needs=_needs,
    run=run,
    subjects=deformed_tuples,
    context=_reference_label,
)
