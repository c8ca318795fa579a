"""Residuals of a bundle adjustment with analytic derivatives, and their normal equations, block by block.

A block is a run of observations that share their parameters: points on one sphere seen by one pair, or
points of one board pose seen by one sensor. Each block fills a small matrix of its own, so that the result
does not depend on which thread computed it.
"""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.bundle.rays import (
    along_change,
    cross,
    dot,
    gap_change,
    pin_hole,
    ray,
    to_sensor,
)
from sms_jobs.metrology.compilation import inlined, inner, kernel, uncounted_kernel, variable
from sms_jobs.metrology.geometry.camera import PER_POSE, PER_SENSOR
from sms_jobs.metrology.geometry.lens import PER_LENS, PIN_HOLE
from sms_jobs.metrology.geometry.lens_kernels import by_parameters, by_point, distorted

SPHERE_SIZE = 2 * PER_SENSOR + 4
"""Parameters of a sphere block: the camera's, the projector's, the centre, the radius."""

PER_BOARD = 4
"""Parameters of a board: the scale of its pitch, bow along x and y, twist; the diameter of a cylinder."""

BOARD_SIZE = PER_SENSOR + PER_POSE + PER_BOARD
"""Parameters of a board block: the sensor's, those of the board's pose, those of the board."""


@inner
@uncounted_kernel
def _add(row: Floats, size: int, weight: float, white: float, normal: Floats, gradient: Floats) -> None:
    """Add one whitened residual to the lower triangle of `normal` (size, size) and to `gradient` (size,)."""
    for i in range(size):
        scaled = weight * row[i]
        gradient[i] += scaled * white
        for j in range(i + 1):
            normal[i, j] += scaled * row[j]


@inner
@uncounted_kernel
def _robust(first: float, second: float, scale: Floats, huber: float) -> tuple[float, float]:
    """Return the cost and the weight of a pair of whitened residuals: half the square up to `huber`."""
    distance = np.sqrt((first / scale[0]) ** 2 + (second / scale[1]) ** 2)
    if distance <= huber:
        return 0.5 * distance * distance, 1.0
    return huber * (distance - 0.5 * huber), huber / distance


@kernel
def ray_distances(
    rotation: Floats, translation: Floats, lens: Floats, pair: tuple[int, int], pixels: Floats, sphere: Floats
) -> tuple[float, float]:
    """Return the residuals in object space of one point, in mm: ray gap and distance to the sphere.

    `pixels` (2, 2) are the camera's and the projector's, `sphere` (4,) centre and radius. The point P lies on
    the camera's ray, nearest to the projector's; epsilon_1 is the distance of the rays (thesis Eq. (1.26))
    and epsilon_2 = |P - S| - R (thesis Eq. (1.27)). NaN where the rays do not meet in front of both sensors.
    """
    inner, turn, direction, hole = np.empty(6), np.empty((2, PER_LENS)), np.empty((2, 3)), np.empty((2, 3))
    by = np.empty((3, 3))
    for k in range(2):
        at = pair[k]
        if not ray(rotation[at], lens[at], pixels[k], inner, turn, direction[k]):
            return np.nan, np.nan
        pin_hole(rotation[at], translation[at], hole[k])
    base = hole[1] - hole[0]
    gap = gap_change(direction[0], direction[1], base, by)
    along = along_change(direction[0], direction[1], base, by)
    square = 0.0
    for i in range(3):
        square += (hole[0, i] + along * direction[0, i] - sphere[i]) ** 2
    return gap, np.sqrt(square) - sphere[3]


@inner
@uncounted_kernel
def meet_sphere(c: Floats, u: Floats, radius: float, flattest: float, by: Floats) -> tuple[float, float]:
    """Return where a ray s u meets a sphere about c, s, and the cosine of its incidence; fill derivatives.

    `by` (3, 3) becomes ds/dc, ds/du and, at [2, 0], ds/dradius. With the distance d of the ray from the
    centre, s = u c / u^2 - R root / |u| where root = sqrt(1 - d^2 / R^2) is the cosine. Below `flattest` the
    root is continued by its tangent, so that rays that (still) miss the sphere have a place too; the cosine
    is 0 for those.
    """
    across = by[2]  # until the end, so that nothing is made for each point
    uu = dot(u, u)
    middle, length = dot(u, c) / uu, np.sqrt(uu)
    for i in range(3):
        across[i] = c[i] - middle * u[i]
    square = 1.0 - dot(across, across) / (radius * radius)
    cosine = np.sqrt(square) if square > 0.0 else 0.0
    root = cosine if cosine > flattest else 0.5 * (flattest + square / flattest)
    turn = 1.0 / (max(cosine, flattest) * radius * length)
    for i in range(3):
        by[0, i] = u[i] / uu + turn * across[i]
        by[1, i] = (c[i] - 2.0 * middle * u[i]) / uu - turn * middle * across[i]
        by[1, i] += radius * root * u[i] / (length * uu)
    by[2, 0] = -(root / length + turn * radius * (1.0 - square))
    return middle - radius * root / length, cosine


@inlined
def room_of_sphere() -> tuple[Floats, Floats, Floats]:
    """Return room for what `sphere_rows` finds on its way: to make it for each point took twice as long."""
    return np.empty(6), np.empty((2, PER_LENS)), np.empty((11, 3))


@inner
@uncounted_kernel
def sphere_rows(
    rotation: Floats,
    translation: Floats,
    lens: Floats,
    pair: tuple[int, int],
    camera_px: Floats,
    sphere: Floats,
    flattest: float,
    pixel: Floats,
    rows: Floats,
    along: Floats,
    room: tuple[Floats, Floats, Floats],
) -> float:
    """Find the projector's pixel that lights what a camera's pixel sees of a sphere; fill derivatives.

    Fills `pixel` (2,), `rows` (2, parameters) with its derivatives by them, and `along` (2,) with its
    direction along the camera's ray; works in `room`, from `room_of_sphere`. Returns the cosine of the
    camera's ray with the surface; NaN where there is no ray or where the sphere lies behind a sensor.
    """
    camera, projector = pair
    inner, turn, vectors = room
    u, hole, c, point = vectors[0], vectors[1], vectors[2], vectors[3]
    by_along, by, slope = vectors[4:7], vectors[7:9], vectors[9:11]
    if not ray(rotation[camera], lens[camera], camera_px, inner, turn, u):
        return np.nan
    pin_hole(rotation[camera], translation[camera], hole)
    for i in range(3):
        c[i] = sphere[i] - hole[i]
    s, cosine = meet_sphere(c, u, sphere[3], flattest, by_along)
    for i in range(3):
        point[i] = hole[i] + s * u[i]
    own = rows[:, PER_SENSOR : 2 * PER_SENSOR]
    if not s > 0.0 or not project_rows(
        rotation[projector], translation[projector], lens[projector], point, pixel, own, slope
    ):
        return np.nan
    for k in range(2):
        g = slope[k]
        facing = dot(g, u)
        for i in range(3):
            by[0, i] = g[i] - facing * by_along[0, i]
            by[1, i] = s * g[i] + facing * by_along[1, i]
            rows[k, SPHERE_SIZE - 4 + i] = facing * by_along[0, i]
        to_sensor(rotation[camera], translation[camera], inner, turn, by, rows[k, :PER_SENSOR])
        rows[k, SPHERE_SIZE - 1] = facing * by_along[2, 0]
        along[k] = facing
    return cosine


@kernel
def sphere_block(
    rotation: Floats,
    translation: Floats,
    lens: Floats,
    pair: tuple[int, int],
    sphere: Floats,
    observed: Floats,
    live: Mask,
    scale: Floats,
    huber: float,
    flattest: float,
    found: Floats,
    normal: Floats,
    gradient: Floats,
) -> float:
    """Add the points of a block to its normal equations; return their cost.

    `observed` (n, 6) holds camera and projector pixels and the sigmas of the latter; `scale` (2,) is the
    estimated over the stated standard deviation of both types. `normal` (2, parameters, parameters), lower
    triangles, and `gradient` (2, parameters) are filled, one for each type, not yet divided by scale^2.
    `found` (n, 4) becomes the whitened residuals of both types, the cosine of incidence and the weight.
    Points that are not live have weight 0; the cost is infinite where a live one has no residual.

    The residual is the way in the projector's image, with x and y in units of their sigmas, that the observed
    pixel would have to go for the rays to meet on the sphere: across the camera ray's image it closes the gap
    epsilon_1, along it it brings the point onto the sphere, epsilon_2.
    """
    rows, along, pixel = np.zeros((2, SPHERE_SIZE)), np.empty(2), np.empty(2)
    turned, room = np.zeros((2, SPHERE_SIZE)), room_of_sphere()
    cost = 0.0
    for i in range(len(observed)):
        cosine = sphere_rows(
            rotation, translation, lens, pair, observed[i, :2], sphere, flattest, pixel, rows, along, room
        )
        found[i, 2], found[i, 3] = cosine, 0.0
        sx, sy = 1.0 / observed[i, 4], 1.0 / observed[i, 5]
        length = np.sqrt((sx * along[0]) ** 2 + (sy * along[1]) ** 2)
        x, y = sx * along[0] / length, sy * along[1] / length
        off_x, off_y = sx * (pixel[0] - observed[i, 2]), sy * (pixel[1] - observed[i, 3])
        first, second = x * off_y - y * off_x, x * off_x + y * off_y
        if not (np.isfinite(cosine) and np.isfinite(first + second)):
            cost = np.inf if live[i] else cost
            found[i, 0] = found[i, 1] = np.nan
            continue
        found[i, 0], found[i, 1] = first, second
        if not live[i]:
            continue
        own, weight = _robust(first, second, scale, huber)
        cost += own
        found[i, 3] = weight
        for k in range(SPHERE_SIZE):
            own_x, own_y = sx * rows[0, k], sy * rows[1, k]
            turned[0, k] = x * own_y - y * own_x
            turned[1, k] = x * own_x + y * own_y
        _add(turned[0], variable(SPHERE_SIZE - 4), weight, first, normal[0], gradient[0])
        _add(turned[1], variable(SPHERE_SIZE), weight, second, normal[1], gradient[1])
    return cost


@inner
@kernel
def project_rows(
    rotation: Floats,
    translation: Floats,
    lens: Floats,
    world: Floats,
    pixel: Floats,
    rows: Floats,
    slope: Floats,
) -> bool:
    """Project a point of the world; fill pixel (2,) and derivatives; say whether it is in front.

    `rows` (2, parameters) are the derivatives by those of the sensor, `slope` (2, 3) those by the point, in
    px/mm in the world.
    """
    tx, ty, tz = dot(rotation[0], world), dot(rotation[1], world), dot(rotation[2], world)
    depth = tz + translation[2]
    if not depth > 0.0:
        return False
    x, y = (tx + translation[0]) / depth, (ty + translation[1]) / depth
    bent = distorted(lens, x, y)
    xx, xy, yx, yy = by_point(lens, x, y)
    by_parameters(lens, x, y, rows[:, PER_POSE + PIN_HOLE : PER_SENSOR])
    for i in range(2):
        f, row = lens[i], rows[i]
        to_x, to_y = (xx, xy) if i == 0 else (yx, yy)
        pixel[i] = f * bent[i] + lens[2 + i]
        row[3], row[4] = f * to_x / depth, f * to_y / depth
        row[5] = -(row[3] * x + row[4] * y)
        row[0] = ty * row[5] - tz * row[4]
        row[1] = tz * row[3] - tx * row[5]
        row[2] = tx * row[4] - ty * row[3]
        row[6], row[7], row[8], row[9] = 0.0, 0.0, 0.0, 0.0
        row[6 + i], row[8 + i] = bent[i], 1.0
        for k in range(PER_POSE + PIN_HOLE, PER_SENSOR):
            row[k] *= f
        for k in range(3):
            slope[i, k] = rotation[0, k] * row[3] + rotation[1, k] * row[4] + rotation[2, k] * row[5]
    return True


@inner
@uncounted_kernel
def wrapped_place(x: float, scale: float, radius: float) -> tuple[float, float, float, float, float, float]:
    """Return where x on a sheet about a cylinder is in space, and how that goes with pitch and radius.

    (x, z) in mm, their derivatives by the scale k of the pitch, and by the radius R: x becomes R sin(k x / R)
    and z R (1 - cos(k x / R)), see `wrapped_sheets`.
    """
    turn = scale * x / radius
    sine, cosine = np.sin(turn), np.cos(turn)
    by_radius = 1.0 - cosine - turn * sine
    return radius * sine, radius * (1.0 - cosine), x * cosine, x * sine, sine - turn * cosine, by_radius


@inner
@kernel
def board_rows(
    rotation: Floats,
    translation: Floats,
    lens: Floats,
    board: Floats,
    point: Floats,
    pixel: Floats,
    rows: Floats,
    slope: Floats,
) -> bool:
    """Project a point of a board; fill pixel (2,) and derivatives; say whether it is in front.

    `board` (3, 6) holds the board's rotation, translation, at [0, 4] the scale of its pitch, at [1, 4] the
    radius about which it is wrapped, 0 for a flat one, and at [:, 5] its shape, of which that of a cylinder
    is what its diameter is more; `point` (6,) its place on the board and its `shape_terms`. `rows` (2,
    parameters) are the derivatives of the pixel by all of them, `slope` (2, 3) those by the point in the
    world.
    """
    place, arm, world, wider = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    height = dot(board[:, 5], point[3:6])
    told = board[1, 4]
    if told != 0.0:
        half = 0.5 if told > 0.0 else -0.5
        x, z, dx, dz, rx, rz = wrapped_place(point[0], board[0, 4], told + half * board[0, 5])
        for i in range(3):
            place[i] = board[i, 0] * dx + board[i, 1] * point[1] + board[i, 2] * dz
            arm[i] = board[i, 0] * x + board[i, 1] * board[0, 4] * point[1] + board[i, 2] * z
            wider[i] = half * (board[i, 0] * rx + board[i, 2] * rz)
            world[i] = arm[i] + board[i, 3]
    else:
        for i in range(3):
            place[i] = board[i, 0] * point[0] + board[i, 1] * point[1] + board[i, 2] * point[2]
            arm[i] = board[0, 4] * place[i] + height * board[i, 2]
            world[i] = arm[i] + board[i, 3]
    if not project_rows(rotation, translation, lens, world, pixel, rows[:, :PER_SENSOR], slope):
        return False
    for i in range(2):
        g = slope[i]
        cross(arm, g, rows[i, PER_SENSOR : PER_SENSOR + 3])
        for k in range(3):
            rows[i, PER_SENSOR + 3 + k] = g[k]
        rows[i, BOARD_SIZE - PER_BOARD] = dot(g, place)
        if told != 0.0:
            rows[i, BOARD_SIZE - PER_BOARD + 1] = dot(g, wider)
            rows[i, BOARD_SIZE - 2], rows[i, BOARD_SIZE - 1] = 0.0, 0.0
            continue
        out = dot(g, board[:, 2])
        for k in range(3):
            rows[i, BOARD_SIZE - PER_BOARD + 1 + k] = out * point[3 + k]
    return True


@kernel
def board_block(
    rotation: Floats,
    translation: Floats,
    lens: Floats,
    board: Floats,
    observed: Floats,
    live: Mask,
    point_sigma: float,
    scale: float,
    huber: float,
    whitening: Floats,
    found: Floats,
    normal: Floats,
    gradient: Floats,
) -> float:
    """Add the points of a board block to its normal equations; return their cost with the whitening given.

    `observed` (n, 9) holds the point on the board, its shape terms, its pixel and sigma; `found` (n, 5)
    becomes the residual (predicted less observed) in px, whitened, and the weight. The variance of a pixel is
    sigma^2 and what `point_sigma`, in mm in each direction, makes of the board's own error. Otherwise as
    `sphere_block`.
    """
    rows, slope, pixel, both = np.empty((2, BOARD_SIZE)), np.empty((2, 3)), np.empty(2), np.empty(2)
    cost = 0.0
    both[0] = both[1] = scale
    for i in range(len(observed)):
        seen = board_rows(rotation, translation, lens, board, observed[i, :6], pixel, rows, slope)
        found[i, 4] = 0.0
        if not (seen and np.isfinite(pixel[0] + pixel[1])):
            cost = np.inf if live[i] else cost
            found[i, 0] = found[i, 1] = found[i, 2] = found[i, 3] = np.nan
            continue
        off_x, off_y = pixel[0] - observed[i, 6], pixel[1] - observed[i, 7]
        if live[i]:
            first = whitening[i, 0] * off_x
            cost += _robust(first, whitening[i, 1] * off_x + whitening[i, 2] * off_y, both, huber)[0]
        own, noise = point_sigma * point_sigma, observed[i, 8] * observed[i, 8]
        xx = noise + own * dot(slope[0], slope[0])
        xy = own * dot(slope[0], slope[1])
        yy = noise + own * dot(slope[1], slope[1])
        a, c = 1.0 / np.sqrt(xx), 1.0 / np.sqrt(yy - xy * xy / xx)
        b = -xy / xx * c
        whitening[i, 0], whitening[i, 1], whitening[i, 2] = a, b, c
        first, second = a * off_x, b * off_x + c * off_y
        found[i, 0], found[i, 1], found[i, 2], found[i, 3] = off_x, off_y, first, second
        if not live[i]:
            continue
        weight = _robust(first, second, both, huber)[1]
        found[i, 4] = weight
        for k in range(BOARD_SIZE):
            rows[1, k] = b * rows[0, k] + c * rows[1, k]
            rows[0, k] *= a
        _add(rows[0], variable(BOARD_SIZE), weight, first, normal, gradient)
        _add(rows[1], variable(BOARD_SIZE), weight, second, normal, gradient)
    return cost
