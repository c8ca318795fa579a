"""Deformations: inverses, gradients by finite differences, and strains that are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.records.scene import (
    Bow,
    Deformation,
    Disbond,
    HalvesApart,
    MidPointBending,
    Rigid,
    StringerCrack,
    UniaxialStrain,
)
from sms_jobs.virtual_rig.deformations import (
    carried,
    carried_points,
    deflection_line,
    followed_back,
    gradients,
    packed_chain,
)

PLACEMENT = Pose.looking_at(np.array([30.0, 20.0, 500.0]), np.zeros(3), np.array([0.1, 1.0, 0.0]))
CHAINS: list[tuple[Deformation, ...]] = [
    (),
    (Rigid((0.1, -0.2, 0.3), (5.0, -6.0, 7.0)),),
    (UniaxialStrain(0.01, 0.3),),
    (MidPointBending(10.0, 500.0, 400.0),),
    (HalvesApart(0.5),),
    (UniaxialStrain(0.02), MidPointBending(-8.0, 500.0, 500.0), Rigid((0.02, 0.01, 0.0), (1.0, 2.0, 3.0))),
    (Rigid((0.3, 0.1, -0.2)), MidPointBending(5.0, 600.0, 600.0), HalvesApart(2.0)),
    (Disbond(3.0, 250.0, 0.004, 3.0), UniaxialStrain(-1e-3), MidPointBending(2.0, 600.0, 500.0)),
    (
        StringerCrack(1.6e-3, 0.33, -2.6e-4, 60.0, 25.0, -50.0, 30.0, 0.35, 0.4),
        Rigid((0.02, 0.01, 0.0), (1.0, 2.0, 3.0)),
    ),
    (Bow(0.5, -0.3, 0.2, (20.0, -10.0), 150.0, 120.0), Rigid((0.2, -0.1, 0.3), (5.0, 0.0, 9.0))),
]


def material_points(rng: np.random.Generator, count: int = 50) -> np.ndarray:
    points = rng.uniform(-200.0, 200.0, (count, 3))
    # Off the cut of halves apart, where there is no gradient.
    points[:, 0] = np.where(np.abs(points[:, 0]) < 1.0, 5.0, points[:, 0])
    # Nor is there one at the skin and the foot's top, where a disbond begins and ends; two in between.
    points[:, 2] = np.where(np.abs(points[:, 2]) < 4.0, 5.0, points[:, 2])
    points[:2, 2] = 1.0, 2.0
    return points


@pytest.mark.parametrize("deformation", CHAINS)
def test_following_back_inverts_carrying(
    deformation: tuple[Deformation, ...], rng: np.random.Generator
) -> None:
    chain = packed_chain(deformation, PLACEMENT)
    points = material_points(rng)
    for point, end in zip(points, carried_points(chain, points), strict=True):
        *back, _, _, _, material = followed_back(chain, *end, 0.0, 0.0, 1.0)
        # A few dozen roundings of numbers up to 1000 mm.
        np.testing.assert_allclose(back, point, atol=1e-11)
        assert material


@pytest.mark.parametrize("deformation", CHAINS)
def test_gradient_is_that_of_finite_differences(
    deformation: tuple[Deformation, ...], rng: np.random.Generator
) -> None:
    chain = packed_chain(deformation, PLACEMENT)
    points = material_points(rng)
    h = 1e-3
    exact = gradients(chain, points)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = h
        slope = (carried_points(chain, points + step) - carried_points(chain, points - step)) / (2 * h)
        # Rounding 1e-13 x 1000 mm / h = 1e-7 at worst; truncation h^2 f''' / 6 is below 1e-11.
        np.testing.assert_allclose(exact[:, :, axis], slope, atol=1e-7)


@pytest.mark.parametrize("deformation", CHAINS)
def test_followed_direction_is_the_inverse_gradient(
    deformation: tuple[Deformation, ...], rng: np.random.Generator
) -> None:
    chain = packed_chain(deformation, PLACEMENT)
    points = material_points(rng, 10)
    ends, exact = carried_points(chain, points), gradients(chain, points)
    for end, gradient in zip(ends, exact, strict=True):
        direction = rng.normal(size=3)
        _, _, _, *back, _ = followed_back(chain, *end, *direction)
        np.testing.assert_allclose(back, np.linalg.solve(gradient, direction), atol=1e-12)


@pytest.mark.parametrize("deformation", CHAINS)
def test_a_carried_normal_stays_normal_to_carried_tangents(
    deformation: tuple[Deformation, ...], rng: np.random.Generator
) -> None:
    chain = packed_chain(deformation, PLACEMENT)
    for point in material_points(rng, 10):
        normal, first = rng.normal(size=3), rng.normal(size=3)
        tangent = np.cross(normal, first)
        *_, nx, ny, nz = carried(chain, *point, *normal)
        gradient = gradients(chain, point[None])[0]
        assert np.dot([nx, ny, nz], gradient @ tangent) == pytest.approx(0.0, abs=1e-12)


def test_bending_is_clamped_at_the_edge_and_whole_in_the_middle() -> None:
    assert deflection_line(0.0) == (1.0, 0.0)
    assert deflection_line(0.5) == (0.0, 0.0)
    # Just inside, value and slope vanish with the square and the first power of the distance, times 24.
    value, slope = deflection_line(0.5 - 1e-6)
    assert abs(value) < 24e-12
    assert abs(slope) < 25e-6


def test_halves_apart_leave_a_gap_without_material() -> None:
    chain = packed_chain((HalvesApart(4.0),), Pose.from_arrays(np.eye(3), np.zeros(3)))
    np.testing.assert_array_equal(
        carried_points(chain, np.array([[-1.0, 0, 0], [1.0, 0, 0]]))[:, 0], [-3.0, 3.0]
    )
    assert not followed_back(chain, 1.5, 0.0, 0.0, 0.0, 0.0, 1.0)[6]


def test_a_specimen_is_not_turned_inside_out() -> None:
    for strain, ratio in ((-0.999, 0.3), (3.3, 0.3), (5.0, -0.2), (0.0, 0.5)):
        assert (
            np.linalg.det(
                gradients(packed_chain([UniaxialStrain(strain, ratio)], PLACEMENT), np.zeros((1, 3)))
            )
            > 0
        )
    for strain, ratio, said in (
        (-1.0, 0.3, "strain = -1.0 turns the specimen inside out: along x it is strained by -1, and should"),
        (-7.5, 0.3, "along x it is strained by -7.5, and should be by more than -1"),
        (4.0, 0.3, "strain = 4.0 with poisson_ratio = 0.3 turns .*: along y it is strained by -1.2, and"),
    ):
        crack = StringerCrack(strain, ratio, 0.0, 0.0, 10.0, 0.0, 20.0, 0.1, 0.1)
        for deformation in (UniaxialStrain(strain, ratio), crack):
            with pytest.raises(InvalidInput, match=said):
                packed_chain([deformation], PLACEMENT)


def test_a_disbond_lifts_the_stringer_and_leaves_the_skin() -> None:
    chain = packed_chain((Disbond(4.0, 200.0, 0.01, 3.0),), Pose.from_arrays(np.eye(3), np.zeros(3)))
    places = np.array([[0.0, 20.0, 0.0], [0.0, 20.0, 3.0], [0.0, 20.0, 1.5], [101.0, 20.0, 3.0]])
    # The foot lifts by 4 (1 + 0.01 x 20) mm in the middle, its side at half the height by half of that;
    # the skin stays, and so does all beyond the ends.
    np.testing.assert_allclose(carried_points(chain, places)[:, 2], [0.0, 7.8, 3.9, 3.0], atol=1e-14)


def test_the_skin_over_a_cracked_stringer_is_strained_more() -> None:
    crack = StringerCrack(1e-3, 0.33, -2e-4, 0.0, 20.0, -50.0, 30.0, 0.4, 0.0)
    chain = packed_chain((crack,), Pose.from_arrays(np.eye(3), np.zeros(3)))
    # Ten fades off the tip tanh is 1 but for 4e-9, and 5 widths off the stringer B is 4e-6.
    places = np.array([[-200.0, -50.0, 0.0], [200.0, -50.0, 0.0], [200.0, 100.0, 0.0]])
    along = gradients(chain, places)[:, 0, 0] - 1.0
    expected = [1e-3 * 1.01, 1e-3 * (1.01 + 0.4), 1e-3 * 0.98]
    np.testing.assert_allclose(along, expected, rtol=1e-5)
    # Half of it at the tip, and the panel bends in its plane so that nothing is sheared far from the crack.
    slopes = gradients(chain, np.array([[0.0, -50.0, 0.0], [-200.0, 80.0, 0.0]]))
    assert slopes[0, 0, 0] - 1.0 == pytest.approx(1e-3 * 1.21, rel=1e-9)
    assert slopes[1, 0, 1] + slopes[1, 1, 0] == pytest.approx(0.0, abs=1e-9)
