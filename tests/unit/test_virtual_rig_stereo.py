"""Cameras that look at one specimen together on the virtual rig: light, noise, correspondence and truth."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.archive import Archive, MemoryStore
from sms_jobs.archive.provenance import Provenance
from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import MEASUREMENT, DatasetOutput, Inputs
from sms_jobs.kinds.recording.simulate import KIND, SimulateParameters
from sms_jobs.kinds.reporting import assess
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.records.assessment import Assessment
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import Surface as MeasuredSurface
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.scene import (
    CameraResponse,
    Gloss,
    Plane,
    PlateWithHoleAndStep,
    Rigid,
    Scene,
    Simulation,
)
from sms_jobs.records.sensors import Rig
from sms_jobs.records.subject import Subject
from sms_jobs.records.times import UNTIMED
from sms_jobs.records.views import view_of
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.campaigns import Lens
from sms_jobs.virtual_rig.deformations import carried_points, packed_chain
from sms_jobs.virtual_rig.exact_meshes import exact_mesh
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.stereo_campaigns import (
    TELEPHOTO,
    WIDE_ANGLE,
    curved,
    stepped,
    stereo_campaign,
    stereo_rig,
)
from sms_jobs.virtual_rig.truth import Shape, exact_shape, exact_truth

CLEAN = CameraResponse(bits=16, full_well=1e12, read_noise=0.0)
FIELD = {TELEPHOTO: 500.0 / 2.8, WIDE_ANGLE: 500.0}
SEQUENCE = FringeSequence()
HIGH_STEP = PlateWithHoleAndStep(400.0, 400.0, (-40.0, 20.0), 12.0, (20.0, 0.0), (40.0, 40.0), 30.0)
"""Hides some of its plate, which reaches out of both images."""

Floats = NDArray[np.float64]


def small_rig(lens: Lens = TELEPHOTO) -> Rig:
    return stereo_rig(320, 256, lens)


def seen_by(campaign: Campaign, camera: str, state: int = 0) -> Simulation:
    load = campaign.states[state]
    assert campaign.scene is not None
    return Simulation.of(campaign.scene, view_of(camera), load.deformation, load.label)


def levels(simulation: Simulation) -> Floats:
    """Return grey levels without noise and rounding."""
    return render(simulation, SEQUENCE).frames.expected(0).astype(np.float64)


def images_in(simulation: Simulation, shape: Shape, name: str) -> Floats:
    """Return where a sensor sees what another sees, (rows, columns, 2)."""
    sensor = simulation.scene.rig.sensor(name)
    return project(sensor.intrinsics, sensor.pose, np.moveaxis(shape.xyz, 0, -1))


def carried_over(image: Floats, pixels: Floats) -> Floats:
    """Return an image at pixels of it, NaN where there are none."""
    known = np.isfinite(pixels[..., 0])
    found = np.full(known.shape, np.nan)
    found[known] = ndimage.map_coordinates(image, pixels[known][:, ::-1].T, order=5, mode="nearest")
    return found


def unmarked(campaign: Campaign) -> Campaign:
    assert campaign.scene is not None
    return replace(campaign, scene=replace(campaign.scene, speckle=None))


@pytest.mark.parametrize("lens", [TELEPHOTO, WIDE_ANGLE], ids=["telephoto", "wide-angle"])
def test_both_cameras_see_lambert_s_light_of_one_lamp(lens: Lens) -> None:
    campaign = unmarked(stereo_campaign("s", rig=small_rig(lens), camera=CLEAN)[1])
    left = seen_by(campaign, "C1", 3)
    shape = exact_shape(left, ("C2",))
    # The spline that carries an image over rings at its dark surroundings, less than 1e-6 of it 20 px away.
    inner = ndimage.binary_erosion(shape.lit, iterations=20)
    here, there = levels(left), carried_over(levels(seen_by(campaign, "C2", 3)), images_in(left, shape, "C2"))
    lamp = np.mean([s.pose.centre() for s in left.scene.rig.sensors], axis=0)
    to_lamp = lamp[:, None, None] - shape.xyz
    distance = np.linalg.norm(to_lamp, axis=0)
    cosine = np.einsum("irc,irc->rc", to_lamp / distance, shape.normal)
    usual = np.linalg.norm(lamp - left.scene.placement.translation)
    expected = 0.8 * 65535 * (cosine * (usual / distance) ** 2 + 0.02)
    # Blur and pixel have a variance of a third of a px^2, and the light the curvature of the cylinder, whose
    # radius is 190 px: together a 1e-5th.
    np.testing.assert_allclose(here[inner], expected[inner], rtol=5e-5)
    np.testing.assert_allclose(there[inner], here[inner], rtol=1e-4)
    assert np.ptp(expected[inner]) > 0.1 * expected[inner].max()


def test_a_lamp_stands_where_the_scene_says_and_lights_one_camera_as_well() -> None:
    scene = Scene(small_rig(), Plane(400.0, 400.0), camera=replace(CLEAN, ambient=0.0))
    middle, aside = (
        levels(Simulation.of(replace(scene, lamp_mm=lamp), view_of("C1"), ()))
        for lamp in (None, (500.0, 0.0, 500.0))
    )
    # Both face the origin's level: the middle directly, the other at 45 degrees from its own distance.
    ratio = aside[128, 160] / middle[128, 160]
    assert ratio == pytest.approx(np.cos(pi / 4), rel=0.01)  # the origin is 2 px off the middle pixel
    behind = levels(Simulation.of(replace(scene, lamp_mm=(0.0, 0.0, -500.0)), view_of("C1"), ()))
    assert behind.max() == 0.0
    with pytest.raises(InvalidInput, match="nothing can be dimmed"):
        render(Simulation(scene, "C1", None, ()), SEQUENCE, dimming=np.ones((2, 2), np.float32))


def test_each_camera_sees_its_own_highlight() -> None:
    plate = Plane(400.0, 400.0)
    scene = Scene(small_rig(), plate, camera=replace(CLEAN, exposure=0.3), gloss=Gloss(1.0, 400.0))
    lamp = np.mean([s.pose.centre() for s in scene.rig.sensors], axis=0)
    for name in ("C1", "C2"):
        simulation = Simulation.of(scene, view_of(name), ())
        shine = levels(simulation) - levels(replace(simulation, scene=replace(scene, gloss=None)))
        row, column = np.unravel_index(shine.argmax(), shine.shape)
        eye = scene.rig.sensor(name).pose.centre()
        # Mirrored at z = 0: where the line from the lamp's image behind the plate to the camera crosses it.
        mirror = lamp * [1.0, 1.0, -1.0]
        spot = mirror + (eye - mirror) * (0.0 - mirror[2]) / (eye[2] - mirror[2])
        # Light falls off by the square of the distance: that moves the brightest place by a few pixels.
        where = exact_shape(simulation).xyz[:, row, column]
        assert np.linalg.norm(where - spot) < 2.0
        assert abs(spot[0]) > 20.0


@pytest.mark.parametrize("lens", [TELEPHOTO, WIDE_ANGLE], ids=["telephoto", "wide-angle"])
@pytest.mark.parametrize("made", [curved, stepped])
def test_speckle_lies_where_the_exact_correspondence_says(lens: Lens, made: object) -> None:
    surface = curved(FIELD[lens]) if made is curved else stepped(FIELD[lens])
    campaign = stereo_campaign("s", rig=stereo_rig(512, 410, lens), surface=surface, camera=CLEAN)[1]
    left = seen_by(campaign, "C1")
    shape = exact_shape(left, ("C2",))
    here = levels(left)
    there = carried_over(levels(seen_by(campaign, "C2")), images_in(left, shape, "C2"))
    side = 31
    whole = ndimage.minimum_filter(np.where(shape.lit, shape.region, 0), side + 2)
    inner = (whole > 0) & (whole == ndimage.maximum_filter(shape.region, side + 2))
    slope_y, slope_x = np.gradient(here)
    off = np.where(shape.lit, there - here, 0.0)
    xx, xy, yy, x, y = (
        ndimage.uniform_filter(one, side)[inner]
        for one in (slope_x**2, slope_x * slope_y, slope_y**2, slope_x * off, slope_y * off)
    )
    shift = np.stack([yy * x - xy * y, xx * y - xy * x]) / (xx * yy - xy**2)
    # Sub-samples average the print in squares, and the lens blurs what one camera sees foreshortened: neither
    # has a direction. Matching is to be tried down to 0.005 px, of which the mean is to be a tenth.
    assert inner.sum() > 3000
    assert np.abs(shift.mean(axis=1)).max() < 0.0005 + 3.0 * shift.std() * side / np.sqrt(inner.sum())
    assert shift.std() < 0.004


def test_noise_is_that_of_its_camera_state_and_seed() -> None:
    campaign = unmarked(stereo_campaign("s", rig=small_rig(), deformations=((),))[1])
    assert campaign.scene is not None
    other = replace(campaign, scene=replace(campaign.scene, seed=1))
    which = ((campaign, "C1", 0), (campaign, "C2", 0), (campaign, "C1", 1), (other, "C1", 0))
    seen = [seen_by(*one) for one in which]
    noise = []
    for simulation in seen:
        rendering = render(simulation, SEQUENCE)
        expected = rendering.frames.expected(0)
        sigma = np.sqrt(rendering.read_noise**2 + rendering.gain * expected)
        lit = expected > 0.2 * rendering.full_scale
        noise.append(np.where(lit, (rendering.texture - expected) / sigma, 0.0).ravel())
        count = lit.sum()
        assert noise[-1].std() * np.sqrt(lit.size / count) == pytest.approx(1.0, abs=5.0 / np.sqrt(2 * count))
    together = np.corrcoef(noise)[np.triu_indices(len(seen), 1)]
    assert np.abs(together).max() < 5.0 / np.sqrt(lit.sum())


def test_measured_is_what_the_partner_sees_too() -> None:
    campaign = stereo_campaign("s", rig=small_rig(), surface=HIGH_STEP)[1]
    left, right = (seen_by(campaign, name) for name in ("C1", "C2"))
    shape, alone, other = exact_shape(left, ("C2",)), exact_shape(left), exact_shape(right)
    np.testing.assert_array_equal(shape.xyz, alone.xyz)
    np.testing.assert_array_equal(alone.lit, alone.seen)
    assert 0.05 < (shape.seen & ~shape.lit).mean() < 0.5
    pixels = images_in(left, shape, "C2")
    inside = ((pixels > -0.5) & (pixels < [319.5, 255.5])).all(axis=-1)
    assert not (shape.lit & ~inside).any()
    # Within the image what C2 sees in the same direction is the point itself, or hides it.
    column, row = np.clip(np.rint(np.nan_to_num(pixels)).astype(int), 0, [319, 255]).transpose(2, 0, 1)
    eye = right.scene.rig.sensor("C2").pose.centre()[:, None, None]
    beyond = np.linalg.norm(shape.xyz - eye, axis=0) - np.linalg.norm(other.xyz[:, row, column] - eye, axis=0)
    edge = ndimage.maximum_filter(other.region, 3) != ndimage.minimum_filter(other.region, 3)
    sure = shape.seen & inside & ~edge[row, column]
    # To the nearest pixel is 0.4 mm at most; a plate seen at 20 degrees is then 0.15 mm farther away.
    assert np.abs(beyond[sure & shape.lit]).max() < 0.4
    hidden = sure & ~shape.lit & (shape.region == 1)
    assert hidden.sum() > 500
    assert beyond[hidden].min() > 0.4


def test_displacement_is_that_of_the_material_and_points_that_one_camera_loses_are_lost() -> None:
    shift = Rigid((0.01, -0.02, 0.03), (30.0, 1.0, -2.0))
    campaign = stereo_campaign("s", rig=small_rig(), deformations=((shift,),))[1]
    rest, end = seen_by(campaign, "C1"), seen_by(campaign, "C1", 1)
    truth, alone = exact_truth(rest, end, ("C2",)), exact_truth(rest, end)
    seen = truth.shape.seen
    material = truth.shape.material[:, seen].T
    assert campaign.scene is not None
    before, after = (
        carried_points(packed_chain(done, campaign.scene.placement), material) for done in ((), (shift,))
    )
    np.testing.assert_allclose(truth.displacement[:, seen].T, after - before, atol=1e-10)
    np.testing.assert_allclose(truth.strain("green-lagrange")[:, seen], 0.0, atol=1e-12)
    sensor = campaign.scene.rig.sensor("C2")
    pixels = project(sensor.intrinsics, sensor.pose, after)
    outside = ~((pixels > -0.5) & (pixels < [319.5, 255.5])).all(axis=1)
    stays, still = truth.lit_and_seen_at_end[seen], alone.lit_and_seen_at_end[seen]
    assert outside.sum() > 300
    np.testing.assert_array_equal(stays, still & ~outside)


def recorded(campaign: Campaign, state: str) -> dict[str, Measurement]:
    subject = Subject(campaign.name, state)
    inputs = Inputs(subject, KIND.context(campaign, subject), {}, 2)
    found = {}
    for output in KIND.run(inputs, SimulateParameters(), lambda fraction, message="": None):
        assert isinstance(output, DatasetOutput)
        measurement = output.records["measurement"]
        assert isinstance(measurement, Measurement)
        found[str(output.subject)] = measurement
    return found


def test_simulate_records_one_white_frame_of_each_camera() -> None:
    campaign = stereo_campaign("panel", rig=small_rig())[1]
    assert campaign.views == ("C1C2",)
    both = recorded(campaign, "S02")
    assert list(both) == ["panel/S02/C1", "panel/S02/C2"]
    for camera, measurement in zip(("C1", "C2"), both.values(), strict=True):
        assert measurement.simulation == seen_by(campaign, camera, 2)
        assert measurement.sequence == FringeSequence()
        assert measurement.frames.shape == (1, 256, 320)
        np.testing.assert_array_equal(measurement.frames.frame(0), measurement.texture)
        np.testing.assert_array_equal(measurement.frames.rows(70, 200)[0], measurement.texture[70:200])
        with pytest.raises(IndexError):
            measurement.frames.frame(1)
        assert 0.5 < measurement.texture.max() / measurement.full_scale < 0.9
    subject = Subject("panel", "S02")
    inputs = Inputs(subject, KIND.context(campaign, subject), {}, 1)
    adaptive = SimulateParameters(adaptive="exposures")
    with pytest.raises(InvalidInput, match="adaptive=exposures needs fringes"):
        next(KIND.run(inputs, adaptive, lambda fraction, message="": None))


def test_an_archived_measurement_knows_that_nothing_was_projected() -> None:
    campaign = stereo_campaign("panel", rig=small_rig())[1]
    (_, measurement), *_ = recorded(campaign, "S01").items()
    archive, subject = Archive(MemoryStore()), Subject("panel", "S01", "C1")
    provenance = Provenance("simulate", 1, subject, "0" * 16, 1, UNTIMED, {}, (), "0", "host", "operator")
    with archive.open(archive.seal_dataset({"measurement": measurement}, provenance)) as dataset:
        assert dataset.read("measurement", Measurement).simulation == measurement.simulation


def measured(shape: Shape, error_mm: float) -> MeasuredSurface:
    """Return a surface as `stereo` would give it, off along X."""
    reason = np.where(shape.lit, 0, 1).astype(np.uint32)
    covariance = np.zeros((6, *reason.shape), np.float32)
    covariance[0] = error_mm**2
    position = np.where(shape.lit, shape.xyz + np.array([error_mm, 0.0, 0.0])[:, None, None], np.nan)
    return MeasuredSurface("C1C2", "mm", position, reason, covariance)


def test_the_surface_of_two_cameras_is_assessed_where_both_see() -> None:
    campaign = stereo_campaign("panel", rig=small_rig(), surface=HIGH_STEP)[1]
    shape = exact_shape(seen_by(campaign, "C1"), ("C2",))
    subject = Subject("panel", "S00", "C1C2")
    shelf = Shelf(campaign, 2)
    shelf.records[MEASUREMENT, replace(subject, view="C1")] = {
        "measurement": recorded(campaign, "S00")["panel/S00/C1"]
    }
    shelf.records["stereo", subject] = {"surface": measured(shape, 0.02)}
    shelf.run(assess.KIND, subject, assess.AssessParameters())
    found = shelf.records["assess", subject]["assessment"]
    assert isinstance(found, Assessment)
    assert found.shape.rms == pytest.approx(0.02, rel=1e-6)
    assert found.shape.score_rms == pytest.approx(1.0, rel=1e-5)
    assert found.shape.expected_count == found.shape.count == int(shape.lit.sum())
    assert assess.simulated_tuples(replace(campaign, views=("C1C2", "C2"))) == tuple(
        Subject("panel", state.label, "C1C2") for state in campaign.states
    )


def test_the_exact_mesh_of_two_cameras_is_that_of_the_reference_camera() -> None:
    campaign = stereo_campaign("panel", rig=small_rig())[1]
    mesh = exact_mesh(campaign, "S03", 8)
    truth = exact_truth(seen_by(campaign, "C1"), seen_by(campaign, "C1", 3), ("C2",))
    rows, columns = (truth.shape.region.shape[k] // 8 for k in (0, 1))
    assert 0.3 * rows * columns < len(mesh.nodes) < rows * columns
    largest = np.linalg.norm(truth.displacement[:, truth.shape.seen], axis=0).max()
    assert np.linalg.norm(mesh.displacement, axis=1).max() == pytest.approx(largest, rel=0.05)


def test_views_of_cameras_are_pairs_in_order_and_fringes_come_first() -> None:
    left, right = small_rig().sensors
    third = replace(right, name="C3")
    assert Rig("r", (left, right)).views() == ("C1C2",)
    assert Rig("r", (left, right, third)).views() == ("C1C2", "C1C3", "C2C3")
    assert Rig("r", (left,)).views() == ()
