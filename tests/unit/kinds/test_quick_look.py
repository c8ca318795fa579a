"""A quick look at a simulated state: the truth within what it states, and doubts where something is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.kinds.deformation.quick_look import KIND, Compared, QuickLookParameters
from sms_jobs.kinds.kind import DatasetOutput, Inputs
from sms_jobs.kinds.shape.plane import PlaneParameters
from sms_jobs.kinds.shape.stereo_parameters import StereoParameters
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, Measurement
from sms_jobs.records.quick_look import QuickLook
from sms_jobs.records.reasons import Reason
from sms_jobs.records.recording import Recording, Verdict
from sms_jobs.records.scene import AT_ORIGIN, Simulation
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import InMemory, unheard
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.deformations import carried_points, packed_chain
from sms_jobs.virtual_rig.rendering import render

GAUGES = ("g1 x=0 y=0 length=60", "g2 x=20 y=-10 length=40 angle=90", "off x=300 y=0 length=10")
ALONG = 0.005
"""Strain of the small plate along x; -0.3 times that along y."""


@dataclass(frozen=True)
class Test:
    """Two states of a plate, and in which frame its gauges are."""

    __test__ = False

    calibration: Calibration
    before: Measurement
    after: Measurement
    placement: Pose
    true: Callable[[np.ndarray], np.ndarray]

    def look(
        self,
        after: Measurement | None = None,
        parameters: QuickLookParameters | None = None,
        recording: Recording | None = None,
        rest: DatasetOutput | None = None,
    ) -> DatasetOutput:
        parameters = parameters or QuickLookParameters()
        subject = Subject("plate", "S01", "C1P1")
        own = {"measurement": after or self.after} | ({} if recording is None else {"recording": recording})
        datasets = {
            f"measurement {subject}": InMemory(subject, own),
            "calibration": InMemory(subject, {"calibration": self.calibration}),
        }
        if not parameters.alone:
            records = (rest or self.at_rest(parameters)).records
            datasets["reference"] = InMemory(replace(subject, state="S00"), records)
            at_rest = {"measurement": self.before}
            datasets["reference_measurement"] = InMemory(replace(subject, state="S00"), at_rest)
        return ran(subject, self.placement, datasets, parameters)

    def at_rest(self, parameters: QuickLookParameters | None = None) -> DatasetOutput:
        subject = Subject("plate", "S00", "C1P1")
        datasets = {
            f"measurement {subject}": InMemory(subject, {"measurement": self.before}),
            "calibration": InMemory(subject, {"calibration": self.calibration}),
        }
        return ran(subject, self.placement, datasets, parameters or QuickLookParameters())


def ran(
    subject: Subject, placement: Pose, datasets: dict[str, InMemory], parameters: QuickLookParameters
) -> DatasetOutput:
    inputs = Inputs(
        subject, Compared("S00", GAUGES, placement, StereoParameters(), PlaneParameters()), datasets
    )
    (output,) = KIND.run(inputs, parameters, unheard)
    assert isinstance(output, DatasetOutput)
    KIND.checked(output)
    return output


def read(output: DatasetOutput) -> QuickLook:
    found = output.records["look"]
    assert isinstance(found, QuickLook)
    return found


@pytest.fixture(scope="module")
def test() -> Test:
    calibration, campaign = small_plate("plate")
    assert campaign.scene is not None
    seen = []
    for state in campaign.states:
        simulation = Simulation(campaign.scene, "C1", "P1", state.deformation, state=state.label)
        images = render(simulation, campaign.sequence)
        frames = ArrayStack(images.frames.rows(0, images.frames.shape[1]))
        seen.append(
            Measurement(
                calibration.valid_from,
                campaign.sequence,
                images.full_scale,
                images.gain,
                images.read_noise,
                images.texture,
                frames,
            )
        )
    chain = packed_chain(campaign.states[1].deformation, AT_ORIGIN)
    placement = campaign.scene.placement
    return Test(calibration, *seen, placement, lambda at: carried_points(chain, at) - at)


def test_gauges_read_what_is_true_within_what_they_state(test: Test) -> None:
    output = test.look()
    look = read(output)
    assert (look.names, look.reference_state, look.doubts) == (("g1", "g2", "off"), "S00", ())
    assert list(look.reason) == [Reason.VALID, Reason.VALID, Reason.TOO_FEW_NEIGHBOURS]
    for k, (length, strain) in enumerate(((60.0, ALONG), (40.0, -0.3 * ALONG))):
        error = look.displacement[k] - test.true(look.place[k][None])[0]
        # Eight numbers: none is beyond 4.5 standard deviations but once in 18,000 times.
        assert np.all(np.abs(error) < 4.5 * look.sigma[k]), (error, look.sigma[k])
        # The plate is flat, so that its gauges are as long as they say.
        assert look.extension[k] == pytest.approx(strain * length, abs=4.5 * float(look.extension_sigma[k]))
        # A subset of 21 px with this texture is matched to 0.01 px, 0.014 mm, and depth to three times that.
        assert np.all(look.sigma[k] < 0.05)
    assert np.isnan([*look.displacement[2], look.extension[2]]).all()
    assert output.statistics["gauges_read"] == 2.0
    assert output.statistics["g1_extension_mm"] == look.extension[0]
    assert "off_extension_mm" not in output.statistics


def test_fewer_places_tell_the_same(test: Test) -> None:
    parameters = QuickLookParameters(places=64)  # every other pixel
    look = read(test.look(parameters=parameters))
    assert look.step_px == 2
    for k in range(2):
        error = look.displacement[k] - test.true(look.place[k][None])[0]
        assert np.all(np.abs(error) < 4.5 * look.sigma[k])  # as above


def test_the_reference_and_what_has_none_show_their_shape(test: Test) -> None:
    for output in (test.at_rest(), test.look(parameters=QuickLookParameters(alone=True))):
        assert (read(output).names, read(output).reference_state) == ((), "")
        surface = output.records["surface"]
        assert isinstance(surface, Surface)
        # The plate fills half the image, of which its rim is given up.
        assert output.statistics["valid_fraction"] > 0.8


def test_what_was_doubted_while_it_was_recorded_is_told(test: Test) -> None:
    verdict = Verdict(0.5, 0.1, 0.3, ("C1P1: load_n went from 1 to 9 N",))
    per_frame = np.zeros(1)
    recording = Recording("rig", verdict, 0, 1, numbers=per_frame.astype(np.int64), times_s=per_frame)
    look = read(test.look(recording=recording))
    assert look.doubts == verdict.doubts
    assert look.reason[0] == Reason.VALID


def test_a_specimen_that_moved_has_no_shape_and_says_why(test: Test) -> None:
    frames = test.after.frames.rows(0, 128).copy()
    half = len(frames) // 2
    frames[half:] = np.roll(frames[half:], 2, axis=2)
    output = test.look(replace(test.after, frames=ArrayStack(frames)))
    (doubt,) = read(output).doubts
    assert "the image moves by 2" in doubt
    assert (read(output).names, list(output.records)) == ((), ["look"])
    assert output.statistics["doubts"] == 1.0


def test_a_blurred_image_is_doubted(test: Test) -> None:
    blurred = ndimage.gaussian_filter(test.after.texture.astype(float), 1.5).astype(np.uint16)
    (doubt,) = read(test.look(replace(test.after, texture=blurred))).doubts
    assert "the image is blurred: its spot is 1." in doubt


def test_saturation_of_what_nobody_has_judged_is_doubted(test: Test) -> None:
    bright = np.minimum(2.0 * test.after.frames.rows(0, 128), test.after.full_scale).astype(np.uint16)
    found = read(test.look(replace(test.after, frames=ArrayStack(bright))))
    assert any("of the lit pixels are saturated" in doubt for doubt in found.doubts)
