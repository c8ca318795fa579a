"""A region is parted where its points have come to different regions, and nowhere else."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.deformation.cracks.splitting import cut_out, split_regions


def grid(rows: int, columns: int, step: int) -> tuple[np.ndarray, np.ndarray]:
    y, x = (v.ravel().astype(np.int64) for v in np.mgrid[2:rows:step, 2:columns:step])
    return x, y


def test_a_crack_parts_a_region_along_it() -> None:
    """Left of x + y / 2 = 50 nothing moves, right of it by 6 px; the crack is seen in between."""
    labels = np.zeros((40, 90), np.int32)
    labels[:, :80] = 1
    row, column = np.mgrid[0:40, 0:90]
    truth = np.where(column + row / 2 < 50, 1, 2)
    ends = np.where(column + row / 2 < 50, 3, 0) + np.where(column - 6 + row / 2 >= 50, 1, 0)
    ends[:, 86:] = 0
    x, y = grid(40, 80, 4)
    warp = np.zeros((len(x), 6))
    warp[:, 0] = np.where(truth[y, x] == 2, 6.0, 0.0)
    split = split_regions(labels, ends.astype(np.int32), x, y, warp)
    assert list(split.pieces) == [1]
    assert len(split.pieces[1]) == 2
    larger, smaller = split.pieces[1]
    assert larger == 1
    assert smaller == 2
    inside = labels > 0
    assert ((split.labels > 0) == inside).all()
    left = split.labels[5, 5]
    wrong = inside & ((split.labels == left) != (truth == 1))
    # A pixel may lie nearer to a point of the other side: up to half of a diagonal of 4 px.
    assert np.abs(column + row / 2 - 50)[wrong].max() / np.hypot(1.0, 0.5) < 2.9
    assert wrong.sum() < 40


def test_what_stays_together_stays_one(rng: np.random.Generator) -> None:
    labels = np.ones((40, 40), np.int32)
    labels[:, 20:] = 2
    # Other numbers in the other state, a few pixels that touch a neighbour's region, and a hole.
    ends = np.where(labels == 1, 2, 1).astype(np.int32)
    ends[:, 20] = 2
    ends[10:14, 5:9] = 0
    x, y = grid(40, 40, 3)
    split = split_regions(labels, ends, x, y, rng.normal(0.0, 0.01, (len(x), 6)))
    assert split.pieces == {}
    np.testing.assert_array_equal(split.labels, labels)


def test_nothing_matched_parts_nothing() -> None:
    labels = np.ones((10, 10), np.int32)
    none = np.zeros(0, np.int64)
    split = split_regions(labels, labels, none, none, np.zeros((0, 6)))
    assert split.pieces == {}


def test_what_the_images_disagree_on_is_cut_out() -> None:
    labels = np.zeros((60, 80), np.int32)
    labels[5:55, 5:75] = 1
    crack = np.zeros(labels.shape, bool)
    crack[:, 48:50] = True
    crack[20, 20] = True  # chance
    found = cut_out(labels, crack, 100)
    assert found is not None
    assert set(np.unique(found)) == {0, 1, 2}
    # The larger piece keeps its number; a single pixel is no cluster and stays.
    assert (found[5:55, 5:48] == 1).all()
    assert (found[5:55, 50:75] == 2).all()
    assert (found[:, 48:50] == 0).all()
    assert cut_out(labels, np.zeros_like(crack), 100) is None


def test_a_crack_that_ends_within_a_region_leaves_it_one() -> None:
    labels = np.ones((60, 80), np.int32)
    crack = np.zeros(labels.shape, bool)
    crack[:40, 48:50] = True
    found = cut_out(labels, crack, 100)
    assert found is not None
    np.testing.assert_array_equal(found, np.where(crack, 0, 1))


def test_small_pieces_are_dropped() -> None:
    labels = np.ones((60, 80), np.int32)
    ring = np.zeros(labels.shape, bool)
    ring[20:31, 20:31] = True
    ring[22:29, 22:29] = False
    found = cut_out(labels, ring, 100)
    assert found is not None
    assert (found[20:31, 20:31] == 0).all()
    assert (found > 0).sum() == 60 * 80 - 121
