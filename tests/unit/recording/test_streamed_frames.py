"""Frames that flow through rings into a spool, what is told of them, and what a kill leaves."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from sms_jobs.errors import Cancelled, FrameLost, InstrumentError, InvalidInput, LinkLost
from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.frame_ring import FrameRing
from sms_jobs.instruments.holding import EventDetector
from sms_jobs.instruments.kept_streams import frames_path, kept_stream, moments_path, readings_path, value_at
from sms_jobs.instruments.protocols import CameraFacts, Frame
from sms_jobs.instruments.spool import Spooled
from sms_jobs.instruments.streaming import StreamOrder, stream
from sms_jobs.kinds.recording.stream import StreamParameters, states_of
from sms_jobs.records.events import Event
from sms_jobs.records.operations import Reading
from sms_jobs.records.streams import StreamSize, frame_label, stream_of

ROWS, COLUMNS = 32, 48
CAMERAS = ("C1", "C2")
ABOVE = Event("load_n", "N", "above", 50.0)
DROP = Event("load_n", "N", "drops", 10.0, 1.0)


@dataclass
class CountingCamera:
    """Delivers frames whose grey level is their number; some of them never come."""

    clock: RealClock = field(default_factory=RealClock)
    lost: frozenset[int] = frozenset()
    unplugged_at: int = 1_000_000
    facts: CameraFacts = field(default_factory=lambda: CameraFacts(COLUMNS, ROWS, "uint16", 4095, 0.15, 1.5))
    _number: int = 0

    def arm(self, exposure: float) -> None:
        """It is ready."""

    def trigger(self) -> None:
        self._number += 1

    def read(self, timeout_s: float) -> Frame:
        if self._number >= self.unplugged_at:
            raise LinkLost("camera C1 does not answer")
        if self._number in self.lost:
            raise FrameLost("camera C1 delivered no frame")
        image = np.full((ROWS, COLUMNS), self._number, np.uint16)
        return Frame(self._number, self.clock.monotonic(), image)

    def disarm(self) -> None:
        """It stands still."""


@dataclass
class Load:
    """A load that is a function of the time since it was first read."""

    of: Callable[[float], float]
    unit: str = "N"
    _begun: float | None = None

    def read(self) -> float:
        return self.reading().value

    def reading(self) -> Reading:
        now = datetime.now(UTC)
        self._begun = self._begun or now.timestamp()
        return Reading("load_n", self.of(now.timestamp() - self._begun), self.unit, now)


def rig(load: Load | None = None, **of_first: object) -> ConnectedRig:
    cameras = {"C1": CountingCamera(**of_first), "C2": CountingCamera()}  # type: ignore[arg-type]
    return ConnectedRig("pair", cameras, {}, RealClock(), channels={} if load is None else {"load_n": load})


def nobody(fraction: float, words: str) -> None:
    """Listen to progress."""


def numbers(spool: Path, camera: str) -> list[int]:
    """Return the numbers of the frames of a camera, each of which must show its own."""
    file = Spooled(frames_path(spool, camera))
    found = file.numbers_and_times(file.complete)[0].tolist()
    assert [int(file.frame(place).max()) for place in range(file.complete)] == found
    return [int(number) for number in found]


def test_every_frame_has_its_moment_and_its_load(tmp_path: Path) -> None:
    stream(rig(Load(lambda t: 100.0 * t)), StreamOrder(CAMERAS, StreamSize(50.0, 0.6)), tmp_path, nobody)
    kept = kept_stream(tmp_path, CAMERAS)
    assert kept is not None
    assert kept.ended
    whole, account = kept.whole(), kept.account("C1")
    assert len(whole) == account.moments <= 30 - account.late
    assert (account.lost, account.refused) == (0, 0)
    times = np.array([moment.time_s for moment in whole])
    assert (np.diff(times) > 0.0).all()
    read_s, read = kept.readings["load_n"]
    for moment in whole:
        # The load goes by 100 N in a second: so much and no more may a value be from the line through all.
        line = np.polyval(np.polyfit(read_s, read, 1), moment.time_s)
        assert kept.values_at(moment.time_s)["load_n"] == pytest.approx(line, abs=0.5)
    # The first frame of all is thrown away: it only shows that the camera delivers.
    assert numbers(tmp_path, "C2")[0] == 2


def test_a_frame_that_is_lost_makes_no_state_and_is_told(tmp_path: Path) -> None:
    order = StreamOrder(CAMERAS, StreamSize(40.0, 0.5))
    stream(rig(lost=frozenset({4, 7})), order, tmp_path, nobody)
    kept = kept_stream(tmp_path, CAMERAS)
    assert kept is not None
    assert (kept.account("C1").lost, kept.account("C2").lost) == (2, 0)
    moments = kept.account("C2").moments
    outputs = list(states_of(kept, "wing", StreamParameters(number=2, every=3), nobody))
    labels = list(dict.fromkeys(output.subject.state for output in outputs))
    assert labels == [frame_label(2, n) for n in range(1, -(-(moments - 2) // 3) + 1)]
    # Of the other camera nothing is missing: what is no state lies beside the state before it.
    archived: list[int] = []
    for output in outputs:
        if output.subject.view == "C2":
            records = {product.stored_as: record for product, record in output.products.items()}
            archived += records["recording"].numbers.tolist()
            archived += records["between_after"].numbers.tolist() if "between_after" in records else []
    assert archived == numbers(tmp_path, "C2")
    assert len(archived) == moments
    assert outputs[0].statistics["stream_lost"] == 2.0


def test_what_is_around_an_event_is_kept(tmp_path: Path) -> None:
    order = StreamOrder(CAMERAS, StreamSize(50.0, 20.0, 0.3, 0.2), ABOVE)
    stream(rig(Load(lambda t: 100.0 * (t > 0.8))), order, tmp_path, nobody)
    kept = kept_stream(tmp_path, CAMERAS)
    assert kept is not None
    event_s = kept.files["C1"].header.about["event_s"]
    since = np.array([moment.time_s - event_s for moment in kept.whole()])
    assert since[0] >= -0.3
    assert since[0] < 0.0
    assert since[-1] > 0.0
    assert len(since) <= 0.5 * 50.0 + 2


def test_an_event_that_does_not_come_leaves_nothing(tmp_path: Path) -> None:
    order = StreamOrder(CAMERAS, StreamSize(50.0, 0.3, 0.2, 0.2), ABOVE)
    stream(rig(Load(lambda t: 1.0)), order, tmp_path, nobody)
    assert kept_stream(tmp_path, CAMERAS) is None


def test_what_flowed_stays_when_a_camera_fails(tmp_path: Path) -> None:
    order = StreamOrder(CAMERAS, StreamSize(100.0, 60.0))
    with pytest.raises(LinkLost, match="C1 does not answer"):
        stream(rig(unplugged_at=20), order, tmp_path, nobody)
    kept = kept_stream(tmp_path, CAMERAS)
    assert kept is not None
    assert not kept.ended
    assert numbers(tmp_path, "C1") == list(range(2, 20))
    assert len(kept.whole()) == 18


def test_what_flowed_stays_when_it_is_stopped(tmp_path: Path) -> None:
    def stop(fraction: float, words: str) -> None:
        if fraction > 0.005:
            raise Cancelled("stopped")

    before = set(threading.enumerate())  # those of other tests may end meanwhile
    with pytest.raises(Cancelled):
        stream(rig(), StreamOrder(CAMERAS, StreamSize(100.0, 60.0)), tmp_path, stop)
    assert numbers(tmp_path, "C1")[0] == 2
    assert not set(threading.enumerate()) - before


def test_a_torn_end_is_left_out(tmp_path: Path) -> None:
    """As after a loss of power: a frame that is not whole, lines that are not, frames of one camera alone."""
    stream(rig(Load(lambda t: t)), StreamOrder(CAMERAS, StreamSize(100.0, 0.2)), tmp_path, nobody)
    before = kept_stream(tmp_path, CAMERAS)
    assert before is not None
    with frames_path(tmp_path, "C1").open("r+b") as file:
        file.truncate(file.seek(0, 2) - 100)
    for path in (moments_path(tmp_path), readings_path(tmp_path)):
        text = path.read_bytes().removesuffix(b"end\n")
        path.write_bytes(text[:-3])
    kept = kept_stream(tmp_path, CAMERAS)
    assert kept is not None
    assert not kept.ended
    assert kept.whole() == before.whole()[:-1]


def test_a_ring_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    order = StreamOrder(CAMERAS, StreamSize(1e4, 60.0, 3600.0, 1.0), ABOVE)
    with pytest.raises(InvalidInput, match=r"frames of each of C1, C2 wait in memory and need \d+ MB"):
        stream(rig(Load(lambda t: t)), order, tmp_path, nobody)


def test_a_channel_of_another_unit_is_not_waited_for(tmp_path: Path) -> None:
    order = StreamOrder(CAMERAS, StreamSize(10.0, 1.0, 0.1, 0.1), ABOVE)
    with pytest.raises(
        InvalidInput, match="no channel load_n in N, which is waited for; it has load_n in kN"
    ):
        stream(rig(Load(lambda t: t, "kN")), order, tmp_path, nobody)


def test_a_camera_that_delivers_nothing_is_told_before_the_event(tmp_path: Path) -> None:
    with pytest.raises(InstrumentError, match="delivered no frame"):
        stream(rig(lost=frozenset({1})), StreamOrder(CAMERAS, StreamSize(10.0, 1.0)), tmp_path, nobody)


def test_a_ring_keeps_the_newest_and_then_refuses() -> None:
    ring = FrameRing(3, 1, 1, "uint16")
    image = np.zeros((1, 1), np.uint16)
    for number in range(5):
        assert ring.put(number, float(number), image + number)
    ring.flow(3.0)  # of 2, 3 and 4, which it has, it lets go 2
    assert [ring.put(number, float(number), image + number) for number in (5, 6)] == [True, False]
    taken = []
    ring.close()
    while (held := ring.take()) is not None:
        taken.append((held.number, int(ring.image(held)[0, 0])))
        ring.let_go(held)
    assert taken == [(3, 3), (4, 4), (5, 5)]


@pytest.mark.parametrize(
    ("event", "readings", "comes_at"),
    [
        (ABOVE, [10.0, 50.0, 50.1, 0.0], 2),
        (Event("load_n", "N", "below", -50.0), [10.0, -50.0, -51.0], 2),
        (DROP, [100.0, 95.0, 89.0], 2),
        (DROP, [100.0, 98.0, 96.0, 94.0, 92.0, 90.0, 88.0, 80.0], 7),
        (DROP, [100.0, float("nan"), 99.0, 89.0], 3),
    ],
)
def test_an_event_comes_when_it_says(event: Event, readings: list[float], comes_at: int) -> None:
    detector = EventDetector(event)
    # Readings 0.4 s apart: a drop of 10 N in 1 s is that from the highest of the last three.
    told = [detector.held(0.4 * place, value) for place, value in enumerate(readings)]
    assert told == [place >= comes_at for place in range(len(readings))]


def test_a_drop_between_readings_far_apart_is_told() -> None:
    detector = EventDetector(DROP)
    assert not detector.held(0.0, 100.0)
    assert detector.held(30.0, 80.0)


def test_a_value_lies_between_readings_that_are_near() -> None:
    times, values = np.array([0.0, 1.0, 4.0]), np.array([10.0, 20.0, 50.0])
    assert value_at(times, values, 0.25) == 12.5
    assert value_at(times, values, 1.0) == 20.0
    assert value_at(times, values, 2.0) is None  # 3 s without a reading
    assert value_at(times, values, -0.1) is None
    assert value_at(times, values, 4.1) is None


def test_states_are_labelled_by_their_stream() -> None:
    assert [frame_label(1, 7), frame_label(3, 12345)] == ["t0007", "t3-12345"]
    assert [stream_of(label) for label in ("t0007", "t3-12345", "S01", "t7", "t0-0001")] == [1, 3, 0, 0, 0]
