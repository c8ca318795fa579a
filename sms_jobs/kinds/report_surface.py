"""Chapter of the report: shape, displacement and strain of surfaces, by views of camera and projector."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from sms_jobs.formats.report.surface import deformed_view, reference_view
from sms_jobs.formats.report.view import View
from sms_jobs.kinds.kind import MEASUREMENT, Inputs, Need, deformed_tuples, tuples
from sms_jobs.kinds.report_chapter import Chapter, Sampling, role
from sms_jobs.records.campaign import Campaign, LoadState, Subject
from sms_jobs.records.fields import MergedField, PointCloud, Regions, StrainField
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.views import view_of

GAUGES = "gauges"


def views_by_camera(campaign: Campaign) -> dict[str, tuple[str, ...]]:
    """Return the views of every camera that measures shape, in the campaign's order."""
    views: dict[str, tuple[str, ...]] = {}
    for view in campaign.shape_views:
        camera = view_of(view).camera
        views[camera] = (*views.get(camera, ()), view)
    return views


def _needs(campaign: Campaign) -> Iterable[Need]:
    reference = campaign.reference.label
    for each in tuples(campaign):
        state, view = each.state or "", each.view or ""
        if state == reference:
            yield Need(role(MEASUREMENT, state, view), MEASUREMENT, each)
            yield Need(role("reconstruct", state, view), "reconstruct", each)
        else:
            yield Need(role("strain", state, view), "strain", each)
        if len(campaign.states) > 1 and state == campaign.states[1].label:
            yield Need(role("correlate", state, view), "correlate", each)
    for loaded in campaign.states[1:] if campaign.shape_views else ():
        yield Need(role("merge", loaded.label), "merge", Subject(campaign.name, loaded.label))


def _gauges(campaign: Campaign) -> Iterable[Need]:
    for each in deformed_tuples(campaign):
        yield Need(role(GAUGES, each.state or "", each.view or ""), GAUGES, each)


def _best_views(inputs: Inputs, campaign: Campaign) -> Mapping[str, str]:
    """Return, by camera, the view that sees most of the surface at the reference state."""
    label = campaign.reference.label
    best: dict[str, str] = {}
    for camera, views in views_by_camera(campaign).items():
        seen: dict[str, int] = {}
        for view in views if len(views) > 1 else ():
            cloud = inputs.read(role("reconstruct", label, view), "cloud", PointCloud)
            seen[view] = int(np.count_nonzero(cloud.reason == Reason.VALID))
            del cloud
        best[camera] = max(views, key=lambda view: seen.get(view, 0))
    return best


def _reference(inputs: Inputs, campaign: Campaign, sampling: Sampling) -> Iterator[View]:
    """Show texture and shape of every camera, by the view that sees most."""
    label = campaign.reference.label
    for view in _best_views(inputs, campaign).values():
        regions = None
        if len(campaign.states) > 1:
            regions = inputs.read(role("correlate", campaign.states[1].label, view), "regions", Regions)
        measurement = inputs.read(role(MEASUREMENT, label, view), "measurement", Measurement)
        cloud = inputs.read(role("reconstruct", label, view), "cloud", PointCloud)
        yield reference_view(view, measurement, cloud, regions, sampling.of(cloud.reason.shape))


def _deformed(inputs: Inputs, campaign: Campaign, state: LoadState, sampling: Sampling) -> Iterator[View]:
    """Show displacement of every camera, and strain by the view that sees most of the surface there."""
    for camera, views in views_by_camera(campaign).items():
        merged = inputs.read(role("merge", state.label), camera, MergedField)
        best: tuple[str, StrainField] | None = None
        for view in views:
            strain = inputs.read(role("strain", state.label, view), "strain", StrainField)
            if best is None or _valid(strain) > _valid(best[1]):
                best = (view, strain)
            del strain
        if best is None:
            continue
        readings = role(GAUGES, state.label, best[0])
        gauges = inputs.read(readings, "gauges", GaugeReadings) if readings in inputs.datasets else None
        yield deformed_view(merged, *best, sampling.of(merged.reason.shape), gauges)


def _valid(field: StrainField) -> int:
    return int(np.count_nonzero(field.reason == Reason.VALID))


CHAPTER = Chapter(
    name="Shape, displacement and strain of the surface",
    rank=0,
    introduction="Lengths are in millimetres in the frame of the calibration, strains in microstrain (µε) "
    "in the plane of the surface. Standard deviations cover the camera's noise, not the calibration. Of a "
    "camera with several projectors displacement is merged of all, shape and strain are of the view that "
    "sees most of the surface.",
    needs=_needs,
    reference=_reference,
    deformed=_deformed,
    also={GAUGES: _gauges},
)
