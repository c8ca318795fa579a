"""A pan-tilt stage from any number of poses, and the parts of an image where it will show the spheres."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.stage.pan_tilt import Stage, centre_jacobian, predict_centres
from sms_jobs.metrology.geometry.camera import Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import rotation_matrix

_PARAMETERS = (
    *(f"the tripod's rotation about {axis}" for axis in "XYZ"),
    *(f"the axes' meeting point in {axis}" for axis in "XYZ"),
    *(f"sphere {k} on the bar in {axis}" for k in (1, 2) for axis in "xyz"),
)
_OUTLIER_LIMIT = 5.0  # standard deviations of a centre in space: one good centre in 70,000
_MEDIAN_OF_THREE = 1.538  # median of the root of chi-square with three degrees of freedom
_SINGULAR = 1e-6
_SIGMAS = 4.0
_SILHOUETTE = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)


@dataclass(frozen=True)
class StageFit:
    """A stage that was fitted to the spheres' centres of many poses.

    Attributes
    ----------
    stage
        With covariance.
    residuals
        (poses, 2, 3) measured less predicted centres, in mm; NaN where a sphere was not seen.
    misfit
        (poses, 2) the same in standard deviations of the centres.
    used
        (poses, 2): which centres the stage was fitted to.
    refused
        (poses, 2) bool by reason: centres that were measured and left out.
    rms_mm
        Root mean square of the used residuals' lengths.
    reduced_chi_square
        1 when centres scatter as their covariances say; above, the stage's covariance is enlarged by it.
    """

    stage: Stage
    residuals: Floats
    misfit: Floats
    used: Mask
    refused: dict[str, Mask]
    rms_mm: float
    reduced_chi_square: float


def refine_stage(start: Stage, angles: Floats, centres: Floats, covariances: Floats) -> StageFit:
    """Fit the tripod's place and the bar's shape to the spheres' centres of all poses.

    Parameters
    ----------
    start
        Such as from the special poses.
    angles
        (poses, 2) pan and tilt, in rad.
    centres
        (poses, 2, 3) in mm, sphere 1 first; NaN where one was not seen.
    covariances
        (poses, 2, 3, 3) in mm^2.

    Notes
    -----
    Least squares over 12 parameters: rotation and origin of thesis Eq. (2.1) and both spheres in the bar's
    frame of Eq. (2.2), so that a bar that is not square to its stalk, or zeros of the angles that are off, do
    no harm. A first fit with a robust loss tells which centres are more than 5 standard deviations off, a
    second one leaves these out.

    Raises `InvalidInput` for arrays that do not belong together, and `CalibrationFailed` when the poses leave
    parameters open, as when all share one pan or one tilt angle.
    """
    count = len(angles)
    for name, array, shape in (
        ("angles", angles, (count, 2)),
        ("centres", centres, (count, 2, 3)),
        ("covariances", covariances, (count, 2, 3, 3)),
    ):
        if np.shape(array) != shape:
            raise InvalidInput(f"the {name} of {count} poses have the shape {shape}, not {np.shape(array)}")
    seen = np.isfinite(np.sum(centres, axis=-1) + np.sum(covariances, axis=(-2, -1)))
    roots = np.zeros((count, 2, 3, 3))
    try:
        inverse = np.linalg.inv(covariances[seen])
        roots[seen] = np.linalg.cholesky(inverse).transpose(0, 2, 1)
    except np.linalg.LinAlgError as error:
        raise InvalidInput("the covariance of a sphere's centre is not positive definite") from error

    stage = _solve(start, angles, centres, roots, seen, robust=True)
    misfit = _misfit(stage, angles, centres, roots, seen)
    used = seen & (misfit <= _OUTLIER_LIMIT * _scale(misfit[seen]))
    stage = _solve(stage, angles, centres, roots, used, robust=False)
    misfit = _misfit(stage, angles, centres, roots, seen)
    # Numbered the other way round they would fit; each pose is judged as a whole.
    turned = _misfit(stage, angles, centres[:, ::-1], roots[:, ::-1], seen[:, ::-1])
    left_out = seen & ~used
    swapped = left_out & (turned[:, ::-1] <= _OUTLIER_LIMIT * _scale(misfit[used]))
    residuals = _residuals(stage, angles, centres)
    chi_square = float(np.sum(misfit[used] ** 2)) / max(3 * int(np.count_nonzero(used)) - 12, 1)
    covariance = _covariance(stage, angles, roots, used) * max(1.0, chi_square)
    return StageFit(
        stage=replace(stage, covariance=covariance),
        residuals=residuals,
        misfit=misfit,
        used=used,
        refused={
            "numbered the other way round": swapped,
            "far from where the stage brings it": left_out & ~swapped,
        },
        rms_mm=float(np.sqrt(np.mean(np.sum(residuals[used] ** 2, axis=-1)))),
        reduced_chi_square=chi_square,
    )


def _residuals(stage: Stage, angles: Floats, centres: Floats) -> Floats:
    return np.asarray(centres - np.array([predict_centres(stage, pan, tilt) for pan, tilt in angles]))


def _misfit(stage: Stage, angles: Floats, centres: Floats, roots: Floats, seen: Mask) -> Floats:
    """Return the lengths of the residuals in standard deviations, (poses, 2)."""
    found = np.full(seen.shape, np.nan)
    standard = roots[seen] @ _residuals(stage, angles, centres)[seen][..., None]
    found[seen] = np.linalg.norm(standard[..., 0], axis=-1)
    return found


def _scale(misfit: Floats) -> float:
    """Return by how much centres scatter more than stated; errors of an early calibration are not noise."""
    return max(1.0, float(np.median(misfit)) / _MEDIAN_OF_THREE)


def _weighted_jacobian(stage: Stage, angles: Floats, roots: Floats, used: Mask) -> Floats:
    """Return the derivative of the standardised predictions by the 12 parameters, (3 centres, 12)."""
    jacobian = np.array([centre_jacobian(stage, pan, tilt) for pan, tilt in angles])
    return np.asarray((roots[used] @ jacobian[used]).reshape(-1, 12))


def _moved(stage: Stage, change: Floats) -> Stage:
    return replace(
        stage,
        rotation=rotation_matrix(change[:3]) @ stage.rotation,
        origin=stage.origin + change[3:6],
        bar=stage.bar + change[6:].reshape(2, 3),
    )


def _solve(
    start: Stage,
    angles: Floats,
    centres: Floats,
    roots: Floats,
    used: Mask,
    *,
    robust: bool,
) -> Stage:
    from scipy.optimize import least_squares

    if 3 * np.count_nonzero(used) < 12:
        raise CalibrationFailed(
            f"{np.count_nonzero(used)} centres of spheres cannot determine the 12 parameters of a stage; "
            "find both spheres in at least three poses"
        )
    _covariance(start, angles, roots, used)

    def residual(change: Floats) -> Floats:
        off = _residuals(_moved(start, change), angles, centres)[used]
        return np.asarray((roots[used] @ off[..., None]).reshape(-1))

    # The derivative by a small left rotation of the moved stage is that by the vector times a regular matrix:
    # both vanish at the same optimum.
    def jacobian(change: Floats) -> Floats:
        return -_weighted_jacobian(_moved(start, change), angles, roots, used)

    spread = _scale(_misfit(start, angles, centres, roots, used)[used])
    options = {"loss": "soft_l1", "f_scale": spread} if robust else {}
    solution = least_squares(
        residual, np.zeros(12), jacobian, x_scale="jac", xtol=1e-14, ftol=1e-14, **options
    )
    return _moved(start, solution.x)


def _covariance(stage: Stage, angles: Floats, roots: Floats, used: Mask) -> Floats:
    """Return the (12, 12) covariance; raise `CalibrationFailed` where a parameter is open."""
    jacobian = _weighted_jacobian(stage, angles, roots, used)
    length = np.linalg.norm(jacobian, axis=0)
    length = np.where(length > 0.0, length, 1.0)
    _, singular, right = np.linalg.svd(jacobian / length, full_matrices=False)
    if singular[-1] < _SINGULAR * singular[0]:
        weak = _PARAMETERS[int(np.argmax(np.abs(right[-1])))]
        raise CalibrationFailed(
            f"{len(angles)} poses of the stage leave {weak} open; add poses that differ in both pan and "
            "tilt by at least 10 degrees"
        )
    return np.asarray((right.T / singular**2) @ right / np.outer(length, length))


def search_margin_mm(covariances: Floats) -> float:
    """Return how far spheres may be from their predictions, in mm, from (..., 3, 3) covariances in mm^2.

    Four standard deviations along the least sure direction.
    """
    return _SIGMAS * float(np.sqrt(np.linalg.eigvalsh(covariances).max()))


def sphere_regions(
    intrinsics: Intrinsics,
    pose: Pose,
    shape: tuple[int, int],
    centres: Floats,
    radius_mm: float,
    margin_mm: float,
) -> Mask:
    """Return the pixels of a sensor that may show spheres whose centres are predicted.

    Parameters
    ----------
    intrinsics, pose
        Of the sensor.
    shape
        Rows and columns of its image.
    centres
        (spheres, 3) predicted, in mm.
    radius_mm
        Of the spheres.
    margin_mm
        How far a sphere may be from its prediction.

    Returns
    -------
    (rows, columns): a circle of pixels around each projected centre, out to the farthest point of the
    outline of a sphere that is larger by the margin; none for a sphere out of sight.

    Notes
    -----
    Thesis section 3.3.5. The rays that touch a sphere of radius R at distance D do so on a circle of radius
    R sqrt(1 - R^2 / D^2), R^2 / D before its centre.
    """
    region = np.zeros(shape, dtype=np.bool_)
    pinhole = pose.centre()
    radius = radius_mm + margin_mm
    for centre in np.asarray(centres, dtype=np.float64):
        away = centre - pinhole
        distance = float(np.linalg.norm(away))
        if distance <= radius:
            region[:] = True  # the margin takes in the sensor itself: nothing is known
            continue
        away /= distance
        first = np.cross(away, np.eye(3)[np.argmin(np.abs(away))])
        first /= np.linalg.norm(first)
        around = np.outer(np.cos(_SILHOUETTE), first) + np.outer(np.sin(_SILHOUETTE), np.cross(away, first))
        nearer = (radius / distance) ** 2
        outline = centre - nearer * distance * away + radius * np.sqrt(1.0 - nearer) * around
        x, y = project(intrinsics, pose, centre)
        reach = float(np.max(np.hypot(*(project(intrinsics, pose, outline) - [x, y]).T)))
        if not np.isfinite(reach):
            continue  # behind the sensor
        rows = slice(max(0, int(y - reach)), max(0, int(y + reach) + 2))
        columns = slice(max(0, int(x - reach)), max(0, int(x + reach) + 2))
        part = region[rows, columns]
        i, j = np.ogrid[: part.shape[0], : part.shape[1]]
        part |= (i + rows.start - y) ** 2 + (j + columns.start - x) ** 2 <= reach**2
    return region
