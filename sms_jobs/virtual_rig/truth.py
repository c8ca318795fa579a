"""What is exactly true of a simulated measurement: shape, displacement and strain at every camera pixel.

A value belongs to the ray through the pixel's centre. Nothing here is rendered or measured: positions are
exact to rounding and strains follow from the exact gradient of the deformation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.compilation import in_row_blocks, inner, uncounted_kernel
from sms_jobs.records.scene import Simulation, Vector
from sms_jobs.virtual_rig.deformations import carried_points, gradients
from sms_jobs.virtual_rig.light import direct_light, sensor_named
from sms_jobs.virtual_rig.optics import image_point, in_image, packed_sensor, pixel_ray
from sms_jobs.virtual_rig.rays import Specimen, first_hit, specimen_in, surface_normal, unobstructed


@dataclass(frozen=True)
class Shape:
    """The exact shape that a camera sees; NaN where a pixel's ray meets nothing that scatters light.

    Attributes
    ----------
    xyz
        (3, rows, columns), position in the world, mm.
    normal
        (3, rows, columns), unit normal in the world, towards the camera.
    material
        (3, rows, columns), the material point in the specimen's frame at rest, mm.
    region
        (rows, columns), number of the patch that the ray meets first, from 1; 0 for none.
    seen
        (rows, columns), whether that patch scatters light: a mirror has no shape that could be measured.
    lit
        (rows, columns), whether it can be measured there: whether the light that it scatters comes straight
        from the projector, or further cameras see it too.
    """

    xyz: Floats
    normal: Floats
    material: Floats
    region: NDArray[np.int32]
    seen: Mask
    lit: Mask


@dataclass(frozen=True)
class Truth:
    """What happens between a reference state and another to the material seen in the reference.

    Attributes
    ----------
    shape
        Of the reference.
    displacement
        (3, rows, columns), in the world, mm.
    green_lagrange, small
        (3, rows, columns), xx, yy and xy of the strain in the tangent plane of the reference surface, x
        along an axis; NaN where that axis is normal to the surface.
    lit_and_seen_at_end
        (rows, columns), whether the material point is still in the camera's image, in its free sight,
        and lit by the projector, or seen by further cameras.
    """

    shape: Shape
    displacement: Floats
    green_lagrange: Floats
    small: Floats
    lit_and_seen_at_end: Mask

    def strain(self, measure: str) -> Floats:
        """Return the strain of a measure, `green-lagrange` or `small`."""
        return self.green_lagrange if measure == "green-lagrange" else self.small


def exact_shape(
    simulation: Simulation, partners: tuple[str, ...] | None = None, *, threads: int = 1
) -> Shape:
    """Return the exact shape behind a simulated measurement.

    Parameters
    ----------
    simulation
        What the reference camera recorded.
    partners
        Names of the sensors that it measures together with, which are those of its view: a projector,
        further cameras, or none; by default the projector of the simulation, if it has one.
    threads
        How many threads to use; the result does not depend on it.
    """
    camera = packed_sensor(sensor_named(simulation, simulation.camera))
    sights = _packed_partners(simulation, partners)
    specimen = specimen_in(simulation.scene, simulation.deformation)
    rows, columns = int(camera[20]), int(camera[19])
    points, region = np.full((9, rows, columns), np.nan), np.zeros((rows, columns), np.int32)
    lit = np.zeros((rows, columns), np.bool_)

    def work(start: int, stop: int) -> None:
        _see_rows(camera, sights, specimen, start, stop, points, region, lit)

    in_row_blocks(work, rows, threads)
    return Shape(points[:3], points[3:6], points[6:], region, np.isfinite(points[0]), lit)


def exact_truth(
    reference: Simulation,
    state: Simulation,
    partners: tuple[str, ...] | None = None,
    *,
    x_axis: Vector | None = None,
    threads: int = 1,
) -> Truth:
    """Return what truly happens, between two simulated measurements, to what the first one sees.

    `partners` are those of `exact_shape`; `x_axis` is the vector in the world whose projection onto the
    surface is the strain's x, the specimen's if it is None.

    Raises
    ------
    InvalidInput
        When the two are not of one scene and camera.
    """
    if reference.camera != state.camera or reference.scene != state.scene:
        raise InvalidInput(
            f"states {reference.state} seen by {reference.camera} and {state.state} seen by {state.camera} "
            "have no common truth; choose two states of one campaign and one camera"
        )
    shape = exact_shape(reference, partners, threads=threads)
    seen = shape.seen
    material = np.ascontiguousarray(shape.material[:, seen].T)
    before = specimen_in(reference.scene, reference.deformation)
    after = specimen_in(state.scene, state.deformation)
    ends = carried_points(after.chain, material)
    displacement = np.full_like(shape.xyz, np.nan)
    displacement[:, seen] = (ends - carried_points(before.chain, material)).T
    relative = gradients(after.chain, material) @ np.linalg.inv(gradients(before.chain, material))
    axis = state.scene.placement.matrix()[:, 0] if x_axis is None else np.array(x_axis)
    frame = tangent_frame(np.ascontiguousarray(shape.normal[:, seen].T), axis)
    green, small = np.full_like(shape.xyz, np.nan), np.full_like(shape.xyz, np.nan)
    green[:, seen] = _green_lagrange(relative, frame).T
    small[:, seen] = _small(relative, frame).T
    stays = np.zeros_like(seen)
    normals = np.einsum("nji,nj->ni", np.linalg.inv(relative), shape.normal[:, seen].T)
    stays[seen] = _stay(state, _packed_partners(state, partners), after, ends, normals)
    return Truth(shape, displacement, green, small, stays)


def _packed_partners(simulation: Simulation, partners: tuple[str, ...] | None) -> Floats:
    """Return what a camera measures together with, by `packed_sensor`, (n, 26).

    What a camera sees is what it would light if it were a projector, so that one test serves both.
    """
    if partners is None:
        partners = () if simulation.projector is None else (simulation.projector,)
    packed = [packed_sensor(sensor_named(simulation, name)) for name in partners]
    return np.array(packed).reshape(len(packed), -1) if packed else np.empty((0, 26))


def tangent_frame(normals: Floats, axis: Floats) -> Floats:
    """Return the tangent vectors x and y at surface points, (n, 3, 2).

    Parameters
    ----------
    normals
        (n, 3), unit normals.
    axis
        (3,), a vector in the world; its projection onto the tangent plane is x.
    """
    x = axis - normals * (normals @ axis)[:, None]
    length = np.linalg.norm(x, axis=1, keepdims=True)
    # Below this the projection's direction is rounding.
    x /= np.where(length > 1e-9, length, np.nan)
    return np.stack([x, np.cross(normals, x)], axis=-1)


def _green_lagrange(gradient: Floats, frame: Floats) -> Floats:
    """Return xx, yy, xy of E = (F^T F - I) / 2 in the tangent plane, (n, 3)."""
    stretched = gradient @ frame
    e = 0.5 * (np.swapaxes(stretched, 1, 2) @ stretched - np.eye(2))
    return np.stack([e[:, 0, 0], e[:, 1, 1], e[:, 0, 1]], axis=-1)


def _small(gradient: Floats, frame: Floats) -> Floats:
    """Return xx, yy, xy of the symmetric part of the displacement gradient in the tangent plane, (n, 3)."""
    e = np.swapaxes(frame, 1, 2) @ (gradient - np.eye(3)) @ frame
    return np.stack([e[:, 0, 0], e[:, 1, 1], 0.5 * (e[:, 0, 1] + e[:, 1, 0])], axis=-1)


def _stay(state: Simulation, sights: Floats, specimen: Specimen, ends: Floats, normals: Floats) -> Mask:
    """Tell which points show the camera the side that they showed it before, and its partners too."""
    camera = packed_sensor(sensor_named(state, state.camera))
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    out = np.zeros(len(ends), np.bool_)
    _still_seen(camera, sights, specimen, ends, normals, out)
    return out


@inner
@uncounted_kernel
def _before_all(
    sights: Floats, specimen: Specimen, x: float, y: float, z: float, nx: float, ny: float, nz: float
) -> bool:
    """Tell whether a point faces every partner, in its image and its free sight."""
    for k in range(sights.shape[0]):
        _, _, light = direct_light(sights[k], specimen, 1.0, x, y, z, nx, ny, nz)
        if not light > 0.0:
            return False
    return True


@uncounted_kernel
def _see_rows(
    camera: Floats,
    sights: Floats,
    specimen: Specimen,
    start: int,
    stop: int,
    points: Floats,
    region: NDArray[np.int32],
    lit: Mask,
) -> None:
    ox, oy, oz = camera[16], camera[17], camera[18]
    for i in range(start, stop):
        gx, gy = -camera[2] / camera[0], (i - camera[3]) / camera[1]
        for j in range(region.shape[1]):
            dx, dy, dz, gx, gy = pixel_ray(camera, float(j), float(i), gx, gy)
            s, patch, mx, my, mz = first_hit(specimen, ox, oy, oz, dx, dy, dz, 0.0)
            if patch < 0:
                continue
            region[i, j] = int(specimen.patches[patch, 20])
            if specimen.patches[patch, 19] > 0.0:
                continue
            x, y, z = ox + s * dx, oy + s * dy, oz + s * dz
            nx, ny, nz = surface_normal(specimen, patch, mx, my, mz)
            if nx * dx + ny * dy + nz * dz > 0.0:
                nx, ny, nz = -nx, -ny, -nz
            points[0, i, j], points[1, i, j], points[2, i, j] = x, y, z
            points[3, i, j], points[4, i, j], points[5, i, j] = nx, ny, nz
            points[6, i, j], points[7, i, j], points[8, i, j] = mx, my, mz
            lit[i, j] = _before_all(sights, specimen, x, y, z, nx, ny, nz)


@uncounted_kernel
def _still_seen(
    camera: Floats,
    sights: Floats,
    specimen: Specimen,
    ends: Floats,
    normals: Floats,
    out: Mask,
) -> None:
    ox, oy, oz = camera[16], camera[17], camera[18]
    for i in range(out.shape[0]):
        x, y, z = ends[i, 0], ends[i, 1], ends[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        px, py = image_point(camera, x, y, z)
        if not in_image(camera, px, py) or nx * (ox - x) + ny * (oy - y) + nz * (oz - z) <= 0.0:
            continue
        if unobstructed(specimen, ox, oy, oz, x, y, z):
            out[i] = _before_all(sights, specimen, x, y, z, nx, ny, nz)
