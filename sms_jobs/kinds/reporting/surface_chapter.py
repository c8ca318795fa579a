"""Chapter of the report: shape, displacement and strain of surfaces, whatever they are measured with."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from sms_jobs.formats.report.surface import deformed_view, reference_view
from sms_jobs.formats.report.view import View
from sms_jobs.kinds.kind import Inputs, Need, deformed_tuples, tested_states
from sms_jobs.kinds.products import GAUGES, MEASURED, MERGED, REGIONS, STRAIN, SURFACE
from sms_jobs.kinds.reporting.chapter import (
    DISPLACEMENTS,
    GAUGES_READ,
    MERGED_STATES,
    RECORDINGS,
    STRAINS,
    SURFACES,
    Chapter,
    Sampling,
)
from sms_jobs.kinds.surface_ports import textured_by
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.fields import StrainField
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject


def _needs(campaign: Campaign) -> Iterable[Need]:
    deformed = deformed_tuples(campaign)
    measured = campaign.measured_views if tested_states(campaign) else ()
    for view in measured if deformed else [v for v in measured if v in campaign.shape_views]:
        at_rest = Subject(campaign.name, campaign.reference.label, view)
        yield RECORDINGS.of(textured_by(at_rest))
        yield SURFACES.of(campaign, at_rest)
    for each in deformed:
        yield STRAINS.of(each)
        if each.state == campaign.states[1].label:
            yield DISPLACEMENTS.of(each)
    for loaded in dict.fromkeys(each.state for each in deformed):
        yield MERGED_STATES.of(Subject(campaign.name, loaded))


def _gauges(campaign: Campaign) -> Iterable[Need]:
    return map(GAUGES_READ.of, deformed_tuples(campaign))


def _best_views(inputs: Inputs, campaign: Campaign) -> Mapping[str, str]:
    """Return, by camera, the view that sees most of the surface at the reference state."""
    at_rest = Subject(campaign.name, campaign.reference.label)
    best: dict[str, str] = {}
    for camera, views in campaign.views_by_camera().items():
        seen: dict[str, int] = {}
        for view in views if len(views) > 1 else ():
            surface = inputs.read(SURFACES.port, SURFACE, replace(at_rest, view=view))
            seen[view] = int(np.count_nonzero(surface.reason == Reason.VALID))
            del surface
        best[camera] = max(views, key=lambda view: seen.get(view, 0))
    return best


def _reference(inputs: Inputs, campaign: Campaign, sampling: Sampling) -> Iterator[View]:
    """Show texture and shape of every camera, by the view that sees most."""
    for view in _best_views(inputs, campaign).values():
        at_rest = Subject(campaign.name, campaign.reference.label, view)
        regions = None
        if len(campaign.states) > 1:
            regions = inputs.read(DISPLACEMENTS, REGIONS, replace(at_rest, state=campaign.states[1].label))
        measurement = inputs.read(RECORDINGS, MEASURED, textured_by(at_rest))
        surface = inputs.read(SURFACES.port, SURFACE, at_rest)
        yield reference_view(view, measurement, surface, regions, sampling.of(surface.reason.shape))


def _deformed(inputs: Inputs, campaign: Campaign, state: LoadState, sampling: Sampling) -> Iterator[View]:
    """Show displacement of every camera, and strain by the view that sees most of the surface there."""
    for camera, views in campaign.views_by_camera().items():
        own = Subject(campaign.name, state.label)
        merged = inputs.read(MERGED_STATES, MERGED.of(camera), own)
        best: tuple[str, StrainField] | None = None
        for view in views:
            strain = inputs.read(STRAINS, STRAIN, replace(own, view=view))
            if best is None or _valid(strain) > _valid(best[1]):
                best = (view, strain)
            del strain
        if best is None:
            continue
        of_best = replace(own, view=best[0])
        gauges = inputs.read(GAUGES_READ, GAUGES, of_best) if inputs.has(GAUGES_READ, about=of_best) else None
        yield deformed_view(merged, *best, sampling.of(merged.reason.shape), gauges)


def _valid(field: StrainField) -> int:
    return int(np.count_nonzero(field.reason == Reason.VALID))


CHAPTER = Chapter(
    name="Shape, displacement and strain",
    rank=0,
    introduction="Lengths are in millimetres in the frame of the calibration, strains in microstrain (µε) in "
    "the plane of the surface. Standard deviations cover the camera's noise and the misfit of "
    "the subsets, not the calibration. Of a camera with several partners displacement is "
    "merged of all, shape and strain are of the view that sees most of the surface. A camera "
    "alone measures in the plane of its image: X points to the right and Y up, both as the "
    "camera sees the specimen, lengths are in millimetres where the size of a pixel was given "
    "and in pixels of the reference image elsewhere, and motion towards the camera or out of "
    "the plane looks like strain; where nothing was measured the image itself shows.",
    needs=_needs,
    reference=_reference,
    deformed=_deformed,
    also={GAUGES.name: _gauges},
)
