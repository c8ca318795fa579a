"""Cameras without a projector are recorded at one moment, judged by their texture, and count together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from sms_jobs.errors import Cancelled, DeviceFault, InstrumentError, InvalidInput, StorageFull
from sms_jobs.formats.rig_configuration import parse_rig
from sms_jobs.instruments import kept_sets
from sms_jobs.instruments.clock import SimulatedClock
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.connection import connected
from sms_jobs.instruments.judging import Limits
from sms_jobs.instruments.kept_sets import finished_sets, forget, interrupted, recorded
from sms_jobs.instruments.protocols import Camera, CameraFacts, Fired, SoftwareTrigger
from sms_jobs.instruments.recorder import record_state
from sms_jobs.instruments.recording_sets import FRAME_TIMEOUT_S
from sms_jobs.instruments.rehearsal import rehearse
from sms_jobs.instruments.simulated.lamp import RoomLamp
from sms_jobs.instruments.simulated.optics import Setting, SimulatedCamera, SimulatedProjector, VirtualRoom
from sms_jobs.instruments.simulated.rig import SimulatedRig
from sms_jobs.jobs.devices.stations import known_sensors
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import OpticalFault, RigFile
from sms_jobs.records.recording import Recording
from sms_jobs.records.scene import CameraResponse, Scene
from sms_jobs.records.sensors import Rig
from sms_jobs.virtual_rig.campaigns import Lens, aimed
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign, stereo_rig

PAIR = ("C1", "C2")
SEQUENCE = FringeSequence((8, 7), 3)
BEGUN = datetime(2026, 5, 4, 10, 0, tzinfo=UTC)
LIMITS = Limits()
Faults = dict[str, tuple[OpticalFault, ...]]


def scene(exposure: float = CameraResponse().exposure, projector: bool = False) -> Scene:
    made = stereo_campaign("pair", rig=stereo_rig(160, 128), camera=CameraResponse(exposure=exposure))[
        1
    ].scene
    assert made is not None
    if not projector:
        return made
    light = aimed("P1", 128, 96, Lens(2.8, 0.0, 0.0, 0.0, 0.0), (20.0, 150.0, 480.0))
    return replace(made, rig=Rig("pair", (*made.rig.sensors, light)))


@dataclass
class Clicking:
    """A camera whose trigger takes its time to be sent."""

    camera: SimulatedCamera
    takes_s: float

    def __getattr__(self, name: str) -> object:
        return getattr(self.camera, name)

    def trigger(self) -> None:
        self.camera.trigger()
        self.camera.room.clock.sleep(self.takes_s)


def rig_of(
    seen: Scene, faults: Faults | None = None, takes_s: Mapping[str, float] | None = None
) -> ConnectedRig:
    clock = SimulatedClock(BEGUN)
    room = VirtualRoom(Setting(seen, "S00", ()), clock)
    names = [s.name for s in seen.rig.sensors]
    cameras = {n: SimulatedCamera(n, room, (faults or {}).get(n, ())) for n in names if n.startswith("C")}
    return ConnectedRig(
        "pair",
        {n: Clicking(c, (takes_s or {}).get(n, 0.0)) for n, c in cameras.items()},  # type: ignore[misc]
        {n: SimulatedProjector(n, room, 0.05) for n in names if n.startswith("P")},
        clock,
        simulation=room.simulation,
        lamp=RoomLamp(room, {}),
    )


def nobody(fraction: float, words: str) -> None:
    """Progress that nobody watches."""


def record(
    rig: ConnectedRig,
    spool: Path,
    views: tuple[str, ...] = PAIR,
    limits: Limits = LIMITS,
    exposure: float = 1.0,
    told: Callable[[float, str], None] = nobody,
) -> dict[str, Recording]:
    record_state(rig, views, SEQUENCE, spool, limits, told, exposure)
    return {view: recorded(spool, view, SEQUENCE)[1] for view in views}


def test_both_cameras_get_the_image_that_they_would_see(tmp_path: Path) -> None:
    seen, told = scene(), list[float]()
    found = record(rig_of(seen), tmp_path, told=lambda fraction, words: told.append(fraction))
    assert told == [1.0]
    expected = SimulatedRig(seen, "S00", (), BEGUN)
    for view in PAIR:
        measurement, _ = recorded(tmp_path, view, SEQUENCE)
        alone = expected.record(view, SEQUENCE)
        np.testing.assert_array_equal(measurement.texture, alone.texture)
        np.testing.assert_array_equal(measurement.frames.frame(0), alone.texture)
        assert measurement.frames.shape == alone.frames.shape == (1, 128, 160)
        assert (measurement.sequence, measurement.simulation) == (alone.sequence, alone.simulation)
        assert measurement.simulation is not None
        assert measurement.simulation.projector is None
        assert (measurement.full_scale, measurement.gain) == (alone.full_scale, alone.gain)
        verdict = found[view].verdict
        assert (verdict.doubts, found[view].apart_s, found[view].recordings) == ((), 0.0, 1)
        assert verdict.contrast_to_noise is not None
        assert verdict.contrast_to_noise > 5.0
        assert 0.2 < verdict.lit_fraction <= 1.0
    assert not any(interrupted(tmp_path, view, SEQUENCE) for view in PAIR)


def test_the_lamp_is_off_beside_fringes_and_afterwards(tmp_path: Path) -> None:
    seen = scene(projector=True)
    rig = rig_of(seen)
    views = ("C1", "C1P1", "C2")
    found = record(rig, tmp_path, views, limits=Limits(lit_fraction=0.0))
    expected = SimulatedRig(seen, "S00", (), BEGUN)
    for view in views:
        measurement, _ = recorded(tmp_path, view, SEQUENCE)
        alone = expected.record(view, SEQUENCE)
        np.testing.assert_array_equal(measurement.texture, alone.texture)
        assert measurement.frames.shape == alone.frames.shape
        np.testing.assert_array_equal(measurement.frames.frame(0), alone.frames.frame(0))
    assert [found[view].apart_s for view in views] == [0.0, None, 0.0]
    assert [found[view].verdict.level is None for view in views] == [False, True, False]
    # Fringes first, whatever the order of the views.
    begun = {view: recorded(tmp_path, view, SEQUENCE)[0].recorded_at for view in views}
    assert begun["C1P1"] < begun["C1"] == begun["C2"]
    assert not rig.cameras["C1"].room.view("C1", 1.0).any()  # type: ignore[attr-defined]


def test_a_camera_that_misses_its_image_has_all_of_them_taken_again(tmp_path: Path) -> None:
    rig = rig_of(scene(), {"C2": (OpticalFault("dropped-frame", frame=1),)})
    found = record(rig, tmp_path)
    assert rig.clock.monotonic() >= FRAME_TIMEOUT_S
    # C1 was exposed twice and its second image is kept; C2 counted one that never came.
    assert {view: (r.retaken, list(r.numbers)) for view, r in found.items()} == {
        "C1": (1, [2]),
        "C2": (1, [2]),
    }


def test_a_camera_that_gives_no_image_is_given_up_and_asked_again(tmp_path: Path) -> None:
    silent = tuple(OpticalFault("dropped-frame", frame=k) for k in (1, 2, 3))
    with pytest.raises(InstrumentError, match=r"C2 delivered no frame.*3 times"):
        record(rig_of(scene(), {"C2": silent}), tmp_path)
    assert not finished_sets(tmp_path)
    assert set(record(rig_of(scene()), tmp_path)) == {"C1", "C2"}
    assert not any(interrupted(tmp_path, view, SEQUENCE) for view in PAIR)  # nothing of it was complete


def test_images_of_two_moments_are_never_taken_for_one_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Down(Exception):
        pass

    replaced: list[str] = []

    def replace_once(path: Path, target: Path) -> Path:
        if replaced and not target.exists():
            raise Down
        replaced.append(target.name)
        return path.rename(target)

    with monkeypatch.context() as patch:
        patch.setattr(kept_sets.Path, "replace", replace_once)
        with pytest.raises(Down):
            record(rig_of(scene()), tmp_path)
    assert replaced == ["C1.json"]  # and the machine went down before C2's
    assert "C1" not in finished_sets(tmp_path)
    found = record(rig_of(scene()), tmp_path)
    assert all(one.recordings == 1 for one in found.values())
    for view in PAIR:
        (broken,) = interrupted(tmp_path, view, SEQUENCE)
        np.testing.assert_array_equal(broken.frames.frame(0), recorded(tmp_path, view, SEQUENCE)[0].texture)


def test_what_was_complete_is_left_alone(tmp_path: Path) -> None:
    seen = scene(projector=True)

    def stop(fraction: float, words: str) -> None:
        if words.startswith("recording C1, C2"):
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        record(rig_of(seen), tmp_path, ("C1P1", *PAIR), Limits(lit_fraction=0.0), told=stop)
    assert set(finished_sets(tmp_path)) == {"C1P1"}
    before = (tmp_path / "C1P1.001.frames").stat().st_mtime_ns
    record(rig_of(seen), tmp_path, ("C1P1", *PAIR), Limits(lit_fraction=0.0))
    assert (tmp_path / "C1P1.001.frames").stat().st_mtime_ns == before
    # The images that were there when it was stopped are kept beside those of the second time.
    assert [len(interrupted(tmp_path, view, SEQUENCE)) for view in ("C1P1", *PAIR)] == [0, 1, 1]


def test_a_doubtful_image_has_its_partner_recorded_again(tmp_path: Path) -> None:
    flash = {"C1": (OpticalFault("flash", frame=1),)}
    found = record(rig_of(scene(), flash), tmp_path, limits=Limits(recordings=1))
    assert found["C1"].verdict.doubts == ("C1: 100% of the lit region is saturated, allowed is 2%",)
    assert found["C2"].verdict.doubts == ()
    forget(tmp_path, "C1")
    assert not finished_sets(tmp_path)
    assert record(rig_of(scene()), tmp_path)["C1"].verdict.doubts == ()
    assert [len(interrupted(tmp_path, view, SEQUENCE)) for view in PAIR] == [1, 1]


def test_a_set_may_be_recorded_three_times(tmp_path: Path) -> None:
    # A lamp shines in for three frames: into the first set and the second, and a third of the other camera.
    flash = {"C1": (OpticalFault("flash", frame=1),)}
    found = record(rig_of(scene(), flash), tmp_path, limits=Limits(recordings=4))
    assert {view: r.recordings for view, r in found.items()} == {"C1": 4, "C2": 4}
    assert all(r.verdict.doubts == () for r in found.values())
    assert len(list(tmp_path.glob("*.frames"))) == 2


def test_images_that_lie_too_far_apart_are_doubted(tmp_path: Path) -> None:
    # C2 is triggered once the 6 ms of C1's trigger are over, and its own take 6 ms more.
    slow = {"C1": 0.006, "C2": 0.006}
    found = record(rig_of(scene(), takes_s=slow), tmp_path / "a", limits=Limits(recordings=1))
    for view, one in found.items():
        assert one.apart_s == pytest.approx(0.012)
        (doubt,) = one.verdict.doubts
        assert f"{view}: C1 and C2 were exposed up to 12 ms apart, allowed is 10 ms" in doubt
    allowed = record(rig_of(scene(), takes_s=slow), tmp_path / "b", limits=Limits(apart_s=0.0125))
    assert all(one.verdict.doubts == () for one in allowed.values())


def test_one_signal_exposes_at_one_moment_however_long_it_takes(tmp_path: Path) -> None:
    @dataclass(frozen=True)
    class OneWire:
        clock: SimulatedClock

        def fire(self, cameras: Mapping[str, Camera]) -> dict[str, Fired]:
            SoftwareTrigger(self.clock).fire(cameras)
            self.clock.sleep(0.5)
            return dict.fromkeys(cameras, Fired(0.0, self.clock.monotonic()))

    rig = rig_of(scene())
    assert isinstance(rig.clock, SimulatedClock)
    found = record(replace(rig, trigger=OneWire(rig.clock)), tmp_path)
    assert [one.apart_s for one in found.values()] == [0.0, 0.0]


def test_what_cannot_be_matched_is_doubted(tmp_path: Path) -> None:
    lens_cap = record(rig_of(scene(exposure=1e-4)), tmp_path / "dark", limits=Limits(recordings=1))
    assert "of full scale: look at lens cap, lamp and exposure" in lens_cap["C2"].verdict.doubts[0]
    plain = record(rig_of(replace(scene(), speckle=None)), tmp_path / "plain", limits=Limits(recordings=1))
    (doubt,) = plain["C1"].verdict.doubts
    assert "C1: grey levels scatter by 5 times their noise in 0.00% of the image, wanted is 1.00%" in doubt
    assert "look at focus, light and speckle" in doubt
    # Of a plain artefact the outline is what is wanted.
    artefact = Limits(lit_fraction=0.0001, speckled=False)
    board = record(rig_of(replace(scene(), speckle=None)), tmp_path / "board", limits=artefact)
    assert board["C1"].verdict.doubts == ()


def test_the_exposure_of_images_can_be_chosen(tmp_path: Path) -> None:
    for name, exposure in (("bright", 1.0), ("dim", 0.5)):
        record(rig_of(scene(exposure=0.4)), tmp_path / name, exposure=exposure)
    bright, dim = (recorded(tmp_path / n, "C2", SEQUENCE)[0] for n in ("bright", "dim"))
    assert (bright.texture < bright.full_scale).all()
    # The mean of 20480 pixels, whose noise is below 50 grey levels.
    assert dim.texture.mean() == pytest.approx(0.5 * bright.texture.mean(), abs=5.0 * 50.0 / np.sqrt(20480))


def test_a_camera_that_the_rig_does_not_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="rig pair has no C3 for the view C3; it has C1, C2"):
        record(rig_of(scene()), tmp_path, ("C1", "C3"))
    assert not list(tmp_path.iterdir())


def test_room_for_one_image_of_each_is_enough(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bytes_of_both = 2 * 2 * 160 * 128
    for free, refused in ((bytes_of_both, False), (bytes_of_both - 1, True)):
        usage = type("Usage", (), {"free": free})
        monkeypatch.setattr(
            "sms_jobs.instruments.recorder.shutil.disk_usage", lambda path, usage=usage: usage
        )
        if refused:
            with pytest.raises(StorageFull, match="need 0 MB"):
                record(rig_of(scene()), tmp_path / "t")
        else:
            record(rig_of(scene()), tmp_path / "s")


CAMERAS_ALONE = """
name = "pair"
[[cameras]]
name = "C1"
driver = "opencv"
columns = 64
rows = 48
source = "{0}"
discarded = 0
noise_gain = 0.2
read_noise = 1.5
[[cameras]]
name = "C2"
driver = "opencv"
columns = 64
rows = 48
source = "{1}"
discarded = 0
noise_gain = 0.2
read_noise = 1.5
"""


def real_rig(folder: Path, columns: int = 64) -> RigFile:
    """Return a rig of two cameras that OpenCV captures from files: one image to connect, one to record."""
    random = np.random.default_rng(3)
    for name, wide in (("left", 64), ("right", columns)):
        (folder / name).mkdir()
        for number in range(2):
            image = np.kron(random.integers(20, 230, (12, wide // 4)), np.ones((4, 4))).astype(np.uint8)
            cv2.imwrite(str(folder / name / f"{number:03d}.png"), image)
    sources = [folder / name / "%03d.png" for name in ("left", "right")]
    return parse_rig(CAMERAS_ALONE.format(*sources), "rig.toml", known_sensors())


def test_a_rig_of_cameras_alone_records_what_they_deliver(tmp_path: Path) -> None:
    rig = real_rig(tmp_path)
    with connected(rig) as found:
        done = record(found, tmp_path / "s", limits=Limits(apart_s=60.0))
        with pytest.raises(InstrumentError, match="delivers no more frames"):
            record(found, tmp_path / "t")
    for view, folder in (("C1", "left"), ("C2", "right")):
        measurement, _ = recorded(tmp_path / "s", view, SEQUENCE)
        image = cv2.imread(str(tmp_path / folder / "001.png"), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(measurement.texture, image)
        assert measurement.frames.dtype == np.uint8
        assert done[view].verdict.doubts == ()
    # Nobody triggers such cameras: they say themselves when their images were taken, one after the other.
    apart = done["C1"].apart_s
    assert apart is not None
    assert apart > done["C2"].times_s[0] - done["C1"].times_s[0] > 0.0


def test_a_camera_of_another_size_is_refused(tmp_path: Path) -> None:
    rig = real_rig(tmp_path, columns=80)
    words = "C2 delivers images of 80 x 48 pixels, the rig file says 64 x 48"
    with pytest.raises(DeviceFault, match=words), connected(rig):
        pass


def test_a_camera_that_changes_its_size_loses_nothing_of_the_others(tmp_path: Path) -> None:
    class Other(SimulatedCamera):
        @property
        def facts(self) -> CameraFacts:
            return replace(super().facts, columns=100)

    rig = rig_of(scene())
    room = rig.cameras["C1"].room  # type: ignore[attr-defined]
    with pytest.raises(DeviceFault, match="C2 delivers an image of 160 x 128 px, announced were 100 x 128"):
        record(replace(rig, cameras={**rig.cameras, "C2": Other("C2", room)}), tmp_path)
    assert not finished_sets(tmp_path)
    assert set(record(rig_of(scene()), tmp_path)) == {"C1", "C2"}


BOX = """
name = "pair"
cameras = [
    { name = "C1", driver = "simulated", columns = 160, rows = 128 },
    { name = "C2", driver = "simulated", columns = 160, rows = 128 },
]
[[triggers]]
name = "box"
link = { port = "simulated" }
protocol = { prefix = "@", checksum = "sum" }
wiring = [{ sensor = "C1", output = 1 }, { sensor = "C2", output = 2 }]
trigger = "{TRIGGER}"
"""


@pytest.mark.parametrize(("trigger", "together"), [("T", True), ("{output}T", False)])
def test_a_box_that_triggers_both_at_once_says_so(trigger: str, together: bool, tmp_path: Path) -> None:
    rig = parse_rig(BOX.replace("{TRIGGER}", trigger), "rig.toml", known_sensors())
    with connected(rig, Setting(scene(), "S00", ()), clock=SimulatedClock(BEGUN)) as found:
        done = record(found, tmp_path, limits=Limits(apart_s=60.0))
    apart = done["C1"].apart_s
    assert apart is not None
    assert (apart == 0.0) is together
    assert apart < 0.1


def test_a_rehearsal_takes_as_long_and_makes_as_much(tmp_path: Path) -> None:
    rig = parse_rig(BOX.replace("{TRIGGER}", "{output}T"), "rig.toml", known_sensors())
    (said,) = rehearse(rig, PAIR, SEQUENCE, (None,))
    clock = SimulatedClock(BEGUN)
    with connected(rig, Setting(scene(), "S00", ()), clock=clock) as found:
        begun = clock.monotonic()
        record(found, tmp_path, limits=Limits(apart_s=60.0))
        assert clock.monotonic() - begun == pytest.approx(said.recording_s)
    assert said.recording_s > 0.0
    assert (said.frames, said.raw_bytes, said.set_bytes) == (2, 2 * 2 * 160 * 128, 2 * 2 * 160 * 128)
    spooled = sum(finished_sets(tmp_path)[view].path.stat().st_size for view in PAIR)
    # Each file has a header of 64 KiB, and each frame one of 24 bytes.
    assert spooled == said.raw_bytes + 2 * (65536 + 24)
