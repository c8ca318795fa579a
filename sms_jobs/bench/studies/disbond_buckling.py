"""A stringer that comes off its skin: displacement on both sides of its edges (thesis section 6.3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.records.fields import DisplacementField
from sms_jobs.records.scene import StiffenedPanel
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf, reconstructed
from sms_jobs.virtual_rig.campaigns import Size
from sms_jobs.virtual_rig.truth import Truth
from sms_jobs.virtual_rig.wing_campaigns import disbond_buckling

WAYS = {"regions": CorrelateParameters(), "plain": CorrelateParameters(regions="none")}
_PARTS = {"skin": (1,), "foot": (2, 3), "web": (4,)}
_STRIP_MM = 6.0  # on each side of an edge
_MIDDLE_MM = 20.0  # of the stringer's length, each way
_THREADS = 2


@dataclass(frozen=True)
class Lift:
    """How far the stringer stands off the skin in the middle, at the foot's edge of positive and negative y.

    Each is the mean displacement along the panel's normal just inside the edge, less that just outside, in
    mm; NaN where nothing is measured.
    """

    positive: float
    negative: float


def out_of_plane(field: Floats, normal: Floats) -> Floats:
    """Return the component of a displacement (3, rows, columns) along a direction (3,), in mm."""
    return np.asarray(np.einsum("i,irc->rc", normal, field))


def lift_of(out: Floats, known: Mask, truth: Truth, panel: StiffenedPanel) -> Lift:
    """Return the lift of the foot off the skin from an out-of-plane displacement."""
    x, y, _ = truth.shape.material
    region, edge = truth.shape.region, 0.5 * panel.foot_width_mm
    middle = known & (np.abs(x) < _MIDDLE_MM)
    found = []
    for sign, foot in ((1.0, 2), (-1.0, 3)):
        off = sign * y - edge
        inside = middle & (region == foot) & (off > -_STRIP_MM)
        outside = middle & (region == 1) & (off > 0.0) & (off < _STRIP_MM)
        both = inside.any() and outside.any()
        found.append(float(out[inside].mean() - out[outside].mean()) if both else float("nan"))
    return Lift(*found)


def part_errors(field: DisplacementField, truth: Truth) -> dict[str, tuple[float, float]]:
    """Return of each part the rms error of displacement in mm, and which of its pixels have one."""
    length = np.linalg.norm(field.displacement - truth.displacement, axis=0)
    usable = truth.shape.lit & truth.lit_and_seen_at_end
    found = {}
    for part, numbers in _PARTS.items():
        own = usable & np.isin(truth.shape.region, numbers)
        valid = own & (field.reason == 0)
        rms = float(np.sqrt(np.mean(length[valid] ** 2))) if valid.any() else float("nan")
        found[part] = (rms, float(valid.sum() / max(own.sum(), 1)))
    return found


def measured(
    shelf: Shelf, subject: Subject, ways: Mapping[str, CorrelateParameters]
) -> dict[str, DisplacementField]:
    """Correlate a state by several ways."""
    found = {}
    for way, parameters in ways.items():
        shelf.run(correlate.KIND, subject, parameters)
        found[way] = shelf.records["correlate", subject]["displacement"]
    return found


def study_at(size: Size, labels: Sequence[str], say: Callable[[str], None]) -> Outcome:
    """Measure some states with regions and without, and compare with the truth."""
    calibration, campaign = disbond_buckling("stringer", size)
    shelf, _ = reconstructed(calibration, campaign, say, _THREADS, labels)
    scene = campaign.scene
    assert scene is not None
    assert isinstance(scene.surface, StiffenedPanel)
    normal = scene.placement.matrix()[:, 2]
    figure = new_figure(4.0 * len(labels), 7.0)
    grid = figure.add_gridspec(2, len(labels))
    rows: list[tuple[Cell, ...]] = []
    for column, state in enumerate(map(campaign.state, labels)):
        subject = Subject(campaign.name, state.label, campaign.views[0])
        say(f"correlating {state.label} with regions and without")
        truth = shelf.truth(subject)
        exact = out_of_plane(truth.displacement, normal)
        fields = measured(shelf, subject, WAYS)
        top, bottom = (figure.add_subplot(grid[row, column]) for row in (0, 1))
        drawn = top.imshow(out_of_plane(fields["regions"].displacement, normal), interpolation="nearest")
        figure.colorbar(drawn, ax=top, label="out of plane [mm]", shrink=0.7)
        top.set_title(f"{state.label}, {(state.load_n or 0.0) / 1000.0:g} kN", fontsize="medium")
        top.set_axis_off()
        _, y, _ = truth.shape.material
        near = truth.shape.lit & (np.abs(truth.shape.material[0]) < 0.5) & (truth.shape.region <= 4)
        bottom.plot(y[near], exact[near], "k.", markersize=1.0, label="exact")
        for way, field in fields.items():
            out = out_of_plane(field.displacement, normal)
            bottom.plot(y[near], out[near], ".", markersize=2.0, label=way)
            valid = field.reason == 0
            true, lift = (lift_of(o, valid, truth, scene.surface) for o in (exact, out))
            errors = part_errors(field, truth)
            rows.append(
                (
                    state.label, (state.load_n or 0.0) / 1000.0, way,
                    true.positive, lift.positive, true.negative, lift.negative,
                    *(1000.0 * errors[p][0] for p in _PARTS), *(errors[p][1] for p in _PARTS),
                )
            )  # fmt: skip
        bottom.set_xlabel("across the stringer [mm]")
        bottom.legend(fontsize="x-small")
    columns = (
        "state", "load, kN", "way", "lift at +y, mm: exact", "measured", "lift at -y, mm: exact", "measured ",
        *(f"{part}: rms, um" for part in _PARTS), *(f"{part}: found" for part in _PARTS),
    )  # fmt: skip
    remarks = {
        "conditions": "virtual rig, skin of 290 mm with a stringer (foot 80 x 5 mm, web 30 x 8 mm), camera "
        "of "
        f"{shelf.truth(subject).shape.region.shape[1]} px and one projector, 12 bit, default parameters; rms "
        "length of the error of displacement over the valid pixels of each part, nothing trimmed; plain is "
        "--regions none",
        "thesis": "Fig. 86-89: 19 regions, displacement up to the stringer's edges and on its web",
    }
    return Outcome(Table(columns, rows, remarks), figure)


def run(say: Callable[[str], None]) -> Outcome:
    """Run the study with a camera of 1024 px: with 512 px, a step of 5 mm passes for a slope of the skin."""
    return study_at("full", ("S02", "S04"), say)


STUDY = Study(
    "disbond-buckling", "a stringer that comes off its skin, with regions and without (Fig. 86-89)", run
)
