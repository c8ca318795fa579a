"""Where a pan-tilt stage brings the spheres of a ball bar (thesis section 3.3).

Three frames: the world; the tripod, with x'' along the pan axis and y'' along the tilt axis of the stage at
home; the bar, with z' along the line of the spheres and x' along its stalk. The origins of the last two are
where the axes meet. Angles are in rad and may be given by any number of turns: 315 degrees are -45 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, degrees, pi, radians, sin, sqrt, tan

import numpy as np

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.metrology.arrays import Floats, Mask

LEAST_SINE = sin(radians(10.0))
"""Of the angle of a pan or tilt pose: below it the axis is five times less sure than at 90 degrees."""

_HOME_TOLERANCE = radians(0.1)
_LABEL_MARGIN = 3.0  # the second best labels must fit so many times worse


@dataclass(frozen=True)
class BarGeometry:
    """A ball bar as the special poses show it, by the thesis's formulas.

    Attributes
    ----------
    lengths, length
        Distance of the spheres at home, in the pan and in the tilt pose, and their mean; in mm.
    offset
        f, from sphere 1 to the clamping point, in mm.
    stalk
        s, from the axes to the bar, in mm; negative when the stalk points against the pan axis.
    """

    lengths: tuple[float, float, float]
    length: float
    offset: float
    stalk: float


@dataclass(frozen=True)
class Stage:
    """A pan-tilt stage with a ball bar, in the world.

    Attributes
    ----------
    rotation, origin
        (3, 3) from the tripod's frame to the world's, and (3,) where the axes meet, in mm.
    bar
        (2, 3): the spheres' centres in the bar's frame, in mm.
    covariance
        (12, 12) of a small rotation vector applied to the left of `rotation` (rad), `origin` and the two rows
        of `bar` (mm); None when it is not known.
    axes_gap_mm
        Closest distance of the two axes, in mm; 0 for an ideal stage and no noise.
    axes_angle_rad
        Angle between them; pi / 2 for an ideal one.
    """

    rotation: Floats
    origin: Floats
    bar: Floats
    covariance: Floats | None
    axes_gap_mm: float
    axes_angle_rad: float


def principal_angle(angle: float) -> float:
    """Return the same direction as an angle in (-pi, pi]; all in rad."""
    return pi - (pi - angle) % (2.0 * pi)


def stage_rotation(pan: float, tilt: float) -> Floats:
    """Return the (3, 3) rotation from the bar's frame to the tripod's for angles in rad.

    Thesis Eq. (2.3): a turn by the tilt about y, then by the pan about x.
    """
    so, co, sp, cp = sin(pan), cos(pan), sin(tilt), cos(tilt)
    return np.array([[cp, 0.0, sp], [so * sp, co, -so * cp], [-co * sp, so, co * cp]])


def predict_centres(stage: Stage, pan: float, tilt: float) -> Floats:
    """Return the spheres' centres in the world, (2, 3) in mm, for angles in rad.

    Thesis Eq. (2.1) and (2.2).
    """
    return np.asarray(stage.bar @ (stage.rotation @ stage_rotation(pan, tilt)).T + stage.origin)


def centre_jacobian(stage: Stage, pan: float, tilt: float) -> Floats:
    """Return the derivative of `predict_centres` by the stage's 12 parameters, (2, 3, 12), see `Stage`."""
    turned = stage.rotation @ stage_rotation(pan, tilt)
    jacobian = np.zeros((2, 3, 12))
    for k, (x, y, z) in enumerate(stage.bar @ turned.T):
        jacobian[k, :, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        jacobian[k, :, 3:6] = np.eye(3)
        jacobian[k, :, 6 + 3 * k : 9 + 3 * k] = turned
    return jacobian


def prediction_covariance(stage: Stage, pan: float, tilt: float) -> Floats:
    """Return the covariances of `predict_centres`, (2, 3, 3) in mm^2.

    Raises `InvalidInput` for a stage without covariance.
    """
    if stage.covariance is None:
        raise InvalidInput("this stage has no covariance; refine it over the poses that were seen")
    jacobian = centre_jacobian(stage, pan, tilt)
    return np.asarray(jacobian @ stage.covariance @ jacobian.transpose(0, 2, 1))


def turning_axis(home: Floats, turned: Floats, angle: float) -> Floats:
    """Return the unit vector about which a bar turned by `angle` between two poses.

    Parameters
    ----------
    home, turned
        (2, 3) centres of spheres 1 and 2, in mm.
    angle
        In rad; the vector has the sense in which it is positive.

    Notes
    -----
    Thesis Eq. (2.4), (2.5) for the pan axis and (2.6), (2.7) for the tilt axis: the cross product of the bar
    at home and turned; its sign is turned for a negative angle, which the thesis leaves out. Exact when the
    bar is square to the axis.
    """
    normal = np.cross(home[1] - home[0], turned[1] - turned[0])
    length = float(np.linalg.norm(normal))
    if not length > 0.0:
        raise CalibrationFailed(
            f"the bar is parallel before and after a turn by {degrees(angle):.1f} degrees, which shows no "
            "axis; take a pose that turns it by 10 to 170 degrees, and check the spheres' numbers"
        )
    return np.asarray(normal / (length if sin(angle) > 0.0 else -length))


def point_on_axis(home: Floats, turned: Floats, axis: Floats, angle: float) -> Floats:
    """Return the point of an axis nearest to the middle of a chord that a sphere's centre turned through.

    Parameters
    ----------
    home, turned
        (3,) the centre before and after, in mm.
    axis
        (3,) unit vector, see `turning_axis`.
    angle
        In rad.

    Notes
    -----
    Thesis Eq. (2.10), (2.11) for the pan axis and (2.12), (2.13) for the tilt axis; in (2.11) the cross
    product is normalised as in (2.13), since a bar is missing there.
    """
    chord = turned - home
    across = np.cross(chord, axis)
    length = float(np.linalg.norm(across))
    middle = (turned + home) / 2.0
    if length == 0.0:  # a sphere on the axis stays where it is
        return np.asarray(middle)
    distance = float(np.linalg.norm(chord)) / (2.0 * tan(principal_angle(angle) / 2.0))
    return np.asarray(middle - distance * across / length)


def meeting_point(first: Floats, along: Floats, second: Floats, towards: Floats) -> tuple[Floats, float]:
    """Return the middle of the closest approach of two lines, (3,) in mm, and the gap between them in mm.

    The lines pass through `first` and `second`, (3,) in mm, along unit vectors.
    """
    between = second - first
    cosine = float(along @ towards)
    p, q = np.linalg.solve([[1.0, -cosine], [cosine, -1.0]], [between @ along, between @ towards])
    a, b = first + p * along, second + q * towards
    return np.asarray((a + b) / 2.0), float(np.linalg.norm(a - b))


def bar_geometry(home: Floats, panned: Floats, tilted: Floats, tilt: float) -> BarGeometry:
    """Return length, offset and stalk of a bar from its three special poses.

    Parameters
    ----------
    home, panned, tilted
        (2, 3) centres of spheres 1 and 2, in mm.
    tilt
        Of the tilt pose, in rad.

    Notes
    -----
    Thesis Eq. (2.14)-(2.20), (2.18) as f = l t1 / (t1 + t2). The clamping point is between the spheres; the
    stalk is taken to be positive.
    """
    first, second, third = (float(np.linalg.norm(pose[1] - pose[0])) for pose in (home, panned, tilted))
    length = (first + second + third) / 3.0
    t1, t2 = (float(np.linalg.norm(panned[k] - home[k])) for k in (0, 1))
    offset = length * t1 / (t1 + t2)
    distance = float(np.linalg.norm(tilted[0] - home[0])) / (2.0 * abs(sin(principal_angle(tilt) / 2.0)))
    # Noise can make the distance of sphere 1 less than its offset where there is no stalk.
    return BarGeometry((first, second, third), length, offset, sqrt(max(0.0, distance**2 - offset**2)))


def stage_from_special_poses(
    home: Floats, panned: Floats, tilted: Floats, pan: float, tilt: float
) -> tuple[Stage, BarGeometry]:
    """Return the stage and the bar that three special poses show, in closed form.

    Parameters
    ----------
    home, panned, tilted
        (2, 3) centres of spheres 1 and 2 in mm, at the angles (0, 0), (pan, 0) and (0, tilt).
    pan, tilt
        In rad.

    Notes
    -----
    Thesis Eq. (2.1)-(2.20). The matrix of (2.9) is replaced by the nearest rotation, since noise leaves the
    axes of (2.5) and (2.7) not quite square. Sphere 1 lies at (s, 0, -f) and sphere 2 at (s, 0, l - f), with
    the signs of s and of the bar's direction as measured at home: an axis has the sense in which its angle
    grows, whichever way the stalk points and however the spheres are numbered.

    Raises `InvalidInput` for angles that determine no axis and `CalibrationFailed` where the centres
    show none.
    """
    for what, angle in (("pan", pan), ("tilt", tilt)):
        if abs(sin(angle)) < LEAST_SINE:
            raise InvalidInput(
                f"a {what} pose at {degrees(principal_angle(angle)):.1f} degrees shows its axis badly; "
                "take one between 10 and 170 degrees"
            )
    x, y = turning_axis(home, panned, pan), turning_axis(home, tilted, tilt)
    z = np.cross(x, y)
    angle = atan2(float(np.linalg.norm(z)), float(x @ y))
    if sin(angle) < LEAST_SINE:
        raise CalibrationFailed(
            f"the pan and tilt axes seem to be {degrees(angle):.1f} degrees apart in place of 90; check "
            "the angles and the spheres' numbers in the three special poses"
        )
    left, _, right = np.linalg.svd(np.stack([x, y, z / np.linalg.norm(z)], axis=1))
    rotation = np.asarray(left @ right)
    origin, gap = meeting_point(
        point_on_axis(home[0], panned[0], x, pan), x, point_on_axis(home[0], tilted[0], y, tilt), y
    )
    geometry = bar_geometry(home, panned, tilted, tilt)
    at_home = (home - origin) @ rotation
    stalk = geometry.stalk if at_home[0, 0] >= 0.0 else -geometry.stalk
    along = 1.0 if at_home[1, 2] > at_home[0, 2] else -1.0
    bar = np.array(
        [[stalk, 0.0, -along * geometry.offset], [stalk, 0.0, along * (geometry.length - geometry.offset)]]
    )
    signed = BarGeometry(geometry.lengths, geometry.length, geometry.offset, stalk)
    return Stage(rotation, origin, bar, None, gap, angle), signed


def label_special_poses(
    home: Floats, panned: Floats, tilted: Floats, pan: float, tilt: float
) -> tuple[Floats, Floats]:
    """Return the centres of the pan and the tilt pose, (2, 3) each, numbered as at home.

    Parameters
    ----------
    home, panned, tilted, pan, tilt
        See `stage_from_special_poses`; the spheres of the last two may be swapped.

    Notes
    -----
    Of the four ways to number them, that whose closed-form stage leads back to the measured centres best.
    This decides also where the angle of thesis Eq. (2.24) cannot, near 90 degrees.

    Raises `CalibrationFailed` when two ways fit almost equally well, as for a bar without stalk that is
    clamped in its middle, turned by 90 degrees both ways.
    """
    outcomes: list[tuple[float, int, Floats, Floats]] = []
    for swap in range(4):
        p, t = panned[::-1] if swap & 1 else panned, tilted[::-1] if swap & 2 else tilted
        try:
            stage, _ = stage_from_special_poses(home, p, t, pan, tilt)
        except CalibrationFailed:
            continue
        angles = ((0.0, 0.0), (pan, 0.0), (0.0, tilt))
        off = [predict_centres(stage, *a) - c for a, c in zip(angles, (home, p, t), strict=True)]
        outcomes.append((float(np.sqrt(np.mean(np.square(off)))), swap, p, t))
    outcomes.sort(key=lambda outcome: outcome[:2])
    if not outcomes:
        raise CalibrationFailed(
            "the three special poses show no pan and tilt axes; check their angles and the centres found"
        )
    best = outcomes[0]
    # Exact input leaves rounding errors, which must not be compared with each other.
    rounding = 1e-9 * float(np.linalg.norm(home[1] - home[0]))
    if len(outcomes) > 1 and outcomes[1][0] < _LABEL_MARGIN * max(best[0], rounding):
        raise CalibrationFailed(
            f"the spheres of the special poses cannot be distinguished: two ways to number them fit to "
            f"{best[0]:.3g} and {outcomes[1][0]:.3g} mm; take special poses at about 45 degrees"
        )
    return best[2], best[3]


def special_poses(angles: Floats, usable: Mask | None = None) -> tuple[int, int, int]:
    """Choose the home pose, a pan pose and a tilt pose from a list.

    Parameters
    ----------
    angles
        (poses, 2) pan and tilt, in rad.
    usable
        (poses,): which of them to choose from, such as those in which two spheres were found; None for all.

    Returns
    -------
    Indices of (0, 0), of (pan, 0) and of (0, tilt); of several those whose angle is nearest to a right angle
    either way, where an axis is surest, and the earlier of equals.

    Notes
    -----
    Thesis section 3.3.5. Raises `InvalidInput` when one of them is missing.
    """
    listed = np.asarray(angles, dtype=np.float64)
    if listed.ndim != 2 or listed.shape[1] != 2:
        raise InvalidInput(f"a list of poses has the shape (poses, 2), pan and tilt, not {listed.shape}")
    wrapped = pi - (pi - listed) % (2.0 * pi)
    allowed = np.ones(len(listed), dtype=np.bool_) if usable is None else np.asarray(usable)
    at_zero = np.abs(wrapped) <= _HOME_TOLERANCE
    # Rounded, so that 45 degrees and 315 are equals.
    sine = np.round(np.abs(np.sin(wrapped)), 9)
    chosen = []
    for name, matching, score in (
        ("home pose (0, 0)", at_zero.all(axis=1), np.ones(len(listed))),
        ("pan pose (pan, 0) between 10 and 170 degrees", at_zero[:, 1], sine[:, 0]),
        ("tilt pose (0, tilt) between 10 and 170 degrees", at_zero[:, 0], sine[:, 1]),
    ):
        candidates = np.where(matching & allowed & (score >= LEAST_SINE), score, 0.0)
        if not candidates.any():
            raise InvalidInput(
                f"there is no {name} with both spheres among {len(listed)} poses; without one the "
                "stage cannot be found: measure it, or look for the spheres in whole images"
            )
        chosen.append(int(np.argmax(candidates)))
    return chosen[0], chosen[1], chosen[2]
