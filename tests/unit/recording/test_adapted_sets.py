"""Exposures and dimming that a recording decides at the rig, from a pre-exposure by all of its cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sms_jobs.errors import InstrumentError, InvalidInput, MeasurementFailed
from sms_jobs.instruments.projectors.scanner import ScannerProjector, ScannerProjectorSettings
from sms_jobs.kinds.kind import DatasetOutput, Inputs, Station
from sms_jobs.kinds.recording import acquire, simulate
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.optical_instruments import OpticalFault, RigFile, VirtualCamera, VirtualProjector
from sms_jobs.records.scene import CameraResponse, Cylinder, Gloss
from sms_jobs.records.sensors import Rig
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import Lens, aimed, small_plate

STATE = Subject("plate", "S00")


@cache
def campaign() -> Campaign:
    """A glossy cylinder before two cameras, the second of which sees its highlight elsewhere."""
    plain = small_plate("plate")[1]
    assert plain.scene is not None
    second = aimed("C2", 96, 96, Lens(7.0, -0.08, 0.1, 0.0, 0.0), (250.0, 60.0, 1230.0))
    scene = replace(
        plain.scene,
        rig=Rig("virtual", (plain.scene.rig.sensors[0], second, *plain.scene.rig.sensors[1:])),
        speckle=None,
        surface=Cylinder(200.0, 150.0, 150.0),
        gloss=Gloss(20.0, 300.0),
    )
    return replace(plain, scene=scene, views=("C1P1", "C2P1"))


def rig_file(faults: tuple[OpticalFault, ...] = ()) -> RigFile:
    return RigFile(
        "virtual",
        (VirtualCamera("C1", 128, 128, "simulated", faults=faults), VirtualCamera("C2", 96, 96, "simulated")),
        tuple(VirtualProjector(name, 256, 192, "simulated", settle_ms=1.0) for name in ("P1", "P2")),
    )


def run(
    what: Campaign,
    spool: Path,
    faults: tuple[OpticalFault, ...] = (),
    tell: Callable[..., None] = lambda fraction, message="": None,
    **parameters: object,
) -> dict[str, DatasetOutput]:
    inputs = Inputs(STATE, acquire.KIND.context(what, STATE), {}, 1, station=Station(rig_file(faults), spool))
    wanted = acquire.AcquireParameters(lit_fraction=0.0, recordings=1, **parameters)  # type: ignore[arg-type]
    return {
        output.subject.view or "": output
        for output in acquire.KIND.run(inputs, wanted, tell)
        if isinstance(output, DatasetOutput)
    }


def measured(output: DatasetOutput) -> Measurement:
    found = output.records["measurement"]
    assert isinstance(found, Measurement)
    return found


@pytest.mark.parametrize("adaptive", ["exposures", "projector"])
def test_one_camera_is_recorded_as_simulate_has_it(tmp_path: Path, adaptive: str) -> None:
    one = replace(campaign(), views=("C1P1",))
    inputs = Inputs(STATE, simulate.KIND.context(one, STATE), {}, 1)
    wanted = simulate.SimulateParameters(adaptive=adaptive)  # type: ignore[arg-type]
    (known,) = simulate.KIND.run(inputs, wanted, lambda fraction, message="": None)
    assert isinstance(known, DatasetOutput)
    expected = measured(known)
    output = run(one, tmp_path, adaptive=adaptive)["C1P1"]
    found = measured(output)
    # The light is rendered with the same noise: frame by frame it is the same.
    assert found.sequence == expected.sequence
    if adaptive == "projector":
        np.testing.assert_array_equal(found.dimming, expected.dimming)
    assert found.frames.shape == expected.frames.shape
    for k in range(found.frames.shape[0]):
        np.testing.assert_array_equal(found.frames.frame(k), expected.frames.frame(k))
    for name in {"exposures", "shortest_exposure", "dimmed_fraction"} & set(known.statistics):
        assert output.statistics[name] == known.statistics[name]


def saturated(found: Measurement) -> float:
    """Return the part of the pixels that saturate in the frames of the shortest exposure."""
    frames = range(found.sequence.frames_per_exposure)
    full = [found.frames.frame(k) >= found.full_scale for k in frames]
    return float(np.mean(np.any(full, axis=0)))


def test_one_set_of_exposures_serves_all_cameras_of_a_projector(tmp_path: Path) -> None:
    planned = run(campaign(), tmp_path / "planned")
    assert min(saturated(measured(one)) for one in planned.values()) > 0.01
    found = run(campaign(), tmp_path / "adapted", adaptive="exposures")
    sequences = {measured(one).sequence for one in found.values()}
    assert len(sequences) == 1
    # As many pixels at the bright end need not be served.
    assert max(saturated(measured(one)) for one in found.values()) <= 2e-3


def test_a_projector_is_dimmed_for_whichever_camera_it_dazzles(tmp_path: Path) -> None:
    both = run(campaign(), tmp_path / "both", adaptive="projector")
    masks = [measured(one).dimming for one in both.values()]
    np.testing.assert_array_equal(masks[0], masks[1])
    alone = [
        measured(one).dimming
        for view in campaign().views
        for one in run(replace(campaign(), views=(view,)), tmp_path / view, adaptive="projector").values()
    ]
    assert alone[0] is not None
    assert alone[1] is not None
    assert masks[0] is not None
    np.testing.assert_array_equal(masks[0], np.minimum(alone[0], alone[1]))
    assert max(saturated(measured(one)) for one in both.values()) <= 2e-3


def test_what_breaks_off_goes_on_with_what_is_missing(tmp_path: Path) -> None:
    one = replace(campaign(), views=("C1P1", "C1P2"))
    # The pre-exposures have 36 frames each; the cable goes in the set of the second projector.
    whole = run(one, tmp_path / "whole", adaptive="exposures")
    first = measured(whole["C1P1"]).sequence.frames + 1
    cable = (OpticalFault("unplugged", frame=36 + first + 36 + 5),)
    with pytest.raises(InstrumentError):
        run(one, tmp_path / "spool", cable, adaptive="exposures")
    told: list[str] = []

    def listen(fraction: float, message: str = "") -> None:
        told.append(message)

    found = run(one, tmp_path / "spool", tell=listen, adaptive="exposures")
    assert not any("P1" in words and "exposing" in words for words in told)
    for view, output in whole.items():
        assert measured(found[view]).sequence == measured(output).sequence
    broken = [record for name, record in found["C1P2"].records.items() if "interrupted" in str(name)]
    assert [one.frames.shape[0] for one in broken] == [4]  # what came before the cable went is kept
    assert broken[0].sequence == measured(whole["C1P2"]).sequence


def test_a_frame_that_is_lost_in_a_pre_exposure_is_taken_again(tmp_path: Path) -> None:
    one = replace(campaign(), views=("C1P1",))
    whole = measured(run(one, tmp_path / "whole", adaptive="exposures")["C1P1"])
    lost = (OpticalFault("dropped-frame", frame=7),)
    found = measured(run(one, tmp_path / "lost", lost, adaptive="exposures")["C1P1"])
    assert found.sequence == whole.sequence


def test_a_scanners_projector_refuses_to_be_dimmed() -> None:
    settings = ScannerProjectorSettings("P1", 256, 192, "scanner", "127.0.0.1:7000", "key")
    projector = ScannerProjector("P1", None, settings, {})  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="no dimming is sent: record with adaptive=exposures"):
        projector.load(campaign().sequence, np.ones((192, 256), np.float32))


def test_a_pre_exposure_in_the_dark_says_so(tmp_path: Path) -> None:
    scene = campaign().scene
    assert scene is not None
    dark = replace(campaign(), scene=replace(scene, camera=CameraResponse(exposure=1e-6)))
    with pytest.raises(MeasurementFailed, match="no pixel is lit by P1"):
        run(dark, tmp_path, adaptive="projector")
