"""The plate and mirror of thesis Fig. 104-111: with and without refinement, over the number of fringes."""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from typing import Any

import numpy as np

from sms_jobs.bench.fringes.plate_mirror import UNMASKED, Plate, only, record, rms_off, unwrapped
from sms_jobs.bench.fringes.returns import simulate
from sms_jobs.bench.published import Judged
from sms_jobs.bench.study import Outcome, Study, Table, new_figure
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.phase.sequences import ranging
from sms_jobs.records.fields import Surface
from sms_jobs.records.reasons import Reason

FRINGES = (8, 16, 32, 64)
_THREADS = 2
_FAR_MM = 50.0
_SHOWN_MM = 0.2
_JOINT = "joint fit, likeliest pair"
PEAKS = (6.90, 3.45)
"""Bins of the two returns of the thesis's Fig. 95 to 100, with 32 fringes."""

METHODS: dict[str, Callable[[Plate], Surface]] = {
    "thesis, no refinement": lambda plate: plate.peeled(0, _THREADS),
    "thesis, 1 refinement": lambda plate: plate.peeled(1, _THREADS),
    "thesis, 2 refinements": lambda plate: plate.peeled(2, _THREADS),
    _JOINT: lambda plate: plate.points({"method": "fdr", "returns": 2, **UNMASKED}, _THREADS),
}
UNWRAPPING = "unwrapping of 32 .. 16"


def two_peaks() -> tuple[float, ...]:
    """Return where two returns are found, in bins: the mean over pixels of noise 0.02 of the stronger."""
    fringes, pixels = 32, 1 << 11
    omega = np.repeat(2.0 * pi * np.array(PEAKS)[:, None] / fringes, pixels, axis=1)
    signals = simulate(omega, (1.0, 0.5), fringes, 50.0, np.random.default_rng(96))
    found = signals.ranged().omega.reshape(len(PEAKS), -1)
    return tuple(float(k) for k in np.nanmean(found, axis=1) * fringes / (2.0 * pi))


def _row(plate: Plate, cloud: Surface, fringes: int, name: str) -> tuple[Any, ...]:
    off = plate.off_plane(cloud)
    once, _ = rms_off(off, plate.once)
    twice, part = rms_off(off, plate.twice)
    far, _ = rms_off(off, plate.twice & (plate.hinge_mm > _FAR_MM))
    wrong = float(np.mean(np.abs(off[plate.twice]) > _SHOWN_MM))
    assert cloud.ray_gap is not None
    measured = plate.twice & (cloud.reason == Reason.VALID)
    gap = float(np.median(np.abs(cloud.ray_gap[measured])))
    return (fringes, name, once, far, far / once, twice, wrong, gap, part)


def run(say: Callable[[str], None]) -> Outcome:
    """Reconstruct one recording with fewer and fewer of its fringes, by every method."""
    say("rendering")
    plate = record("small", max(FRINGES), _THREADS)
    rows, maps = [], {}
    for fringes in FRINGES:
        part = only(plate, ranging(fringes))
        for name, method in METHODS.items():
            say(f"s = {fringes}, {name}")
            cloud = method(part)
            rows.append(_row(plate, cloud, fringes, name))
            maps[name] = plate.off_plane(cloud)
    say(UNWRAPPING)
    cloud = unwrapped(plate, _THREADS, UNMASKED)
    rows.append(_row(plate, cloud, 32, UNWRAPPING))
    maps[UNWRAPPING] = plate.off_plane(cloud)
    columns = (
        "s",
        "method",
        "lit once: rms, mm",
        f"lit twice, {_FAR_MM:.0f} mm off the hinge: rms, mm",
        "twice / once",
        "lit twice: rms, mm",
        f"over {_SHOWN_MM} mm off",
        "median ray gap, mm",
        "part measured",
    )
    joint = next(row for row in reversed(rows) if row[1] == _JOINT)
    unwrapping = rows[-1]
    found = two_peaks()
    judged = (
        Judged("plate-once", joint[2]),
        Judged("plate-once-unwrapped", unwrapping[2]),
        Judged("plate-twice", joint[5]),
        Judged("plate-twice-unwrapped", unwrapping[5]),
        Judged("plate-better", unwrapping[5] / joint[5]),
        *(Judged(f"peak-{n}", one, k) for n, (one, k) in enumerate(zip(found, PEAKS, strict=True), start=1)),
    )
    remarks = {
        "conditions": "plate and mirror of the virtual rig, camera of 512 px, 12 bits, two returns; rms "
        "off the plane through what is lit once, without masks but that of the volume: every pixel counts",
        "thesis": "section 7.3.1, real plate, s = 64, no refinement: 0.405 mm lit once, 0.538 mm lit twice "
        "(1.33 x), unwrapping 2.726 mm; the plate itself was not flat to 0.4 mm",
    }
    return Outcome(Table(columns, rows, remarks), _picture(rows, maps), judged)


def _picture(rows: list[tuple[Any, ...]], maps: dict[str, Floats]) -> Any:
    figure = new_figure(12.0, 7.5)
    grid = figure.subplots(2, 3).ravel()
    for axes, (name, off) in zip(grid, maps.items(), strict=False):
        drawn = axes.imshow(off, cmap="RdBu", vmin=-_SHOWN_MM, vmax=_SHOWN_MM, interpolation="none")
        axes.set_title(name, fontsize="medium")
        axes.set_xticks([])
        axes.set_yticks([])
    figure.colorbar(drawn, ax=list(grid[:3]), label="off the plane [mm], s = 64", extend="both")
    axes = grid[-1]
    for name in METHODS:
        mine = [row for row in rows if row[1] == name]
        axes.loglog([row[0] for row in mine], [row[5] for row in mine], "o-", label=name)
    joint = [row for row in rows if row[1] == _JOINT]
    axes.loglog([row[0] for row in joint], [row[2] for row in joint], "k--", label="joint fit, lit once")
    axes.set_xticks(FRINGES, [str(s) for s in FRINGES])
    axes.minorticks_off()
    axes.set_xlabel("number of fringes s")
    axes.set_ylabel("rms off the plane, lit twice [mm]")
    axes.legend(fontsize="x-small")
    return figure


STUDY = Study("plate-mirror", "plate and mirror over refinement and number of fringes (Fig. 104-111)", run)
