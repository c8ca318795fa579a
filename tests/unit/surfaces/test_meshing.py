"""Meshing: every face turned to the camera, no overlap, no bridge."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.surfaces.meshing import triangulate_image

Labels = NDArray[np.int32]


def doubled_areas(vertices: NDArray[np.int32], faces: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return twice the signed areas in the image with y up: positive is counter-clockwise to the eye."""
    x, y = vertices[:, 1].astype(np.int64), -vertices[:, 0].astype(np.int64)
    a, b, c = faces.T
    return (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])


def test_a_full_image_is_covered_once() -> None:
    vertices, faces = triangulate_image(np.ones((7, 9), np.int32))
    assert len(vertices) == 63
    assert len(faces) == 2 * 6 * 8
    areas = doubled_areas(vertices, faces)
    assert (areas == 1).all()
    assert areas.sum() == 2 * 6 * 8


@pytest.mark.parametrize("missing", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_square_that_lacks_a_corner_is_one_triangle(missing: tuple[int, int]) -> None:
    labels = np.ones((2, 2), np.int32)
    labels[missing] = 0
    vertices, faces = triangulate_image(labels)
    assert len(faces) == 1
    assert doubled_areas(vertices, faces)[0] == 1
    assert [*missing] not in vertices.tolist()


def test_regions_are_not_joined(rng: np.random.Generator) -> None:
    labels = rng.integers(0, 3, size=(40, 50)).astype(np.int32)
    vertices, faces = triangulate_image(labels)
    of_vertex = labels[vertices[:, 0], vertices[:, 1]]
    assert (of_vertex > 0).all()
    corners = of_vertex[faces]
    assert (corners == corners[:, :1]).all()
    assert (doubled_areas(vertices, faces) == 1).all()
    # Each square of pixels holds at most two triangles, and two only if they do not overlap: no face twice.
    assert len(np.unique(np.sort(faces, axis=1), axis=0)) == len(faces)
    assert set(np.unique(faces)) == set(range(len(vertices)))


def test_no_edge_has_more_than_two_faces(rng: np.random.Generator) -> None:
    _, faces = triangulate_image((rng.random((30, 30)) > 0.3).astype(np.int32))
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() <= 2


def test_a_coarser_mesh_takes_every_nth_pixel() -> None:
    vertices, faces = triangulate_image(np.ones((10, 13), np.int32), step=3)
    assert (vertices % 3 == 0).all()
    assert doubled_areas(vertices, faces).sum() == 2 * 9 * 12


def test_nothing_to_mesh_gives_nothing() -> None:
    vertices, faces = triangulate_image(np.zeros((5, 5), np.int32))
    assert vertices.shape == (0, 2)
    assert faces.shape == (0, 3)


def test_a_step_of_nothing_is_refused() -> None:
    with pytest.raises(InvalidInput, match="at least 1 pixel"):
        triangulate_image(np.ones((3, 3), np.int32), step=0)
