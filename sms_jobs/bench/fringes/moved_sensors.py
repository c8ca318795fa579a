"""A camera and a projector of which one turns between two states: how far displacement is off."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sms_jobs.bench.sessions.bar_session import MANY_SESSIONS, bar_session
from sms_jobs.bench.sessions.drawn_calibrations import moved, of_a_bar_session
from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT
from sms_jobs.kinds.shape import reconstruct
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import PER_POSE, PER_SENSOR
from sms_jobs.metrology.geometry.transforms import rotation_matrix
from sms_jobs.records.calibration import CalibrationUncertainty
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.campaigns import Made, tension_panel

_DIAGONAL = [0, 3, 5]
_SEED = 3


@dataclass(frozen=True)
class Panel:
    """A campaign of fringes, recorded at rest and at its last state, and what its calibration would say."""

    calibration: Calibration
    uncertainty: CalibrationUncertainty
    shelf: Shelf
    at_rest: Subject
    last: Subject

    def z(self, name: str, x_px: float, y_px: float, *, stated: bool) -> Floats:
        """Return errors of displacements over all that is stated of them, of all valid points.

        A sensor has turned since the state at rest, so that its image has moved by so many px.
        """
        scene = self.shelf.campaign.scene
        assert scene is not None
        rig = turned(self.calibration, name, x_px, y_px).rig
        later = Shelf(replace(self.shelf.campaign, scene=replace(scene, rig=rig)), self.shelf.threads)
        later.record(self.last)
        shelf = Shelf(self.shelf.campaign, self.shelf.threads)
        for subject, recorded in ((self.at_rest, self.shelf), (self.last, later)):
            shelf.records[MEASUREMENT, subject] = recorded.records[MEASUREMENT, subject]
            known = {"uncertainty": self.uncertainty} if stated else {}
            shelf.records[CALIBRATION, subject] = {"calibration": self.calibration, **known}
            shelf.run(reconstruct.KIND, subject, reconstruct.KIND.parameters())
        shelf.run(correlate.KIND, self.last, correlate.KIND.parameters())
        field = shelf.records[correlate.KIND.name, self.last]["displacement"]
        truth = self.shelf.truth(self.last).displacement
        valid = (field.reason == Reason.VALID) & np.isfinite(truth[0])
        error = (field.displacement - truth)[:, valid]
        variance = field.covariance[_DIAGONAL][:, valid].astype(np.float64)
        if field.sigma_calibration is not None:
            variance += np.square(field.sigma_calibration[:, valid], dtype=np.float64)
        return np.asarray(np.linalg.norm(error, axis=0) / np.sqrt(variance.sum(axis=0)))


def panel_seen(seed: int, threads: int, made: Made | None = None) -> Panel:
    """Record a panel under tension, or another campaign of fringes, at rest and at its last state."""
    calibration, campaign = made or tension_panel("moved", "small")
    assert campaign.scene is not None
    campaign = replace(campaign, scene=replace(campaign.scene, seed=seed))
    at_rest, last = (
        Subject(campaign.name, state.label, campaign.views[0])
        for state in (campaign.reference, campaign.states[-1])
    )
    shelf = Shelf(campaign, threads)
    for subject in (at_rest, last):
        shelf.record(subject)
    uncertainty = of_a_bar_session(calibration, bar_session(MANY_SESSIONS, _SEED))
    return Panel(calibration, uncertainty, shelf, at_rest, last)


def turned(calibration: Calibration, name: str, x_px: float, y_px: float) -> Calibration:
    """Return a calibration of which a sensor has turned about its centre, its image moved by so many px."""
    sensor = calibration.rig.sensor(name)
    step = np.zeros(PER_SENSOR)
    step[:3] = y_px / sensor.intrinsics.fy, -x_px / sensor.intrinsics.fx, 0.0
    translation = np.array(sensor.pose.translation)
    step[3:PER_POSE] = rotation_matrix(step[:3]) @ translation - translation
    return moved(calibration, [name], step)
