"""All states of the bent top hat: its loaded point, and two cameras beside fringes (thesis section 5.4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sms_jobs.bench.compared_fields import Compared, Mean, lengths, rms
from sms_jobs.bench.published import Judged
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.kinds.deformation import correlate
from sms_jobs.metrology.arrays import Mask
from sms_jobs.records.fields import Surface
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf, state_by_state
from sms_jobs.virtual_rig.campaigns import PIXELS, Size, top_hat_before_two_cameras, top_hat_bending
from sms_jobs.virtual_rig.truth import Truth

DEFLECTIONS_MM = tuple(float(n) for n in range(1, 11))
_THREADS = 2
_TOP = 3
_COIN_MM = 10.0  # radius of what pushes
_LOADED_MM = 100.0  # half the width of the top
_STRAIGHT, _CROSSED = ("C1P1", "C2P2"), {"C1": ("C1P1", "C1P2"), "C2": ("C2P2", "C2P1")}
_SHOWN = 5.0  # mm, the state of the thesis's Fig. 61 to 67
_CHAIN = [(correlate.KIND, correlate.KIND.parameters())]
_COLUMNS = (
    "state", "pushed, mm", "exact, mm", "C1P1: error, mm", "C2P2: error, mm", "both: error, mm", "z",
    "two cameras less fringes: good data, mm", "all data, mm", "two cameras less exact: good data, mm",
    "fringes less exact: good data, mm", "good data, part of two cameras",
)  # fmt: skip


@dataclass(frozen=True)
class Point:
    """The loaded point as each of two views has it, and both taken together by their inverse variances."""

    first: Mean
    second: Mean

    @property
    def both(self) -> Mean:
        """The weighted mean."""
        weights = np.array([self.first.sigma, self.second.sigma]) ** -2.0
        part = weights / weights.sum()
        measured, exact = (
            float(part @ [getattr(one, name) for one in (self.first, self.second)])
            for name in ("measured", "exact")
        )
        return Mean(measured, exact, float(weights.sum() ** -0.5))


@dataclass(frozen=True)
class Beside:
    """Two cameras beside fringes, all seen by C1: rms differences of the length of displacement, mm.

    `good` is the loaded part of the top, `everywhere` all that both measure; `stereo` and `fringes` are each
    less the exact one on the good part, `found` is which part of it two cameras measure.
    """

    good: float
    everywhere: float
    stereo: float
    fringes: float
    found: float


def around(truth: Truth, radius_mm: float) -> Mask:
    """Return the pixels that see the top within a distance of its middle."""
    x, y, _ = truth.shape.material
    with np.errstate(invalid="ignore"):
        return np.asarray((truth.shape.region == _TOP) & (np.hypot(x, y) < radius_mm))


def beside(fringes: Compared, stereo: Compared, truth: Truth) -> Beside:
    """Compare what two cameras and fringes measure of one state with the eyes of one camera."""
    good = around(truth, _LOADED_MM)
    apart = stereo.measured - fringes.measured
    measured = good & np.isfinite(stereo.measured)
    return Beside(
        rms(apart[good]),
        rms(apart),
        rms(stereo.error[good]),
        rms(fringes.error[good]),
        float(measured.sum() / good.sum()),
    )


def _points(size: Size, say: Callable[[str], None], pushed: Sequence[float]) -> Iterator[Point]:
    """Yield the loaded point in every state."""
    calibration, campaign = top_hat_bending("hat", size, pushed)
    straight = replace(campaign, views=_STRAIGHT)
    for state, shelf in state_by_state(calibration, straight, say, _THREADS, _CHAIN):
        yield Point(*(_loaded(shelf, Subject(straight.name, state.label, view)) for view in _STRAIGHT))


def _loaded(shelf: Shelf, subject: Subject) -> Mean:
    truth = shelf.truth(subject)
    field = shelf.records["correlate", subject]["displacement"]
    return lengths(field, truth).mean(around(truth, _COIN_MM))


def _compared(size: Size, say: Callable[[str], None], pushed: Sequence[float]) -> Iterator[Beside]:
    """Yield two cameras beside fringes in every state."""
    calibration, campaign = top_hat_before_two_cameras("hat-before-two", size, pushed)
    for state, shelf in state_by_state(calibration, campaign, say, _THREADS, _CHAIN):
        by_view = {view: Subject(campaign.name, state.label, view) for view in campaign.views}
        truth = shelf.truth(by_view["C1P1"])
        fringes, stereo = (
            lengths(shelf.records["correlate", by_view[view]]["displacement"], truth)
            for view in ("C1P1", "C1C2")
        )
        yield beside(fringes, stereo, truth)


@dataclass(frozen=True)
class Pairs:
    """How far the pairs of a camera are apart in one state, mm rms, and the largest displacement, mm."""

    displacement: float
    shape: float
    largest: float
    largest_exact: float


def _pairs(size: Size, say: Callable[[str], None]) -> Pairs:
    """Compare the straight and the crossed pair of each camera at 5 mm."""
    calibration, campaign = top_hat_bending("hat-pairs", size, (_SHOWN,))
    moved, lies, largest, exact = [], [], [], []
    state, shelf = next(state_by_state(calibration, campaign, say, _THREADS, _CHAIN))
    for views in _CROSSED.values():
        ends = [Subject(campaign.name, state.label, view) for view in views]
        truth = shelf.truth(ends[0])
        first, second = (
            lengths(shelf.records["correlate", end]["displacement"], truth).measured for end in ends
        )
        moved.append(first - second)
        largest.append(np.nanmax(first))
        exact.append(
            np.nanmax(np.where(np.isfinite(first), np.linalg.norm(truth.displacement, axis=0), np.nan))
        )
        surfaces: list[Surface] = [
            shelf.records["reconstruct", replace(end, state=campaign.reference.label)]["surface"]
            for end in ends
        ]
        lies.append(np.linalg.norm(surfaces[0].position - surfaces[1].position, axis=0))
    return Pairs(
        rms(np.concatenate([m.ravel() for m in moved])),
        rms(np.concatenate([one.ravel() for one in lies])),
        float(max(largest)),
        float(max(exact)),
    )


def run_at(size: Size, say: Callable[[str], None], pushed: Sequence[float] = DEFLECTIONS_MM) -> Outcome:
    """Measure the loaded point by two views, two cameras beside fringes, and the pairs at 5 mm."""
    points, compared = list(_points(size, say, pushed)), list(_compared(size, say, pushed))
    pairs = _pairs(size, say)
    rows: list[tuple[Cell, ...]] = []
    for number, (deflection, point, other) in enumerate(zip(pushed, points, compared, strict=True), start=1):
        both = point.both
        rows.append(
            (
                f"S{number:02d}", deflection, both.exact, point.first.error, point.second.error, both.error,
                both.z, other.good, other.everywhere, other.stereo, other.fringes, other.found,
            )
        )  # fmt: skip
    errors = np.abs([point.both.error for point in points])
    judged = (
        Judged("hat-maximum", pairs.largest, pairs.largest_exact),
        Judged("hat-pairs", pairs.displacement),
        Judged("hat-pairs-shape", pairs.shape),
        Judged("hat-point-least", float(errors.min())),
        Judged("hat-point-largest", float(errors.max())),
        Judged("hat-point-rms", rms(errors)),
        Judged("hat-point-apart", rms(np.array([p.first.error - p.second.error for p in points]))),
        Judged("hat-stereo-first", compared[0].good),
        Judged("hat-stereo-last", compared[-1].good),
    )
    figure = new_figure(9.0, 4.0)
    left, right = figure.subplots(1, 2)
    for name, found in (
        ("C1P1", [p.first for p in points]),
        ("C2P2", [p.second for p in points]),
        ("both", [p.both for p in points]),
    ):
        left.plot(pushed, [1e3 * abs(one.error) for one in found], "o-", markersize=3, label=name)
    left.set_ylabel("error at the loaded point [um]")
    for name, values in (
        ("two cameras less fringes, good data", [c.good for c in compared]),
        ("two cameras less fringes, all data", [c.everywhere for c in compared]),
        ("fringes less exact, good data", [c.fringes for c in compared]),
    ):
        right.semilogy(pushed, [1e3 * value for value in values], "o-", markersize=3, label=name)
    right.set_ylabel("rms difference [um]")
    for axes in (left, right):
        axes.set_xlabel("pushed out by [mm]")
        axes.legend(fontsize="x-small")
    remarks = {
        "conditions": f"virtual rig, the top hat of section 5.3, cameras of {PIXELS[size]} px, 12 bit, "
        f"default parameters; the loaded point is what is seen within {_COIN_MM:g} mm of the middle, good "
        f"data that within {_LOADED_MM:g} mm; beside two cameras 34 degrees apart, as in Table 4, stands "
        "C1 with a projector, another rig than that of the loaded point",
        "exact": "displacement of the loaded point; the frame gives a hundredth of what is pushed",
        "thesis": "Fig. 69 and 73 are pictures: the text tells 0.02 to 0.13 mm and 0.07 mm rms of the loaded "
        "point, 0.05 mm at 1 mm and 0.5 mm at 10 mm of two cameras",
    }
    return Outcome(Table(_COLUMNS, rows, remarks), figure, judged)


STUDY = Study(
    "top-hat",
    "the bent top hat's ten states, fringes and two cameras (section 5.4, Fig. 61-73)",
    lambda say: run_at("small", say),
    lambda say: run_at("full", say),
)
