"""The wing panel's nine loads from three positions: gauges, and a stringer that cracks on (section 6.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from sms_jobs.bench.compared_fields import rms
from sms_jobs.bench.published import Judged
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.kinds.deformation import correlate, gauges, strain
from sms_jobs.kinds.kind import Kind
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.fields import DisplacementField, StrainField
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.scene import AT_ORIGIN, Deformation
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf, state_by_state
from sms_jobs.virtual_rig.campaigns import PIXELS, Made, Size
from sms_jobs.virtual_rig.deformations import gradients, packed_chain
from sms_jobs.virtual_rig.truth import Truth
from sms_jobs.virtual_rig.wing_campaigns import GAUGES_MM, TABLE_5, cracked_wing_panel

_THREADS = 2
_MICROSTRAIN = 1e6
_GAUGE_MM = 20.0
_CELL_MM = 6.0  # of the net on which views are compared, wider than a subset's half
_HALF_MM = (340.0, 90.0)
_BAND_MM = 18.0  # half of the width about the stringer over which strain is averaged
_TEXTS = tuple(
    f"G{number} x={x:g} y={y:g} length={_GAUGE_MM:g}" for number, (x, y) in enumerate(GAUGES_MM, start=1)
)
_CHAIN: list[tuple[Kind[Any], Parameters]] = [
    (correlate.KIND, correlate.KIND.parameters()),
    (strain.KIND, strain.KIND.parameters(gauge_length_mm=_GAUGE_MM)),
    (gauges.KIND, gauges.KIND.parameters(gauge=_TEXTS)),
]
_COLUMNS = (
    "state", "load, kN",
    "gauge 1: thesis, microstrain", "gauge 1: exact", "gauge 1: measured", "gauge 1: z",
    "gauge 2: thesis, microstrain", "gauge 2: exact", "gauge 2: measured", "gauge 2: z",
    "strain along the load: rms error, microstrain", "stated", "displacement: rms error, mm",
    "views differ, mm rms", "tip of the crack: exact, mm", "measured, mm", "tip: z",
)  # fmt: skip


@dataclass(frozen=True)
class Net:
    """Means over the cells of a net on the panel, of what one view sees of a state.

    Attributes
    ----------
    displacement
        (3, rows, columns), measured, in the panel's frame, mm.
    strain, sigma, exact
        (rows, columns), strain along the load, what is stated of one pixel, and what is true.
    """

    displacement: Floats
    strain: Floats
    sigma: Floats
    exact: Floats


@dataclass(frozen=True)
class Seen:
    """What one view sees of one state, and how far it is off what is true.

    `squared` are sums over pixels: of the squared error of strain along the load, of its stated variance, of
    the squared length of the error of displacement; `pixels` how many they are, of strain and displacement.
    """

    net: Net
    readings: GaugeReadings
    squared: tuple[float, float, float]
    pixels: tuple[int, int]


def netted(truth: Truth, turn: Floats, field: DisplacementField, strained: StrainField) -> Net:
    """Return the means over the cells of the net, NaN where nothing is known."""
    x, y, _ = truth.shape.material
    columns, rows = (int(2.0 * half / _CELL_MM) for half in _HALF_MM)
    with np.errstate(invalid="ignore"):
        known = (field.reason == 0) & (strained.reason == 0) & np.isfinite(x)
    column = ((x[known] + _HALF_MM[0]) / _CELL_MM).astype(np.int64)
    row = ((y[known] + _HALF_MM[1]) / _CELL_MM).astype(np.int64)
    cell, size = row * columns + column, rows * columns
    count = np.bincount(cell, minlength=size)

    def mean(values: Floats) -> Floats:
        total = np.bincount(cell, values[known], minlength=size)
        with np.errstate(invalid="ignore"):
            return np.where(count > 0, total / count, np.nan).reshape(rows, columns)

    moved = np.einsum("ij,jrc->irc", turn.T, field.displacement)
    green = truth.strain(strained.measure)[0]
    return Net(
        np.stack([mean(component) for component in moved]),
        mean(strained.strain[0]),
        mean(strained.sigma[0].astype(np.float64)),
        mean(green),
    )


def _seen(shelf: Shelf, subject: Subject) -> Seen:
    scene = shelf.campaign.scene
    assert scene is not None
    truth = shelf.truth(subject)
    field: DisplacementField = shelf.records["correlate", subject]["displacement"]
    strained: StrainField = shelf.records["strain", subject]["strain"]
    readings: GaugeReadings = shelf.records["gauges", subject]["gauges"]
    error = (strained.strain[0] - truth.strain(strained.measure)[0])[strained.reason == 0]
    off = (field.displacement - truth.displacement)[:, field.reason == 0]
    squared = (
        float(np.nansum(error**2)),
        float(np.sum(strained.sigma[0, strained.reason == 0].astype(np.float64) ** 2)),
        float(np.nansum(off**2)),
    )
    net = netted(truth, scene.placement.matrix(), field, strained)
    return Seen(net, readings, squared, (error.size, off.shape[1]))


def tip_of(strain_along: Floats, sigma: Floats) -> tuple[float, float]:
    """Return where strain along the stringer rises to its half, and its standard deviation, in mm.

    A step (1 + tanh) is fitted to the mean over the band about the cracked stringer; NaN where none is found.

    Parameters
    ----------
    strain_along, sigma
        (rows, columns) on the net, and standard deviations of that.
    """
    y = (np.arange(strain_along.shape[0]) + 0.5) * _CELL_MM - _HALF_MM[1]
    band = np.abs(y + 50.0) < _BAND_MM
    known = np.isfinite(strain_along[band]).all(axis=0)
    x = ((np.arange(strain_along.shape[1]) + 0.5) * _CELL_MM - _HALF_MM[0])[known]
    along = strain_along[band][:, known].mean(axis=0)
    if len(x) < 10:
        return float("nan"), float("nan")
    # Cells of a band are nearer to each other than a gauge length and so are one value.
    weight = np.sqrt(_CELL_MM / _GAUGE_MM) / np.maximum(
        np.sqrt(np.mean(sigma[band][:, known] ** 2, axis=0)), 1e-9
    )
    size = float(along[-5:].mean() - along[:5].mean())

    def off(p: Floats) -> Floats:
        return np.asarray((p[0] + 0.5 * p[1] * (1.0 + np.tanh((x - p[2]) / p[3])) - along) * weight)

    start = [float(along[:5].mean()), size, float(x[len(x) * 3 // 4]), 30.0]
    limits = ([-np.inf, -np.inf, x[0], 5.0], [np.inf, np.inf, x[-1], 100.0])
    best = least_squares(off, start, bounds=limits, x_scale=[1e-4, 1e-4, 10.0, 10.0])
    spread = np.linalg.pinv(best.jac.T @ best.jac)
    return float(best.x[2]), float(np.sqrt(spread[2, 2]))


def exact_gauge(deformation: Sequence[Deformation], x: float, y: float) -> float:
    """Return the mean Green-Lagrange strain along x under a gauge's grid on the flat panel."""
    half = _GAUGE_MM / 2.0
    along, across = np.meshgrid(x + np.linspace(-half, half, 11), y + np.linspace(-half / 2, half / 2, 7))
    points = np.stack([along.ravel(), across.ravel(), np.zeros(along.size)], axis=-1)
    slope = gradients(packed_chain(deformation, AT_ORIGIN), points)[:, :, 0]
    return float(np.mean(0.5 * (np.sum(slope**2, axis=1) - 1.0)))


def joined(nets: Sequence[Floats]) -> Floats:
    """Return the mean over views of what is on their nets, where any of them knows it."""
    known = np.isfinite(nets)
    total = np.where(known, nets, 0.0).sum(axis=0)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / known.sum(axis=0))


def _measured(
    made: Sequence[Made], say: Callable[[str], None], labels: Sequence[str]
) -> dict[str, list[Seen]]:
    """Return what every position sees, by state."""
    found: dict[str, list[Seen]] = {}
    for calibration, campaign in made:
        for state, shelf in state_by_state(calibration, campaign, say, _THREADS, _CHAIN, labels):
            seen = _seen(shelf, Subject(campaign.name, state.label, campaign.views[0]))
            found.setdefault(state.label, []).append(seen)
    return found


def run_at(size: Size, say: Callable[[str], None], labels: Sequence[str] = ()) -> Outcome:
    """Measure the loads, all if none are named, from every position of the rig."""
    made = cracked_wing_panel("wing", size)
    campaign = made[1][1]
    found = _measured(made, say, labels)
    rows: list[tuple[Cell, ...]] = []
    judged: list[Judged] = []
    differences: list[float] = []
    figure = new_figure(9.0, 4.5)
    axes = figure.add_subplot()
    for state in campaign.states[1:]:
        if state.label not in found:
            continue
        seen, load = found[state.label], (state.load_n or 0.0) / 1000.0
        cells: list[Cell] = []
        table = next(strains for load_n, *strains in TABLE_5 if load_n == state.load_n)
        for number, place in enumerate(GAUGES_MM):
            exact = exact_gauge(state.deformation, *place)
            value, sigma = (float(a[number]) for a in (seen[1].readings.strain, seen[1].readings.sigma))
            z = (value - exact) / sigma
            cells += [*(_MICROSTRAIN * v for v in (table[number], exact, value)), z]
            key = f"wing-{load:g}-{number + 1}"
            judged.append(Judged(key, *(_MICROSTRAIN * v for v in (value, exact, sigma))))
            differences.append(_MICROSTRAIN * (value - table[number]))
        squared = np.sum([one.squared for one in seen], axis=0)
        strained, moved = np.sum([one.pixels for one in seen], axis=0)
        apart = [a.net.displacement - b.net.displacement for a, b in pairwise(seen)]
        nets = [joined([getattr(one.net, name) for one in seen]) for name in ("strain", "sigma", "exact")]
        tip, tip_sigma = tip_of(nets[0], nets[1])
        true_tip, _ = tip_of(nets[2], nets[1])
        rows.append(
            (
                state.label, load, *cells,
                *(float(v) for v in _MICROSTRAIN * np.sqrt(squared[:2] / strained)),
                float(np.sqrt(squared[2] / moved)), rms(np.linalg.norm(apart, axis=1)),
                true_tip, tip, (tip - true_tip) / tip_sigma,
            )
        )  # fmt: skip
        y = (np.arange(nets[0].shape[0]) + 0.5) * _CELL_MM - _HALF_MM[1]
        middle = np.abs(np.arange(nets[0].shape[1]) + 0.5 - nets[0].shape[1] / 2.0) < 2.0
        (line,) = axes.plot(y, _MICROSTRAIN * nets[0][:, middle].mean(axis=1), ".-", label=f"{load:g} kN")
        axes.plot(y, _MICROSTRAIN * nets[2][:, middle].mean(axis=1), ":", color=line.get_color())
    judged += [
        Judged("wing-largest", float(np.abs(differences).max())),
        Judged("wing-offset", float(abs(np.mean(differences)))),
    ]
    axes.set_xlabel("across the panel through both gauges [mm]")
    axes.set_ylabel("strain along the load [microstrain], dotted: exact")
    axes.legend(fontsize="x-small")
    return Outcome(Table(_COLUMNS, rows, _remarks(size)), figure, judged)


def _remarks(size: Size) -> dict[str, str]:
    return {
        "conditions": "virtual rig, a panel of 660 x 175 mm from three positions of the rig, each with "
        f"all loads; camera of {PIXELS[size]} px and one projector, 12 bit, default parameters, gauge "
        f"length {_GAUGE_MM:g} mm; gauges of {_GAUGE_MM:g} x {_GAUGE_MM / 2:g} mm at x = 0, y = 60 and -60 "
        "mm in the middle view; rms errors over all valid pixels of all views",
        "views differ": f"rms distance of displacements in cells of {_CELL_MM:g} mm that neighbouring "
        "views both see, each brought to the panel by the exact position of the rig",
        "tip": "where strain along the cracked stringer rises to its half, by a fit to the mean over "
        f"{2 * _BAND_MM:g} mm of all views; the exact one is fitted alike",
        "thesis": "Table 5 and Fig. 81: 100 microstrain at most, 50 in the mean; where its gauges were is "
        "not told in numbers, nor how far the crack had gone at which load",
    }


STUDY = Study(
    "wing-panel",
    "the wing panel's nine loads from three positions, with a crack that grows (section 6.2, Table 5)",
    lambda say: run_at("small", say),
    lambda say: run_at("full", say),
)
