"""A glossy cylinder: one exposure, a set chosen by a pre-exposure, a projector dimmed where it dazzles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage

from sms_jobs.bench.fringes.returns import rms
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.kinds.kind import DatasetOutput, Inputs
from sms_jobs.kinds.recording import simulate
from sms_jobs.kinds.shape import reconstruct
from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Cylinder, Gloss
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import run_kind
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.truth import exact_shape

SHINE = Gloss(strength=20.0, exponent=300.0)
SEQUENCES = {
    "temporal-unwrapping": FringeSequence((16, 15, 14, 12, 8)),
    "fdr": FringeSequence(tuple(range(16))),
}
RECORDINGS = {
    "one exposure": "none",
    "exposures chosen, merged": "exposures",
    "one exposure, projector dimmed": "projector",
}
_TUPLE = Subject("glossy", "S00", "C1P1")


@dataclass(frozen=True)
class Judged:
    """What became of a recording: error in mm (NaN where nothing is measured) of pixels far from edges."""

    error: Floats
    sigma: Floats
    measured: float
    measurement: Measurement

    def row(self) -> tuple[Cell, ...]:
        """Return the part that is measured in per cent, the rms error in um, and its median over sigma."""
        known = np.isfinite(self.error)
        score = float(np.median(self.error[known] / self.sigma[known])) / 0.6745
        return 100.0 * self.measured, 1e3 * rms(self.error[known]), score


def _campaign(sequence: FringeSequence) -> tuple[Calibration, Campaign]:
    calibration, plain = small_plate("glossy")
    assert plain.scene is not None
    scene = replace(plain.scene, speckle=None, surface=Cylinder(200.0, 150.0, 150.0), gloss=SHINE)
    return calibration, replace(plain, scene=scene, views=("C1P1",), sequence=sequence)


def _recorded(campaign: Campaign, adaptive: Any) -> Measurement:
    state = Subject("glossy", "S00")
    inputs = Inputs(state, simulate.KIND.context(campaign, state), {}, 1)
    parameters = simulate.SimulateParameters(adaptive=adaptive)
    (output,) = simulate.KIND.run(inputs, parameters, lambda fraction, message="": None)
    assert isinstance(output, DatasetOutput)
    measurement: Measurement = output.records["measurement"]
    return measurement


def judged(method: Any, adaptive: str) -> Judged:
    """Record the cylinder, reconstruct it and compare it with the truth."""
    calibration, campaign = _campaign(SEQUENCES[method])
    measurement = _recorded(campaign, adaptive)
    records = {"measurement": measurement, "calibration": calibration}
    parameters = reconstruct.ReconstructParameters(method=method)
    cloud: Surface = run_kind(reconstruct.KIND, _TUPLE, records, 1, parameters).records["surface"]
    assert measurement.simulation is not None
    shape = exact_shape(measurement.simulation)
    inside = ndimage.binary_erosion(shape.seen & shape.lit, iterations=4)
    valid = inside & (cloud.reason == Reason.VALID)
    error = np.where(valid, np.linalg.norm(cloud.position - shape.xyz, axis=0), np.nan)
    sigma = np.sqrt(trace(position_covariance(cloud)))
    return Judged(error, sigma, float(valid.sum() / inside.sum()), measurement)


def run(say: Callable[[str], None]) -> Outcome:
    """Record the cylinder in three ways, and reconstruct it by two methods."""
    rows: list[tuple[Cell, ...]] = []
    pictures: dict[str, Floats] = {}
    chosen: tuple[float, ...] = ()
    for method in SEQUENCES:
        for name, adaptive in RECORDINGS.items():
            say(f"{method}: {name}")
            found = judged(method, adaptive)
            sequence = found.measurement.sequence
            rows.append((name, method, len(sequence.exposures), sequence.frames, *found.row()))
            if method == "fdr":
                pictures[name] = 1e3 * found.error
            if adaptive == "exposures":
                chosen = sequence.exposures
    columns = ("recording", "method", "exposures", "frames", "measured, %", "rms, um", "median / sigma")
    remarks = {
        "conditions": "glossy cylinder of the virtual rig, camera of 128 px, 12 bits; a Blinn lobe of "
        "exponent 300, 20 times as bright as white paper; fringes 16, 15, 14, 12, 8 or 0 .. 15 in two "
        "orientations; distance from the truth of pixels at least 5 px from edges",
        "exposures": f"chosen {', '.join(f'{e:.3g}' for e in chosen)} from 36 quick frames, at most 1",
        "thesis": "section 8.2 names the dimmed projector as further work",
    }
    return Outcome(Table(columns, rows, remarks), _picture(pictures))


def _picture(pictures: dict[str, Floats]) -> Any:
    figure = new_figure(11.0, 3.8)
    for axes, (name, image) in zip(figure.subplots(1, len(pictures)), pictures.items(), strict=True):
        drawn = axes.imshow(image, vmin=0.0, vmax=60.0, interpolation="none")
        axes.set_title(f"{name}\nerror [um]", fontsize="medium")
        axes.set_xticks([])
        axes.set_yticks([])
        figure.colorbar(drawn, ax=axes)
    return figure


STUDY = Study(
    "glossy-surface", "a highlight beyond the camera's range: exposures merged, projector dimmed", run
)
