"""The job that records, with sensors that are not ours: a GigE Vision camera and a display of an X server."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.display import COLUMNS, ROWS, display
from support.gige_camera import ADDRESS, gige_camera

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.rig_configuration import example_rig, parse_rig
from sms_jobs.instruments.simulated.optics import Setting
from sms_jobs.jobs.devices.stations import known_sensors
from sms_jobs.kinds.kind import DatasetOutput, Inputs, Station
from sms_jobs.kinds.recording.acquire import AcquireParameters, Order, run
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.recording import Recording
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate

SEQUENCE = FringeSequence((3, 2), 3, (0.0,), (1.0, 2.0))
ORDER = Order(("C1P1",), SEQUENCE, None, None)
RIG = f"""
name = "desk"
[[cameras]]
name = "C1"
driver = "aravis"
device = "{ADDRESS}"
columns = 160
rows = 120
pixel_format = "Mono8"
exposure_ms = 10.0
noise_gain = 0.2
read_noise = 1.5
[[projectors]]
name = "P1"
driver = "window"
columns = {COLUMNS}
rows = {ROWS}
settle_ms = 1.0
"""


def nobody(fraction: float, words: str) -> None:
    """Progress that nobody watches."""


def test_a_state_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = parse_rig(RIG, "rig.toml", known_sensors())
    inputs = Inputs(Subject("panel", "S00"), ORDER, {}, station=Station(rig, tmp_path / "spool"))
    with display(tmp_path) as hidden, gige_camera():
        monkeypatch.setenv("DISPLAY", hidden.name)
        monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
        (output,) = run(inputs, AcquireParameters(recordings=1), nobody)
    assert isinstance(output, DatasetOutput)
    assert output.subject == Subject("panel", "S00", "C1P1")
    measurement, recording = output.records["measurement"], output.records["recording"]
    assert isinstance(measurement, Measurement)
    assert isinstance(recording, Recording)
    assert (measurement.full_scale, measurement.gain, measurement.read_noise) == (255, 0.2, 1.5)
    assert measurement.simulation is None
    # One frame a pattern and exposure, then the white one, by the camera's own count; none was taken twice
    # unless the network lost one.
    assert len(recording.numbers) == SEQUENCE.frames + 1 == 13
    assert recording.retaken or (np.diff(recording.numbers) == 1).all()
    assert (np.diff(recording.times_s) > 0.0).all()
    # The camera simulates a ramp that goes on by one with every frame, and is brighter by log10 of exposure.
    dark, bright = measurement.frames.frame(0), measurement.frames.frame(6)
    assert (dark.max(), bright.max()) == (254, 255)
    assert np.count_nonzero(bright == 255) > np.count_nonzero(dark == 254)


def test_a_simulated_rig_needs_a_scene(tmp_path: Path) -> None:
    station = Station(parse_rig(example_rig(), "rig.toml"), tmp_path / "spool")
    inputs = Inputs(Subject("panel", "S00"), ORDER, {}, station=station)
    with pytest.raises(InvalidInput, match="rig virtual is simulated, and campaign panel describes no scene"):
        list(run(inputs, AcquireParameters(), nobody))


def test_a_simulated_rig_has_the_images_of_the_scene(tmp_path: Path) -> None:
    station = Station(parse_rig(example_rig(), "rig.toml"), tmp_path / "spool")
    scene = small_plate("panel")[1].scene
    assert scene is not None
    order = replace(ORDER, setting=Setting(scene, "S00", ()))
    inputs = Inputs(Subject("panel", "S00"), order, {}, station=station)
    with pytest.raises(
        InvalidInput, match=r"C1 has 256 x 256 px in the file of rig virtual, and 128 x 128 px"
    ):
        list(run(inputs, AcquireParameters(), nobody))
