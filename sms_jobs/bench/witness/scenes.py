"""Specimens of the virtual rig as painted meshes for renderers that are not ours, and what is true of them.

A sheet is a mesh over the coordinates (a, b) of a patch, in which its paint is an image. The truth is that of
the mesh: a renderer tells which place in it the ray through a pixel's centre meets, and displacement and
strain follow from where its nodes are. Nothing of the virtual rig's own rays, light or truth is in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.compilation import kernel
from sms_jobs.records.scene import Deformation, Scene
from sms_jobs.records.sensors import Sensor
from sms_jobs.virtual_rig.deformations import carried_points, packed_chain
from sms_jobs.virtual_rig.speckle import packed_speckle, reflectance
from sms_jobs.virtual_rig.surfaces import CYLINDER, Cutout, Patch, patches_of

Motions: TypeAlias = tuple[Deformation, ...]


@dataclass(frozen=True)
class Sheet:
    """A patch of a specimen as a mesh.

    Attributes
    ----------
    a, b
        (m,) and (n,), material coordinates of the nodes in mm, evenly spaced.
    rest
        (m, n, 3), the nodes in the specimen's frame at rest, mm.
    kept
        (m - 1, n - 1), which cells have material.
    paint
        (rows, columns), reflectance: b along the rows, a along the columns, from edge to edge of the sheet.
    """

    a: Floats
    b: Floats
    rest: Floats
    kept: Mask
    paint: Floats

    def placed(self, scene: Scene, motions: Motions) -> Floats:
        """Return where the nodes are in the world, (m, n, 3), after some motions, mm."""
        chain = packed_chain(motions, scene.placement)
        return carried_points(chain, self.rest.reshape(-1, 3)).reshape(self.rest.shape)


@dataclass(frozen=True)
class MeshTruth:
    """What is true of each pixel, (3, rows, columns); NaN where its ray meets no sheet.

    Attributes
    ----------
    position, displacement
        Of the reference state and of another, in the world, mm.
    strain
        xx, yy and xy of Green and Lagrange's strain in the tangent plane, x along the coordinate a and z
        outwards.
    """

    position: Floats
    displacement: Floats
    strain: Floats


def sheets_of(scene: Scene, spacing_mm: float, texel_mm: float) -> tuple[Sheet, ...]:
    """Return the patches of a scene's specimen as meshes.

    Parameters
    ----------
    scene
        With a specimen of plane and cylindrical patches, with speckle or without.
    spacing_mm
        Of the nodes, at most.
    texel_mm
        Side of the squares of the paint's image, at most.
    """
    pattern = packed_speckle(scene.speckle)
    found = []
    for patch in patches_of(scene.surface):
        a, b = (_spread(limits, spacing_mm) for limits in (patch.a_range, patch.b_range))
        columns, rows = (ceil(np.ptp(limits) / texel_mm) for limits in (patch.a_range, patch.b_range))
        paint = np.empty((rows, columns))
        # The print goes on from patch to patch.
        start = (patch.a_range[0] + patch.speckle_shift[0], patch.b_range[0] + patch.speckle_shift[1])
        _fill_paint(pattern, start, (float(np.ptp(patch.a_range)), float(np.ptp(patch.b_range))), paint)
        found.append(Sheet(a, b, _at_rest(patch, a, b), _kept(patch.cutouts, a, b), paint))
    return tuple(found)


def mesh_truth(
    scene: Scene,
    sheets: Sequence[Sheet],
    motions: tuple[Motions, Motions],
    number: NDArray[np.integer],
    place: Floats,
) -> MeshTruth:
    """Return what is true between two states of what the pixels' rays meet.

    Parameters
    ----------
    scene, sheets
        What stands before the camera.
    motions
        What had been done to it in the reference state, and in the other.
    number
        (rows, columns), which sheet each ray meets, from 0; -1 for none.
    place
        (2, rows, columns), where in it: 0 .. 1 along a and b.
    """
    fields = np.full((9, *number.shape), np.nan)
    for index, sheet in enumerate(sheets):
        before, after = (sheet.placed(scene, each) for each in motions)
        of_nodes = np.concatenate([before, after - before, _strain(sheet, before, after)], axis=-1)
        at = RegularGridInterpolator((sheet.a, sheet.b), of_nodes)
        here = number == index
        u, v = place[:, here].astype(np.float64)
        points = np.stack([_between(sheet.a, u), _between(sheet.b, v)], axis=1)
        fields[:, here] = at(points).T
    return MeshTruth(fields[:3], fields[3:6], fields[6:])


def told_sensor(sensor: Sensor) -> dict[str, Any]:
    """Return a sensor's parameters as OpenCV names them, for a file."""
    lens = sensor.intrinsics
    return {
        "columns": sensor.columns,
        "rows": sensor.rows,
        "matrix": lens.matrix().tolist(),
        "distortion": [getattr(lens, name) for name in ("k1", "k2", "p1", "p2", "k3")],
        "rotation": sensor.pose.matrix().tolist(),
        "translation": list(sensor.pose.translation),
    }


def _spread(limits: tuple[float, float], spacing_mm: float) -> Floats:
    # An even number of cells: two of them are an element with nodes in the middle of its sides.
    cells = 2 * ceil((limits[1] - limits[0]) / spacing_mm / 2.0)
    return np.linspace(*limits, cells + 1)


def _between(nodes: Floats, part: Floats) -> Floats:
    return np.asarray(np.clip(nodes[0] + part * (nodes[-1] - nodes[0]), nodes[0], nodes[-1]))


def _at_rest(patch: Patch, a: Floats, b: Floats) -> Floats:
    """Return the material points of a patch's coordinates, (m, n, 3)."""
    origin, along_a, along_b = (np.array(v) for v in (patch.origin, patch.along_a, patch.along_b))
    if patch.kind == CYLINDER:
        outwards, radius = np.cross(along_a, along_b), patch.radius
        turn = (a / radius)[:, None]
        across = radius * (np.sin(turn) * along_a + np.cos(turn) * outwards)
    else:
        across = a[:, None] * along_a
    return np.asarray(origin + across[:, None] + (b[:, None] * along_b)[None])


def _kept(cutouts: Sequence[Cutout], a: Floats, b: Floats) -> Mask:
    """Return which cells have material in their middle, (m - 1, n - 1)."""
    x, y = np.meshgrid(0.5 * (a[1:] + a[:-1]), 0.5 * (b[1:] + b[:-1]), indexing="ij")
    kept = np.ones(x.shape, np.bool_)
    for cut in cutouts:
        if cut.half_b == 0.0:
            kept &= np.hypot(x - cut.a, y - cut.b) >= cut.half_a
        else:
            kept &= (np.abs(x - cut.a) >= cut.half_a) | (np.abs(y - cut.b) >= cut.half_b)
    return kept


def _strain(sheet: Sheet, before: Floats, after: Floats) -> Floats:
    """Return xx, yy and xy of Green and Lagrange's strain at the nodes, (m, n, 3)."""

    def metric(place: Floats) -> Floats:
        along_a = np.gradient(place, sheet.a, axis=0, edge_order=2)
        along_b = np.gradient(place, sheet.b, axis=1, edge_order=2)
        pairs = ((along_a, along_a), (along_b, along_b), (along_a, along_b))
        return np.stack([np.sum(p * q, axis=-1) for p, q in pairs], axis=-1)

    return np.asarray(0.5 * (metric(after) - metric(before)))


@kernel
def _fill_paint(pattern: Floats, start: tuple[float, float], size: tuple[float, float], out: Floats) -> None:
    """Fill an image with the reflectance of a rectangle of print, from its corner on."""
    rows, columns = out.shape
    along, down = size[0] / columns, size[1] / rows
    for r in range(rows):
        for c in range(columns):
            a, b = start[0] + (c + 0.5) * along, start[1] + (r + 0.5) * down
            out[r, c] = reflectance(pattern, a, b, 0.5 * (along + down))
