"""The exact truth: on the ray, on the surface, with the strain that theory gives, in sight and in light."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import Pose, pixel_grid, project
from sms_jobs.records.scene import (
    Cylinder,
    Deformation,
    HalvesApart,
    MidPointBending,
    Plane,
    PlateAndMirror,
    PlateWithHoleAndStep,
    Rigid,
    Scene,
    Simulation,
    Sphere,
    Surface,
    TopHat,
    UniaxialStrain,
)
from sms_jobs.records.sensors import Rig
from sms_jobs.virtual_rig.campaigns import CAMERA_LENS, PROJECTOR_LENS, aimed
from sms_jobs.virtual_rig.deformations import carried_points, packed_chain
from sms_jobs.virtual_rig.truth import Shape, exact_shape, exact_truth

SIZE = 72
CAMERA = aimed("C1", SIZE, SIZE, CAMERA_LENS, (-500.0, 60.0, 2400.0), 0.05)
PROJECTOR = aimed("P1", 128, 96, PROJECTOR_LENS, (700.0, -50.0, 2300.0))
PLACEMENT = Pose.from_arrays(
    Rotation.from_rotvec([0.04, -0.03, 0.02]).as_matrix(), np.array([4.0, -3.0, 6.0])
)
STEP = PlateWithHoleAndStep(420.0, 400.0, (-110.0, 20.0), 60.0, (90.0, -30.0), (120.0, 150.0), 30.0)
SURFACES: list[Surface] = [
    Plane(400.0, 380.0),
    Cylinder(260.0, 400.0, 400.0),
    Sphere(200.0),
    STEP,
    TopHat(),
    PlateAndMirror(300.0, 300.0, 2.2),
]
BENT: tuple[Deformation, ...] = (
    UniaxialStrain(0.003),
    MidPointBending(12.0, 520.0, 520.0),
    Rigid((0.01, -0.02, 0.015), (1.0, -2.0, 1.5)),
)


def simulation(surface: Surface, *deformation: Deformation, placement: Pose = PLACEMENT) -> Simulation:
    scene = Scene(Rig("rig", (CAMERA, PROJECTOR)), surface, placement=placement)
    return Simulation(scene, "C1", "P1", deformation)


def seen_material(shape: Shape) -> np.ndarray:
    return np.ascontiguousarray(shape.material[:, shape.seen].T)


@pytest.mark.parametrize("surface", SURFACES, ids=lambda s: s.shape)
@pytest.mark.parametrize("bent", [False, True])
def test_what_a_pixel_sees_lies_on_its_ray_and_on_the_material(surface: Surface, bent: bool) -> None:
    deformation = BENT if bent and not isinstance(surface, PlateAndMirror) else BENT[2:]
    sim = simulation(surface, *deformation)
    shape = exact_shape(sim)
    assert shape.seen.mean() > 0.2
    pixels = project(CAMERA.intrinsics, CAMERA.pose, np.moveaxis(shape.xyz, 0, -1))
    error = np.abs(pixels - pixel_grid(SIZE, SIZE))[shape.seen]
    # Positions are good to about 1e-11 mm, a pixel is some 8 mm here.
    assert error.max() < 1e-9
    chain = packed_chain(deformation, PLACEMENT)
    again = carried_points(chain, seen_material(shape))
    np.testing.assert_allclose(again, shape.xyz[:, shape.seen].T, atol=1e-9)
    assert np.isnan(shape.xyz[:, ~shape.seen]).all()


def on_surface(surface: Surface, m: np.ndarray) -> np.ndarray:
    """Return by how much material points at rest miss their surface, in mm, from its plain definition."""
    x, y, z = m.T
    if isinstance(surface, Cylinder):
        return np.hypot(x, z + surface.radius_mm) - surface.radius_mm
    if isinstance(surface, Sphere):
        return np.sqrt(x**2 + y**2 + (z + surface.radius_mm) ** 2) - surface.radius_mm
    if isinstance(surface, TopHat):
        return z - np.interp(x, [-250, -150, -100, 100, 150, 250], [-50, -50, 50, 50, -50, -50])
    return z


@pytest.mark.parametrize("surface", [SURFACES[0], *SURFACES[1:3], TopHat()], ids=lambda s: s.shape)
def test_material_points_lie_on_the_surface_at_rest(surface: Surface) -> None:
    m = seen_material(exact_shape(simulation(surface, *BENT)))
    assert np.abs(on_surface(surface, m)).max() < 1e-9


def test_there_is_no_material_in_holes_gaps_and_beyond_edges() -> None:
    x, y, _ = seen_material(exact_shape(simulation(TopHat(), *BENT))).T
    assert np.max(np.abs([x, y])) <= 250.0
    assert np.min(np.hypot(x, np.abs(y) - 130.0)) >= 25.0
    split = exact_shape(simulation(Plane(400.0, 380.0), HalvesApart(40.0)))
    whole = exact_shape(simulation(Plane(400.0, 380.0)))
    middle = np.abs(whole.material[0]) < 15.0
    assert not split.seen[middle].any()
    assert whole.seen[middle].all()


def test_normal_is_that_of_the_seen_surface() -> None:
    shape = exact_shape(simulation(Sphere(200.0), BENT[2]))
    inside = carried_points(packed_chain(BENT[2:], PLACEMENT), np.array([[0.0, 0.0, -200.0]]))[0]
    from_centre = np.moveaxis(shape.xyz, 0, -1)[shape.seen] - inside
    np.testing.assert_allclose(from_centre / 200.0, np.moveaxis(shape.normal, 0, -1)[shape.seen], atol=1e-11)


@pytest.mark.parametrize("surface", [Plane(400.0, 380.0), Sphere(200.0), TopHat()], ids=lambda s: s.shape)
def test_rigid_motion_strains_nothing(surface: Surface) -> None:
    motion = Rigid((0.2, -0.1, 0.15), (3.0, 4.0, -5.0))
    truth = exact_truth(simulation(surface), simulation(surface, motion))
    # Twenty roundings of numbers near 1.
    assert np.nanmax(np.abs(truth.green_lagrange)) < 1e-14
    # Small strain takes a rotation for strain: that is its error, second order in the angle.
    assert 1e-3 < np.nanmax(np.abs(truth.small)) < 0.27**2


def test_uniaxial_strain_of_a_plate_is_the_closed_form() -> None:
    e, nu = 0.02, 0.3
    plate = Plane(400.0, 380.0)
    turned = Rigid((0.3, 0.0, 0.1))
    truth = exact_truth(simulation(plate), simulation(plate, UniaxialStrain(e, nu), turned))
    seen = truth.shape.seen
    expected = [e + e**2 / 2, -nu * e + (nu * e) ** 2 / 2, 0.0]
    for component, value in zip(truth.green_lagrange, expected, strict=True):
        np.testing.assert_allclose(component[seen], value, atol=1e-14)
    truth = exact_truth(simulation(plate), simulation(plate, UniaxialStrain(e, nu)))
    for component, value in zip(truth.small, [e, -nu * e, 0.0], strict=True):
        np.testing.assert_allclose(component[seen], value, atol=1e-14)


def test_strain_is_the_change_of_length_between_neighbouring_material_points() -> None:
    # From a strained reference to a bent state: only the change between the two counts.
    reference = simulation(TopHat(), UniaxialStrain(0.01))
    state = simulation(TopHat(), *BENT)
    truth = exact_truth(reference, state)
    before, after = (packed_chain(s.deformation, PLACEMENT) for s in (reference, state))
    shape, h = truth.shape, 1e-3
    axis = PLACEMENT.matrix()[:, 0]
    for row, column in [(30, 20), (36, 36), (20, 44), (50, 30)]:
        assert shape.seen[row, column]
        point, n = shape.material[:, row, column], shape.normal[:, row, column]
        x = axis - n * (n @ axis)
        x /= np.linalg.norm(x)
        inverse = np.linalg.inv(
            np.stack([carried_points(before, (point + d)[None])[0] for d in np.eye(3)], axis=-1)
            - carried_points(before, point[None])[0][:, None]
        )  # the reference is affine: differences over 1 mm are exact
        ends = point + np.array([s * inverse @ (h * x) for s in (-1.0, 1.0)])
        lengths = [np.linalg.norm(np.diff(carried_points(c, ends), axis=0)) for c in (before, after)]
        expected = 0.5 * ((lengths[1] / lengths[0]) ** 2 - 1.0)
        # Rounding of 1e-13 mm over 2e-3 mm.
        assert truth.green_lagrange[0, row, column] == pytest.approx(expected, abs=5e-10)


def test_displacement_is_that_of_the_material_point() -> None:
    shift = Rigid((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    truth = exact_truth(simulation(TopHat()), simulation(TopHat(), shift))
    expected = PLACEMENT.matrix() @ [1.0, 2.0, 3.0]
    np.testing.assert_allclose(truth.displacement[:, truth.shape.seen].T - expected, 0.0, atol=1e-12)


def blocked(points: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Tell from the top hat's profile z(x) alone whether the segments from points to an eye are cut.

    Profile and segment are straight between creases, so that looking at the creases is exact as long
    as the segment stays above the sheet's length in y.
    """
    creases = [(-150.0, -50.0), (-100.0, 50.0), (100.0, 50.0), (150.0, -50.0)]
    cut = np.zeros(len(points), bool)
    for x, z in creases:
        part = (x - points[:, 0]) / (eye[0] - points[:, 0])
        between = (part > 1e-9) & (part < 1.0)
        cut |= between & (points[:, 2] + part * (eye[2] - points[:, 2]) < z - 1e-9)
    return cut


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_shadow_and_occlusion_are_those_of_the_profile(side: float) -> None:
    camera = aimed("C1", SIZE, SIZE, CAMERA_LENS, (-side * 1400.0, 30.0, 2000.0))
    projector = aimed("P1", 256, 192, PROJECTOR_LENS, (side * 1500.0, -30.0, 1900.0))
    shape = exact_shape(Simulation(Scene(Rig("rig", (camera, projector)), TopHat()), "C1", "P1", ()))
    # Away from the ends in y, where a shadow could leave the sheet.
    checked = shape.seen & (np.abs(shape.xyz[1]) < 200.0)
    points = shape.xyz[:, checked].T
    assert not blocked(points, camera.pose.centre()).any()
    back = -shape.normal[:, checked].T @ projector.pose.centre() + np.sum(
        shape.normal[:, checked].T * points, axis=1
    )
    lit = ~blocked(points, projector.pose.centre()) & (back < 0.0)
    np.testing.assert_array_equal(shape.lit[checked], lit)
    # The side that faces the camera is in the dark, the top is not.
    faces_camera = 2 if side > 0 else 4
    assert not shape.lit[shape.region == faces_camera].any()
    assert shape.lit[shape.region == 3].all()


def test_a_mirror_has_no_shape_of_its_own() -> None:
    shape = exact_shape(simulation(PlateAndMirror(300.0, 300.0, 2.2)))
    assert (shape.region == 2).any()
    assert not shape.seen[shape.region == 2].any()
    assert shape.seen[shape.region == 1].all()


def test_points_that_leave_the_image_or_the_light_are_known() -> None:
    plate = Plane(200.0, 200.0)
    start = simulation(plate)
    assert exact_truth(start, start).lit_and_seen_at_end.sum() == exact_shape(start).lit.sum()
    far = exact_truth(start, simulation(plate, Rigid(translation_mm=(500.0, 0.0, 0.0))))
    assert not far.lit_and_seen_at_end.any()
    turned = exact_truth(start, simulation(plate, Rigid(rotation_rad=(0.0, pi / 2 + 0.3, 0.0))))
    assert not turned.lit_and_seen_at_end.any()


def test_a_bent_mirror_and_foreign_states_are_refused() -> None:
    mirror = PlateAndMirror(300.0, 300.0, 2.2)
    with pytest.raises(InvalidInput, match="only move rigidly"):
        exact_shape(simulation(mirror, UniaxialStrain(0.01)))
    start = simulation(Plane(400.0, 380.0))
    with pytest.raises(InvalidInput, match="no common truth"):
        exact_truth(start, simulation(Plane(300.0, 380.0)))
    with pytest.raises(InvalidInput, match="no sensor P9"):
        exact_shape(replace(start, projector="P9"))


def test_truth_does_not_depend_on_threads() -> None:
    one, two = (exact_truth(simulation(TopHat()), simulation(TopHat(), *BENT), threads=n) for n in (1, 2))
    np.testing.assert_array_equal(one.displacement, two.displacement)
    np.testing.assert_array_equal(one.shape.xyz, two.shape.xyz)


def test_a_sphere_is_seen_to_its_cap() -> None:
    shape = exact_shape(simulation(Sphere(200.0, cap_angle_rad=0.6)))
    lowest = np.nanmin(shape.material[2])
    edge = 200.0 * (cos(0.6) - 1.0)
    # Pixels sample the cap every 8 mm, across a slope of tan 0.6.
    assert edge - 1e-9 <= lowest < edge + 8.0
