"""A small plate, recorded by two views in two states and reconstructed, all in memory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from sms_jobs.kinds.deformation import correlate, merge, strain
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, DatasetOutput, Inputs, Kind, Need
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.shape import reconstruct
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS
from sms_jobs.records.calibration import CalibrationUncertainty
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.measurement import ArrayStack, Measurement
from sms_jobs.records.scene import HalvesApart, Rigid, Simulation
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of
from sms_jobs.testing.in_memory import InMemory
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import Truth, exact_truth


@dataclass(frozen=True)
class Plate:
    """A campaign and what has been measured and computed of it, by kind and subject."""

    calibration: Calibration
    campaign: Campaign
    results: dict[tuple[str, Subject], dict[str, Any]] = field(default_factory=dict)
    uncertainty: CalibrationUncertainty | None = None

    def run(
        self, kind: Kind[Any], subject: Subject, parameters: Parameters | None = None, threads: int = 1
    ) -> DatasetOutput:
        """Run a kind on what its needs name."""
        chosen = parameters or kind.parameters()
        needs = kind.checked_needs(self.campaign, subject, chosen)
        datasets = {need.role: self.find(need) for need in needs}
        inputs = Inputs(subject, kind.context(self.campaign, subject), datasets, threads)
        done: list[float] = []

        def progress(fraction: float, message: str = "") -> None:
            done.append(fraction)

        outputs = [kind.checked(output) for output in kind.run(inputs, chosen, progress)]
        assert done == sorted(done)
        assert done[-1] == 1.0
        assert len(outputs) == 1
        output = outputs[0]
        assert isinstance(output, DatasetOutput)
        assert output.subject == subject
        return output

    def find(self, need: Need) -> InMemory:
        if need.source == CALIBRATION:
            stated = {} if self.uncertainty is None else {"uncertainty": self.uncertainty}
            return InMemory(need.subject, {"calibration": self.calibration, **stated})
        return InMemory(need.subject, self.results[need.source, need.subject])

    def keep(self, kind: Kind[Any], subject: Subject, parameters: Parameters | None = None) -> DatasetOutput:
        """Run a kind and keep its result for those that need it."""
        output = self.run(kind, subject, parameters)
        self.results[kind.name, subject] = dict(output.records)
        return output

    def subject(self, state: str, view: str | None = None) -> Subject:
        return Subject(self.campaign.name, state, view)

    def truth(self, view: str) -> Truth:
        states = (self.results[MEASUREMENT, self.subject(s, view)]["measurement"] for s in ("S00", "S01"))
        return exact_truth(*(m.simulation for m in states))


def _record(campaign: Campaign, state: str, view: str) -> Measurement:
    assert campaign.scene is not None
    load = campaign.state(state)
    simulation = Simulation(campaign.scene, *view_of(view).sensors, load.deformation, state=state)
    seen = render(simulation, campaign.sequence)
    assert load.time is not None
    return Measurement(
        recorded_at=load.time,
        sequence=campaign.sequence,
        full_scale=seen.full_scale,
        gain=seen.gain,
        read_noise=seen.read_noise,
        texture=seen.texture,
        frames=ArrayStack(seen.frames.rows(0, seen.frames.shape[1])),
        simulation=simulation,
    )


def plate_that_moves(name: str, *deformations: Any) -> Plate:
    """Return the plate at rest and in states S01 .. of some deformations, reconstructed for one view."""
    calibration, campaign = small_plate(name)
    rest, first = campaign.states[:2]
    states = [rest]
    for number, deformation in enumerate(deformations, start=1):
        states.append(replace(first, label=f"S{number:02d}", deformation=(deformation,)))
    found = Plate(calibration, replace(campaign, states=tuple(states), views=campaign.views[:1]))
    for state in states:
        subject = found.subject(state.label, found.campaign.views[0])
        measurement = _record(found.campaign, state.label, found.campaign.views[0])
        found.results[MEASUREMENT, subject] = {"measurement": measurement}
        found.keep(reconstruct.KIND, subject)
    return found


@pytest.fixture(scope="session")
def turning_plate() -> Plate:
    """Return the plate at rest, turned in its plane by 9 degrees and by 18, reconstructed."""
    turned = (Rigid((0.0, 0.0, 0.157 * number), (0.4 * number, 0.0, 0.0)) for number in (1, 2))
    return plate_that_moves("turning", *turned)


@pytest.fixture(scope="session")
def troubled_plate() -> Plate:
    """Return the plate at rest, broken by a crack, half out of the view, and out of it, reconstructed."""
    return plate_that_moves(
        "troubled",
        HalvesApart(8.0),
        Rigid(translation_mm=(85.0, 0.0, 0.0)),
        Rigid(translation_mm=(400.0, 0.0, 0.0)),
    )


@pytest.fixture(scope="session")
def plate() -> Plate:
    """Return the plate, correlated, strained and merged with the defaults."""
    found = Plate(*small_plate("plate"))
    for view in found.campaign.views:
        for state in ("S00", "S01"):
            measured = {"measurement": _record(found.campaign, state, view)}
            found.results[MEASUREMENT, found.subject(state, view)] = measured
    return _computed(found)


def _computed(found: Plate) -> Plate:
    """Return a plate that is recorded, with everything computed."""
    for view in found.campaign.views:
        for state in ("S00", "S01"):
            found.keep(reconstruct.KIND, found.subject(state, view))
        found.keep(correlate.KIND, found.subject("S01", view))
        found.keep(strain.KIND, found.subject("S01", view))
    found.keep(merge.KIND, found.subject("S01"))
    return found


@pytest.fixture(scope="session")
def known_plate(plate: Plate) -> Plate:
    """Return the same recordings, measured with a calibration that says how well it is known.

    Sensors are known to 20 urad, 10 um, 0.05 px and distortion of 1e-4, all independent.
    """
    each = np.zeros(PER_SENSOR)
    each[:3], each[3:6], each[6:10], each[10:12] = 2e-5, 0.01, 0.05, 1e-4
    names = tuple(sensor.name for sensor in plate.calibration.rig.sensors)
    covariance = np.diag(np.tile(each, len(names)) ** 2)
    recorded = {key: each for key, each in plate.results.items() if key[0] == MEASUREMENT}
    uncertainty = CalibrationUncertainty(names, SENSOR_PARAMETERS, covariance)
    return _computed(Plate(plate.calibration, plate.campaign, recorded, uncertainty))
