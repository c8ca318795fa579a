"""Reconstruction by Fourier domain ranging: a plate that a mirror lights a second time, and its limits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from math import pi
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import DatasetOutput
from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.metrology.phase.patterns import direction, span_px
from sms_jobs.records.fields import PhaseMaps, ReturnMaps, Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Simulation
from sms_jobs.records.sensors import Calibration, Rig
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import run_kind
from sms_jobs.virtual_rig.campaigns import plate_and_mirror, small_plate
from sms_jobs.virtual_rig.light import Light, trace
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import Shape, exact_shape

Mask = NDArray[np.bool_]

CROSSED = (0.0, pi / 2)
DIAGONAL = (pi / 4, -pi / 4)
FRINGES = 64
PIXELS = 192


@dataclass(frozen=True)
class Seen:
    """A simulated tuple and what is true of it."""

    calibration: Calibration
    simulation: Simulation
    measurement: Measurement
    shape: Shape
    light: Light

    def reconstruct(self, threads: int = 1, **parameters: Any) -> DatasetOutput:
        subject = Subject("mirror", "S00", "C1P1")
        records = {"measurement": self.measurement, "calibration": self.calibration}
        return run_kind(KIND, subject, records, threads, ReconstructParameters(**parameters))

    def halves(self) -> tuple[Mask, Mask]:
        """Return the parts of the plate that are lit once and twice, without their outermost three pixels."""
        rows, columns = self.shape.lit.shape
        direct, detour = (s.reshape(rows, 2, columns, 2) > 0.0 for s in self.light.strength)
        plate = self.shape.seen & direct.all(axis=(1, 3)) & (self.shape.region == 1)
        parts = (plate & ~detour.any(axis=(1, 3)), plate & detour.all(axis=(1, 3)))
        once, twice = (ndimage.binary_erosion(part, iterations=3) for part in parts)
        return once, twice

    def separation_bins(self, orientation: float) -> NDArray[np.float64]:
        """Return how far apart the two returns of each pixel are, in units of 2 pi / s."""
        projector = self.simulation.scene.rig.sensor("P1")
        a, b = direction(orientation)
        off = a * (self.light.x[0] - self.light.x[1]) + b * (self.light.y[0] - self.light.y[1])
        span = span_px(projector.columns, projector.rows, orientation)
        return np.asarray(np.abs(off)[::2, ::2] / span * FRINGES)


def seen(calibration: Calibration, simulation: Simulation, sequence: FringeSequence) -> Seen:
    recorded = render(simulation, sequence)
    measurement = Measurement(
        recorded_at=calibration.valid_from,
        sequence=sequence,
        full_scale=recorded.full_scale,
        gain=recorded.gain,
        read_noise=recorded.read_noise,
        texture=recorded.texture,
        frames=ArrayStack(recorded.frames.rows(0, recorded.frames.shape[1])),
    )
    return Seen(calibration, simulation, measurement, exact_shape(simulation), trace(simulation))


@cache
def mirror(orientations: tuple[float, ...]) -> Seen:
    """Return the plate beside a mirror, seen by a camera of few pixels but sharp: its blur is 0.25 px."""
    calibration, campaign = plate_and_mirror("mirror", "small", FRINGES)
    assert campaign.scene is not None
    camera, projector = campaign.scene.rig.sensors
    coarse = PIXELS / camera.columns
    inner = replace(
        camera.intrinsics,
        fx=coarse * camera.intrinsics.fx,
        fy=coarse * camera.intrinsics.fy,
        cx=coarse * (camera.intrinsics.cx + 0.5) - 0.5,
        cy=coarse * (camera.intrinsics.cy + 0.5) - 0.5,
    )
    sensors = (replace(camera, columns=PIXELS, rows=PIXELS, intrinsics=inner), projector)
    rig = Rig(campaign.rig, sensors)
    scene = replace(campaign.scene, rig=rig, camera=replace(campaign.scene.camera, blur_px=0.1))
    sequence = FringeSequence(tuple(range(FRINGES)), orientations_rad=orientations)
    return seen(replace(calibration, rig=rig), Simulation(scene, "C1", "P1", (), state="S00"), sequence)


@cache
def plate(densities: tuple[int, ...], orientations: tuple[float, ...] = CROSSED) -> Seen:
    """Return an unmarked plate that is lit once."""
    calibration, campaign = small_plate("plate")
    assert campaign.scene is not None
    scene = replace(campaign.scene, speckle=None)
    sequence = FringeSequence(densities, orientations_rad=orientations)
    return seen(calibration, Simulation(scene, "C1", "P1", (), state="S00"), sequence)


def off_plane(cloud: Surface, where: Mask) -> float:
    """Return the rms distance in mm of the valid points of a part from their own plane of best fit."""
    points = cloud.position[:, where & (cloud.reason == Reason.VALID)].T
    centred = points - points.mean(axis=0)
    return float(np.sqrt(np.mean((centred @ np.linalg.svd(centred, full_matrices=False)[2][2]) ** 2)))


def scores(cloud: Surface, shape: Shape, where: Mask) -> NDArray[np.float64]:
    """Return the errors of the valid points of a part in units of their predicted standard deviation."""
    kept = where & (cloud.reason == Reason.VALID)
    sigma = np.sqrt(cloud.covariance[[0, 3, 5]].sum(axis=0))
    return np.asarray((np.linalg.norm(cloud.position - shape.xyz, axis=0) / sigma)[kept])


def test_one_return_scatters_as_predicted() -> None:
    scene = plate(tuple(range(16)))
    output = scene.reconstruct(method="fdr")
    cloud: Surface = output.records["surface"]
    assert list(output.records) == ["surface", "phase", "factor"]
    inside = ndimage.binary_erosion(scene.shape.lit, iterations=3)
    z = scores(cloud, scene.shape, inside)
    assert z.size > 0.995 * inside.sum()
    # 10,000 pixels: 1.2 % scatter of the median; four times that.
    assert np.median(z) / 0.6745 == pytest.approx(1.0, abs=0.05)


def test_a_single_return_stays_single() -> None:
    scene = plate(tuple(range(16)))
    one, two = (scene.reconstruct(method="fdr", returns=n) for n in (1, 2))
    inside = ndimage.binary_erosion(scene.shape.lit, iterations=3)
    # Noise makes a second return in 1e-4 of the pixels and orientations; blur unlike the typical in a few.
    assert np.isfinite(two.records["returns"].omega[:, 1, inside]).mean() < 0.01
    change = np.abs(one.records["phase"].omega - two.records["phase"].omega)[:, inside]
    assert (change == 0.0).mean() > 0.99


def test_the_half_that_is_lit_twice_is_as_flat_as_the_other() -> None:
    scene = mirror(DIAGONAL)
    once, twice = scene.halves()
    cloud: Surface = scene.reconstruct(method="fdr", returns=2).records["surface"]
    assert (cloud.reason[twice] == Reason.VALID).mean() > 0.99
    apart = twice & (np.minimum(*(scene.separation_bins(a) for a in DIAGONAL)) > 1.5)
    assert apart.sum() > 0.7 * twice.sum()
    # Two returns 1.5 bins apart have 1.02 times the error of one, and the tilt of the plate a few percent.
    assert off_plane(cloud, apart) < 1.1 * off_plane(cloud, once)
    unwrapped: Surface = scene.reconstruct(maximum_phase_error_rad=10.0, calibration_sigma_px=12.0).records[
        "surface"
    ]
    # Unwrapping takes the sum of both returns for one: the thesis found 2.726 mm against 0.538 mm.
    assert off_plane(unwrapped, apart) > 5.0 * off_plane(cloud, apart)


def test_amplitudes_separate_what_vertical_fringes_cannot() -> None:
    crossed, diagonal = mirror(CROSSED), mirror(DIAGONAL)
    _, twice = crossed.halves()
    # The hinge lies along x, so that both returns leave nearly the same column of the projector.
    close = twice & (crossed.separation_bins(0.0) < 0.5)
    assert close.sum() > 300
    told = [diagonal.separation_bins(a)[close] for a in DIAGONAL]
    assert np.median(np.minimum(*told)) > 1.2
    alone, shared, apart = (
        scene.reconstruct(method="fdr", returns=2, pair_rule=rule).records["surface"]
        for scene, rule in ((crossed, "least-gap"), (crossed, "likelihood"), (diagonal, "likelihood"))
    )
    errors = [
        np.linalg.norm(cloud.position - crossed.shape.xyz, axis=0)[close & (cloud.reason == Reason.VALID)]
        for cloud in (alone, shared, apart)
    ]
    # The bound of two returns 0.3 bins apart is 6.7 times that of one, and that of 1.2 bins 1.04 times.
    assert np.median(errors[0]) > 4.0 * np.median(errors[2])
    # With the amplitudes that horizontal fringes tell it is 1.5 to 2.5 times that of one from 0.15 bins on;
    # nearer to the hinge the weaker return may lie on either side.
    assert np.median(errors[1]) < 0.6 * np.median(errors[0])
    decided = close & (crossed.separation_bins(0.0) > 0.25)
    assert (shared.reason[decided] == Reason.VALID).mean() > 0.98
    z = scores(shared, crossed.shape, close)
    assert np.median(z) / 0.6745 == pytest.approx(1.0, abs=0.15)
    assert z.max() < 6.0


def test_what_is_stated_of_two_returns_happens() -> None:
    scene = mirror(DIAGONAL)
    once, twice = scene.halves()
    cloud: Surface = scene.reconstruct(method="fdr", returns=2).records["surface"]
    for part in (once, twice):
        z = scores(cloud, scene.shape, part)
        # 2000 pixels: 2.5 % scatter; the two returns' unequal blur, which the model lacks, adds some.
        assert np.median(z) / 0.6745 == pytest.approx(1.0, abs=0.15)


def test_the_label_names_the_chosen_returns() -> None:
    scene = mirror(CROSSED)
    _, twice = scene.halves()
    output = scene.reconstruct(method="fdr", returns=2, blur_px=0.0)
    phase: PhaseMaps = output.records["phase"]
    returns: ReturnMaps = output.records["returns"]
    assert output.statistics["several_returns_fraction"] > 0.3
    assert 0.0 <= output.statistics["ambiguous_pair_fraction"] < 0.1
    known = returns.label > 0
    which = [(returns.label.astype(int) - 1) // 2, (returns.label.astype(int) - 1) % 2]
    for k, number in enumerate(which):
        named = np.take_along_axis(returns.omega[k], np.maximum(number, 0)[None], axis=0)[0]
        # Kept in single precision: 2e-7 rad of 3.
        np.testing.assert_allclose(named[known], phase.omega[k][known], atol=4e-7)
        strongest, other = returns.amplitude[k]
        assert not (other[known] > strongest[known]).any()
    assert np.isfinite(returns.omega[:, 1, twice]).mean() > 0.95
    # On the plate the direct light is the stronger one of both orientations: view 1 of thesis Fig. 106.
    assert (returns.label[twice] == 1).mean() > 0.97


def test_the_plain_rule_flags_nothing_and_mostly_agrees() -> None:
    scene = mirror(CROSSED)
    _, twice = scene.halves()
    plain = scene.reconstruct(method="fdr", returns=2, pair_rule="least-gap").records
    assert not (plain["surface"].reason & Reason.AMBIGUOUS_PAIR).any()
    assert (plain["returns"].label[twice] == 1).mean() > 0.9


def test_what_the_mirror_shows_is_told_from_the_plate_by_the_volume_alone() -> None:
    scene = mirror(CROSSED)
    image = (scene.shape.region == 2) & (scene.light.strength[0, ::2, ::2] > 0.0)
    inside = ndimage.binary_erosion(image, iterations=4)
    assert inside.sum() > 300
    cloud: Surface = scene.reconstruct(method="fdr", returns=2).records["surface"]
    # Light that goes to the plate and back by the mirror meets in the plate's mirror image: whatever point
    # is reported there is behind the mirror, well below the hinge.
    ghosts = cloud.position[:, inside & (cloud.reason == Reason.VALID)]
    hinge = scene.simulation.scene.placement.translation[1]
    assert (ghosts[1] < hinge).all()


def test_one_orientation_alone_cannot_tell_two_returns_of_the_volume() -> None:
    scene = mirror((0.0,))
    once, twice = scene.halves()
    cloud: Surface = scene.reconstruct(method="fdr", returns=2).records["surface"]
    assert (cloud.reason[once] == Reason.VALID).mean() > 0.98
    far = twice & (scene.separation_bins(0.0) > 1.0)
    assert (cloud.reason[far] & Reason.AMBIGUOUS_PAIR != 0).mean() > 0.95
    strongest: Surface = scene.reconstruct(method="fdr", returns=2, minimum_pair_margin=0.0).records[
        "surface"
    ]
    z = scores(strongest, scene.shape, far)
    assert np.median(z) / 0.6745 == pytest.approx(1.0, abs=0.15)  # as above


def test_threads_change_nothing() -> None:
    scene = mirror(CROSSED)
    one, two = (scene.reconstruct(threads=n, method="fdr", returns=2) for n in (1, 2))
    assert one.statistics == two.statistics
    for record, names in (
        ("surface", ("position", "covariance", "reason")),
        ("returns", ("label", "margin", "omega")),
    ):
        for name in names:
            np.testing.assert_array_equal(
                getattr(one.records[record], name), getattr(two.records[record], name)
            )


def test_unwrapping_leaves_the_uniform_field_out() -> None:
    with_zero, without = plate(tuple(range(6))), plate(tuple(range(1, 6)))
    found = [s.reconstruct(blur_px=0.0).records["surface"] for s in (with_zero, without)]
    inside = ndimage.binary_erosion(with_zero.shape.lit, iterations=3)
    for cloud, scene in zip(found, (with_zero, without), strict=True):
        z = scores(cloud, scene.shape, inside)
        assert z.size > 0.99 * inside.sum()
        assert np.median(z) / 0.6745 == pytest.approx(1.0, abs=0.05)  # 10,000 pixels, as above


def test_a_method_says_which_sequence_it_needs() -> None:
    with pytest.raises(InvalidInput, match=r"needs the fringe densities 0, 1, 2, \.\.\. .* not \(16, 8, 1\)"):
        plate((16, 8, 1)).reconstruct(method="fdr")
    with pytest.raises(
        InvalidInput, match=r"returns.*temporal unwrapping finds only one return; set method=fdr"
    ):
        KIND.checked_parameters({"returns": "2"})
    assert KIND.checked_parameters({"method": "fdr", "returns": "2"}).model_dump()["returns"] == 2
    with pytest.raises(InvalidInput, match=r"'returns' .* less than or equal to 4"):
        KIND.checked_parameters({"method": "fdr", "returns": "5"})
