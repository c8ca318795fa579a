"""The buckling panel's seven loads, with bolts, sensors, a tie rod and its shadows (thesis section 6.3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.bench.compared_fields import components, rms
from sms_jobs.bench.published import Judged
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.kinds.deformation import correlate
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.records.fields import DisplacementField
from sms_jobs.records.scene import StiffenedPanel
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import state_by_state
from sms_jobs.virtual_rig.campaigns import PIXELS, Size
from sms_jobs.virtual_rig.truth import Truth
from sms_jobs.virtual_rig.wing_campaigns import buckling_panel

_THREADS = 2
_SKIN, _FEET, _WEB = (1,), (2, 3), (4,)
_FOOT_AT = {"+y": 2, "-y": 3}
_STRIP_MM = 12.0  # of the foot, from its edge inwards
_OFF_MM = 3.0  # from the edge, where a pixel may see both
_MIDDLE_MM = 20.0  # of the stringer's length, each way
_CHAIN = [(correlate.KIND, correlate.KIND.parameters())]
_COLUMNS = (
    "state", "load, kN",
    "foot at +y, out of plane, mm: exact", "+y: measured, mm", "+y: z",
    "foot at -y, out of plane, mm: exact", "-y: measured, mm", "-y: z",
    "skin: exact, mm", "skin: measured, mm", "skin: z",
    "skin: rms error, mm", "foot: rms error, mm", "web: rms error, mm",
    "web: found", "regions", "valid without truth",
)  # fmt: skip


def exact_regions(truth: Truth, smallest_px: int) -> int:
    """Return how many connected pieces of one patch are seen and lit, of at least so many pixels."""
    usable = truth.shape.seen & truth.shape.lit
    pieces = 0
    for number in np.unique(truth.shape.region[usable]):
        labels, _ = ndimage.label(usable & (truth.shape.region == number), np.ones((3, 3)))
        pieces += int(np.count_nonzero(np.bincount(labels.ravel())[1:] >= smallest_px))
    return pieces


def places(truth: Truth, panel: StiffenedPanel) -> dict[str, Mask]:
    """Return the pixels of the foot's edges at +y and -y, and of the skin beside them, in the middle."""
    x, y, _ = truth.shape.material
    edge, region = 0.5 * panel.foot_width_mm, truth.shape.region
    with np.errstate(invalid="ignore"):
        middle = np.abs(x) < _MIDDLE_MM
        inside = (np.abs(y) < edge - _OFF_MM) & (np.abs(y) > edge - _STRIP_MM)
        beyond = (np.abs(y) > edge + _OFF_MM) & (np.abs(y) < edge + _STRIP_MM)
    found = {side: middle & inside & (region == number) for side, number in _FOOT_AT.items()}
    return found | {"skin": middle & beyond & (region == _SKIN[0])}


def run_at(size: Size, say: Callable[[str], None], labels: Sequence[str] = ()) -> Outcome:
    """Measure the loads, all if none are named, and compare what comes out of the plane with the truth."""
    calibration, campaign = buckling_panel("buckling", size)
    scene = campaign.scene
    assert scene is not None
    assert isinstance(scene.surface, StiffenedPanel)
    normal = scene.placement.matrix()[:, 2]
    rows: list[tuple[Cell, ...]] = []
    maps: dict[str, Floats] = {}
    regions: NDArray[np.int32] | None = None
    count = expected = 0
    for state, shelf in state_by_state(calibration, campaign, say, _THREADS, _CHAIN, labels):
        subject = Subject(campaign.name, state.label, campaign.views[0])
        truth, found = shelf.truth(subject), shelf.records["correlate", subject]
        field: DisplacementField = found["displacement"]
        out = components(field, truth, normal)
        means = [out.mean(where) for where in places(truth, scene.surface).values()]
        usable = truth.shape.lit & truth.lit_and_seen_at_end
        length = np.linalg.norm(field.displacement - truth.displacement, axis=0)
        errors = [
            rms(length[usable & np.isin(truth.shape.region, numbers) & (field.reason == 0)])
            for numbers in (_SKIN, _FEET, _WEB)
        ]
        web = usable & np.isin(truth.shape.region, _WEB)
        count, expected = len(found["regions"].regions), exact_regions(truth, _smallest())
        load = (state.load_n or 0.0) / 1000.0
        rows.append(
            (
                state.label, load,
                *(v for one in means for v in (one.exact, one.measured, one.z)),
                *errors, float((web & (field.reason == 0)).sum() / web.sum()), count,
                int(np.count_nonzero((field.reason == 0) & ~np.isfinite(truth.displacement[0]))),
            )
        )  # fmt: skip
        maps[f"{load:g} kN"] = out.measured
        regions = found["regions"].labels
    assert regions is not None
    remarks = {
        "conditions": "virtual rig, a skin of 290 mm with a stringer along the load (foot 80 x 5 mm, web "
        "30 x 8 mm), four bolts, four sensors and a tie rod across, whose shadow falls on skin, foot and "
        f"web; camera of {PIXELS[size]} px and one projector, 12 bit, default parameters; out of plane is "
        f"the mean over {2 * _MIDDLE_MM:g} mm in the middle, from {_OFF_MM:g} to {_STRIP_MM:g} mm off the "
        "foot's edge",
        "z": "error of the mean over what is stated of it, if values within a subset are one value",
        "regions": f"of the measured view, and {expected} pieces of surface that are seen and lit in truth",
        "thesis": "Fig. 89: the stringer buckles before the skin, most on one side; Fig. 86: 19 regions "
        "of its own panel. Its displacements are pictures only",
    }
    judged = (Judged("buckling-regions", float(count), float(expected)),)
    return Outcome(Table(_COLUMNS, rows, remarks), _picture(maps, regions), judged)


def _smallest() -> int:
    """Return the least area of a region in px."""
    return int(correlate.KIND.parameters().minimum_region_area_px)


def _picture(maps: dict[str, Floats], regions: NDArray[np.int32]) -> Any:
    """Draw the labels of the regions, and what comes out of the plane at every load."""
    figure = new_figure(12.0, 6.0)
    grid = figure.subplots(2, 4).ravel()
    grid[0].imshow(np.where(regions > 0, regions, np.nan), cmap="tab20", interpolation="none")
    grid[0].set_title("regions", fontsize="medium")
    top = max(float(np.nanmax(one)) for one in maps.values())
    for axes, (name, one) in zip(grid[1:], maps.items(), strict=False):
        drawn = axes.imshow(one, vmin=0.0, vmax=top, interpolation="none")
        axes.set_title(name, fontsize="medium")
    figure.colorbar(drawn, ax=list(grid), label="out of plane [mm]")
    for axes in grid:
        axes.set_axis_off()
    return figure


STUDY = Study(
    "buckling-panel",
    "the buckling panel's seven loads, bolts, tie rod and shadows (section 6.3, Fig. 86-89)",
    lambda say: run_at("small", say),
    lambda say: run_at("full", say),
)
