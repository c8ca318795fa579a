"""What match in time and shapes share of an image's noise is taken off the covariance of displacement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from support.two_cameras import Floats, cameras

from sms_jobs.metrology.deformation.fields.common_noise import CommonNoise
from sms_jobs.metrology.deformation.fields.displacement import (
    DenseDisplacement,
    StateShape,
    displacement_field,
)
from sms_jobs.metrology.geometry.camera import Camera, pixel_grid, project, ray_directions
from sms_jobs.metrology.geometry.several_cameras import SeenPoints, meet_rays
from sms_jobs.metrology.geometry.transforms import rotation_matrix, unpack

SHAPE_SIGMA = 0.02
"""Of matches between cameras, along both axes, in px."""
CORRELATION = 0.9
AT = np.array([4.0, -3.0, 2.0])
PIXEL = np.array([[60.0], [36.0]])
DRAWS = 4000


@dataclass(frozen=True)
class Plane:
    """A plane through a point with a normal, both (3,)."""

    at: Floats
    normal: Floats

    def seen(self, camera: Camera, pixels: Floats) -> Floats:
        """Return the points that pixels (2, n) of a camera see, (n, 3)."""
        rays, centre = ray_directions(camera.intrinsics, camera.pose, pixels.T), camera.pose.centre()
        return centre + ((self.at - centre) @ self.normal / (rays @ self.normal))[:, None] * rays


@dataclass(frozen=True)
class Moved:
    """Cameras that look at a plane, which is turned about `AT` and shifted.

    `time_sigma` is that of matches in time, along columns and along rows, in px.
    """

    rig: tuple[Camera, ...]
    before: Plane
    turn: Floats
    shift: Floats
    time_sigma: Floats

    @property
    def after(self) -> Plane:
        return Plane(AT + self.shift, self.turn @ self.before.normal)

    def ends(self, pixels: Floats) -> Floats:
        """Return where the points of pixels (2, n) of state 0 are seen at state 1, (2, n)."""
        points = (self.before.seen(self.rig[0], pixels) - AT) @ self.turn.T + AT + self.shift
        return self.image(0, points)

    def image(self, camera: int, points: Floats) -> Floats:
        return np.asarray(project(self.rig[camera].intrinsics, self.rig[camera].pose, points).T)

    def met(
        self, plane: Plane, pixels: Floats, own: Floats, random: np.random.Generator | None
    ) -> SeenPoints:
        """Return the points of pixels (2, n), by matches that noise has moved by `own` px (2, n).

        Along the surface; the partners' own noise besides, if it is drawn, is half of a match's variance.
        """
        partners = range(1, len(self.rig))
        step = 0.5 * np.eye(2)

        def places(at: Floats) -> Floats:
            points = plane.seen(self.rig[0], at)
            return np.stack([self.image(k, points) for k in partners])

        noisy = places(pixels + own)
        if random is not None:
            noisy = noisy + random.normal(0.0, SHAPE_SIGMA / np.sqrt(2.0), noisy.shape)
        slopes = np.stack(
            [places(pixels + one[:, None]) - places(pixels - one[:, None]) for one in step], axis=2
        )
        return meet_rays(self.rig[0], self.rig[1:], pixels, noisy, np.full_like(noisy, SHAPE_SIGMA), slopes)

    def stated(self) -> DenseDisplacement:
        """Return what is stated of a displacement without errors."""
        rows, columns = self.rig[0].rows, self.rig[0].columns
        pixels = pixel_grid(rows, columns).reshape(-1, 2).T
        labels = np.zeros((rows, columns), np.int32)
        x, y = PIXEL[:, 0].astype(int)
        labels[y - 4 : y + 5, x - 4 : x + 5] = 1
        states = []
        for plane, region in ((self.before, labels), (self.after, np.ones_like(labels))):
            met = self.met(plane, pixels, np.zeros_like(pixels), None)
            states.append(
                StateShape(
                    met.xyz.reshape(3, rows, columns),
                    met.covariance.reshape(6, rows, columns),
                    region,
                    own_noise=(met.by_own * SHAPE_SIGMA / np.sqrt(2.0)).reshape(2, rows, columns),
                )
            )
        whole = np.ones((2, rows, columns))
        variance = self.time_sigma[:, None, None] ** 2 * whole
        image = (self.ends(pixels) - pixels).reshape(2, rows, columns)
        common = CommonNoise(variance, CORRELATION * whole[0], self.rig[0].pose.centre())
        return displacement_field(image, variance, 0.0 * whole, *states, labels > 0, 0.0, common=common)

    def drawn(self, random: np.random.Generator) -> Floats:
        """Return displacements (3, draws) of the material point of a pixel, by noisy matches."""
        pixels = np.repeat(PIXEL, DRAWS, axis=1)

        def noise_of_an_image(gradient: Floats) -> tuple[Floats, Floats]:
            """Return by how many px of it subsets in time and between cameras are moved, (2, draws)."""
            in_time = gradient @ (self.time_sigma[:, None] * random.normal(0.0, np.sqrt(0.5), (2, DRAWS)))
            sigma = np.sqrt(0.5 * np.diag(gradient @ np.diag(self.time_sigma**2) @ gradient.T))
            other = random.normal(0.0, 1.0, (2, DRAWS))
            between = CORRELATION * in_time / sigma[:, None] + np.sqrt(1.0 - CORRELATION**2) * other
            return in_time, SHAPE_SIGMA / np.sqrt(2.0) * between

        in_time, between = noise_of_an_image(np.eye(2))
        start = self.met(self.before, pixels, between, random)
        later, between_later = noise_of_an_image(self.gradient())
        ends = self.ends(pixels + in_time) - later
        return np.asarray(self.met(self.after, ends, between_later, random).xyz - start.xyz)

    def gradient(self) -> Floats:
        """Return how the end changes with the pixel, (2, 2)."""
        step = 0.5 * np.eye(2)
        sides = [self.ends(PIXEL + one[:, None]) - self.ends(PIXEL - one[:, None]) for one in step]
        return np.concatenate(sides, axis=1)


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize(
    ("tilt", "turn", "time_sigma"),
    [
        (0.0, (0.0, 0.0, 0.05), (0.02, 0.02)),
        (-0.8, (0.02, -0.1, 0.0), (0.02, 0.02)),
        (0.8, (0.0, 0.0, 0.0), (0.015, 0.025)),
        (0.0, (0.0, 0.0, 2.0), (0.03, 0.03)),
    ],
)
def test_displacements_scatter_as_their_covariance_says(
    count: int, tilt: float, turn: tuple[float, float, float], time_sigma: tuple[float, float]
) -> None:
    """All six covariances of faces of any tilt, at rest, turned a little and turned by 115 degrees."""
    plane = Plane(AT, np.array([np.sin(tilt), 0.3, np.cos(tilt)]))
    shift = np.array([0.2, -0.1, 0.3])
    moved = Moved(
        cameras(80, 60, count=count), plane, rotation_matrix(np.array(turn)), shift, np.array(time_sigma)
    )
    field = moved.stated()
    x, y = PIXEL[:, 0].astype(int)
    stated = unpack(field.covariance[:, y, x])
    observed = np.cov(moved.drawn(np.random.default_rng(7)))
    # Of Gaussian draws a covariance scatters by sqrt((s_ij^2 + s_ii s_jj) / draws).
    diagonal = np.diag(stated)
    error = np.sqrt((stated**2 + np.outer(diagonal, diagonal)) / DRAWS)
    assert (np.abs(observed - stated) < 4.0 * error).all(), (observed - stated) / error
