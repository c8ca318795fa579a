"""Pictures are PNG, show what they are told to, and do not depend on anything but the record."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.figures import Map, draw_map, plot_record, plottable, reduced, robust_limits
from sms_jobs.records.fields import DisplacementField, ImageMatches, Mesh, PhaseMaps, Surface
from sms_jobs.records.measurement import ArrayStack, Measurement
from sms_jobs.records.reasons import Reason


def pixels(png: bytes) -> NDArray[np.float32]:
    image: NDArray[np.float32] = imread(io.BytesIO(png))
    return image


@pytest.fixture
def cloud(rng: np.random.Generator) -> Surface:
    y, x = np.mgrid[0:60, 0:80]
    xyz = np.stack([x, y, 0.01 * x**2]).astype(float)
    reason = np.zeros((60, 80), np.uint32)
    reason[:20, :20] = Reason.LOW_MODULATION | Reason.SATURATED
    xyz[:, :20, :20] = np.nan
    return Surface(
        "C1P1",
        "mm",
        xyz,
        reason,
        np.ones((6, 60, 80), np.float32),
        rng.random((60, 80), np.float32),
        sigma_calibration=np.ones((3, 60, 80), np.float32),
        texture_part=rng.random((60, 80), np.float32),
        own_noise=rng.normal(size=(2, 60, 80)).astype(np.float32),
        noise_part=rng.random((60, 80), np.float32),
    )


def test_every_field_of_a_record_can_be_drawn(cloud: Surface) -> None:
    assert plottable(Surface) == (
        "position",
        "reason",
        "covariance",
        "ray_gap",
        "sigma_calibration",
        "texture_part",
        "own_noise",
        "noise_part",
    )
    for field in plottable(Surface):
        assert pixels(plot_record(cloud, field)).shape[1] == 900


def test_a_picture_depends_on_field_and_component(cloud: Surface) -> None:
    z = plot_record(cloud)
    assert z == plot_record(cloud, "position", "Z")
    assert z != plot_record(cloud, "position", "X")
    assert plot_record(cloud, "position", "magnitude") not in (z, plot_record(cloud, "position", "X"))


def test_a_displacement_is_drawn_by_its_magnitude(rng: np.random.Generator) -> None:
    vector = rng.normal(size=(3, 20, 30))
    covariance = np.ones((6, 20, 30), np.float32)
    reason = np.zeros((20, 30), np.uint32)
    field = DisplacementField("C1P1", "S00", "mm", vector, covariance, vector[:2], reason)
    assert plot_record(field) == plot_record(field, "displacement", "magnitude")
    assert plot_record(field) != plot_record(field, "displacement", "Z")


def test_missing_values_are_grey(cloud: Surface) -> None:
    image = pixels(plot_record(cloud))
    grey = np.isclose(image[..., :3], 0.75, atol=1 / 255).all(axis=-1)
    # A twelfth of the image is missing; the image takes about half of the picture. Grey is in no other place.
    assert 0.02 < grey.mean() < 1 / 12


def test_points_and_meshes_and_frames_can_be_drawn(rng: np.random.Generator) -> None:
    n = 40
    single, integer = rng.random(n, np.float32), np.ones(n, np.int32)
    double = rng.random(n)
    double[3] = np.nan
    matches = ImageMatches(
        rng.random(n), rng.random(n), integer, double, double, rng.random((4, n)), single, single, single,
        integer, integer.astype(np.uint32),
    )  # fmt: skip
    assert plot_record(matches) != plot_record(matches, "gradient", "dv/dy")
    mesh = Mesh(
        ("u", "v"), ("mm", "mm"), rng.random((n, 3)), np.array([[0, 1, 2]], np.int32), rng.random((2, n))
    )
    assert plot_record(mesh, "values", "v") != plot_record(mesh, "values", "u")
    assert plottable(Measurement) == ("texture", "frames", "dimming")


def test_one_frame_of_a_measurement(rng: np.random.Generator) -> None:
    from datetime import UTC, datetime

    from sms_jobs.records.measurement import FringeSequence

    frames = ArrayStack(rng.integers(0, 4096, (3, 20, 30), dtype=np.uint16))
    record = Measurement(
        datetime(2026, 1, 1, tzinfo=UTC), FringeSequence(), 4095, 0.1, 2.0, frames.frames[0], frames
    )
    assert plot_record(record, "frames", "2") != plot_record(record, "frames", "1")


@pytest.mark.parametrize(
    ("field", "component", "complaint"),
    [
        ("colour", None, "no field 'colour' to draw; choose one of position, reason"),
        ("position", "T", "no component 'T'; choose one of X, Y, Z, magnitude"),
        ("ray_gap", "X", "has no components"),
    ],
)
def test_what_cannot_be_drawn_is_named(
    cloud: Surface, field: str, component: str | None, complaint: str
) -> None:
    with pytest.raises(InvalidInput, match=complaint):
        plot_record(cloud, field, component)


def test_reducing_keeps_the_mean_of_what_is_there(rng: np.random.Generator) -> None:
    values = rng.normal(size=(50, 70))
    values[:, 35:] = np.nan
    values[7, 7] = np.nan
    small = reduced(values, 10)
    assert small.shape == (8, 10)
    for row, column in ((0, 0), (1, 1), (7, 4)):
        block = values[row * 7 : row * 7 + 7, column * 7 : column * 7 + 7]
        # Blocks are kept in single precision: 24 bits of values up to about 4.
        np.testing.assert_allclose(small[row, column], np.nanmean(block), atol=4 * 2.0**-24)
    assert np.isnan(small[:, 5:]).all()
    assert reduced(values, 70) is values


def test_reducing_labels_makes_no_new_ones(rng: np.random.Generator) -> None:
    labels = rng.integers(0, 3, (50, 70)).astype(np.int32) * 50
    assert set(np.unique(reduced(labels, 10))) <= {0, 50, 100}


def test_colours_span_the_bulk_of_the_values(rng: np.random.Generator) -> None:
    values = rng.normal(size=(100, 100))
    values[0, :5] = 1e6
    values[1, :] = np.nan
    low, high = robust_limits(values)
    # The 1st and 99th percentile of a normal distribution are at 2.33; with 10^4 samples within 0.1 of it.
    assert low == pytest.approx(-2.33, abs=0.15)
    assert high == pytest.approx(2.33, abs=0.15)
    assert robust_limits(np.full((2, 2), np.nan)) == (0.0, 1.0)
    low, high = robust_limits(np.full((2, 2), 5.0))
    assert low < 5.0 < high


def test_an_empty_map_and_one_with_borders_can_be_drawn() -> None:
    empty = np.full((30, 40), np.nan)
    labels = np.zeros((30, 40), np.int32)
    labels[5:20, 5:30] = 1
    bare = draw_map(Map(empty, (300, 400), "nothing", "mm"))
    outlined = draw_map(Map(empty, (300, 400), "nothing", "mm", labels))
    # The border is the only thing in the picture that is redder than blue.
    redness = [np.max(pixels(p)[..., 0] - pixels(p)[..., 2]) for p in (bare, outlined)]
    assert redness[1] > 0.4


def test_phase_maps_are_chosen_by_number(rng: np.random.Generator) -> None:
    image = rng.random((2, 20, 30))
    single = image.astype(np.float32)
    maps = PhaseMaps((0.0, 1.57), image, single, single, single, single[0])
    assert plot_record(maps, "omega", "1") != plot_record(maps, "omega", "0")
