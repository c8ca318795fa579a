"""A rig that records what is in front of the virtual rig."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.scene import Deformation, Scene, Simulation
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.rendering import render


@dataclass(frozen=True)
class SimulatedRig:
    """A `Recorder` made of light rays.

    Attributes
    ----------
    scene
        The sensors and the specimen.
    state, deformation
        Label of the load state, and what it does to the specimen.
    recorded_at
        The time that its measurements bear.
    threads
        For rendering; the measurements do not depend on it.
    """

    scene: Scene
    state: str
    deformation: tuple[Deformation, ...]
    recorded_at: datetime
    threads: int = 1

    def record(
        self, view: str, sequence: FringeSequence, dimming: NDArray[np.float32] | None = None
    ) -> Measurement:
        """Render a measurement; its frames are made while they are asked for.

        Of a camera alone, for which nothing is projected, the white frame is the only one.
        """
        simulation = Simulation.of(self.scene, view_of(view), self.deformation, self.state)
        rendering = render(simulation, sequence, threads=self.threads, dimming=dimming)
        return Measurement(
            self.recorded_at,
            FringeSequence() if simulation.projector is None else sequence,
            rendering.full_scale,
            rendering.gain,
            rendering.read_noise,
            rendering.texture,
            rendering.frames,
            simulation,
            dimming,
        )
