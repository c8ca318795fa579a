"""Which test finds the edges of a surface, and only these: distance, gradient or gap (section 4.2.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi

import numpy as np
from scipy import ndimage

from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.images.segmentation import EdgeSettings, find_discontinuities, pixel_footprint
from sms_jobs.records.scene import PlateWithHoleAndStep, Simulation
from sms_jobs.virtual_rig.campaigns import Made, hole_and_step_translation, top_hat_bending
from sms_jobs.virtual_rig.light import sensor_named
from sms_jobs.virtual_rig.truth import exact_shape

WAYS = {
    "gap": EdgeSettings(),
    "distance, 80": EdgeSettings("distance"),
    "gradient, 80": EdgeSettings("gradient"),
    "distance, 60": EdgeSettings("distance", maximum_slope_rad=pi / 3),
    "gradient, 60": EdgeSettings("gradient", maximum_slope_rad=pi / 3),
    "gradient, 45": EdgeSettings("gradient", maximum_slope_rad=pi / 4),
}
"""The tests by the steepest surface, in degrees, that is continuous."""
STEPS = (2.0, 4.0, 8.0, 25.0)  # footprints
NOISES = (0.0, 0.1, 0.3, 0.6)  # footprints
_BESIDE = 3  # px from a true edge or the end of what is seen, within which nothing that is marked is false
_STEEP_RAD = np.radians(60.0)
_THREADS = 2


@dataclass(frozen=True)
class Edges:
    """A surface whose edges are known.

    Attributes
    ----------
    xyz, ray
        (3, rows, columns), positions in mm, NaN where nothing is seen, and unit vectors from the camera.
    footprint
        (rows, columns), of pixels, in mm.
    across, down
        (rows, columns), which pixels have an edge between them and their neighbour on the right, and below.
    steep
        (rows, columns), where the surface is too steep to be measured.
    """

    xyz: Floats
    ray: Floats
    footprint: Floats
    across: Mask
    down: Mask
    steep: Mask

    def judged(self, settings: EdgeSettings, noise: float, seed: int) -> tuple[float, float]:
        """Return the part of the pairs across an edge of which one is marked, and that of others that are.

        `noise` is that of positions along the rays, in footprints, independent from pixel to pixel.
        """
        sigma = noise * np.nan_to_num(self.footprint)
        drawn = np.random.default_rng(seed).standard_normal(sigma.shape)
        xyz = self.xyz + sigma * drawn * self.ray
        seen: Mask = np.asarray(np.isfinite(xyz).all(axis=0))
        marked = find_discontinuities(xyz, seen, sigma, self.footprint, edges=settings, threads=_THREADS)
        found = np.concatenate(
            [
                (marked[:, :-1] | marked[:, 1:])[self.across[:, :-1]],
                (marked[:-1] | marked[1:])[self.down[:-1]],
            ]
        )
        beside = self.across | self.down | self.steep
        far = seen & (ndimage.distance_transform_cdt(seen & ~beside, "chessboard") > _BESIDE)
        return float(found.mean()), float(marked[far].mean())


def edges_of(made: Made, faces: tuple[int, int]) -> Edges:
    """Return what the first camera of a campaign sees at rest.

    An edge is where it sees one of two faces past the other; `faces` are their numbers.
    """
    scene = made[1].scene
    assert scene is not None
    simulation = Simulation(scene, "C1", "P1", ())
    shape, camera = exact_shape(simulation, threads=_THREADS), sensor_named(simulation, "C1")
    towards = shape.xyz - camera.pose.centre()[:, None, None]
    ray = towards / np.linalg.norm(towards, axis=0)
    across, down = np.zeros_like(shape.seen), np.zeros_like(shape.seen)
    near, far = (shape.seen & (shape.region == number) for number in faces)
    for mask, first, second in ((across, np.s_[:, :-1], np.s_[:, 1:]), (down, np.s_[:-1, :], np.s_[1:, :])):
        mask[first] = (near[first] & far[second]) | (far[first] & near[second])
    cosine = -np.sum(shape.normal * ray, axis=0)
    with np.errstate(invalid="ignore"):
        steep = shape.seen & (cosine < np.cos(_STEEP_RAD))
    footprint = pixel_footprint(shape.xyz, camera.intrinsics, camera.pose)
    return Edges(shape.xyz, ray, footprint, across, down, steep)


def stepped(footprints: float) -> Edges:
    """Return the plate of thesis section 4.6, with a step of so many footprints of a pixel."""
    calibration, campaign = hole_and_step_translation("plate", "small")
    scene = campaign.scene
    assert scene is not None
    assert isinstance(scene.surface, PlateWithHoleAndStep)
    intrinsics = scene.rig.sensor("C1").intrinsics
    height = footprints * 2700.0 / intrinsics.fx
    surface = replace(scene.surface, step_height_mm=height)
    return edges_of((calibration, replace(campaign, scene=replace(scene, surface=surface))), (1, 2))


def top_hat() -> Edges:
    """Return the top hat, of which a side is hidden behind the top; folds are no edges."""
    return edges_of(top_hat_bending("hat", "small"), (3, 5))


def run(say: Callable[[str], None]) -> Outcome:
    """Judge every test on a plate with steps of several heights and on a top hat, with noise."""
    surfaces = {f"step of {step:g}": stepped(step) for step in STEPS} | {"top hat": top_hat()}
    rows: list[tuple[Cell, ...]] = []
    for name, edges in surfaces.items():
        say(name)
        for noise in NOISES:
            values = [
                value
                for settings in WAYS.values()
                for found, false in [edges.judged(settings, noise, len(rows))]
                for value in (found, 1e3 * false)
            ]
            rows.append((name, noise, *values))
    figure = new_figure(9.5, 4.2)
    for k, (axes, label) in enumerate(
        zip(figure.subplots(1, 2), ("edges found", "false edges, per thousand px"), strict=True)
    ):
        for number, way in enumerate(WAYS):
            of_way = [float(row[2 + 2 * number + k] or 0.0) for row in rows if row[1] == NOISES[1]]
            axes.plot(list(surfaces), of_way, "o-", markersize=3, label=way)
        axes.set_ylabel(label)
        axes.tick_params(axis="x", labelsize="x-small")
        axes.set_title(f"noise of {NOISES[1]:g} footprints", fontsize="small")
    figure.axes[0].legend(fontsize="x-small")
    columns = (
        "surface", "noise, footprints",
        *(f"{way}: {what}" for way in WAYS for what in ("found", "false, per thousand")),
    )  # fmt: skip
    remarks = {
        "conditions": "exact shape of the virtual rig's plate (tilted by 10 degrees, a hole, steps of so "
        "many footprints of a pixel) and top hat (sides of 63 degrees, seen from one side), one camera of "
        "512 px; Gaussian noise of positions along the rays, independent from pixel to pixel, known; p = 2",
        "found": "part of the pairs of neighbours across an edge of which one is marked",
        "false": f"marked, of the pixels more than {_BESIDE} px from an edge, from a face steeper than "
        "60 degrees and from where nothing is seen",
        "thesis": "section 4.2.2: distance is highly sensitive to noise and misses sharp edges that are "
        "lower than its limit; the gradient is more robust",
    }
    return Outcome(Table(columns, rows, remarks), figure)


STUDY = Study(
    "discontinuities", "edges found and false edges by distance, gradient and gap (section 4.2.2)", run
)
