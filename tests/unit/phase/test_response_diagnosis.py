"""The projector's response, found in frames of the virtual rig and of formulas."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.metrology.phase.patterns import fringe_harmonics, phase_gradient
from sms_jobs.metrology.phase.phase_stepping import stepping_weights
from sms_jobs.metrology.phase.response import (
    Response,
    corrected_gradient,
    diagnose_response,
    distortion,
    gradient_ripple,
)
from sms_jobs.metrology.phase.temporal_unwrapping import unwrap
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import ProjectorResponse, Simulation
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.rendering import Rendering, render
from sms_jobs.virtual_rig.truth import exact_shape

DENSITIES = (32, 31, 30, 28, 24, 16)
GAMMAS = (1.0, 1.4, 1.8, 2.2)


@dataclass(frozen=True)
class Rippled:
    """Frames of an unmarked plate, and the phase gradient that is true of them; `inside` far from edges."""

    rendering: Rendering
    frames: NDArray[np.uint16]
    steps: int
    inside: NDArray[np.bool_]
    true: NDArray[np.float64]

    def unwrapped(self, frames: NDArray[np.uint16]) -> NDArray[np.float64]:
        camera = self.rendering
        return unwrap(
            frames,
            DENSITIES,
            self.steps,
            full_scale=camera.full_scale,
            gain=camera.gain,
            read_noise=camera.read_noise,
        ).omega

    def response(self) -> Response:
        omega = self.unwrapped(self.frames)
        return diagnose_response(self.frames[:, self.inside], DENSITIES, self.steps, omega[self.inside])

    def share(self, omega: NDArray[np.float64], response: Response) -> float:
        """Return how much of the predicted ripple is in a measured phase gradient."""
        predicted = gradient_ripple(response, self.true, DENSITIES, self.steps)[self.inside]
        return float(predicted @ (omega - self.true)[self.inside] / (predicted @ predicted))


@cache
def rippled(gamma: float, steps: int, defocus_px: float = 0.0) -> Rippled:
    calibration, campaign = small_plate("plate")
    assert campaign.scene is not None
    scene = replace(campaign.scene, speckle=None, projector=ProjectorResponse(gamma, defocus_px))
    simulation = Simulation(scene, "C1", "P1", ())
    rendering = render(simulation, FringeSequence(DENSITIES, steps, (0.0,)))
    shape = exact_shape(simulation)
    projector = calibration.rig.sensor("P1")
    points = np.moveaxis(shape.xyz, 0, -1)
    pixels = project(projector.intrinsics, projector.pose, points)
    inside = ndimage.binary_erosion(shape.seen & shape.lit, iterations=4)
    true = phase_gradient(pixels, projector.columns, projector.rows, 0.0)
    return Rippled(rendering, rendering.frames.rows(0, 128), steps, inside, true)


@pytest.mark.parametrize("gamma", GAMMAS)
@pytest.mark.parametrize(("steps", "defocus_px"), [(4, 0.0), (3, 1.0)])
def test_gamma_is_found(gamma: float, steps: int, defocus_px: float) -> None:
    response = rippled(gamma, steps, defocus_px).response()
    # Noise gives 5e-4; what q = 3 mixes into the second harmonic leaves another 2e-3.
    assert response.gamma == pytest.approx(gamma, abs=5e-3)
    sent = fringe_harmonics(0, 1.0, gamma=gamma)
    wanted = np.zeros(6)
    wanted[: min(len(sent) - 1, 6)] = sent[1:7] / sent[1]
    # The ripple of omega itself is known to some per cent, and with it the harmonics that cause it; the
    # sixth is all but blurred away, which its standard deviation says.
    assert (np.abs(response.harmonics - wanted) < 3e-3 + 5.0 * response.sigma).all()


@pytest.mark.parametrize("gamma", GAMMAS[1:])
@pytest.mark.parametrize(("steps", "defocus_px"), [(4, 0.0), (3, 1.0)])
def test_the_ripple_is_the_predicted_one(gamma: float, steps: int, defocus_px: float) -> None:
    seen = rippled(gamma, steps, defocus_px)
    # The ripple is at least 0.3 of the noise of 1e-4 rad, and 9700 pixels give its share to 0.035.
    assert seen.share(seen.unwrapped(seen.frames), seen.response()) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize("gamma", GAMMAS[1:])
@pytest.mark.parametrize(("steps", "defocus_px"), [(4, 0.0), (3, 1.0)])
def test_the_correction_leaves_a_tenth(gamma: float, steps: int, defocus_px: float) -> None:
    seen = rippled(gamma, steps, defocus_px)
    response = seen.response()
    found = seen.unwrapped(seen.frames)
    corrected = corrected_gradient(response, found, DENSITIES, steps)
    # Three times the standard deviation above; seen are 0.05 and less.
    assert abs(seen.share(corrected, response)) < 0.1
    again = corrected + gradient_ripple(response, corrected, DENSITIES, steps)
    # The ripple's slope is at most 0.6, and twelve rounds leave 0.6^12 of 3e-3 rad.
    np.testing.assert_allclose(again[seen.inside], found[seen.inside], atol=1e-5)


def test_a_linear_projector_has_no_ripple() -> None:
    seen = rippled(1.0, 4)
    ripple = gradient_ripple(seen.response(), seen.true[seen.inside], DENSITIES, 4)
    # A hundredth of the noise of omega, 1e-4 rad.
    assert np.std(ripple) < 1e-6


def response_of(harmonics: tuple[float, ...], damping: float = 0.0) -> Response:
    values = np.array(harmonics)
    return Response(values, np.zeros(len(values)), damping, 1.0, 0.0, 1.0)


@pytest.mark.parametrize("steps", [3, 4, 5, 7])
def test_the_ripple_is_what_stepping_makes_of_harmonics(steps: int) -> None:
    response = response_of((1.0, 0.12, -0.05, 0.03, -0.02, 0.01), damping=1e-4)
    phase = np.linspace(-pi, pi, 101)
    shifts = 2.0 * pi * np.arange(steps)[:, None] / steps
    frames = sum(
        amplitude * np.cos(n * (phase + shifts)) for n, amplitude in enumerate(response.at_density(9), 1)
    )
    weights = stepping_weights(steps)
    found = np.angle((weights[0] + 1j * weights[1]) @ frames * np.exp(-1j * phase))
    # Rounding.
    np.testing.assert_allclose(np.angle(distortion(response, phase, 9, steps)), found, atol=1e-12)


@pytest.mark.parametrize("steps", [3, 4])
def test_the_ripple_of_omega_is_what_unwrapping_makes_of_harmonics(steps: int) -> None:
    response = response_of((1.0, 0.05, -0.03, 0.02, 0.01, 0.0), damping=1e-4)
    omega = np.linspace(-2.5, 2.5, 400)[None]
    frames = []
    for t in DENSITIES:
        for k in range(steps):
            theta = omega * t + 2.0 * pi * k / steps
            level = sum(a * np.cos(n * theta) for n, a in enumerate(response.at_density(t), 1))
            frames.append(np.rint(32_000.0 + 25_000.0 * level).astype(np.uint16))
    found = unwrap(np.array(frames), DENSITIES, steps, full_scale=65_535, gain=0.0, read_noise=1.0).omega
    # Rounding to one grey level of 25 000 gives a phase error of 2e-5 rad, and omega one of 4e-7.
    np.testing.assert_allclose(found - omega, gradient_ripple(response, omega, DENSITIES, steps), atol=3e-6)


@pytest.mark.parametrize("densities", [(16,), (16, 16), (0, 1, 2)])
def test_densities_that_tell_nothing_are_refused(densities: tuple[int, ...]) -> None:
    frames = np.zeros((4 * len(densities), 10), np.uint16)
    with pytest.raises(InvalidInput, match="two fringe densities"):
        diagnose_response(frames, densities, 4, np.zeros(10))
