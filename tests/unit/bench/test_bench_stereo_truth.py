"""What goes wrong before two cameras: each mishap changes what they see, and what comes of it is counted."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sms_jobs.bench.two_cameras.mishaps import (
    LATER,
    Images,
    Seen,
    known_to,
    measured,
    mishaps,
    shifted,
    specimen_seen,
    total_z,
)
from sms_jobs.virtual_rig.stereo_campaigns import curved


@cache
def seen() -> Seen:
    return specimen_seen(curved, 240, 5, 1)


@cache
def every() -> dict[str, Images]:
    found = list(mishaps(seen(), np.random.default_rng(5)))
    assert len({name for name, _ in found}) == len(found)
    return dict(found)


def test_each_mishap_changes_some_image_and_no_size() -> None:
    for name, images in every().items():
        assert images.keys() == seen().light.keys()
        changed = [key for key, one in images.items() if not np.array_equal(one, seen().light[key])]
        assert bool(changed) == (name != "nothing"), name
        for (state, camera), one in images.items():
            assert one.shape == seen().shape, name
            assert np.isfinite(one).all(), name
            if (state, camera) in changed:
                assert state == LATER or "later" not in name, name
                assert camera == "C2" or "partner" not in name, name


def test_an_image_is_shifted_as_its_name_says() -> None:
    image = seen().light["S00", "C1"]
    moved = shifted(image, 3.0, -2.0)
    np.testing.assert_allclose(moved[20:-20, 20:-20], image[18:-22, 23:-17], atol=1e-6)


def test_where_nothing_goes_wrong_no_point_is_silently_wrong() -> None:
    outcome = measured(seen(), seen().light, np.random.default_rng(6))
    assert outcome.refused == ""
    assert outcome.displacement is not None
    for errors in (*outcome.shapes, outcome.displacement):
        assert errors.outliers == 0
        assert errors.valid_part > 0.7


def test_what_is_refused_is_no_error() -> None:
    outcome = measured(seen(), every()["partner knocked later across rays, 2 px"], np.random.default_rng(6))
    assert "beside the images of their rays" in outcome.refused
    assert outcome.displacement is None
    assert len(outcome.shapes) == 1


@pytest.mark.parametrize("knock", [0.1, 0.4])
def test_a_camera_that_moves_is_stated(knock: float) -> None:
    images = {**seen().light, (LATER, "C2"): shifted(seen().light[LATER, "C2"], knock, knock)}
    z = total_z(seen(), measured(seen(), images, np.random.default_rng(6), known_to(0.02)))
    # Of one axis the other's is taken: as much here; by a median of what is the same everywhere 1.5 times.
    assert 0.4 < float(np.sqrt(np.mean(z**2))) < 1.3
