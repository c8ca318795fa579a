"""How accurate strain is on a flat panel in tension, over gauge length and subset."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sms_jobs.bench.study import Outcome, Study, Table, new_figure
from sms_jobs.kinds.deformation import correlate, strain
from sms_jobs.testing.shelf import reconstructed
from sms_jobs.virtual_rig.campaigns import tension_panel

GAUGE_LENGTHS_MM = (10.0, 15.0, 20.0, 30.0, 40.0)
SUBSET_RADII_PX = (10, 16, 24)
_THREADS = 2


def run(say: Callable[[str], None]) -> Outcome:
    """Strain a panel by 2000 microstrain and compare every valid pixel with the exact strain."""
    shelf, subject = reconstructed(*tension_panel("panel", "full"), say, _THREADS)
    truth = shelf.truth(subject)
    rows: list[tuple[float, ...]] = []
    figure = new_figure(7.0, 4.5)
    axes = figure.add_subplot()
    for radius in SUBSET_RADII_PX:
        say(f"subset radius {radius} px")
        shelf.run(correlate.KIND, subject, correlate.KIND.parameters(subset_radius_px=radius))
        pooled = []
        for length in GAUGE_LENGTHS_MM:
            shelf.run(strain.KIND, subject, strain.KIND.parameters(gauge_length_mm=length))
            found = shelf.records["strain", subject]["strain"]
            valid = found.reason == 0
            error = 1e6 * (found.strain - truth.strain(found.measure))[:, valid]
            stated = 1e6 * float(np.sqrt(np.mean(np.square(found.sigma[:, valid], dtype=np.float64))))
            each = np.sqrt(np.mean(error**2, axis=1))
            pooled.append(float(np.sqrt(np.mean(error**2))))
            rows.append((radius, length, *map(float, each), pooled[-1], stated))
        axes.loglog(GAUGE_LENGTHS_MM, pooled, "o-", label=f"subset radius {radius} px")
    axes.set_xlabel("gauge length [mm]")
    axes.set_ylabel("rms error of the strain [microstrain]")
    axes.set_title("flat panel of 290 mm, 2000 microstrain, 1024 px", fontsize="medium")
    axes.set_xticks(GAUGE_LENGTHS_MM, [f"{length:g}" for length in GAUGE_LENGTHS_MM])
    axes.minorticks_off()
    axes.legend(fontsize="small")
    columns = (
        "subset radius, px", "gauge length, mm", "xx, microstrain", "yy, microstrain", "xy, microstrain",
        "pooled, microstrain", "stated, microstrain",
    )  # fmt: skip
    remarks = {
        "conditions": "virtual rig, one camera of 1024 px and one projector, 12 bit, texture averaged over "
        "the fringe frames, Green-Lagrange strain; rms over all valid pixels, nothing trimmed",
        "thesis": "100 microstrain on the wing panel (section 6.2.5)",
    }
    return Outcome(Table(columns, rows, remarks), figure)


STUDY = Study(
    "strain-gauge-length", "noise of strain over gauge length and subset, flat panel in tension", run
)
