"""States are recorded whole, or what broke off is kept and nothing is recorded twice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from sms_jobs.errors import Cancelled, InstrumentError, InvalidInput, LinkLost, StorageFull
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.judging import Limits
from sms_jobs.instruments.kept_sets import finished_sets, interrupted, recorded
from sms_jobs.instruments.protocols import CameraFacts
from sms_jobs.instruments.recorder import record_state
from sms_jobs.instruments.recording_sets import FRAME_TIMEOUT_S
from sms_jobs.instruments.simulated.optics import SimulatedCamera, VirtualRoom
from sms_jobs.instruments.simulated.rig import SimulatedRig
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import OpticalFault

VIEWS = ("C1P1", "C1P2", "C2P1", "C2P2")
SEQUENCE = FringeSequence((8, 7), 3, exposures=(0.5, 1.0))
LIMITS = Limits()
FRAMES = 24  # 2 exposures of 2 orientations of 2 densities of 3 steps


@dataclass
class Told:
    """Listens to progress, and may stop it."""

    words: list[str] = field(default_factory=list)
    fractions: list[float] = field(default_factory=list)
    stop_at: int = -1

    def __call__(self, fraction: float, words: str) -> None:
        self.words.append(words)
        self.fractions.append(fraction)
        if len(self.words) == self.stop_at:
            raise Cancelled("stopped")


def record(rig: ConnectedRig, spool: Path, told: Told | None = None, limits: Limits = LIMITS) -> Told:
    told = told or Told()
    record_state(rig, VIEWS, SEQUENCE, spool, limits, told)
    return told


def room_of(rig: ConnectedRig) -> VirtualRoom:
    camera = rig.cameras["C1"]
    assert isinstance(camera, SimulatedCamera)
    return camera.room


def test_every_pair_gets_the_frames_that_it_would_see(
    make_rig: Callable[..., ConnectedRig], tmp_path: Path
) -> None:
    rig = make_rig()
    told = record(rig, tmp_path / "s")
    assert told.fractions == sorted(told.fractions)
    room = room_of(rig)
    seen = SimulatedRig(room.setting.scene, "S00", (), rig.clock.now())
    for view in VIEWS:
        assert view in finished_sets(tmp_path / "s")
        measurement, recording = recorded(tmp_path / "s", view, SEQUENCE)
        expected = seen.record(view, SEQUENCE)
        np.testing.assert_array_equal(measurement.texture, expected.texture)
        assert measurement.simulation == expected.simulation
        assert measurement.frames.shape == expected.frames.shape
        for k in range(FRAMES):
            np.testing.assert_array_equal(measurement.frames.frame(k), expected.frames.frame(k))
        assert (measurement.full_scale, measurement.gain) == (expected.full_scale, expected.gain)
        assert measurement.read_noise == pytest.approx(expected.read_noise)
        assert (np.diff(recording.numbers) == 1).all()
        # The projectors' settling is all the time that passes.
        np.testing.assert_allclose(np.diff(recording.times_s), 0.05, rtol=1e-9)
        assert recording.retaken == 0
        assert recording.verdict.doubts == ()
        assert 0.2 < recording.verdict.lit_fraction <= 1.0
        assert recording.verdict.modulation > 0.05
    assert not any(interrupted(tmp_path / "s", view, SEQUENCE) for view in VIEWS)
    # In the dark, and no longer armed.
    assert not room.view("C1", 1.0).any()


def test_a_lost_frame_is_taken_again(make_rig: Callable[..., ConnectedRig], tmp_path: Path) -> None:
    rig = make_rig({"C2": (OpticalFault("dropped-frame", "S00", 5),)})
    begun = rig.clock.monotonic()
    record(rig, tmp_path / "s")
    assert rig.clock.monotonic() - begun > FRAME_TIMEOUT_S
    expected = SimulatedRig(room_of(rig).setting.scene, "S00", (), rig.clock.now())
    for view in VIEWS:
        measurement, recording = recorded(tmp_path / "s", view, SEQUENCE)
        assert recording.retaken == (1 if view.endswith("P1") else 0)
        for k in range(FRAMES):
            np.testing.assert_array_equal(
                measurement.frames.frame(k), expected.record(view, SEQUENCE).frames.frame(k)
            )
    # C1 saw pattern 5 twice and its second frame is kept; C2 counted a frame that never came.
    for view in ("C1P1", "C2P1"):
        numbers = recorded(tmp_path / "s", view, SEQUENCE)[1].numbers
        assert list(numbers[:6]) == [1, 2, 3, 4, 6, 7]


def test_a_camera_that_misses_every_frame_is_given_up(
    make_rig: Callable[..., ConnectedRig], tmp_path: Path
) -> None:
    rig = make_rig({"C1": tuple(OpticalFault("dropped-frame", frame=k) for k in (3, 4, 5))})
    with pytest.raises(InstrumentError, match=r"C1 delivered no frame.*3 times"):
        record(rig, tmp_path / "s")
    assert [view for view, _ in interrupted_after(tmp_path / "s", make_rig())] == ["C1P1", "C2P1"]


def interrupted_after(spool: Path, rig: ConnectedRig) -> list[tuple[str, int]]:
    """Return view and number of frames of what had broken off, after recording the rest."""
    record(rig, spool)
    return [(p, broken.frames.shape[0]) for p in VIEWS for broken in interrupted(spool, p, SEQUENCE)]


def test_an_unplugged_camera_loses_nothing_that_was_complete(
    make_rig: Callable[..., ConnectedRig], tmp_path: Path
) -> None:
    frame = FRAMES + 1 + 10  # the tenth of the second projector
    rig = make_rig({"C2": (OpticalFault("unplugged", frame=frame),)})
    with pytest.raises(LinkLost, match="C2 does not answer; check its cable"):
        record(rig, tmp_path / "s")
    assert [p for p in VIEWS if p in finished_sets(tmp_path / "s")] == ["C1P1", "C2P1"]
    before = {p: (tmp_path / "s" / f"{p}.001.frames").stat().st_mtime_ns for p in ("C1P1", "C2P1")}
    # Plugged in again: what there is stays as it is, the rest is recorded, what broke off is kept beside it.
    assert interrupted_after(tmp_path / "s", make_rig()) == [("C1P2", 9), ("C2P2", 9)]
    assert before == {p: (tmp_path / "s" / f"{p}.001.frames").stat().st_mtime_ns for p in before}
    for view in ("C1P2", "C2P2"):
        (broken,) = interrupted(tmp_path / "s", view, SEQUENCE)
        whole = recorded(tmp_path / "s", view, SEQUENCE)[0]
        for k in range(9):
            np.testing.assert_array_equal(broken.frames.frame(k), whole.frames.frame(k))


def test_a_saturated_set_is_recorded_again(make_rig: Callable[..., ConnectedRig], tmp_path: Path) -> None:
    rig = make_rig({"C1": (OpticalFault("flash", frame=4),)})
    record(rig, tmp_path / "s")
    _, recording = recorded(tmp_path / "s", "C1P1", SEQUENCE)
    assert recording.recordings == 2
    assert recording.verdict.doubts == ()
    assert recorded(tmp_path / "s", "C1P2", SEQUENCE)[1].recordings == 1
    assert len(list((tmp_path / "s").glob("*.frames"))) == len(VIEWS)


def test_a_set_that_stays_saturated_is_kept_and_says_so(
    make_rig: Callable[..., ConnectedRig], tmp_path: Path
) -> None:
    rig = make_rig({"C1": (OpticalFault("flash", frame=4),)})
    record(rig, tmp_path / "s", limits=Limits(recordings=1))
    _, recording = recorded(tmp_path / "s", "C1P1", SEQUENCE)
    assert recording.recordings == 1
    assert recording.verdict.saturated_fraction == 1.0
    assert recording.verdict.doubts == ("C1P1: 100% of the lit region is saturated, allowed is 2%",)


def test_a_recording_that_is_stopped_leaves_the_hall_dark(
    make_rig: Callable[..., ConnectedRig], tmp_path: Path
) -> None:
    rig = make_rig()
    with pytest.raises(Cancelled):
        record(rig, tmp_path / "s", Told(stop_at=7))
    assert not room_of(rig).view("C1", 1.0).any()
    assert interrupted_after(tmp_path / "s", make_rig()) == [("C1P1", 7), ("C2P1", 7)]


def test_channels_are_read_before_and_after(make_rig: Callable[..., ConnectedRig], tmp_path: Path) -> None:
    @dataclass
    class Load:
        value: float = 100.0
        unit: str = "N"

        def read(self) -> float:
            self.value += 1.0
            return self.value

    record(make_rig(channels={"load_n": Load()}), tmp_path / "s")
    _, recording = recorded(tmp_path / "s", "C2P2", SEQUENCE)
    assert recording.channels_before == {"load_n": 103.0}
    assert recording.channels_after == {"load_n": 104.0}


@dataclass
class Ramp:
    """A load that goes on by a newton at each reading, until it is held."""

    held_at: float
    value: float = 100.0
    unit: str = "N"

    def read(self) -> float:
        self.value = min(self.value + 1.0, self.held_at)
        return self.value


def test_a_set_during_which_the_load_moved_is_recorded_again(
    make_rig: Callable[..., ConnectedRig], tmp_path: Path
) -> None:
    limits = Limits(channels={"load_n": 0.5})
    record(make_rig(channels={"load_n": Ramp(103.0)}), tmp_path / "s", limits=limits)
    # From 101 to 102 in the first set; from 103 on it is held.
    recordings = [recorded(tmp_path / "s", view, SEQUENCE)[1] for view in VIEWS]
    assert [r.recordings for r in recordings] == [2, 1, 2, 1]
    assert all(r.channels_before == r.channels_after == {"load_n": 103.0} for r in recordings)
    record(make_rig(channels={"load_n": Ramp(1000.0)}), tmp_path / "t", limits=limits)
    _, moving = recorded(tmp_path / "t", "C2P1", SEQUENCE)
    assert moving.verdict.doubts == (
        "C2P1: load_n went from 103 to 104 N while it was recorded, allowed is 0.5 N",
    )


def test_a_channel_is_recorded_and_judged_in_the_unit_of_its_name(
    make_rig: Callable[..., ConnectedRig], tmp_path: Path
) -> None:
    limits = Limits(channels={"load_n": 500.0})
    record(make_rig(channels={"load_n": Ramp(1000.0, unit="kN")}), tmp_path / "s", limits=limits)
    _, recording = recorded(tmp_path / "s", "C2P1", SEQUENCE)
    assert (recording.channels_before, recording.channels_after) == ({"load_n": 103e3}, {"load_n": 104e3})
    assert recording.verdict.doubts == (
        "C2P1: load_n went from 103000 to 104000 N while it was recorded, allowed is 500 N",
    )


def test_a_channel_that_is_only_to_be_read_may_move(
    make_rig: Callable[..., ConnectedRig], tmp_path: Path
) -> None:
    limits = Limits(channels={"load_n": None})
    record(make_rig(channels={"load_n": Ramp(1000.0)}), tmp_path / "s", limits=limits)
    assert recorded(tmp_path / "s", "C1P1", SEQUENCE)[1].verdict.doubts == ()
    with pytest.raises(InvalidInput, match="rig virtual has no channel 'load_n'"):
        record(make_rig(), tmp_path / "t", limits=limits)


def test_the_white_frame_has_an_exposure_of_its_own(
    make_rig: Callable[..., ConnectedRig], tmp_path: Path
) -> None:
    rig = make_rig()
    for name, exposure in (("bright", 1.0), ("dim", 0.5)):
        record_state(rig, ("C1P1",), SEQUENCE, tmp_path / name, LIMITS, Told(), exposure)
    bright, dim = (recorded(tmp_path / n, "C1P1", SEQUENCE)[0] for n in ("bright", "dim"))
    unsaturated = bright.texture < bright.full_scale
    level = bright.texture[unsaturated].astype(float)
    # Half the light, with the shot noise of both, averaged over more than a thousand pixels.
    assert level.size > 1000
    noise = np.sqrt(dim.read_noise**2 + dim.gain * level.mean())
    assert dim.texture[unsaturated].mean() == pytest.approx(
        0.5 * level.mean(), abs=5.0 * noise / np.sqrt(level.size)
    )
    np.testing.assert_array_equal(dim.frames.frame(3), bright.frames.frame(3))


def test_a_disk_without_room_is_told_before_anything_is_recorded(
    make_rig: Callable[..., ConnectedRig], tmp_path: Path
) -> None:
    class Huge(SimulatedCamera):
        @property
        def facts(self) -> CameraFacts:
            return replace(super().facts, rows=10**7, columns=10**7)  # 5 PB of frames

    rig = make_rig()
    rig = replace(rig, cameras={**rig.cameras, "C2": Huge("C2", room_of(rig))})
    with pytest.raises(StorageFull, match="the frames of this state need"):
        record(rig, tmp_path / "s")
    assert not list((tmp_path / "s").iterdir())


def test_a_pair_that_the_rig_does_not_have_is_refused(
    make_rig: Callable[..., ConnectedRig], tmp_path: Path
) -> None:
    with pytest.raises(InvalidInput, match=r"no P3 for the view C1P3; it has C1, C2, P1, P2"):
        record_state(make_rig(), ("C1P1", "C1P3"), SEQUENCE, tmp_path / "s", Limits(), Told())
    assert not list((tmp_path / "s").iterdir())
