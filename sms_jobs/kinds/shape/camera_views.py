"""The shape that a camera sees at a state, all its partners taken together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.kind import Inputs, Need
from sms_jobs.kinds.port_names import SHAPE
from sms_jobs.kinds.products import SURFACE
from sms_jobs.kinds.surface_ports import position_covariance, surface_port
from sms_jobs.metrology.deformation.joining.merging import merge_by_variance
from sms_jobs.metrology.surfaces.continuity import continuous_labels
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject

_DIAGONAL = [0, 3, 5]


@dataclass(frozen=True)
class CameraView:
    """Points of one camera, merged by inverse variance over its views.

    Attributes
    ----------
    xyz
        (3, rows, columns) in mm, NaN where no view has a point.
    covariance
        (6, rows, columns) in mm^2.
    labels
        (rows, columns), continuous pieces; 0 for none.
    reason
        (rows, columns), why there is no point: what any of the views has against it.
    """

    camera: str
    views: tuple[str, ...]
    xyz: NDArray[np.float64]
    covariance: NDArray[np.float64]
    labels: NDArray[np.int32]
    reason: NDArray[np.uint32]

    def sigma(self) -> NDArray[np.float64]:
        """Return the standard deviation of each position, (rows, columns) in mm: the root of the trace."""
        return np.asarray(np.sqrt(self.covariance[_DIAGONAL].sum(axis=0)))


def cameras(campaign: Campaign, subject: Subject) -> dict[str, tuple[str, ...]]:
    """Return the views of each camera that measures shape, in the campaign's order."""
    alone = campaign.cameras_alone
    return {camera: views for camera, views in campaign.views_by_camera().items() if camera not in alone}


SHAPES = surface_port(SHAPE, several=True)


def cloud_needs(campaign: Campaign, subject: Subject) -> Iterable[Need]:
    """Return the points of every view at a state."""
    for views in cameras(campaign, subject).values():
        for view in views:
            yield SHAPES.of(campaign, replace(subject, view=view))


def camera_views(inputs: Inputs) -> Iterator[CameraView]:
    """Yield the view of each camera; the context of the kind is `cameras`."""
    for camera, views in inputs.context.items():
        clouds = [inputs.read(SHAPES.port, SURFACE, replace(inputs.subject, view=view)) for view in views]
        merged = merge_by_variance([c.position for c in clouds], [position_covariance(c) for c in clouds])
        missing = merged.contributors == 0
        reason = np.zeros(missing.shape, np.uint32)
        reason[missing] = np.bitwise_or.reduce([c.reason for c in clouds])[missing]
        sigma = np.sqrt(merged.covariance[_DIAGONAL].sum(axis=0))
        labels = continuous_labels(merged.value, sigma, threads=inputs.threads)
        reason[(labels == 0) & ~missing] |= np.uint32(Reason.OUTSIDE_REGION)
        yield CameraView(camera, views, merged.value, merged.covariance, labels, reason)
