"""A projector plays patterns by itself, its pulses expose the cameras: the same frames, or none of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import psutil
import pytest

from sms_jobs.errors import Cancelled, InstrumentError, InvalidInput, LinkLost
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.judging import Limits
from sms_jobs.instruments.kept_sets import finished_sets, interrupted, recorded
from sms_jobs.instruments.recorder import record_state
from sms_jobs.instruments.recording_sets import FringeSet
from sms_jobs.instruments.rehearsal import rehearse, ways
from sms_jobs.instruments.simulated.optics import SimulatedCamera, SimulatedProjector, VirtualRoom
from sms_jobs.kinds.kind import DatasetOutput, Inputs, Station
from sms_jobs.kinds.recording import acquire
from sms_jobs.records.bursts import Burst, PulseTrain
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.optical_instruments import (
    CameraInstrument,
    OpticalFault,
    ProjectorFault,
    RigFile,
    VirtualCamera,
    VirtualProjector,
)
from sms_jobs.records.recording import Recording
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate

SEQUENCE = FringeSequence((8, 7), 3, exposures=(0.5, 1.0))
VIEWS = ("C1P1", "C2P1")
EACH = 12  # 2 orientations of 2 densities of 3 steps
PERIOD_S, LEAD_S, SETTLE_S = 0.02, 0.1, 0.05
BURST_S = LEAD_S + (EACH - 1) * PERIOD_S + 0.05  # to the last pulse, and until no other frame has come
BOTH = PulseTrain(("C1", "C2"), 1e3 * PERIOD_S, 1e3 * LEAD_S)
MakeRig = Callable[..., ConnectedRig]


def rig_file(pulses: PulseTrain | None = BOTH, cameras: Sequence[CameraInstrument] = ()) -> RigFile:
    seeing = tuple(cameras) or (
        VirtualCamera("C1", 128, 128, "simulated"),
        VirtualCamera("C2", 128, 96, "simulated"),
    )
    return RigFile("virtual", seeing, (VirtualProjector("P1", 256, 192, "simulated", 50.0, pulses),))


@pytest.fixture
def bursting(make_rig: MakeRig) -> MakeRig:
    """Make the small rig with pulses of P1, and faults of it and of its cameras."""

    def make(
        faults: dict[str, tuple[OpticalFault, ...]] | None = None,
        stops: tuple[ProjectorFault, ...] = (),
        pulses: PulseTrain = BOTH,
    ) -> ConnectedRig:
        rig = make_rig(faults)
        playing = SimulatedProjector("P1", room_of(rig), SETTLE_S, pulses, stops)
        return replace(rig, projectors={**rig.projectors, "P1": playing}, burst=rig_file(pulses).burst)

    return make


def room_of(rig: ConnectedRig) -> VirtualRoom:
    camera = rig.cameras["C1"]
    assert isinstance(camera, SimulatedCamera)
    return camera.room


def nobody(fraction: float, words: str) -> None:
    """Progress that nobody watches."""


def record(rig: ConnectedRig, spool: Path, told: Callable[[float, str], None] = nobody) -> float:
    """Record a state and return how long that took."""
    begun = rig.clock.monotonic()
    record_state(rig, VIEWS, SEQUENCE, spool, Limits(), told)
    return rig.clock.monotonic() - begun


def same_frames(one: Path, other: Path) -> bool:
    for view in VIEWS:
        first, second = (recorded(spool, view, SEQUENCE)[0] for spool in (one, other))
        np.testing.assert_array_equal(first.texture, second.texture)
        for k in range(SEQUENCE.frames):
            np.testing.assert_array_equal(first.frames.frame(k), second.frames.frame(k))
    return True


@pytest.fixture(scope="module")
def stepped(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Where a recording pattern by pattern is kept, once one was made."""
    return [tmp_path_factory.mktemp("stepped") / "s"]


def expected(make_rig: MakeRig, stepped: list[Path]) -> Path:
    if not stepped[0].exists():
        assert record(make_rig(), stepped[0]) == pytest.approx(25 * SETTLE_S)
    return stepped[0]


def test_a_burst_records_what_patterns_one_by_one_do(
    make_rig: MakeRig, bursting: MakeRig, stepped: list[Path], tmp_path: Path
) -> None:
    rig = bursting()
    fractions: list[float] = []
    took = record(rig, tmp_path / "s", lambda fraction, words: fractions.append(fraction))
    # Two bursts, one for each exposure, and the white frame, which is shown by a command.
    assert took == pytest.approx(2 * BURST_S + SETTLE_S)
    assert same_frames(tmp_path / "s", expected(make_rig, stepped))
    assert len(fractions) == 2 * EACH
    assert fractions == sorted(fractions)
    for view in VIEWS:
        _, recording = recorded(tmp_path / "s", view, SEQUENCE)
        assert (np.diff(recording.numbers) == 1).all()
        np.testing.assert_allclose(np.diff(recording.times_s)[: EACH - 1], PERIOD_S, rtol=1e-9)
        assert (recording.retaken, recording.verdict.doubts) == (0, ())
        assert not interrupted(tmp_path / "s", view, SEQUENCE)
    # In the dark, and nobody waits for pulses.
    room = room_of(rig)
    assert not room.view("C1", 1.0).any()
    assert not room.wires


REFUSED = {
    ("dropped-frame", 1): r"C2 delivered 11 of 12 frames of a burst",  # the others fit together
    ("dropped-frame", 5): r"C2 went from frame 4 to 6 after frame 4 of a burst of 12",
    ("dropped-frame", EACH): r"C2 delivered 11 of 12 frames of a burst",
    ("lost-pulse", 1): r"C2 delivered 11 of 12 frames of a burst",
    ("lost-pulse", 5): r"C2 missed a pulse after frame 4 of .*: the next came 40 ms later, .* 20 ms apart",
    ("lost-pulse", EACH): r"C2 delivered 11 of 12 frames of a burst",
    ("double-pulse", 1): r"C2 was exposed twice after frame 1 of .*: the next came 10 ms later",
    ("double-pulse", 5): r"C2 was exposed twice after frame 5 of .*: the next came 10 ms later",
    ("double-pulse", EACH): r"C2 delivered 13 frames for 12 pulses",
    ("late-pulse", 1): r"C2 was not in step after frame 1 of .*: the next came 14 ms later",
    ("late-pulse", 5): r"C2 was not in step after frame 4 of .*: the next came 26 ms later",
    ("late-pulse", EACH): r"C2 was not in step after frame 11 of .*: the next came 26 ms later",
}


@pytest.mark.parametrize(("fault", "at"), REFUSED)
def test_a_burst_that_is_not_whole_is_played_again(
    make_rig: MakeRig,
    bursting: MakeRig,
    stepped: list[Path],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    fault: Literal["dropped-frame", "lost-pulse", "double-pulse", "late-pulse"],
    at: int,
) -> None:
    record(bursting({"C2": (OpticalFault(fault, "S00", at),)}), tmp_path / "s")
    (told,) = [r.getMessage() for r in caplog.records if "it is taken again" in r.getMessage()]
    assert re.search(REFUSED[fault, at], told), told
    assert same_frames(tmp_path / "s", expected(make_rig, stepped))
    for view in VIEWS:
        assert recorded(tmp_path / "s", view, SEQUENCE)[1].retaken == EACH


@pytest.mark.parametrize("at", [1, 8])
def test_a_projector_that_stops_is_named(
    make_rig: MakeRig,
    bursting: MakeRig,
    stepped: list[Path],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    at: int,
) -> None:
    record(bursting(stops=(ProjectorFault("stops", "S00", at),)), tmp_path / "s")
    assert same_frames(tmp_path / "s", expected(make_rig, stepped))
    assert (
        f"projector P1 stopped after {at - 1} of 12 patterns, and camera C1 delivered {at - 1}" in caplog.text
    )


def test_a_burst_that_is_never_whole_leaves_nothing_behind(bursting: MakeRig, tmp_path: Path) -> None:
    # The first exposure is whole; of the second a pulse is lost each time.
    lost = tuple(OpticalFault("lost-pulse", frame=EACH + 4 + 12 * k) for k in range(3))
    rig = bursting({"C1": lost})
    with pytest.raises(InstrumentError, match=r"C1 missed a pulse after frame 3.*3 times.*period_ms"):
        record(rig, tmp_path / "s")
    assert finished_sets(tmp_path / "s") == {}
    assert not room_of(rig).wires
    record(bursting(), tmp_path / "s")
    for view in VIEWS:  # what broke off has the frames of the first exposure, and none of the second
        (broken,) = interrupted(tmp_path / "s", view, SEQUENCE)
        whole = recorded(tmp_path / "s", view, SEQUENCE)[0]
        assert broken.frames.shape[0] == EACH
        np.testing.assert_array_equal(broken.frames.frame(EACH - 1), whole.frames.frame(EACH - 1))


def test_a_burst_that_is_stopped_leaves_the_hall_dark(bursting: MakeRig, tmp_path: Path) -> None:
    rig = bursting()

    def stop(fraction: float, words: str) -> None:
        if "frame 7 " in words:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        record(rig, tmp_path / "s", stop)
    assert not room_of(rig).view("C1", 1.0).any()
    assert not room_of(rig).wires
    assert finished_sets(tmp_path / "s") == {}
    record(bursting(), tmp_path / "s")
    assert not any(interrupted(tmp_path / "s", view, SEQUENCE) for view in VIEWS)


def test_an_unplugged_camera_ends_a_burst(bursting: MakeRig, tmp_path: Path) -> None:
    rig = bursting({"C2": (OpticalFault("unplugged", frame=EACH + 5),)})
    with pytest.raises(LinkLost, match="C2 does not answer"):
        record(rig, tmp_path / "s")
    assert not room_of(rig).wires
    record(bursting(), tmp_path / "s")
    assert [interrupted(tmp_path / "s", v, SEQUENCE)[0].frames.shape[0] for v in VIEWS] == [EACH, EACH]


def test_a_camera_beyond_the_wires_has_patterns_shown_one_by_one(bursting: MakeRig, tmp_path: Path) -> None:
    alone = PulseTrain(("C1",), 20.0)
    assert record(bursting(pulses=alone), tmp_path / "s") == pytest.approx(25 * SETTLE_S)
    assert ways(rig_file(alone), VIEWS, SEQUENCE) == {
        "P1": "12 patterns shown one by one: its pulses do not reach C2"
    }
    assert ways(rig_file(None), VIEWS, SEQUENCE) == {
        "P1": "12 patterns shown one by one: the file of rig virtual gives P1 no pulses"
    }
    assert ways(rig_file(alone), ("C1P1",), SEQUENCE) == {
        "P1": "12 patterns played in a burst, one every 20 ms"
    }


def test_a_pre_exposure_is_a_burst_as_well(make_rig: MakeRig, bursting: MakeRig, tmp_path: Path) -> None:
    seen = []
    for rig in (make_rig(), bursting()):
        one = FringeSet(rig, ("C1", "C2"), SEQUENCE, 1.0, tmp_path, Limits(), projector="P1")
        begun = rig.clock.monotonic()
        seen.append(one.looked_at(nobody))
        took = rig.clock.monotonic() - begun
    assert took == pytest.approx(2 * BURST_S)
    for shown, played in zip(*seen, strict=True):
        for k in range(SEQUENCE.frames):
            np.testing.assert_array_equal(shown.frames.frame(k), played.frames.frame(k))


def test_a_burst_takes_as_long_as_was_said(bursting: MakeRig, tmp_path: Path) -> None:
    (said,) = rehearse(rig_file(), VIEWS, SEQUENCE, (None,))
    assert record(bursting(), tmp_path / "s") == pytest.approx(said.recording_s)


def test_loading_patterns_is_counted_once_for_all_exposures() -> None:
    class Loading(VirtualProjector):
        load_ms = 4000.0

    plain = rig_file()
    loading = replace(plain, projectors=(Loading("P1", 256, 192, "simulated", 50.0, BOTH),))
    before, after = (rehearse(rig, VIEWS, SEQUENCE, (None,))[0].recording_s for rig in (plain, loading))
    assert after - before == pytest.approx(4.0)


def test_pulses_wait_for_the_slowest_camera() -> None:
    class Slow(VirtualCamera):
        exposure_ms, readout_ms = 30.0, 4.0

    class Quick(VirtualCamera):
        exposure_ms = 30.0

    slow = rig_file(cameras=(Slow("C1", 8, 8, "simulated"), Quick("C2", 8, 8, "simulated")))
    assert slow.burst("P1", ("C1", "C2"), 12, 0.5) == Burst(12, 0.5, 0.02, 0.1, 0.015)  # 15 + 4 ms are less
    assert slow.burst("P1", ("C1", "C2"), 12, 2.0) == Burst(12, 2.0, 0.06 + 0.004, 0.1, 0.06)
    assert slow.burst("P1", ("C2",), 12, 2.0) == Burst(12, 2.0, 0.06, 0.1, 0.06)
    assert slow.way("P1", ("C1", "C2"), (0.5, 2.0)) == "patterns played in a burst, one every 20, 64 ms"


def test_cameras_of_a_burst_expose_as_long_as_each_other() -> None:
    class Slow(VirtualCamera):
        exposure_ms = 30.0

    class Quick(VirtualCamera):
        exposure_ms = 20.0

    with pytest.raises(InvalidInput, match=r"pulses of P1 expose C1 for 30 ms and C2 for 20 ms"):
        rig_file(cameras=(Slow("C1", 8, 8, "simulated"), Quick("C2", 8, 8, "simulated")))


def test_a_burst_that_does_not_fit_into_memory_is_told_at_once(
    bursting: MakeRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Little:
        available = 10_000

    rig = bursting()
    monkeypatch.setattr(psutil, "virtual_memory", Little)
    with pytest.raises(InvalidInput, match=r"12 frames of each of C1, C2 wait in memory.*remove `pulses`"):
        record(rig, tmp_path / "s")
    assert not list((tmp_path / "s").iterdir())


@pytest.mark.parametrize(
    ("pulses", "words"),
    [
        (((), 20.0), "pulses are wired to cameras, each named once, not to ''"),
        ((("C1", "C1"), 20.0), "not to 'C1, C1'"),
        ((("C1",), 0.0), "a period above 0"),
        ((("C1",), 20.0, -1.0), "a lead from 0"),
        ((("C1", "C9"), 20.0), "wires pulses of P1 to C9, which is none of its cameras C1, C2"),
    ],
)
def test_pulses_that_cannot_be(pulses: tuple[tuple[str, ...], float], words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        rig_file(PulseTrain(*pulses))


def test_a_camera_that_waits_for_no_pulses_cannot_be_wired_to_them() -> None:
    class Deaf(VirtualCamera):
        pulsed = False

    with pytest.raises(InvalidInput, match=r"pulses of P1 to C1, which does not wait for them.*pulse_line"):
        rig_file(PulseTrain(("C1",), 20.0), (Deaf("C1", 8, 8, "simulated"),))


def test_the_job_plays_bursts(tmp_path: Path) -> None:
    campaign = replace(small_plate("plate")[1], views=("C1P1",), sequence=SEQUENCE)
    state = Subject("plate", "S00")
    measured: list[Measurement] = []
    for name, pulses in (("burst", PulseTrain(("C1",), 20.0)), ("stepped", None)):
        camera = VirtualCamera("C1", 128, 128, "simulated", (OpticalFault("lost-pulse", "S00", 5),))
        rig = rig_file(pulses, (camera,))
        context = acquire.KIND.context(campaign, state)
        inputs = Inputs(state, context, {}, 1, station=Station(rig, tmp_path / name))
        parameters = acquire.AcquireParameters(recordings=1)
        (output,) = acquire.KIND.run(inputs, parameters, lambda fraction, message="": None)
        assert isinstance(output, DatasetOutput)
        found, how = output.records["measurement"], output.records["recording"]
        assert isinstance(found, Measurement)
        assert isinstance(how, Recording)
        assert how.retaken == (0 if pulses is None else EACH)
        measured.append(found)
    np.testing.assert_array_equal(measured[0].texture, measured[1].texture)
    for k in range(SEQUENCE.frames):
        np.testing.assert_array_equal(measured[0].frames.frame(k), measured[1].frames.frame(k))
