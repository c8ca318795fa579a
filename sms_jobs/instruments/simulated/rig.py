"""A rig that records what is in front of the virtual rig."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.scene import Deformation, Scene, Simulation
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.gloss import shining
from sms_jobs.virtual_rig.light import Light
from sms_jobs.virtual_rig.rendering import render


@dataclass
class SimulatedRig:
    """A `Recorder` made of light rays.

    It keeps the light of the camera that it recorded last until another is asked for: at 1 Mpx 84 MB for each
    projector, as much as following the rays of one camera takes at least.

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
    views
        That are to be recorded: rays of a camera are followed once for all of its views.
    """

    scene: Scene
    state: str
    deformation: tuple[Deformation, ...]
    recorded_at: datetime
    threads: int = 1
    views: tuple[str, ...] = ()
    _lights: dict[str, Light] = field(default_factory=dict, init=False, repr=False)

    def record(
        self, view: str, sequence: FringeSequence, dimming: NDArray[np.float32] | None = None
    ) -> Measurement:
        """Render a measurement; its frames are made while they are asked for.

        Of a camera alone, for which nothing is projected, the white frame is the only one.
        """
        simulation = self._simulation(view)
        light = self._light(view)
        rendering = render(simulation, sequence, threads=self.threads, dimming=dimming, light=light)
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

    def _simulation(self, view: str) -> Simulation:
        return Simulation.of(self.scene, view_of(view), self.deformation, self.state)

    def _light(self, view: str) -> Light:
        """Return what reaches the camera of a view; that of one camera is kept until another is asked for."""
        if view not in self._lights:
            asked = self._simulation(view)
            together = {view: asked}
            for other in self.views:
                simulation = self._simulation(other)
                if simulation.camera == asked.camera and simulation.projector and asked.projector:
                    together[other] = simulation
            self._lights = {}  # let go before there is more
            lights = shining(list(together.values()), self.threads)
            self._lights = dict(zip(together, lights, strict=True))
        return self._lights[view]
