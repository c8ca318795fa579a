"""The light that reaches every camera pixel, and the projector pixel that it came from.

Each pixel is divided into sub-samples and a ray sent through the middle of each, so that a pixel on an
edge mixes what lies on both sides of it. A sub-sample holds up to two returns: light straight from the
projector, and light by way of a mirror. Where nothing projects there is one return, of a lamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Ints, Singles
from sms_jobs.metrology.compilation import in_row_blocks, inner, uncounted_kernel
from sms_jobs.records.scene import PlateAndMirror, Simulation
from sms_jobs.records.sensors import Sensor
from sms_jobs.records.views import Role
from sms_jobs.virtual_rig.deformations import carried, followed_back
from sms_jobs.virtual_rig.ink import PLAIN, SPECIMEN, packed_ink, printed_reflectance
from sms_jobs.virtual_rig.optics import image_point, in_image, packed_sensor, pixel_ray
from sms_jobs.virtual_rig.rays import (
    TOUCHING_MM,
    Specimen,
    first_hit,
    specimen_in,
    surface_normal,
    unit_to,
    unobstructed,
)
from sms_jobs.virtual_rig.speckle import packed_speckle, reflectance
from sms_jobs.virtual_rig.surfaces import CYLINDER, patch_coordinates, patch_normal
from sms_jobs.virtual_rig.windows import image_windows

SUBSAMPLES = 2
"""Sub-samples along each side of a pixel."""
LAMP = 3
"""Numbers that describe a lamp, its place; those of a projector are many more."""


@dataclass(frozen=True)
class Light:
    """What reaches the sub-samples of a camera's image.

    Attributes
    ----------
    x, y
        (returns, n rows, n columns): projector pixel that the light came from; 0 where there is none.
    strength
        (returns, n rows, n columns): what a projector at full brightness, or the lamp, gives, 1 for a
        perfectly diffuse white surface that faces it where the specimen stands.
    ambient
        (n rows, n columns): diffuse reflectance, by which ambient light is multiplied.
    windows
        (m, 4): first and end row, first and end column, in pixels, of parts beyond which there is no light.
    """

    x: Floats
    y: Floats
    strength: Singles
    ambient: Singles
    windows: Ints


class Prints(NamedTuple):
    """What is printed on a specimen, by `packed_speckle`, or on an artefact, by `packed_ink`."""

    speckle: Floats
    ink: Floats


def sensor_named(simulation: Simulation, name: str) -> Sensor:
    """Return a sensor of the simulated rig; raise `InvalidInput` where there is none."""
    for sensor in simulation.scene.rig.sensors:
        if sensor.name == name:
            return sensor
    known = ", ".join(s.name for s in simulation.scene.rig.sensors)
    raise InvalidInput(f"the virtual rig has no sensor {name}; it has {known}")


def source_of(simulation: Simulation) -> Floats:
    """Return what lights a simulated measurement: a projector by `packed_sensor`, or a lamp's place, (3,)."""
    scene = simulation.scene
    if simulation.projector is not None:
        return packed_sensor(sensor_named(simulation, simulation.projector))
    if scene.lamp_mm is not None:
        return np.array(scene.lamp_mm, dtype=np.float64)
    cameras = [s.pose.centre() for s in scene.rig.sensors if s.role is Role.CAMERA]
    return np.asarray(np.mean(cameras, axis=0))


def source_centre(source: Floats) -> Floats:
    """Return where the light of a `source_of` comes from, (3,), mm."""
    return source if len(source) == LAMP else source[16:19]


def trace(simulation: Simulation, threads: int = 1) -> Light:
    """Follow the rays of every sub-sample of a camera to the specimen and on to the projector or the lamp."""
    return trace_together([simulation], threads)[0]


def trace_together(simulations: Sequence[Simulation], threads: int = 1) -> list[Light]:
    """Trace simulations that differ in their projectors alone: rays are followed to the specimen once."""
    first = simulations[0]
    scene = first.scene
    camera = packed_sensor(sensor_named(first, first.camera))
    sources = np.array([source_of(simulation) for simulation in simulations])
    specimen = specimen_in(scene, first.deformation)
    prints = Prints(packed_speckle(scene.speckle), packed_ink(scene.surface))
    windows = image_windows(scene, first.deformation, first.camera)
    rows, columns = SUBSAMPLES * int(camera[20]), SUBSAMPLES * int(camera[19])
    returns = 2 if isinstance(scene.surface, PlateAndMirror) and first.projector is not None else 1
    shape = (len(sources), returns, rows, columns)
    x, y, strength = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.float32)
    ambient = np.zeros((rows, columns), np.float32)
    # The distance at which a facing white surface has the strength 1.
    placed = np.array(scene.placement.translation)
    distances = np.array([float(np.linalg.norm(source_centre(source) - placed)) for source in sources])

    def work(start: int, stop: int) -> None:
        for top, bottom, left, right in SUBSAMPLES * windows:
            _trace_window(
                camera,
                sources,
                specimen,
                prints,
                distances,
                (max(start, top), min(stop, bottom), left, right),
                x,
                y,
                strength,
                ambient,
            )

    in_row_blocks(work, rows, threads)
    windows = _narrowed(windows, ambient)
    return [Light(*one, ambient, windows) for one in zip(x, y, strength, strict=True)]


def _narrowed(windows: Ints, ambient: Singles) -> Ints:
    """Return windows without the rows and columns at their edges where nothing is seen, (m, 4), in pixels."""
    narrowed = []
    for top, bottom, left, right in windows:
        window = slice(SUBSAMPLES * top, SUBSAMPLES * bottom), slice(SUBSAMPLES * left, SUBSAMPLES * right)
        seen = ambient[window] > 0.0
        rows, columns = (np.flatnonzero(seen.any(axis)) // SUBSAMPLES for axis in (1, 0))
        if len(rows):
            narrowed.append((top + rows[0], top + rows[-1] + 1, left + columns[0], left + columns[-1] + 1))
    return np.array(narrowed, dtype=np.int64).reshape(-1, 4)


@uncounted_kernel
def _trace_window(
    camera: Floats,
    sources: Floats,
    specimen: Specimen,
    prints: Prints,
    distances: Floats,
    window: tuple[int, int, int, int],
    x: Floats,
    y: Floats,
    strength: Singles,
    ambient: Singles,
) -> None:
    top, bottom, left, right = window
    for i in range(top, bottom):
        py = (i + 0.5) / SUBSAMPLES - 0.5
        gx = (left / SUBSAMPLES - 0.5 - camera[2]) / camera[0]
        gy = (py - camera[3]) / camera[1]
        for j in range(left, right):
            px = (j + 0.5) / SUBSAMPLES - 0.5
            dx, dy, dz, gx, gy = pixel_ray(camera, px, py, gx, gy)
            ox, oy, oz = camera[16], camera[17], camera[18]
            s, patch, mx, my, mz = first_hit(specimen, ox, oy, oz, dx, dy, dz, 0.0)
            travelled, factor = s, 1.0
            if patch >= 0 and specimen.patches[patch, 19] > 0.0:
                factor = specimen.patches[patch, 19]
                nx, ny, nz = surface_normal(specimen, patch, mx, my, mz)
                ox, oy, oz = ox + s * dx, oy + s * dy, oz + s * dz
                along = 2.0 * (nx * dx + ny * dy + nz * dz)
                dx, dy, dz = dx - along * nx, dy - along * ny, dz - along * nz
                s, patch, mx, my, mz = first_hit(specimen, ox, oy, oz, dx, dy, dz, TOUCHING_MM)
                travelled += s
            if patch < 0 or specimen.patches[patch, 19] > 0.0:
                continue
            wx, wy, wz = ox + s * dx, oy + s * dy, oz + s * dz
            nx, ny, nz = surface_normal(specimen, patch, mx, my, mz)
            towards = -(nx * dx + ny * dy + nz * dz)
            if prints.ink[0] == SPECIMEN:
                a, b = patch_coordinates(specimen.patches[patch], mx, my, mz)
                shift_a, shift_b = specimen.patches[patch, 23], specimen.patches[patch, 24]
                footprint = travelled / (camera[0] * SUBSAMPLES * np.sqrt(max(abs(towards), 0.01)))
                white = factor * reflectance(prints.speckle, a + shift_a, b + shift_b, footprint)
            elif prints.ink[0] == PLAIN or towards <= 0.0:  # nothing is printed on the back of a board
                white = prints.ink[1]
            else:
                sides = footprint_sides(camera, specimen, patch, s, dx, dy, dz, nx, ny, nz)
                a, b = patch_coordinates(specimen.patches[patch], mx, my, mz)
                white = printed_reflectance(prints.ink, a, b, *sides)
            if towards < 0.0:  # the side that is seen is the side that is lit
                nx, ny, nz = -nx, -ny, -nz
            ambient[i, j] = white
            for n in range(sources.shape[0]):
                source, distance = sources[n], distances[n]
                if source.shape[0] == LAMP:
                    strength[n, 0, i, j] = white * lamp_light(source, distance, wx, wy, wz, nx, ny, nz)
                    continue
                xp, yp, lit = direct_light(source, specimen, distance, wx, wy, wz, nx, ny, nz)
                x[n, 0, i, j], y[n, 0, i, j], strength[n, 0, i, j] = xp, yp, white * lit
                if x.shape[1] == 2:
                    xp, yp, lit = mirrored_light(source, specimen, distance, wx, wy, wz, nx, ny, nz)
                    x[n, 1, i, j], y[n, 1, i, j], strength[n, 1, i, j] = xp, yp, white * lit


@inner
@uncounted_kernel
def footprint_sides(
    camera: Floats,
    specimen: Specimen,
    patch: int,
    s: float,
    dx: float,
    dy: float,
    dz: float,
    nx: float,
    ny: float,
    nz: float,
) -> tuple[float, float, float, float]:
    """Return the sides of a sub-sample's square as seen on a plane or cylinder, s along its ray d, normal n.

    d(a)/dx, d(a)/dy, d(b)/dx and d(b)/dy in mm for a step of one sub-sample; lens distortion, which
    stretches a sub-sample by less than a hundredth, is left out.
    """
    depth = s * (camera[10] * dx + camera[11] * dy + camera[12] * dz)
    facing = nx * dx + ny * dy + nz * dz
    sides = (0.0, 0.0, 0.0, 0.0)
    row = specimen.patches[patch]
    for axis in range(2):
        scale = depth / (camera[axis] * SUBSAMPLES)
        ex, ey, ez = camera[4 + 3 * axis], camera[5 + 3 * axis], camera[6 + 3 * axis]
        along = (nx * ex + ny * ey + nz * ez) / facing
        mx, my, mz, vx, vy, vz, _ = followed_back(
            specimen.chain,
            camera[16] + s * dx,
            camera[17] + s * dy,
            camera[18] + s * dz,
            scale * (ex - along * dx),
            scale * (ey - along * dy),
            scale * (ez - along * dz),
        )
        b = row[7] * vx + row[8] * vy + row[9] * vz
        if row[0] == CYLINDER:
            ux, uy, uz = patch_normal(row, mx, my, mz)
            a = (row[8] * uz - row[9] * uy) * vx + (row[9] * ux - row[7] * uz) * vy
            a += (row[7] * uy - row[8] * ux) * vz
        else:
            a = row[4] * vx + row[5] * vy + row[6] * vz
        sides = (a, sides[1], b, sides[3]) if axis == 0 else (sides[0], a, sides[2], b)
    return sides


@inner
@uncounted_kernel
def direct_light(
    projector: Floats,
    specimen: Specimen,
    distance: float,
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
) -> tuple[float, float, float]:
    """Return the projector pixel that lights a point of the specimen, and how strongly.

    Lambert's cosine times the inverse square of the distance, 1 at `distance` mm and facing; 0 in shadow,
    outside the projector's image or from behind.
    """
    ox, oy, oz = projector[16], projector[17], projector[18]
    dx, dy, dz, length = unit_to(x, y, z, ox, oy, oz)
    cosine = nx * dx + ny * dy + nz * dz
    if cosine <= 0.0:
        return 0.0, 0.0, 0.0
    px, py = image_point(projector, x, y, z)
    if not in_image(projector, px, py) or not unobstructed(specimen, ox, oy, oz, x, y, z):
        return 0.0, 0.0, 0.0
    return px, py, cosine * distance * distance / (length * length)


@inner
@uncounted_kernel
def lamp_light(
    lamp: Floats,
    distance: float,
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
) -> float:
    """Return how strongly a lamp lights a point, as `direct_light` does; it casts no shadows."""
    dx, dy, dz, length = unit_to(x, y, z, lamp[0], lamp[1], lamp[2])
    cosine = nx * dx + ny * dy + nz * dz
    return float(max(cosine, 0.0) * distance * distance / (length * length))


@inner
@uncounted_kernel
def mirrored_light(
    projector: Floats,
    specimen: Specimen,
    distance: float,
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
) -> tuple[float, float, float]:
    """Return the projector pixel that lights a point by way of a flat mirror, and how strongly.

    The light comes as if from the projector's image behind the mirror.
    """
    for i in range(specimen.patches.shape[0]):
        patch = specimen.patches[i]
        if patch[19] == 0.0:
            continue
        qx, qy, qz, _, _, _ = carried(specimen.chain, patch[1], patch[2], patch[3], 0.0, 0.0, 0.0)
        rx, ry, rz = surface_normal(specimen, i, patch[1], patch[2], patch[3])
        ox, oy, oz = projector[16], projector[17], projector[18]
        behind = 2.0 * ((ox - qx) * rx + (oy - qy) * ry + (oz - qz) * rz)
        dx, dy, dz, length = unit_to(x, y, z, ox - behind * rx, oy - behind * ry, oz - behind * rz)
        cosine = nx * dx + ny * dy + nz * dz
        if cosine <= 0.0:
            continue
        s, met, _, _, _ = first_hit(specimen, x, y, z, dx, dy, dz, TOUCHING_MM)
        if met != i:
            continue
        mx, my, mz = x + s * dx, y + s * dy, z + s * dz
        px, py = image_point(projector, mx, my, mz)
        if in_image(projector, px, py) and unobstructed(specimen, ox, oy, oz, mx, my, mz):
            return px, py, patch[19] * cosine * distance * distance / (length * length)
    return 0.0, 0.0, 0.0
