"""A camera and a projector that look at one thing, and what their rays make of phase gradients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.ray_pairing import CandidateReturns, Pairing, PairingRule, choose_returns
from sms_jobs.metrology.geometry.triangulation import Projector, Triangulation, camera_rays, triangulate


@dataclass(frozen=True)
class SensorPair:
    """One pair: all that triangulation needs besides the phase.

    Attributes
    ----------
    intrinsics, pose, rows, columns
        Of the camera.
    projector
        The other one.
    orientations
        Directions of the fringes in rad.
    threads
        Number of threads; no result depends on it.
    """

    intrinsics: Intrinsics
    pose: Pose
    rows: int
    columns: int
    projector: Projector
    orientations: tuple[float, ...]
    threads: int

    def rays(self) -> Floats:
        """Return the ray of every camera pixel, (rows, columns, 3)."""
        return camera_rays(self.intrinsics, self.pose, self.rows, self.columns, self.threads)

    def meet(
        self, omega: Floats, omega_sigma: Singles, every: int = 1, part: Singles | None = None
    ) -> Triangulation:
        """Triangulate phase gradients (orientations, rows, columns) that are of `every`-th row."""
        rays = np.ascontiguousarray(self.rays()[::every])
        rays.setflags(write=False)  # as the table is: kernels are compiled for one kind of array
        return triangulate(
            self.pose.centre(),
            rays,
            self.projector,
            self.orientations,
            omega,
            omega_sigma,
            part=part,
            threads=self.threads,
        )

    def choose(self, rows: slice, candidates: CandidateReturns, rule: PairingRule) -> Pairing:
        """Choose among the returns of some rows: `choose_returns`."""
        return choose_returns(
            self.pose.centre(),
            self.rays()[rows],
            self.projector,
            self.orientations,
            candidates,
            rule,
            threads=self.threads,
        )
