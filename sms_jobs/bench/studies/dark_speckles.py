"""How dark speckles may be: fringes are weak on dark paint, and subsets need contrast (section 8.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from sms_jobs.bench.fringes.returns import rms
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.kinds.deformation import correlate, strain
from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.records.reasons import Reason
from sms_jobs.testing.shelf import reconstructed
from sms_jobs.virtual_rig.campaigns import tension_panel

DARK = (0.02, 0.05, 0.1, 0.25, 0.5, 0.7)
"""Reflectance of the paint; the ground's is 0.85."""
GAUGE_MM = 20.0
_THREADS = 2


def judged(dark: float, say: Callable[[str], None]) -> tuple[Cell, ...]:
    """Return what is measured of a panel with paint of a reflectance, and how well; see `run`."""
    calibration, campaign = tension_panel("panel", "small")
    assert campaign.scene is not None
    assert campaign.scene.speckle is not None
    scene = replace(campaign.scene, speckle=replace(campaign.scene.speckle, dark=dark))
    painted = replace(campaign, scene=scene)
    shelf, loaded = reconstructed(calibration, painted, say, _THREADS)
    shelf.run(correlate.KIND, loaded, correlate.KIND.parameters())
    shelf.run(strain.KIND, loaded, strain.KIND.parameters(gauge_length_mm=GAUGE_MM))
    at_rest = replace(loaded, state=campaign.reference.label)
    shape, truth = shelf.shape(at_rest), shelf.truth(loaded)
    seen = shape.seen & shape.lit
    surface = shelf.records["reconstruct", at_rest]["surface"]
    valid = seen & (surface.reason == Reason.VALID)
    far = np.linalg.norm(surface.position - shape.xyz, axis=0)
    sigma = np.sqrt(trace(position_covariance(surface)))
    texture = shelf.records["measurement", at_rest]["measurement"].texture
    low, high = np.quantile(texture[seen], (0.25, 0.75))
    darkest, brightest = seen & (texture <= low), seen & (texture >= high)

    def of(part: Any) -> tuple[Cell, ...]:
        there = part & valid
        share = 100.0 * float(there.sum() / part.sum())
        if not there.any():
            return share, None, None
        return share, 1e3 * rms(far[there]), rms(far[there] / sigma[there])

    moved = shelf.records["correlate", loaded]["displacement"]
    strained = shelf.records["strain", loaded]["strain"]
    known = moved.reason == Reason.VALID
    displacement = np.linalg.norm((moved.displacement - truth.displacement)[:, known], axis=0)
    read = strained.reason == Reason.VALID
    error = (strained.strain - truth.strain(strained.measure))[:, read]
    return (dark, *of(darkest), *of(brightest), 1e3 * rms(displacement), 1e6 * rms(error))


def run(say: Callable[[str], None]) -> Outcome:
    """Paint a flat panel ever less dark, and measure its shape, displacement and strain."""
    rows = []
    for dark in DARK:
        say(f"paint of reflectance {dark}")
        rows.append(judged(dark, say))
    columns = (
        "reflectance of the paint",
        *("darkest quarter: valid, %", "darkest: rms, um", "darkest: rms / sigma"),
        *("brightest quarter: valid, %", "brightest: rms, um", "brightest: rms / sigma"),
        *("displacement, um", "strain, microstrain"),
    )
    remarks = {
        "conditions": "flat panel of 290 mm at 2000 microstrain, one camera of 512 px and one projector, "
        "12 bit, ground of reflectance 0.85, speckles of 6 px, default parameters, gauge of 20 mm; distance "
        "of points from the truth, of the darkest and the brightest quarter of the pixels; length of the "
        "displacement's error and strain's components over all valid pixels",
        "thesis": "section 8.2 asks for it: dark speckles have weak fringes",
    }
    return Outcome(Table(columns, rows, remarks), _picture(rows))


def _picture(rows: list[tuple[Cell, ...]]) -> Any:
    figure = new_figure(9.0, 3.8)
    shape, motion = figure.subplots(1, 2)
    dark = [row[0] for row in rows]
    for column, name in ((2, "darkest quarter"), (5, "brightest quarter")):
        shape.loglog(dark, [row[column] for row in rows], "o-", label=name)
    shape.set_ylabel("rms error of a point [um]")
    motion.loglog(dark, [row[7] for row in rows], "o-", label="displacement [um]")
    motion.loglog(dark, [row[8] for row in rows], "s-", label="strain [microstrain]")
    for axes in (shape, motion):
        axes.set_xlabel("reflectance of the paint")
        axes.legend(fontsize="small")
    return figure


STUDY = Study(
    "dark-speckles", "shape, displacement and strain over how dark the speckles are (section 8.2)", run
)
