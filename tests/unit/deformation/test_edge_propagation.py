"""What an edge does to the noise of slopes: its propagation against impulses sent through the filters."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.deformation.fields.averaging import average_in_region
from sms_jobs.metrology.deformation.fields.displacement import ImagePoints, blend_matches
from sms_jobs.metrology.deformation.strain.edge_propagation import EdgeFactors, edge_factors

Floats = np.ndarray
DISC = 6.0


def through_planes(rows: int, columns: int, rim: int, radius: float) -> Floats:
    """Return what averages make of an impulse at each pixel, (pixels, rows, columns)."""
    labels = np.ones((rows, columns), np.int32)
    used = np.broadcast_to(np.arange(columns) >= rim, labels.shape)
    covariance = np.zeros((6, rows, columns))
    covariance[[0, 3, 5]] = 1.0  # so much that an impulse is no outlier
    impulses = np.eye(rows * columns).reshape(-1, rows, columns)
    impulses = np.concatenate([impulses, np.zeros((-len(impulses) % 3, rows, columns))]).reshape(
        -1, 3, rows, columns
    )
    found = [average_in_region(one, covariance, labels, used, radius)[0] for one in impulses]
    return np.concatenate(found)[: rows * columns]


def through_matches(rows: int, columns: int, rim: int, radius: int) -> Floats:
    """Return what subsets of first order at every pixel, blended, make of an impulse at each."""
    labels = np.ones((rows, columns), np.int32)
    row, column = np.mgrid[0:rows, 0:columns]
    xyz = np.stack([column, -row, 0 * row]).astype(np.float64)
    y, x = (place.ravel() for place in np.mgrid[0:rows, rim:columns])
    fits, sigma = [], []
    for at_row, at_column in zip(y, x, strict=True):
        near = (np.abs(row - at_row) <= radius) & (np.abs(column - at_column) <= radius) & (column >= rim)
        design = np.stack([np.ones(near.sum()), column[near] - at_column, row[near] - at_row], axis=1)
        inverse = np.linalg.inv(design.T @ design)
        fit = np.zeros((3, rows, columns))
        fit[:, near] = inverse @ design.T
        fits.append(fit.reshape(3, -1))
        sigma.append([np.sqrt(inverse[0, 0])] * 2)
    by_pixel = np.moveaxis(np.array(fits), 2, 0)  # (pixels, matches, 3)
    if len(by_pixel) % 2:
        by_pixel = np.concatenate([by_pixel, 0.0 * by_pixel[:1]])
    pairs = np.concatenate([by_pixel[0::2], by_pixel[1::2]], axis=2)
    region = np.ones(len(x), np.int32)
    deviations = np.array(sigma)
    found = [
        blend_matches(ImagePoints(x, y, region, warp, deviations), xyz, labels, radius).value
        for warp in pairs
    ]
    return np.concatenate(found)[: rows * columns]


def seen_by_discs(impulses: Floats, distance: Floats) -> tuple[Floats, Floats]:
    """Return the variances of slopes across and along the edge over that of white noise."""
    rows, columns = impulses.shape[1:]
    row, column = np.mgrid[0:rows, 0:columns].astype(np.float64)
    row -= rows // 2
    across, along = [], []
    for place in distance:
        disc = row**2 + (column - place) ** 2 <= DISC**2
        for found, off in ((across, column[disc] - column[disc].mean()), (along, row[disc])):
            found.append(np.sum((impulses[:, disc] @ off) ** 2) / np.sum(off**2))
    return np.array(across), np.array(along)


def compare(found: EdgeFactors, impulses: Floats) -> None:
    """The last place has nothing of the edge. Cells are pixels here, so that both are the same sums."""
    across, along = seen_by_discs(impulses, found.distance)
    np.testing.assert_allclose(found.across, across / across[-1], rtol=1e-6)
    np.testing.assert_allclose(found.along, along / along[-1], rtol=1e-6)


@pytest.mark.parametrize("rim", [0, 1])
def test_averages_beside_an_edge(rim: int) -> None:
    """About the last place a disc, an average and a doubled one fit into the image."""
    radius = 3.0
    found = edge_factors("shape", radius, rim, DISC)
    deep, half = int(found.distance[-1] + DISC + 2 * radius) + 1, int(DISC + 2 * radius) + 1
    compare(found, through_planes(2 * half + 1, deep, rim, radius))


@pytest.mark.parametrize("rim", [0, 2])
def test_matches_beside_an_edge(rim: int) -> None:
    radius = 2
    found = edge_factors("match", radius, rim, DISC)
    reach = int(DISC + 2.7 * radius) + 1
    impulses = through_matches(2 * reach + 1, int(found.distance[-1]) + reach + 1, rim, radius)
    compare(found, impulses)


def test_without_a_rim_little_changes_for_discs_that_are_larger_than_subsets() -> None:
    """To a disc of ten radii filtered noise is white but in its own outermost tenth.

    Half of that is within reach of the edge: 5 %.
    """
    found = edge_factors("match", 5.0, 0.0, 50.0)
    np.testing.assert_allclose(found.across, 1.0, atol=0.05)
    np.testing.assert_allclose(found.along, 1.0, atol=0.05)


def test_factors_depend_on_ratios_alone() -> None:
    """Cells are larger than a pixel both times, and as many.

    A subset has half a pixel more than its radius: a percent of 60 px, so that variances of slopes, which go
    with the fourth power, change by 4 %. Places are told by cells of 7 and 14 px.
    """
    small, large = edge_factors("match", 60.0, 20.0, 200.0), edge_factors("match", 120.0, 40.0, 400.0)
    np.testing.assert_allclose(large.across, small.across, rtol=0.05)
    np.testing.assert_allclose(large.distance, 2.0 * small.distance, atol=8.0)
