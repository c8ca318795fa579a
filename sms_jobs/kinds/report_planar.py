"""Chapter of the report: displacement and strain in the image of cameras alone, of a flat specimen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from sms_jobs.formats.report.planar import planar_view, texture_view
from sms_jobs.formats.report.view import View
from sms_jobs.kinds.kind import MEASUREMENT, Inputs, Need, deformed_images_alone, tested_states
from sms_jobs.kinds.report_chapter import Chapter, Sampling, role
from sms_jobs.kinds.report_surface import GAUGES
from sms_jobs.records.campaign import Campaign, LoadState, Subject
from sms_jobs.records.fields import ImageMatches
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.planar import PlanarDisplacement, PlanarStrain


def _needs(campaign: Campaign) -> Iterable[Need]:
    reference = campaign.reference.label
    for camera in campaign.cameras_alone if tested_states(campaign) else ():
        at_rest = Subject(campaign.name, reference, camera)
        yield Need(role(MEASUREMENT, reference, camera), MEASUREMENT, at_rest)
    for each in deformed_images_alone(campaign):
        for kind in ("correlate-images", "strain-images"):
            yield Need(role(kind, each.state or "", each.view or ""), kind, each)


def _gauges(campaign: Campaign) -> Iterable[Need]:
    for each in deformed_images_alone(campaign):
        yield Need(role(GAUGES, each.state or "", each.view or ""), GAUGES, each)


def _reference(inputs: Inputs, campaign: Campaign, sampling: Sampling) -> Iterator[View]:
    """Show the image of every camera, and what of it was measured."""
    label = campaign.reference.label
    deformed = tested_states(campaign)[1:]
    for camera in campaign.cameras_alone:
        reason = None
        if deformed:
            moved = role("correlate-images", deformed[0].label, camera)
            reason = inputs.read(moved, "displacement", PlanarDisplacement).reason
        measurement = inputs.read(role(MEASUREMENT, label, camera), "measurement", Measurement)
        yield texture_view(camera, measurement, reason, sampling.of(measurement.texture.shape))


def _deformed(inputs: Inputs, campaign: Campaign, state: LoadState, sampling: Sampling) -> Iterator[View]:
    """Show displacement and strain in the image of every camera."""
    for camera in campaign.cameras_alone:
        found = role("correlate-images", state.label, camera)
        moved = inputs.read(found, "displacement", PlanarDisplacement)
        matches = inputs.read(found, "matches", ImageMatches)
        strain = inputs.read(role("strain-images", state.label, camera), "strain", PlanarStrain)
        readings = role(GAUGES, state.label, camera)
        gauges = inputs.read(readings, "gauges", GaugeReadings) if readings in inputs.datasets else None
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
    also={GAUGES: _gauges},
)
