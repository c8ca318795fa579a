"""How near to an edge displacement is right: a translated plate with hole and step (thesis Fig. 48-53)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.records.fields import DisplacementField
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of
from sms_jobs.testing.shelf import Shelf, reconstructed
from sms_jobs.virtual_rig.campaigns import hole_and_step_translation
from sms_jobs.virtual_rig.truth import Truth

RADIUS = 8  # px: the thesis's windows had 16 x 16 px
WIDTH_LIMIT = 0.005  # px of rms error, beyond which an edge is felt: twice what is left far from it
_THREADS = 2
_FARTHEST = 25  # px
_EDGES = ("step", "hole")
WAYS = {
    "regions": CorrelateParameters(subset_radius_px=RADIUS),
    "plain": CorrelateParameters(subset_radius_px=RADIUS, regions="none"),
}


@dataclass(frozen=True)
class Profile:
    """Errors over the distance from an edge, in bins of a pixel from 0 .. 1 px on.

    Attributes
    ----------
    found
        (bins,), part of the pixels that have a displacement.
    image_rms
        (bins,), rms error of (u, v) in px.
    rms_mm
        (bins,), rms error of the displacement in space.
    """

    found: Floats
    image_rms: Floats
    rms_mm: Floats

    def width(self) -> float:
        """Return from how many px on most pixels are found and their rms error is within the limit."""
        felt = np.flatnonzero(~(self.image_rms <= WIDTH_LIMIT) | (self.found < 0.5))
        return float(felt[-1] + 1) if len(felt) else 0.0


def distance_from_edges(truth: Truth) -> dict[str, Floats]:
    """Return, for each edge, the distance in px of the pixels that are nearer to it than to other edges.

    The hole is what is seen of no surface and does not reach the image's border; across the step another
    surface is seen, or its shadow.
    """
    region = np.where(truth.shape.seen, truth.shape.region, 0)
    nothing = ndimage.label(region == 0)[0]
    rim = np.concatenate([nothing[0], nothing[-1], nothing[:, 0], nothing[:, -1]])
    hole = (nothing > 0) & ~np.isin(nothing, rim)
    distance = {name: np.full(region.shape, np.nan) for name in _EDGES}
    usable = truth.shape.seen & truth.shape.lit & truth.lit_and_seen_at_end
    for number in range(1, region.max() + 1):
        own = region == number
        far, (row, column) = ndimage.distance_transform_edt(own, return_indices=True)
        edge = np.where(hole[row, column], 1, np.where(region[row, column] > 0, 0, -1))
        for k, name in enumerate(_EDGES):
            here = own & usable & (edge == k)
            distance[name][here] = far[here] - 0.5
    return distance


def profile(field: DisplacementField, truth: Truth, image_truth: Floats, distance: Floats) -> Profile:
    """Return the errors of a displacement field over the distance (rows, columns) from an edge."""
    image = np.hypot(*(field.image_displacement - image_truth))
    space = np.linalg.norm(field.displacement - truth.displacement, axis=0)
    found, in_image, in_space = (np.full(_FARTHEST, np.nan) for _ in range(3))
    for k in range(_FARTHEST):
        here = (distance >= k) & (distance < k + 1)
        valid = here & (field.reason == 0)
        if here.any():
            found[k] = valid.sum() / here.sum()
        if valid.any():
            in_image[k] = np.sqrt(np.mean(image[valid] ** 2))
            in_space[k] = np.sqrt(np.mean(space[valid] ** 2))
    return Profile(found, in_image, in_space)


def exact_image_displacement(shelf: Shelf, subject: Subject, truth: Truth) -> Floats:
    """Return where each pixel's material point goes in the image, (2, rows, columns) in px."""
    scene = shelf.campaign.scene
    assert scene is not None
    camera = scene.rig.sensor(view_of(subject.view).camera)
    end = truth.shape.xyz + truth.displacement
    rows, columns = end.shape[1:]
    pixels = project(camera.intrinsics, camera.pose, end.reshape(3, -1).T).T.reshape(2, rows, columns)
    return np.asarray(pixels - np.mgrid[0:rows, 0:columns][::-1])


def profiles(
    shelf: Shelf, subject: Subject, ways: Mapping[str, CorrelateParameters]
) -> dict[str, dict[str, Profile]]:
    """Correlate by several ways and return the profiles by edge and way."""
    truth = shelf.truth(subject)
    exact = exact_image_displacement(shelf, subject, truth)
    distance = distance_from_edges(truth)
    found: dict[str, dict[str, Profile]] = {name: {} for name in _EDGES}
    for way, parameters in ways.items():
        shelf.run(correlate.KIND, subject, parameters)
        field = shelf.records["correlate", subject]["displacement"]
        for name in _EDGES:
            found[name][way] = profile(field, truth, exact, distance[name])
    return found


def run(say: Callable[[str], None]) -> Outcome:
    """Translate the plate by 10.16 mm and compare every pixel near the hole and the step with the truth."""
    shelf, subject = reconstructed(*hole_and_step_translation("hole", "full"), say, _THREADS)
    say("correlating with regions and without")
    found = profiles(shelf, subject, WAYS)
    figure = new_figure(9.5, 4.2)
    rows: list[tuple[Cell, ...]] = []
    for axes, name in zip(figure.subplots(1, 2, sharey=True), _EDGES, strict=True):
        for way, one in found[name].items():
            axes.semilogy(np.arange(_FARTHEST) + 0.5, one.image_rms, "o-", markersize=3, label=way)
        axes.set_xlabel(f"distance from the edge of the {name} [px]")
        axes.set_title(
            ", ".join(f"{way}: {one.width():g} px wide" for way, one in found[name].items()), fontsize="small"
        )
        axes.legend(fontsize="small")
        for k in range(_FARTHEST):
            values = [
                float(v[k]) for one in found[name].values() for v in (one.image_rms, one.rms_mm, one.found)
            ]
            rows.append((name, k + 0.5, *values))
    figure.axes[0].set_ylabel("rms error of (u, v) [px]")
    columns = (
        "edge", "distance, px",
        *(f"{way}: {what}" for way in ("regions", "plain") for what in ("rms, px", "rms, mm", "found")),
    )  # fmt: skip
    remarks = {
        "conditions": "virtual rig, one camera of 1024 px and one projector, a tilted plate of 640 mm with a "
        f"hole and a step of 40 mm, translated by 10.16 mm; subset radius {RADIUS} px, points 4 px apart, "
        "texture averaged over the fringe frames; pixels that are seen and lit in both states",
        "edge widths": "; ".join(
            f"{name}, {way}: {one.width():g} px" for name, ways in found.items() for way, one in ways.items()
        )
        + f" (from there on most pixels have a displacement, and its rms error is below {WIDTH_LIMIT} px)",
        "thesis": "section 4.6.2: 1 px with regions, about 20 px without",
    }
    return Outcome(Table(columns, rows, remarks), figure)


STUDY = Study(
    "edges", "error of displacement near a hole and a step, with regions and without (Fig. 48-53)", run
)
