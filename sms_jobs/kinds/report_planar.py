"""Chapter of the report: displacement and strain in the image of cameras alone, of a flat specimen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from sms_jobs.formats.report.planar import planar_view, texture_view
from sms_jobs.formats.report.view import View
from sms_jobs.kinds.kind import Inputs, Need, deformed_images_alone, tested_states
from sms_jobs.kinds.products import GAUGES, MATCHES, MEASURED, PLANAR_DISPLACEMENT, PLANAR_STRAIN
from sms_jobs.kinds.report_chapter import (
    GAUGES_READ,
    PLANAR_DISPLACEMENTS,
    PLANAR_STRAINS,
    RECORDINGS,
    Chapter,
    Sampling,
)
from sms_jobs.records.campaign import Campaign, LoadState, Subject


def _needs(campaign: Campaign) -> Iterable[Need]:
    for view in campaign.cameras_alone if tested_states(campaign) else ():
        yield RECORDINGS.of(Subject(campaign.name, campaign.reference.label, view))
    for each in deformed_images_alone(campaign):
        yield PLANAR_DISPLACEMENTS.of(each)
        yield PLANAR_STRAINS.of(each)


def _gauges(campaign: Campaign) -> Iterable[Need]:
    return map(GAUGES_READ.of, deformed_images_alone(campaign))


def _reference(inputs: Inputs, campaign: Campaign, sampling: Sampling) -> Iterator[View]:
    """Show the image of every camera, and what of it was measured."""
    deformed = tested_states(campaign)[1:]
    for view in campaign.cameras_alone:
        at_rest = Subject(campaign.name, campaign.reference.label, view)
        reason = None
        if deformed:
            moved = replace(at_rest, state=deformed[0].label)
            reason = inputs.read(PLANAR_DISPLACEMENTS, PLANAR_DISPLACEMENT, moved).reason
        measurement = inputs.read(RECORDINGS, MEASURED, at_rest)
        yield texture_view(view, measurement, reason, sampling.of(measurement.texture.shape))


def _deformed(inputs: Inputs, campaign: Campaign, state: LoadState, sampling: Sampling) -> Iterator[View]:
    """Show displacement and strain in the image of every camera."""
    for view in campaign.cameras_alone:
        own = Subject(campaign.name, state.label, view)
        moved = inputs.read(PLANAR_DISPLACEMENTS, PLANAR_DISPLACEMENT, own)
        matches = inputs.read(PLANAR_DISPLACEMENTS, MATCHES, own)
        strain = inputs.read(PLANAR_STRAINS, PLANAR_STRAIN, own)
        gauges = inputs.read(GAUGES_READ, GAUGES, own) if inputs.has(GAUGES_READ, about=own) else None
        yield planar_view(moved, matches, strain, sampling.of(moved.reason.shape), gauges)


CHAPTER = Chapter(
    name="Displacement and strain in the image",
    rank=1,
    introduction="A camera alone measures in the plane of its image: x points to the right and y up, both as "
    "the camera sees the specimen. Lengths are in millimetres where the size of a pixel was given, in pixels "
    "of the reference image elsewhere, strains in microstrain (µε). Standard deviations cover the camera's "
    "noise and the misfit of the subsets. Motion towards the camera or out of the plane looks like strain. "
    "Where nothing was measured the image itself shows.",
    needs=_needs,
    reference=_reference,
    deformed=_deformed,
    also={GAUGES.name: _gauges},
)
