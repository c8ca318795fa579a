"""Exposures for surfaces brighter than the camera's range; shown on a glossy cylinder of the virtual rig."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.metrology.phase.exposure import (
    HEADROOM,
    best_exposure,
    exposure_set,
    merge_exposures,
    projector_dimming,
)
from sms_jobs.metrology.phase.patterns import phase_gradient
from sms_jobs.metrology.phase.seen_texture import log_gradient, relative_gradient, roughness, texture_shift
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import Cylinder, Gloss, Simulation
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.gloss import dimmed, glossy
from sms_jobs.virtual_rig.light import Light, trace
from sms_jobs.virtual_rig.noise import Noise
from sms_jobs.virtual_rig.rendering import SimulatedFrames
from sms_jobs.virtual_rig.truth import exact_shape

FULL_SCALE = 4095
SEQUENCE = FringeSequence((16, 15, 14, 12, 8), 4, (0.0,))
SPOT = (1.0 / 3.0) ** 0.5  # of the lens, 0.5 px, and the pixel's own area
SHINE = Gloss(strength=20.0, exponent=300.0)


@cache
def shiny() -> tuple[Simulation, Light, NDArray[np.bool_], NDArray[np.float64]]:
    """Return a glossy cylinder, its light, what is lit far from edges, and the projector pixels behind it."""
    calibration, campaign = small_plate("plate")
    assert campaign.scene is not None
    scene = replace(campaign.scene, speckle=None, surface=Cylinder(200.0, 150.0, 150.0))
    simulation = Simulation(scene, "C1", "P1", ())
    light = glossy(trace(simulation), simulation, SHINE)
    shape = exact_shape(simulation)
    projector = calibration.rig.sensor("P1")
    xy = project(projector.intrinsics, projector.pose, np.moveaxis(shape.xyz, 0, -1))
    return simulation, light, ndimage.binary_erosion(shape.seen & shape.lit, iterations=3), xy


def recorded(light: Light, exposure: float) -> SimulatedFrames:
    simulation = shiny()[0]
    camera = replace(simulation.scene.camera, exposure=exposure)
    state = f"exposure {exposure}"  # noise of its own
    simulation = replace(simulation, scene=replace(simulation.scene, camera=camera), state=state)
    return SimulatedFrames(simulation, SEQUENCE, light, 1)


def unwrapped(frames: NDArray[np.uint16]) -> PhaseGradient:
    noise = Noise.of(shiny()[0].scene.camera)
    return unwrap(
        frames,
        SEQUENCE.densities,
        SEQUENCE.steps,
        full_scale=FULL_SCALE,
        gain=noise.gain,
        read_noise=float(np.hypot(noise.read_noise, 12**-0.5)),
    )


def score(found: PhaseGradient, modulation: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the errors of omega over their standard deviations, rid of the highlight's own slope."""
    _, _, inside, xy = shiny()
    usable = ndimage.binary_dilation(inside) & ~found.saturated
    gradient = log_gradient(modulation, usable, relative_gradient(modulation))
    rough = roughness(modulation)
    shift = texture_shift(found.omega[None], usable, gradient, rough)[0][0]
    error = found.omega - SPOT**2 * shift - phase_gradient(xy, 256, 192, 0.0)
    return (error / found.omega_sigma)[inside & ~found.saturated]


@cache
def bracket() -> tuple[tuple[float, ...], NDArray[np.float64]]:
    """Return the exposures that three white frames suggest, and the brightness at exposure 1."""
    tried = (0.5, 0.1, 0.02)
    whites = np.stack([recorded(shiny()[1], e).texture() for e in tried])
    index = best_exposure(whites, tried, FULL_SCALE)
    white = np.take_along_axis(whites, index[None].astype(np.intp), axis=0)[0]
    brightness = np.where(white < FULL_SCALE, white / np.array(tried)[index], np.inf)
    return exposure_set(brightness[shiny()[2]], FULL_SCALE), brightness


def test_a_set_of_exposures_brings_a_highlight_into_range() -> None:
    _, light, inside, _ = shiny()
    exposures, _ = bracket()
    assert len(exposures) == 3  # the highlight is some 25 times brighter than the rest: log4(25) = 2.3
    frames = np.stack([recorded(light, e).rows(0, 128) for e in exposures])
    single = frames[-1]
    dazzled = (single.max(axis=0) >= FULL_SCALE)[inside].mean()
    assert dazzled > 0.05
    merged, index = merge_exposures(frames, exposures, FULL_SCALE)
    # Left are the pixels that `exposure_set` was allowed to ignore, and as many by noise.
    assert (merged.max(axis=0) >= FULL_SCALE)[inside].mean() < 2e-3
    assert set(np.unique(index[inside])) == {0, 1, 2}
    found = unwrapped(merged)
    # The modulation of one scene: what another exposure has done to it is taken out.
    modulation = found.modulation / np.array(exposures)[index]
    # About 9000 pixels give the scatter to 1 %; edges of the highlight keep some of its slope.
    assert np.std(score(found, modulation)) == pytest.approx(1.0, abs=0.15)


def test_a_dimmed_projector_brings_a_highlight_into_range() -> None:
    _, light, inside, xy = shiny()
    _, brightness = bracket()
    exposure = 0.9
    factor = projector_dimming(exposure * brightness, xy, 256, 192, FULL_SCALE)
    before = recorded(light, exposure).texture()[inside] >= FULL_SCALE
    frames = recorded(dimmed(light, factor), exposure).rows(0, 128)
    after = (frames.max(axis=0) >= FULL_SCALE)[inside]
    assert before.mean() > 0.05
    # White is brought to 0.9 of full scale, 410 levels or 15 sigma below it.
    assert after.mean() == 0.0
    # Where nothing dazzles, nothing is dimmed.
    calm = inside & (ndimage.maximum_filter(exposure * brightness, 25) < HEADROOM * FULL_SCALE)
    np.testing.assert_array_equal(
        frames[:, calm].max(axis=0) > 0.3 * FULL_SCALE, np.ones(calm.sum(), np.bool_)
    )
    found = unwrapped(frames)
    # The dimming's own slope is taken out as a texture's is.
    assert np.std(score(found, found.modulation)) == pytest.approx(1.0, abs=0.15)


def test_exposures_cover_every_brightness_within_the_ratio(rng: np.random.Generator) -> None:
    brightness = np.exp(rng.uniform(np.log(1.0), np.log(1e4), 5000))
    chosen = np.array(exposure_set(brightness, 4095, ratio=4.0, ignored=0.0, most=20))
    levels = brightness[:, None] * chosen
    best = np.max(np.where(levels <= HEADROOM * 4095 * (1.0 + 1e-12), levels, 0.0), axis=1)
    assert best.min() >= HEADROOM * 4095 / 4.0 * (1.0 - 1e-12)
    # The least number that can cover four decades in factors of four is log4(10^4) = 6.6.
    assert len(chosen) == 7
    assert len(exposure_set(brightness, 4095, most=3)) == 3
    assert max(exposure_set(brightness, 4095, longest=2.0)) == 2.0


def test_every_pixel_takes_its_longest_unsaturated_exposure(rng: np.random.Generator) -> None:
    frames = rng.integers(0, 120, (3, 6, 5, 7)).astype(np.uint8)
    exposures = (2.0, 1.0, 4.0)
    merged, index = merge_exposures(frames, exposures, 100)
    for row in range(5):
        for column in range(7):
            free = [i for i in (2, 0, 1) if frames[i, :, row, column].max() < 100]
            wanted = free[0] if free else 1
            assert index[row, column] == wanted
            np.testing.assert_array_equal(merged[:, row, column], frames[wanted, :, row, column])
    np.testing.assert_array_equal(index, best_exposure(frames.max(axis=1), exposures, 100))


def test_dimming_is_smooth_and_never_above_what_is_allowed(rng: np.random.Generator) -> None:
    xy = rng.uniform(0.0, 63.0, (400, 2))
    brightness = rng.uniform(100.0, 40_000.0, 400)
    factor = projector_dimming(brightness, xy, 64, 64, 4095, reach=3)
    at = factor[np.rint(xy[:, 1]).astype(int), np.rint(xy[:, 0]).astype(int)]
    assert (at * brightness <= HEADROOM * 4095 * (1.0 + 1e-9)).all()
    # A mean over 7 px changes by at most 1/7 of the range from pixel to pixel.
    assert np.abs(np.diff(factor, axis=0)).max() <= 1.0 / 7.0 + 1e-9
    assert (projector_dimming(np.full(400, 10.0), xy, 64, 64, 4095) == 1.0).all()


def test_what_cannot_be_chosen_is_refused() -> None:
    with pytest.raises(InvalidInput, match="shorten the pre-exposure"):
        exposure_set(np.full(3, np.inf), 4095)


def test_gloss_is_brightest_where_the_surface_mirrors() -> None:
    simulation, light, inside, _ = shiny()
    shape = exact_shape(simulation)
    sensors = {s.name: s.pose.centre() for s in simulation.scene.rig.sensors}
    points, normals = np.moveaxis(shape.xyz, 0, -1), np.moveaxis(shape.normal, 0, -1)
    away = sensors["P1"] - points
    out = sensors["C1"] - points
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    out /= np.linalg.norm(out, axis=-1, keepdims=True)
    mirrored = 2.0 * np.sum(normals * away, axis=-1, keepdims=True) * normals - away
    angle = np.arccos(np.clip(np.sum(mirrored * out, axis=-1), -1.0, 1.0))
    coarse = light.strength[0].reshape(128, 2, 128, 2).mean(axis=(1, 3))
    # Within half the lobe's width of the mirror direction, (cos(a/2))^300 = 1/2 at a = 0.136 rad.
    assert coarse[inside & (angle < 0.1)].min() > 8.0
    assert coarse[inside & (angle > 0.5)].max() < 1.2
    assert angle[inside].min() < 0.02 < pi
