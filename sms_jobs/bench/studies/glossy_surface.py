"""A glossy cylinder: one exposure, a set of exposures merged, and a projector dimmed where it dazzles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.bench.returns import rms
from sms_jobs.bench.study import Outcome, Study, Table, new_figure
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.metrology.phase.exposure import (
    exposure_set,
    merge_exposures,
    projector_dimming,
    white_brightness,
)
from sms_jobs.metrology.phase.patterns import phase_gradient
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap
from sms_jobs.metrology.phase.texture_error import TYPICAL, log_gradient, texture_shift
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import Cylinder, Gloss, Simulation
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.gloss import dimmed, glossy
from sms_jobs.virtual_rig.light import Light, trace
from sms_jobs.virtual_rig.rendering import Noise, SimulatedFrames
from sms_jobs.virtual_rig.truth import exact_shape

SEQUENCE = FringeSequence((16, 15, 14, 12, 8), 4, (0.0,))
SHINE = Gloss(strength=20.0, exponent=300.0)
EXPOSURE = 0.9
TRIED = (0.5, 0.1, 0.02)

Frames = NDArray[np.uint16]
Floats = NDArray[np.float64]


class _Bench:
    """A glossy cylinder before a camera whose exposure can be chosen."""

    def __init__(self) -> None:
        calibration, campaign = small_plate("plate")
        assert campaign.scene is not None
        scene = replace(campaign.scene, speckle=None, surface=Cylinder(200.0, 150.0, 150.0))
        self.simulation = Simulation(scene, "C1", "P1", ())
        self.light = glossy(trace(self.simulation), self.simulation, SHINE)
        self.projector = calibration.rig.sensor("P1")
        shape = exact_shape(self.simulation)
        points = np.moveaxis(shape.xyz, 0, -1)
        self.xy = project(self.projector.intrinsics, self.projector.pose, points)
        self.omega = phase_gradient(self.xy, self.projector.columns, self.projector.rows, 0.0)
        lit = shape.seen & shape.lit
        self.inside = ndimage.binary_erosion(lit, iterations=3)
        self.usable = ndimage.binary_erosion(lit, iterations=2)
        self.noise = Noise.of(scene.camera)

    def recorded(self, light: Light, exposure: float) -> SimulatedFrames:
        camera = replace(self.simulation.scene.camera, exposure=exposure)
        scene = replace(self.simulation.scene, camera=camera)
        state = f"exposure {exposure}"  # noise of its own
        return SimulatedFrames(replace(self.simulation, scene=scene, state=state), SEQUENCE, light, 1)

    def frames(self, light: Light, exposure: float) -> Frames:
        found = self.recorded(light, exposure)
        return found.rows(0, found.shape[1])

    def unwrapped(self, frames: Frames) -> PhaseGradient:
        return unwrap(
            frames,
            SEQUENCE.densities,
            SEQUENCE.steps,
            full_scale=self.noise.full_scale,
            gain=self.noise.gain,
            read_noise=float(np.hypot(self.noise.read_noise, 12**-0.5)),
        )

    def row(self, name: str, frames: Frames, exposure: Any) -> tuple[str | float, ...]:
        """Return the saturated and measured parts, and the errors of omega over their sigma."""
        found = self.unwrapped(frames)
        good = self.inside & ~found.saturated
        shift = texture_shift(
            found.omega[None], self.usable & ~found.saturated, log_gradient(found.modulation / exposure)
        )[0]
        error = (found.omega - TYPICAL.variance * shift - self.omega)[good]
        dazzled = (frames.max(axis=0) >= self.noise.full_scale)[self.inside].mean()
        lost = found.saturated[self.inside].mean()
        score = rms(error / found.omega_sigma[good])
        return (name, float(dazzled), float(lost), rms(error) * 1e5, score)


def run(say: Callable[[str], None]) -> Outcome:
    """Record the cylinder in three ways."""
    bench = _Bench()
    full_scale = bench.noise.full_scale
    say("a bracket of white frames")
    whites = np.stack([bench.recorded(bench.light, e).texture() for e in TRIED])
    brightness = white_brightness(whites, TRIED, full_scale)
    exposures = exposure_set(brightness[bench.inside], full_scale)
    say("one exposure")
    single = bench.frames(bench.light, EXPOSURE)
    say(f"{len(exposures)} exposures")
    several = np.stack([bench.frames(bench.light, e) for e in exposures])
    merged, index = merge_exposures(several, exposures, full_scale)
    say("a dimmed projector")
    factor = projector_dimming(
        EXPOSURE * brightness, bench.xy, bench.projector.columns, bench.projector.rows, full_scale
    )
    kept = bench.frames(dimmed(bench.light, factor), EXPOSURE)
    rows = [
        bench.row(f"one exposure, {EXPOSURE}", single, 1.0),
        bench.row(f"{len(exposures)} exposures, merged", merged, np.array(exposures)[index]),
        bench.row("one exposure, projector dimmed", kept, 1.0),
    ]
    columns = ("recording", "saturated pixels", "lost pixels", "rms of omega, 1e-5 rad", "rms / sigma")
    remarks = {
        "conditions": "glossy cylinder of the virtual rig, camera of 128 px, 12 bits; a Blinn lobe of "
        "exponent 300, 20 times as bright as white paper; fringes 16, 15, 14, 12, 8; rms over what is not "
        "lost, the slope of the highlight corrected as a texture's",
        "exposures": f"chosen {', '.join(f'{e:.3g}' for e in exposures)} from white frames at "
        f"{', '.join(map(str, TRIED))}",
        "thesis": "section 8.2 names the dimmed projector as further work",
    }
    pictures = {
        "white, one exposure": bench.recorded(bench.light, EXPOSURE).texture().astype(np.float64),
        "chosen exposure": np.array(exposures)[index],
        "white, projector dimmed": bench.recorded(dimmed(bench.light, factor), EXPOSURE)
        .texture()
        .astype(np.float64),
    }
    return Outcome(Table(columns, rows, remarks), _picture(pictures))


def _picture(pictures: dict[str, Floats]) -> Any:
    figure = new_figure(11.0, 3.6)
    for axes, (name, image) in zip(figure.subplots(1, 3), pictures.items(), strict=True):
        drawn = axes.imshow(image, cmap="gray", interpolation="none")
        axes.set_title(name, fontsize="medium")
        axes.set_xticks([])
        axes.set_yticks([])
        figure.colorbar(drawn, ax=axes)
    return figure


STUDY = Study(
    "glossy-surface", "a highlight beyond the camera's range: exposures merged, projector dimmed", run
)
