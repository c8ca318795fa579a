"""Pose tables: those of the thesis, and the laws behind them."""

from __future__ import annotations

from itertools import permutations
from math import degrees, radians

import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.stage_poses import AngleRange, StagePose, travel, uniform_poses


def in_degrees(poses: tuple[StagePose, ...]) -> list[tuple[float, float]]:
    return [(round(degrees(p.pan_rad), 6), round(degrees(p.tilt_rad), 6)) for p in poses]


def test_thesis_table_2() -> None:
    # A full turn of pan is divided into 0, 120 and 240 degrees: 360 is 0 again. The tilt axis moves first,
    # since its way is shorter.
    poses = uniform_poses(9, AngleRange(0.0, radians(360.0)), AngleRange(radians(-90.0), radians(90.0)))
    assert in_degrees(poses) == [
        (0, -90), (0, 0), (0, 90), (120, 90), (120, 0), (120, -90), (240, -90), (240, 0), (240, 90),
    ]  # fmt: skip


def test_thesis_table_3() -> None:
    poses = uniform_poses(
        25, AngleRange(radians(-45.0), radians(45.0)), AngleRange(radians(-45.0), radians(45.0))
    )
    first_rows = [
        (-45, -45), (-22.5, -45), (0, -45), (22.5, -45), (45, -45),
        (45, -22.5), (22.5, -22.5), (0, -22.5), (-22.5, -22.5), (-45, -22.5),
    ]  # fmt: skip
    assert in_degrees(poses)[:10] == first_rows
    assert in_degrees(poses)[-1] == (45, 45)
    assert in_degrees(poses)[12] == (0, 0)


def test_a_serpentine_is_the_shortest_way_over_a_small_grid() -> None:
    poses = uniform_poses(6, AngleRange(-0.4, 0.4), AngleRange(-0.3, 0.3))
    shortest = min(travel(order) for order in permutations(poses))
    assert travel(poses) == pytest.approx(shortest)


def test_a_random_order_has_the_same_poses_and_repeats_itself() -> None:
    ranges = AngleRange(-1.0, 1.0), AngleRange(-0.8, 0.8)
    straight, one, same, other = (
        uniform_poses(20, *ranges),
        uniform_poses(20, *ranges, order="random", seed=3),
        uniform_poses(20, *ranges, order="random", seed=3),
        uniform_poses(20, *ranges, order="random", seed=4),
    )
    assert one == same != other
    assert sorted(in_degrees(one)) == sorted(in_degrees(straight))
    assert travel(one) > travel(straight)


@pytest.mark.parametrize("count", [4, 6, 9, 12, 16, 20, 25, 30, 48])
def test_poses_stay_within_their_ranges_and_reach_their_ends(count: int) -> None:
    pan, tilt = AngleRange(-2.0, 1.0), AngleRange(-0.7, 1.2)
    poses = uniform_poses(count, pan, tilt)
    assert len(set(poses)) == count
    for axis, angles in ((pan, [p.pan_rad for p in poses]), (tilt, [p.tilt_rad for p in poses])):
        # Ends are sums of steps: exact to rounding.
        assert min(angles) == pytest.approx(axis.minimum_rad)
        assert max(angles) == pytest.approx(axis.maximum_rad)


def test_a_number_that_does_not_divide_names_its_neighbours() -> None:
    with pytest.raises(InvalidInput, match=r"13 poses do not divide .*: ask for 12 or 15"):
        uniform_poses(13, AngleRange(-1.0, 1.0), AngleRange(-0.7, 0.7))
    with pytest.raises(InvalidInput, match="not empty"):
        uniform_poses(4, AngleRange(0.0, 0.0), AngleRange(-0.7, 0.7))


def test_one_pose_is_in_the_middle() -> None:
    assert uniform_poses(1, AngleRange(-1.0, 2.0), AngleRange(0.0, 1.0)) == (StagePose(0.5, 0.5),)
