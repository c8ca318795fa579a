"""Correlate: from two states of a view to the displacement of every point seen in the reference image."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.calibration_factors import (
    DEFORMED,
    REFERENCE,
    displacement_sigma,
    median_part,
    moved_since,
    states_from,
)
from sms_jobs.kinds.deformation.correlate_parameters import (
    CorrelateParameters,
    match_settings,
    search_settings,
)
from sms_jobs.kinds.deformation.dense_fields import (
    field_in_plane,
    field_in_space,
    spread,
)
from sms_jobs.kinds.deformation.finer import take_subsets
from sms_jobs.kinds.deformation.followed_partners import (
    CALIBRATION_AT_REST,
    PARTNERS,
    PARTNERS_AT_REST,
    followed_field,
    needs_of_partners,
)
from sms_jobs.kinds.deformation.ray_gaps import told_of_gaps
from sms_jobs.kinds.deformation.textured_state import (
    CALIBRATION_OF_SHAPE,
    TexturedState,
    read_later,
    read_reference,
)
from sms_jobs.kinds.kind import (
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    deformed_tuples,
    deformed_views,
    tested_states,
)
from sms_jobs.kinds.point_matches import match_statistics, summary
from sms_jobs.kinds.port_names import AT_REST, FRAMES_AT_REST
from sms_jobs.kinds.products import CALIBRATION_FACTOR, DISPLACEMENT, MATCHES, PLACES, REGIONS
from sms_jobs.kinds.resolution import resolution_statistics
from sms_jobs.kinds.shape.textures import spots_of
from sms_jobs.kinds.surface_ports import state_ports
from sms_jobs.kinds.valid_parts import fractions
from sms_jobs.metrology.deformation.cracks.lines import crack_lines
from sms_jobs.metrology.deformation.cracks.splitting import Split, cut_out, split_regions
from sms_jobs.metrology.deformation.matching import correlation
from sms_jobs.metrology.deformation.matching.correlation import Matches, PreparedImages, prepare_images
from sms_jobs.metrology.deformation.matching.grid import GridMatches, GridSettings, match_nodes
from sms_jobs.metrology.deformation.matching.incremental import Followed, follow, match_in_steps
from sms_jobs.metrology.deformation.matching.sampling import Nodes, sample_nodes
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.images.masks import widened
from sms_jobs.metrology.images.segmentation import ContinuousRegions
from sms_jobs.records.calibration import CalibrationFactor
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import DisplacementField, ImageMatches, Region, Regions
from sms_jobs.records.reasons import Reason
from sms_jobs.records.remarks import remarked
from sms_jobs.records.sizes import number_of
from sms_jobs.records.statistic_names import maximum_displacement
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

_REFERENCE = state_ports(AT_REST, FRAMES_AT_REST, (PLACES,))
_DEFORMED = state_ports("deformed", "measurement")
_BEFORE = state_ports("previous_shape", "previous_measurement")
_MATCHED_BEFORE = Port("previous", "correlate", (MATCHES,))


def _needs(campaign: Campaign, subject: Subject, parameters: CorrelateParameters) -> Iterable[Need]:
    """Yield both states and, unless that is the reference, what the state before gives."""
    if view_of(subject.view).measures_shape:
        yield CALIBRATION_OF_SHAPE.of(subject)
    yield from _REFERENCE.of(campaign, replace(subject, state=campaign.reference.label))
    yield from _DEFORMED.of(campaign, subject)
    yield from needs_of_partners(campaign, subject, parameters)
    labels = [state.label for state in tested_states(campaign)]
    place = labels.index(subject.state) if subject.state in labels else 0
    if parameters.reference == "first" or place < 2:
        return
    before = Subject(subject.campaign, labels[place - 1], subject.view)
    yield from _BEFORE.of(campaign, before)
    yield _MATCHED_BEFORE.of(before)


def _reference_label(campaign: Campaign, subject: Subject) -> str:
    return campaign.reference.label


def run(inputs: Inputs, parameters: CorrelateParameters, progress: Progress) -> Iterator[Output]:
    """Match the textures region by region and look the displacement up in both states' surfaces."""
    whole = before = read_reference(inputs, _REFERENCE, parameters)
    after = read_later(inputs, _DEFORMED, parameters, before)
    progress(0.2, f"{number_of(len(before.regions.areas), 'region')} in the reference state")
    last = None
    if inputs.has(_MATCHED_BEFORE):
        last = read_later(inputs, _BEFORE, parameters, before)
    images = _prepared(before, after, parameters)
    grid, steps = _match(inputs, images, before, last, after, parameters)
    apart = _come_apart(grid, before, after, parameters)
    if apart:
        # Subsets must not look across what has opened: its sides are regions of their own from here on.
        progress(0.5, f"{len(apart.pieces)} regions have come apart")
        before = before.parted(apart.labels, parameters)
        images = replace(images, labels=before.matched)
        grid, steps = _match(inputs, images, before, last, after, parameters)
    progress(0.6, summary(grid.matches.ending, apart))
    reference, threads = inputs.context, inputs.threads
    image = spread(grid, images, before, parameters, threads)
    radius = parameters.subset_radius_px
    cracks = crack_lines(images, image.value, image.variance, image.verified, before.match_regions, radius)
    cut = cut_out(before.match_regions, image.verified.unlike | cracks, parameters.minimum_region_area_px)
    if cut is not None:
        out = (before.match_regions > 0) & (cut == 0)
        area = np.count_nonzero(out)
        progress(0.65, f"nothing is alike on {area} px; matching again what is about them")
        before = before.parted(cut, parameters)
        images = replace(images, labels=before.matched)
        known = _far_from(grid, out, parameters.subset_radius_px)
        grid, steps = _match(inputs, images, before, last, after, parameters, known)
        image = spread(grid, images, before, parameters, threads).without(out)
    taken = take_subsets(image, grid, images, before, parameters, threads)
    image, matches = taken.image, taken.record(before.regions.labels, steps)
    resolution = taken.resolution(before, parameters)
    if before.surface.has_depth:
        field = field_in_space(image, before, after, reference, parameters, resolution, threads)
        if parameters.following != "each-state":
            progress(0.8, f"following points by {parameters.following}")
            field = followed_field(inputs, _REFERENCE, field, images, image, before, parameters)
    else:
        field = field_in_plane(image, matches, before, reference, parameters, resolution)
    field, factors = _with_calibration(inputs, field, before)
    told = _told_of_gaps(before, after, factors)
    progress(1.0, remarked(told, beside="looked up the displacement"))
    yield DatasetOutput(
        inputs.subject,
        {
            DISPLACEMENT: field,
            MATCHES: matches,
            REGIONS: _regions_record(before.regions, whole.regions),
            **{CALIBRATION_FACTOR.of(key): factor for key, factor in factors.items()},
        },
        _statistics(field, matches, before) | {"regions_split": float(len(apart.pieces) if apart else 0)},
    )


def _with_calibration(
    inputs: Inputs, field: DisplacementField, before: TexturedState
) -> tuple[DisplacementField, dict[str, CalibrationFactor]]:
    """Return the displacement with the calibration's part of sigma, and what makes it in both states.

    Unchanged where that is not known of both.
    """
    ports = {REFERENCE: _REFERENCE.surface.port, DEFORMED: _DEFORMED.surface.port}
    if not all(inputs.has(port, CALIBRATION_FACTOR) for port in ports.values()):
        return field, {}
    factors = {key: inputs.read(port, CALIBRATION_FACTOR) for key, port in ports.items()}
    factors[DEFORMED] = moved_since(factors[REFERENCE], factors[DEFORMED])
    if not all(factor.is_stated for factor in factors.values()) and not factors[DEFORMED].turned_px:
        return field, {}
    states = states_from(factors[REFERENCE], factors[DEFORMED])
    sigma = displacement_sigma(states, before.surface, field)
    return replace(field, sigma_calibration=sigma), factors


def _told_of_gaps(
    before: TexturedState, after: TexturedState, factors: Mapping[str, CalibrationFactor]
) -> str:
    """Return what it means that rays miss each other by more than at rest; empty where they do not."""
    if not factors:
        return told_of_gaps(before.surface, after.surface)
    turned_px = factors[DEFORMED].turned_px
    counted = turned_px > 0.0 or factors[DEFORMED].times > factors[REFERENCE].times
    return told_of_gaps(before.surface, after.surface, turned_px, counted=counted)


def _come_apart(
    grid: GridMatches, before: TexturedState, after: TexturedState, parameters: CorrelateParameters
) -> Split | None:
    """Return the regions of the reference as the deformed state has parted them, if it has."""
    if parameters.regions == "none" or not before.surface.has_depth:
        return None
    good = grid.matches.ending == correlation.CONVERGED
    split = split_regions(
        before.regions.labels, after.regions.labels, grid.x[good], grid.y[good], grid.matches.warp[good, :6]
    )
    return split if split.pieces else None


def _far_from(grid: GridMatches, out: NDArray[np.bool_], radius: int) -> GridMatches:
    """Return the matches whose subsets hold nothing of some pixels (rows, columns)."""
    near = widened(out, 2 * radius + 1)
    kept = ~near[grid.y, grid.x]
    matches = Matches(*(values[kept] for values in vars(grid.matches).values()))
    return GridMatches(grid.x[kept], grid.y[kept], matches)


def _prepared(before: TexturedState, after: TexturedState, parameters: CorrelateParameters) -> PreparedImages:
    return prepare_images(
        before.texture,
        after.texture,
        before.matched,
        (before.noise, after.noise),
        parameters.interpolation,
        spots=(0.0, 0.0) if parameters.following == "each-state" else spots_of(parameters.smoothing_px),
    )


def _match(
    inputs: Inputs,
    direct: PreparedImages,
    before: TexturedState,
    last: TexturedState | None,
    after: TexturedState,
    parameters: CorrelateParameters,
    known: GridMatches | None = None,
) -> tuple[GridMatches, NDArray[np.int32] | None]:
    """Match the points of a grid, and count the steps where the reference is not always the first state."""
    nodes = sample_nodes(before.matched, parameters.spacing_px, parameters.edge_spacing_px)
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

    if last is None:
        found = match_nodes(direct, after.texture, nodes, *how, known)
        if parameters.reference == "first":
            return found, None
        return found, (found.matches.ending == correlation.CONVERGED).astype(np.int32)
    followed = _followed(inputs.read(_MATCHED_BEFORE, MATCHES), nodes)
    between = _prepared(last, after, parameters)
    if parameters.reference == "auto":
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
    matched = row >= 0
    return Followed(
        np.where(matched[:, None], warp[row], np.nan) if len(warp) else np.full((len(row), 6), np.nan),
        np.where(matched[:, None], sigma[row], np.nan) if len(warp) else np.full((len(row), 2), np.nan),
        np.where(matched, steps[row], 0) if len(warp) else np.zeros(len(row), dtype=np.int32),
    )


def _regions_record(regions: ContinuousRegions, whole: ContinuousRegions) -> Regions:
    """Return regions, and which of them are pieces of one that was whole."""
    numbers = range(1, len(regions.areas) + 1)
    origin = np.zeros(len(numbers) + 1, np.int32)
    origin[regions.labels] = whole.labels
    pieces = {origin[n]: [k for k in numbers if origin[k] == origin[n]] for n in numbers}
    described = (
        Region(
            n, int(area), (float(x), float(y)), pieces[origin[n]][0] if len(pieces[origin[n]]) > 1 else None
        )
        for n, area, (x, y) in zip(numbers, regions.areas, regions.centroids, strict=True)
    )
    return Regions(tuple(described), regions.labels)


def _statistics(field: DisplacementField, matches: ImageMatches, before: TexturedState) -> dict[str, float]:
    """Return what people search by; where nothing is valid, only the fractions."""
    valid = field.reason == Reason.VALID
    statistics = {
        **fractions(valid, (before.surface.reason == Reason.VALID) & before.of_interest),
        "regions": float(len(before.regions.areas)),
        **match_statistics(matches),
    }
    if valid.any():
        sigma = np.sqrt(trace(field.covariance)[valid])
        length = np.linalg.norm(field.displacement, axis=0)[valid]
        statistics |= {
            f"median_sigma_{field.unit}": float(np.median(sigma)),
            f"median_displacement_{field.unit}": float(np.median(length)),
            maximum_displacement(field.unit): float(length.max()),
            **median_part(field.sigma_calibration, field.unit),
            **resolution_statistics(field),
        }
    return statistics


KIND = Kind(
    name="correlate",
    summary="displacement from two states: texture matched region by region, looked up in both surfaces",
    version=32,
    scope=Scope.TUPLE,
    parameters=CorrelateParameters,
    inputs=(
        CALIBRATION_OF_SHAPE,
        *_REFERENCE.all,
        *_DEFORMED.all,
        *_BEFORE.all,
        _MATCHED_BEFORE,
        CALIBRATION_AT_REST,
        PARTNERS_AT_REST,
        PARTNERS,
    ),
    outputs=(DISPLACEMENT, MATCHES, REGIONS, CALIBRATION_FACTOR.by("state")),
    needs=_needs,
    run=run,
    subjects=deformed_views,
    pipeline_subjects=deformed_tuples,
    context=_reference_label,
)
