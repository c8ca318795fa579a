"""Gloss on the virtual rig: a highlight beside the diffuse light, and a projector dimmed in places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.scene import Gloss, Simulation
from sms_jobs.virtual_rig.light import (
    SUBSAMPLES,
    Light,
    sensor_named,
    source_centre,
    source_of,
    trace_together,
)
from sms_jobs.virtual_rig.truth import exact_shape


def shining(simulations: Sequence[Simulation], threads: int = 1) -> list[Light]:
    """Return the light of what `trace_together` takes, with the highlight of its scene if that has one."""
    lights, gloss = trace_together(simulations, threads), simulations[0].scene.gloss
    if gloss is None:
        return lights
    pairs = zip(lights, simulations, strict=True)
    return [glossy(light, simulation, gloss, threads=threads) for light, simulation in pairs]


def glossy(light: Light, simulation: Simulation, gloss: Gloss, *, threads: int = 1) -> Light:
    """Return light with a highlight where the surface mirrors the projector, or the lamp, towards the camera.

    strength (n . h)^exponent, h half way between the directions to the camera and to the light (Blinn
    1977), times the inverse square of the distance as in `direct_light`. Computed for pixel centres: good as
    long as a highlight is wider than a pixel.
    """
    shape = exact_shape(simulation, threads=threads)
    points = np.moveaxis(shape.xyz, 0, -1)
    camera = sensor_named(simulation, simulation.camera).pose.centre()
    source = source_centre(source_of(simulation))
    to_camera, to_source = camera - points, source - points
    length = np.linalg.norm(to_source, axis=-1)
    half = to_camera / np.linalg.norm(to_camera, axis=-1, keepdims=True) + to_source / length[..., None]
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    cosine = np.clip(np.sum(np.moveaxis(shape.normal, 0, -1) * half, axis=-1), 0.0, 1.0)
    placed = np.array(simulation.scene.placement.translation)
    distance = float(np.linalg.norm(source - placed))
    lobe = gloss.strength * cosine**gloss.exponent * np.square(distance / length)
    lobe = np.where(shape.lit, lobe, 0.0)
    fine = np.repeat(np.repeat(lobe, SUBSAMPLES, axis=0), SUBSAMPLES, axis=1)
    strength = light.strength.copy()
    strength[0] += np.where(strength[0] > 0.0, fine, 0.0).astype(np.float32)
    return replace(light, strength=strength)


def dimmed(light: Light, factor: Floats) -> Light:
    """Return what is left of the light when a projector is dimmed by a factor for each of its pixels."""
    left = ndimage.map_coordinates(factor, [light.y, light.x], order=1, mode="nearest")
    return replace(light, strength=(light.strength * left).astype(np.float32))
