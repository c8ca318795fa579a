"""Points that cameras follow by images of their own scatter as is stated, and forget where they began."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
import pytest
from support.two_cameras import Floats, cameras

from sms_jobs.metrology.deformation.fields.followed_points import (
    FollowedPlaces,
    FollowedPoints,
    StartPlaces,
    followed_displacement,
)
from sms_jobs.metrology.geometry.camera import Camera, project, ray_directions
from sms_jobs.metrology.geometry.several_cameras import meet_rays
from sms_jobs.metrology.geometry.transforms import rotation_matrix, unpack

Places: TypeAlias = Callable[[Floats], Floats]

BETWEEN_SIGMA, TIME_SIGMA, LATE_SIGMA = 0.02, 0.015, 0.025
"""Of matches between cameras, in time, and of the last images with the first one, along both axes, in px."""
NOISE_PART = 0.6
"""Of all their variances."""
CORRELATION = 0.9
AT = np.array([4.0, -3.0, 2.0])
PIXEL = np.array([[60.0], [36.0]])
DRAWS = 4000


@dataclass(frozen=True)
class Scene:
    """Cameras that look at a plane through `AT`, which is turned about it and shifted."""

    rig: tuple[Camera, ...]
    normal: Floats
    turn: Floats
    shift: Floats

    def points(self, camera: int, pixels: Floats) -> Floats:
        """Return the points that pixels (2, n) of a camera see at rest, (n, 3)."""
        seen = self.rig[camera]
        rays, centre = ray_directions(seen.intrinsics, seen.pose, pixels.T), seen.pose.centre()
        return np.asarray(centre + ((AT - centre) @ self.normal / (rays @ self.normal))[:, None] * rays)

    def image(self, camera: int, points: Floats) -> Floats:
        return np.asarray(project(self.rig[camera].intrinsics, self.rig[camera].pose, points).T)

    def start(self, camera: int, pixels: Floats) -> Floats:
        """Return where a camera sees at rest what pixels of the first one do, (2, n)."""
        return self.image(camera, self.points(0, pixels))

    def end(self, camera: int, pixels: Floats, of: int = 0) -> Floats:
        """Return where a camera sees later what pixels of one see at rest, (2, n)."""
        return self.image(camera, (self.points(of, pixels) - AT) @ self.turn.T + AT + self.shift)

    @property
    def partners(self) -> range:
        return range(1, len(self.rig))

    @property
    def exact(self) -> Floats:
        """The displacement of what the pixel sees, (3,) in mm."""
        return np.asarray((self.points(0, PIXEL)[0] - AT) @ (self.turn.T - np.eye(3)) + self.shift)


def slopes_of(places: Places, at: Floats) -> Floats:
    """Return the derivatives (2, 2, n) of a map of places (2, n)."""
    sides = [places(at + one[:, None]) - places(at - one[:, None]) for one in 0.5 * np.eye(2)]
    return np.stack(sides, axis=1)


def stated(scene: Scene, draws: Floats | None, by_own_texture: bool) -> FollowedPoints:
    """Return displacements by exact places or, with draws of the standard normal, by as many noisy ones."""
    count = 1 if draws is None else draws.shape[-1]
    zeros = iter(np.zeros((60, 2, count))) if draws is None else iter(draws)
    pixels = np.repeat(PIXEL, count, axis=1)

    def scatter(variance: float) -> Floats:
        return np.asarray(np.sqrt(variance) * next(zeros))

    def of_an_image(first: float, second: float) -> tuple[Floats, Floats]:
        """Return by how much two matches are moved by the noise of one image, of their variances."""
        alike, other = next(zeros), next(zeros)
        between = CORRELATION * alike + np.sqrt(1.0 - CORRELATION**2) * other
        return np.sqrt(0.5 * NOISE_PART) * first * alike, np.sqrt(0.5 * NOISE_PART) * second * between

    rest = 1.0 - 0.5 * NOISE_PART
    in_time, across = of_an_image(TIME_SIGMA, BETWEEN_SIGMA)
    end = scene.end(0, pixels + in_time + scatter(rest * TIME_SIGMA**2))
    first, last = [], []
    for k in scene.partners:
        own, own_across = of_an_image(TIME_SIGMA, BETWEEN_SIGMA)
        left = scatter((1.0 - NOISE_PART) * BETWEEN_SIGMA**2)
        first.append(scene.start(k, pixels + across) - own_across + left)
        if by_own_texture:
            last.append(scene.end(k, first[-1] + own + scatter(rest * TIME_SIGMA**2), of=k))
        else:
            late = scene.end(k, pixels + across * LATE_SIGMA / BETWEEN_SIGMA)
            last.append(late + scatter(rest * LATE_SIGMA**2))

    def followed(place: Floats, sigma: float, slopes: Floats) -> FollowedPlaces:
        whole = np.full((2, count), sigma**2)
        return FollowedPlaces(place, whole, NOISE_PART * whole, 0.0 * whole, slopes)

    def repeated(places: Places, at: Floats) -> Floats:
        return np.repeat(slopes_of(places, at), count, axis=2)

    slopes = np.stack([repeated(partial(scene.start, k), PIXEL) for k in scene.partners])
    exact = np.stack([scene.start(k, PIXEL) for k in scene.partners])
    sigma = np.full(exact.shape, BETWEEN_SIGMA)
    met = meet_rays(scene.rig[0], scene.rig[1:], PIXEL, exact, sigma, slopes[..., :1])
    depth = np.repeat(met.covariance[[0, 3, 5]].sum(axis=0), count)
    return followed_displacement(
        (scene.rig, scene.rig),
        pixels,
        StartPlaces(np.stack(first), slopes, depth, np.full(count, NOISE_PART)),
        followed(end, TIME_SIGMA, repeated(partial(scene.end, 0), PIXEL)),
        [
            followed(place, TIME_SIGMA, repeated(partial(scene.end, k, of=k), exact[k - 1]))
            if by_own_texture
            else followed(place, LATE_SIGMA, repeated(partial(scene.end, k), PIXEL))
            for k, place in enumerate(last, start=1)
        ],
        np.full(count, CORRELATION),
        by_own_texture=by_own_texture,
    )


@pytest.mark.parametrize("by_own_texture", [True, False])
@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize(
    ("tilt", "turn"),
    [(0.0, (0.0, 0.0, 0.0)), (-0.8, (0.02, -0.1, 0.0)), (0.3, (0.0, 0.5, 0.0)), (0.0, (0.0, 0.0, 2.0))],
)
def test_displacements_scatter_as_their_covariance_says(
    count: int, tilt: float, turn: tuple[float, float, float], by_own_texture: bool
) -> None:
    """All six covariances, of faces that are shifted, turned a little, tilted, and turned in their plane."""
    normal = np.array([np.sin(tilt), 0.3, np.cos(tilt)])
    scene = Scene(
        cameras(80, 60, count=count), normal, rotation_matrix(np.array(turn)), np.array([0.2, -0.1, 0.3])
    )
    found = stated(scene, None, by_own_texture)
    # Exact places meet where the plane is, but for the rounding of lens models.
    np.testing.assert_allclose(found.displacement[:, 0], scene.exact, atol=1e-6)
    said = unpack(found.covariance[:, 0])
    draws = np.random.default_rng(11).normal(size=(40, 2, DRAWS))
    observed = np.cov(stated(scene, draws, by_own_texture).displacement)
    # Of Gaussian draws a covariance scatters by sqrt((s_ij^2 + s_ii s_jj) / draws).
    diagonal = np.diag(said)
    error = np.sqrt((said**2 + np.outer(diagonal, diagonal)) / DRAWS)
    assert (np.abs(observed - said) < 4.0 * error).all(), (observed - said) / error


def test_where_nothing_turns_the_match_between_cameras_leaves_no_error() -> None:
    scene = Scene(cameras(80, 60), np.array([0.0, 0.0, 1.0]), np.eye(3), np.array([0.2, -0.1, 0.3]))
    pixels, places = PIXEL, scene.start(1, PIXEL)
    off = np.array([[0.5], [0.1]])
    whole = np.full((2, 1), TIME_SIGMA**2)

    def displacement(by_own_texture: bool) -> Floats:
        first = places + off
        end = scene.end(1, first, of=1) if by_own_texture else scene.end(1, PIXEL)
        eye = np.eye(2)[..., None]
        found = followed_displacement(
            (scene.rig, scene.rig),
            pixels,
            StartPlaces(first[None], eye[None], np.ones(1), np.ones(1)),
            FollowedPlaces(scene.end(0, PIXEL), whole, whole, 0.0 * whole, eye),
            [FollowedPlaces(end, whole, whole, 0.0 * whole, eye)],
            np.zeros(1),
            by_own_texture=by_own_texture,
        )
        return np.asarray(np.linalg.norm(found.displacement[:, 0] - scene.exact))

    # A shift by 0.3 mm of 600 mm changes what half a pixel is in depth by a thousandth.
    assert displacement(True) < 2e-3 * displacement(False)


def test_a_partner_has_a_part_only_where_it_sees_a_point_before_and_after() -> None:
    scene = Scene(cameras(80, 60, count=3), np.array([0.0, 0.3, 1.0]), np.eye(3), np.array([0.2, -0.1, 0.3]))
    two = Scene(scene.rig[:2], scene.normal, scene.turn, scene.shift)
    eye, whole = np.eye(2)[..., None], np.full((2, 1), TIME_SIGMA**2)
    hidden = np.full((2, 1), np.nan)

    def found(one: Scene, first: list[Floats], last: list[Floats]) -> FollowedPoints:
        return followed_displacement(
            (one.rig, one.rig),
            PIXEL,
            StartPlaces(np.stack(first), np.stack([eye] * len(first)), np.ones(1), np.ones(1)),
            FollowedPlaces(one.end(0, PIXEL), whole, whole, 0.0 * whole, eye),
            [FollowedPlaces(place, whole, whole, 0.0 * whole, eye) for place in last],
            np.zeros(1),
            by_own_texture=True,
        )

    first, last = [scene.start(k, PIXEL) for k in (1, 2)], [scene.end(k, PIXEL) for k in (1, 2)]
    alone = found(two, first[:1], last[:1])
    for starts, ends in ((first, [last[0], hidden]), ([first[0], hidden], last)):
        one = found(scene, starts, ends)
        np.testing.assert_allclose(one.displacement, alone.displacement, atol=1e-9)
        assert np.isfinite(one.covariance).all()
    nowhere = found(scene, first, [hidden, hidden])
    assert np.isnan(nowhere.displacement).all()
    assert np.isnan(nowhere.covariance).all()
