"""Where spheres of a known radius may be in an organised point cloud: votes of points along their normals."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.compilation import in_row_blocks, inlined, kernel

_HALF = 2  # pixels to each side of a normal's window: a sphere that is 25 px across is round over 5 of them
_LEAST_NEIGHBOURS = 12  # of the 25 of a window: about half
_LEAST_COSINE = 0.3  # of the incidence; beyond some 73 degrees a window of 5 px reaches over the limb
_VOTERS = 300_000  # every second pixel of a megapixel each way; a sphere of 25 px then has about 80
_CELLS_PER_RADIUS = 4.0
_STRONGEST_CELLS = 1000
_FARTHEST_MM = 1e6  # from the camera; keeps the numbers of cells within 64 bits

_NEIGHBOURS = np.array(
    [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)], dtype=np.int64
)


@inlined
def _slopes(points: Floats, region: Mask, row: int, column: int, radius: float, across: Floats) -> bool:
    """Fill the least-squares slopes (2, 3) of a surface along rows and columns at a point, in mm per pixel.

    Points farther away than the radius are another surface. False where too few are left.
    """
    rows, columns = region.shape
    x0, y0, z0 = points[0, row, column], points[1, row, column], points[2, row, column]
    n = si = sj = sii = sij = sjj = 0.0
    s = np.zeros((3, 3))  # sums of 1, i, j times the difference from the middle, by component
    for i in range(max(-_HALF, -row), min(_HALF, rows - 1 - row) + 1):
        for j in range(max(-_HALF, -column), min(_HALF, columns - 1 - column) + 1):
            if not region[row + i, column + j]:
                continue
            dx = points[0, row + i, column + j] - x0
            dy = points[1, row + i, column + j] - y0
            dz = points[2, row + i, column + j] - z0
            # NaN fails this comparison too.
            if not dx * dx + dy * dy + dz * dz < radius * radius:
                continue
            n += 1.0
            si += i
            sj += j
            sii += i * i
            sij += i * j
            sjj += j * j
            s[0, 0] += dx
            s[0, 1] += dy
            s[0, 2] += dz
            s[1, 0] += i * dx
            s[1, 1] += i * dy
            s[1, 2] += i * dz
            s[2, 0] += j * dx
            s[2, 1] += j * dy
            s[2, 2] += j * dz
    if n < _LEAST_NEIGHBOURS:
        return False
    a, b, c = sii - si * si / n, sij - si * sj / n, sjj - sj * sj / n
    determinant = a * c - b * b
    if determinant <= 0.0:
        return False
    for k in range(3):
        p, q = s[1, k] - si * s[0, k] / n, s[2, k] - sj * s[0, k] / n
        across[0, k] = (c * p - b * q) / determinant
        across[1, k] = (a * q - b * p) / determinant
    return True


@kernel
def _vote(
    points: Floats,
    region: Mask,
    camera: Floats,
    radius: float,
    step: int,
    votes: Floats,
    start: int,
    stop: int,
) -> None:
    """Fill rows start .. stop of the votes (rows, columns, 3) of every `step`-th pixel; NaN for none."""
    across = np.empty((2, 3))
    for vr in range(start, stop):
        row = vr * step
        for vc in range(votes.shape[1]):
            column = vc * step
            votes[vr, vc, 0] = np.nan
            x0, y0, z0 = points[0, row, column], points[1, row, column], points[2, row, column]
            if not region[row, column] or not np.isfinite(x0 + y0 + z0):
                continue
            if not _slopes(points, region, row, column, radius, across):
                continue
            nx = across[0, 1] * across[1, 2] - across[0, 2] * across[1, 1]
            ny = across[0, 2] * across[1, 0] - across[0, 0] * across[1, 2]
            nz = across[0, 0] * across[1, 1] - across[0, 1] * across[1, 0]
            tx, ty, tz = camera[0] - x0, camera[1] - y0, camera[2] - z0
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            distance = np.sqrt(tx * tx + ty * ty + tz * tz)
            towards = nx * tx + ny * ty + nz * tz
            if not abs(towards) > _LEAST_COSINE * length * distance or distance > _FARTHEST_MM:
                continue
            # The normal points to the camera, the centre lies behind the surface.
            inwards = -radius / length if towards > 0.0 else radius / length
            votes[vr, vc, 0] = x0 + inwards * nx
            votes[vr, vc, 1] = y0 + inwards * ny
            votes[vr, vc, 2] = z0 + inwards * nz


@dataclass(frozen=True)
class Peak:
    """A place that many points take for the centre of a sphere.

    Attributes
    ----------
    centre
        (3,) mean of their votes, in mm.
    votes
        How many there are.
    rows, columns
        Half-open ranges of the image that hold the voters.
    """

    centre: Floats
    votes: int
    rows: tuple[int, int]
    columns: tuple[int, int]


def sphere_peaks(
    points: Floats,
    region: Mask,
    camera_centre: Floats,
    radius_mm: float,
    limit: int,
    threads: int = 1,
) -> list[Peak]:
    """Find where many points of a cloud see the centre of a sphere of known radius.

    Parameters
    ----------
    points
        (3, rows, columns) in mm; NaN where nothing was measured.
    region
        (rows, columns): which pixels to look at.
    camera_centre
        (3,) in mm.
    radius_mm
        Of the spheres.
    limit
        Most peaks to return.
    threads
        Results do not depend on it.

    Returns
    -------
    The strongest first; no two are nearer to each other than the radius.

    Notes
    -----
    Hough transform: each of at most about 300,000 points, on a regular grid of pixels, votes for
    P - R n, where the normal n, towards the camera, comes from the least-squares slopes over 5 x 5 pixels.
    Votes are counted in cells of R / 4; a peak is a cell with its 26 neighbours. A plane's votes stay
    spread over a plane, a cylinder's over a line or a cylinder.
    """
    step = max(1, ceil(sqrt(int(np.count_nonzero(region)) / _VOTERS)))
    shape = tuple(-(-size // step) for size in region.shape)
    votes = np.empty((*shape, 3))
    in_row_blocks(
        lambda start, stop: _vote(points, region, camera_centre, radius_mm, step, votes, start, stop),
        shape[0],
        threads,
    )
    voters = np.flatnonzero(np.isfinite(votes[..., 0]))
    if not voters.size:
        return []
    cast = votes.reshape(-1, 3)[voters]
    low = cast.min(axis=0)
    cell = np.floor((cast - low) / (radius_mm / _CELLS_PER_RADIUS)).astype(np.int64) + 1
    size = cell.max(axis=0) + 2  # an empty border on every side, so that neighbours do not wrap around
    strides = np.array([size[1] * size[2], size[2], 1])
    keys = cell @ strides
    order = np.argsort(keys, kind="stable")
    filled, begins, counts = np.unique(keys[order], return_index=True, return_counts=True)
    ends = begins + counts

    strongest = np.argsort(-counts, kind="stable")[:_STRONGEST_CELLS]
    neighbour_keys = filled[strongest][:, None] + _NEIGHBOURS @ strides
    at = np.minimum(np.searchsorted(filled, neighbour_keys), filled.size - 1)
    there = filled[at] == neighbour_keys
    scores = np.where(there, counts[at], 0).sum(axis=1)

    peaks: list[Peak] = []
    for best in np.argsort(-scores, kind="stable"):
        members = np.concatenate([order[begins[i] : ends[i]] for i in at[best][there[best]]])
        centre = cast[members].mean(axis=0)
        if any(np.linalg.norm(centre - peak.centre) < radius_mm for peak in peaks):
            continue
        row, column = np.divmod(voters[members], shape[1])
        peaks.append(
            Peak(
                centre,
                members.size,
                (int(row.min()) * step, int(row.max()) * step + 1),
                (int(column.min()) * step, int(column.max()) * step + 1),
            )
        )
        if len(peaks) == limit:
            break
    return peaks
