"""A projector that is not linear: the error of shape that it makes, and what is left when it is corrected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from scipy import ndimage

from sms_jobs.bench.fringes.returns import rms
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.errors import MeasurementFailed
from sms_jobs.kinds.shape import reconstruct
from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import ProjectorResponse, Simulation
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import run_kind
from sms_jobs.virtual_rig.campaigns import START, small_plate
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import exact_shape

GAMMAS = (1.0, 1.3, 1.8)
STEPS = (3, 4, 5)
DENSITIES = {"temporal-unwrapping": (32, 31, 30, 28, 24, 16), "fdr": tuple(range(32))}
_TUPLE = Subject("plate", "S00", "C1P1")
_ROUGH: dict[str, Any] = {"maximum_phase_error_rad": 0.5, "calibration_sigma_px": 1.25}


def judged(gamma: float, steps: int, method: Any) -> tuple[Cell, ...]:
    """Return what is kept without correction, and rms error in um and over sigma before and after it."""
    calibration, campaign = small_plate("plate")
    assert campaign.scene is not None
    scene = replace(campaign.scene, speckle=None, projector=ProjectorResponse(gamma))
    simulation, sequence = Simulation(scene, "C1", "P1", ()), FringeSequence(DENSITIES[method], steps)
    seen = render(simulation, sequence)
    frames = ArrayStack(seen.frames.rows(0, seen.frames.shape[1]))
    measurement = Measurement(
        START, sequence, seen.full_scale, seen.gain, seen.read_noise, seen.texture, frames, simulation
    )
    shape = exact_shape(simulation)
    inside = ndimage.binary_erosion(shape.seen & shape.lit, iterations=4)

    def reconstructed(**parameters: Any) -> tuple[float, float, float]:
        settings = reconstruct.ReconstructParameters(method=method, blur_px=0.0, **parameters)
        records = {"measurement": measurement, "calibration": calibration}
        try:
            cloud: Surface = run_kind(reconstruct.KIND, _TUPLE, records, 1, settings).records["surface"]
        except MeasurementFailed:  # phases that fit no linear projector
            return 0.0, np.nan, np.nan
        valid = inside & (cloud.reason == Reason.VALID)
        error = np.linalg.norm(cloud.position - shape.xyz, axis=0)[valid]
        sigma = np.sqrt(trace(position_covariance(cloud)))[valid]
        kept = 100.0 * float(valid.sum() / inside.sum())
        return (kept, 1e3 * rms(error), rms(error / sigma)) if valid.any() else (0.0, np.nan, np.nan)

    kept, _, _ = reconstructed()
    _, before, missed = reconstructed(**_ROUGH)
    kept_after, after, score = reconstructed(response="measured")
    return kept, before, missed, kept_after, after, score


def run(say: Callable[[str], None]) -> Outcome:
    """Measure an unmarked plate with several exponents and numbers of steps, by two methods."""
    rows: list[tuple[Cell, ...]] = []
    for method, gamma, steps in product(DENSITIES, GAMMAS, STEPS):
        say(f"{method}: gamma {gamma}, {steps} steps")
        rows.append((method, gamma, steps, *judged(gamma, steps, method)))
    columns = (
        *("method", "gamma", "steps", "kept, %", "rms, um", "rms / sigma"),
        *("kept when corrected, %", "rms when corrected, um", "rms / sigma when corrected"),
    )
    remarks = {
        "conditions": "unmarked plate of the virtual rig, camera of 128 px, 12 bits, fringes 32, 31, 30, 28, "
        "24, 16 or 0 .. 31 in two orientations; distance from the truth of pixels 5 px from edges; "
        "no texture correction",
        "kept": "with the default thresholds, which refuse phases that do not fit a linear projector; the "
        "error without correction is of all pixels, let through by a phase error of 0.5 rad",
    }
    return Outcome(Table(columns, rows, remarks), _picture(rows))


def _picture(rows: list[tuple[Cell, ...]]) -> Any:
    figure = new_figure(9.0, 3.8)
    for axes, method in zip(figure.subplots(1, len(DENSITIES), sharey=True), DENSITIES, strict=True):
        for steps in STEPS:
            selected: list[Any] = [row for row in rows if row[0] == method and row[2] == steps]
            gammas = [row[1] for row in selected]
            (line,) = axes.semilogy(gammas, [row[4] for row in selected], "o--")
            axes.semilogy(
                gammas, [row[7] for row in selected], "o-", color=line.get_color(), label=f"{steps} steps"
            )
        axes.set_title(f"{method}: dashed as it is, full corrected", fontsize="medium")
        axes.set_xlabel("gamma")
        axes.legend(fontsize="small")
    figure.axes[0].set_ylabel("rms error [um]")
    return figure


STUDY = Study(
    "projector-response",
    "the ripple of a projector that is not linear, in shape, before and after correction",
    run,
)
