"""Pairs are averaged by what they know, and views joined without doubling."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.deformation.joining.merging import (
    combine_labels,
    correlation_of_pairs,
    join_meshes,
    merge_by_variance,
)
from sms_jobs.metrology.surfaces.meshing import triangulate_image


def packed(variance: float, shape: tuple[int, int]) -> np.ndarray:
    covariance = np.zeros((6, *shape))
    covariance[[0, 3, 5]] = variance
    return covariance


def test_equal_variances_give_the_mean_of_the_thesis(rng: np.random.Generator) -> None:
    fields = rng.normal(size=(3, 3, 4, 5))
    merged = merge_by_variance(list(fields), [packed(0.2, (4, 5))] * 3)
    # Thesis Eq. (4.1); rounding only.
    np.testing.assert_allclose(merged.value, fields.mean(axis=0), atol=1e-14)
    np.testing.assert_allclose(merged.covariance[0], 0.2 / 3.0, rtol=1e-12)
    assert (merged.contributors == 3).all()


def test_the_weighted_mean_scatters_as_predicted_and_least(rng: np.random.Generator) -> None:
    sigma = np.array([0.1, 0.3])
    errors = sigma[:, None, None, None] * rng.normal(size=(2, 3, 100, 100))
    merged = merge_by_variance(list(errors), [packed(s * s, (100, 100)) for s in sigma])
    best = 1.0 / np.sum(1.0 / sigma**2)
    assert merged.covariance[0, 0, 0] == pytest.approx(best, rel=1e-12)
    # 30,000 deviates: sqrt(2 / 30000) = 0.8 %, four of those.
    assert merged.value.var() == pytest.approx(best, rel=0.035)
    expected = np.sqrt(3.0 * np.sum(sigma**2))
    assert merged.discrepancy_rms == pytest.approx(expected, rel=0.02)


def sharing(rng: np.random.Generator, own: tuple[float, ...], shared: float) -> list[np.ndarray]:
    """Return errors of pairs (3, 100, 100): one of each pair's own, and one that all have."""
    together = shared * rng.normal(size=(3, 100, 100))
    return [together + sigma * rng.normal(size=(3, 100, 100)) for sigma in own]


def test_what_pairs_share_is_told_by_how_little_they_differ(rng: np.random.Generator) -> None:
    errors = sharing(rng, (0.1, 0.2, 0.3), 0.2)
    variance = np.array([0.1, 0.2, 0.3]) ** 2 + 0.2**2
    found = correlation_of_pairs(errors, [packed(v, (100, 100)) for v in variance])
    expected = 0.2**2 / np.sqrt(np.outer(variance, variance))
    np.fill_diagonal(expected, 1.0)
    # The mean square of 30,000 differences is known to sqrt(2 / 30000) = 0.8 %; it is at most 2.2 times
    # 2 sqrt(v_a v_b) here, so rho to 0.02 at two sigma.
    np.testing.assert_allclose(found, expected, atol=0.025)


def test_the_mean_of_pairs_that_share_errors_scatters_as_predicted(rng: np.random.Generator) -> None:
    errors = sharing(rng, (0.1, 0.2), 0.2)
    covariances = [packed(s * s + 0.2**2, (100, 100)) for s in (0.1, 0.2)]
    merged = merge_by_variance(errors, covariances, correlation_of_pairs(errors, covariances))
    # The observed variance is known to 0.8 %, the predicted one to 0.02 of rho, 1.6 %; three of both.
    assert merged.covariance[0, 0, 0] == pytest.approx(merged.value.var(), rel=0.06)
    # Taken for independent, the pairs would promise too much by a third.
    assert merge_by_variance(errors, covariances).covariance[0, 0, 0] < 0.7 * merged.value.var()


def test_the_covariance_of_related_errors_is_that_of_their_mean(rng: np.random.Generator) -> None:
    spread = packed(0.3, (4, 5))
    spread[1] = 0.1
    fields = list(rng.normal(size=(2, 3, 4, 5)))
    for rho, expected in ((0.0, 0.5), (0.4, 0.7), (1.0, 1.0)):
        # Var of (a + b) / 2 is (1 + rho) / 2 of either; rounding only.
        merged = merge_by_variance(fields, [spread, spread], np.array([[1.0, rho], [rho, 1.0]]))
        np.testing.assert_allclose(merged.covariance, expected * spread, atol=1e-15)


def test_independent_opposed_and_unmet_pairs_count_as_independent(rng: np.random.Generator) -> None:
    errors = list(rng.normal(size=(2, 3, 100, 100)))
    covariances = [packed(1.0, (100, 100))] * 2
    # As above: the mean square of the differences is known to 0.8 % of 2 v.
    assert correlation_of_pairs(errors, covariances)[0, 1] < 0.025
    assert correlation_of_pairs([errors[0], -errors[0]], covariances)[0, 1] == 0.0
    apart = [errors[0].copy(), errors[0].copy()]
    apart[0][:, :, :50] = apart[1][:, :, 50:] = np.nan
    assert correlation_of_pairs(apart, covariances)[0, 1] == 0.0
    # A patch where one pair sees another surface tells nothing of the noise.
    astray = [errors[0], errors[0].copy()]
    astray[1][:, :20] += 100.0
    assert correlation_of_pairs(astray, covariances)[0, 1] == pytest.approx(1.0)


def test_a_pixel_takes_what_there_is() -> None:
    a, b = np.full((3, 2, 2), 1.0), np.full((3, 2, 2), 3.0)
    a[:, 0, 0] = np.nan
    a[:, 1, 1] = b[:, 1, 1] = np.nan
    merged = merge_by_variance([a, b], [packed(1.0, (2, 2)), packed(1.0, (2, 2))])
    np.testing.assert_array_equal(merged.contributors, [[1, 2], [2, 0]])
    np.testing.assert_array_equal(merged.value[0], [[3.0, 2.0], [2.0, np.nan]])
    np.testing.assert_array_equal(merged.covariance[0], [[1.0, 0.5], [0.5, np.nan]])
    assert np.isnan(merge_by_variance([a], [packed(1.0, (2, 2))]).discrepancy_rms)


def test_later_labels_continue_the_first() -> None:
    first = np.array([[1, 1, 0, 0, 2, 2, 0, 0]], np.int32)
    later = np.array([[0, 2, 2, 0, 1, 1, 1, 3]], np.int32)
    np.testing.assert_array_equal(combine_labels([first, later]), [[1, 1, 1, 0, 2, 2, 2, 3]])
    np.testing.assert_array_equal(combine_labels([first]), first)
    np.testing.assert_array_equal(combine_labels([np.zeros_like(first), later]), later)


def plate(x0: float, columns: int) -> tuple[np.ndarray, np.ndarray]:
    pixels, faces = triangulate_image(np.ones((21, columns), np.int32))
    vertices = np.stack([x0 + pixels[:, 1], -pixels[:, 0], np.zeros(len(pixels))], axis=1).astype(np.float64)
    return vertices, faces


def area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def test_overlapping_views_are_not_doubled() -> None:
    # Two views of a plate of 50 x 20 mm overlap by a fifth, half a pixel out of step.
    views = [plate(0.0, 31), plate(20.5, 31)]
    vertices, faces, camera, vertex = join_meshes(views)
    assert area(*views[0]) + area(*views[1]) == pytest.approx(1200.0)
    # What is left over of the overlap is the seam: about a pixel along 20 mm.
    assert 1010.0 - 20.0 < area(vertices, faces) < 1010.0 + 30.0
    for k, (own, _) in enumerate(views):
        np.testing.assert_array_equal(vertices[camera == k], own[vertex[camera == k]])


def test_views_apart_are_kept_and_empty_ones_do_no_harm() -> None:
    empty = (np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    vertices, faces, camera, _ = join_meshes([empty, plate(0.0, 5), empty, plate(100.0, 5)])
    assert len(faces) == 2 * len(plate(0.0, 5)[1])
    assert set(camera) == {1, 3}
    assert faces.max() == len(vertices) - 1
    assert len(join_meshes([empty])[1]) == 0


def test_pairs_disagree_where_they_do(rng: np.random.Generator) -> None:
    shape = (3, 6, 7)
    values = [rng.normal(size=shape) for _ in range(3)]
    values[2][:, :3] = np.nan
    values[1][:, :, :2] = np.nan
    spread = np.zeros((6, 6, 7))
    spread[[0, 3, 5]] = 1.0
    found = merge_by_variance(values, [spread] * 3)
    # One pair alone disagrees with nobody; two or three by the rms of their one or three distances.
    assert np.isnan(found.discrepancy[:3, :2]).all()
    np.testing.assert_allclose(
        found.discrepancy[:3, 2:], np.linalg.norm(values[0] - values[1], axis=0)[:3, 2:], rtol=1e-12
    )
    three = [np.sum((values[a] - values[b]) ** 2, axis=0) for a, b in ((0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(found.discrepancy[3:, 2:], np.sqrt(np.mean(three, axis=0))[3:, 2:], rtol=1e-12)
    count = np.where(found.contributors == 3, 3, np.where(found.contributors == 2, 1, 0))
    total = np.nansum(found.discrepancy**2 * count) / count.sum()
    assert found.discrepancy_rms == pytest.approx(np.sqrt(total), rel=1e-12)
