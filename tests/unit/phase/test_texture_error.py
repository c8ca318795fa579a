"""The texture's error: predicted by the modulation's gradient, measured by the ray gaps it opens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.bench.fringes.bent_waveforms import scores
from sms_jobs.bench.fringes.fringe_textures import TexturedPlate, record
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.kinds.surface_ports import independent_covariance
from sms_jobs.metrology.phase.seen_texture import (
    SeenTexture,
    log_gradient,
    relative_gradient,
    roughness,
    texture_shift,
)
from sms_jobs.metrology.phase.texture_error import UNKNOWN, estimate_blur, textured_interior
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import run_kind
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.campaigns import tension_panel

Floats = NDArray[np.float64]

SPOT = 0.7  # standard deviation in px
SHAPE = (60, 80)
SLOPES = np.array([[5e-3, 1e-3], [-2e-3, 6e-3]])  # of omega along x and y, rad/px


def seen_through_a_spot(rng: np.random.Generator, fine: int = 8) -> tuple[Floats, Floats, Floats]:
    """Return brightness, omega as measured (2, ...) and omega at the pixel centres, for a random texture.

    Computed on a grid `fine` times finer: the mean of R and of R omega over a Gaussian spot.
    """
    rows, columns = SHAPE[0] * fine, SHAPE[1] * fine
    texture = np.exp(ndimage.gaussian_filter(rng.normal(size=(rows, columns)), 2.0 * fine) * 2.0 * fine * 2.0)
    y, x = (np.indices((rows, columns)) - (fine // 2)) / fine
    middle = slice(fine // 2, None, fine)
    brightness = ndimage.gaussian_filter(texture, SPOT * fine)[middle, middle]
    omega = np.tensordot(SLOPES, np.stack([x, y]), axes=1)
    smeared = np.stack([ndimage.gaussian_filter(texture * o, SPOT * fine)[middle, middle] for o in omega])
    return brightness, smeared / brightness, omega[:, middle, middle]


def inside(values: Floats) -> Floats:
    return values[..., 6:-6, 6:-6]


def test_the_shift_of_a_textured_surface_is_taken_away(rng: np.random.Generator) -> None:
    brightness, measured, exact = seen_through_a_spot(rng)
    valid = np.ones(SHAPE, dtype=bool)
    shift, _ = texture_shift(
        measured, valid, log_gradient(brightness, valid, relative_gradient(brightness)), roughness(brightness)
    )
    before = inside(measured - exact)
    after = inside(measured - SPOT**2 * shift - exact)
    assert np.abs(before).max() > 5e-4
    # What is left comes from taking grad(omega) of the measured omega, itself disturbed by the texture:
    # s^2 times the second derivative of ln B, here about 0.1, of the correction.
    assert np.sqrt(np.mean(after**2)) < 0.2 * np.sqrt(np.mean(before**2))


def test_the_log_gradient_of_an_exponential_is_its_exponent() -> None:
    y, x = np.indices(SHAPE).astype(float)
    brightness = np.exp(0.11 * x - 0.07 * y)
    found = log_gradient(brightness, np.ones(SHAPE, bool), relative_gradient(brightness))
    # A cubic spline's derivative at the knots is good to h^4 f^(5) / 180, 1e-6 relative; the mirrored
    # border's part of it falls by 0.27 a pixel, to 1e-7 after twelve.
    np.testing.assert_allclose(inside(inside(found[0])), 0.11, rtol=1e-5)
    np.testing.assert_allclose(inside(inside(found[1])), -0.07, rtol=1e-5)


def test_darkness_has_no_gradient() -> None:
    dark = np.zeros((8, 9))
    found = log_gradient(dark, dark.astype(bool), relative_gradient(dark))
    np.testing.assert_array_equal(found, 0.0)


def test_slopes_do_not_reach_across_edges_or_gaps() -> None:
    x = np.arange(40.0)
    omega = np.where(x < 20, 0.01 * x, 0.01 * x + 0.5) * np.ones((2, 12, 1))
    valid = np.ones((12, 40), dtype=bool)
    valid[:, 10] = False
    gradient = np.zeros((2, 12, 40))
    gradient[0] = 1.0
    shift, spread = texture_shift(omega, valid, gradient, 3.0 * gradient)
    assert (shift[:, ~valid] == 0.0).all()
    np.testing.assert_allclose(shift[:, valid], 0.01, atol=1e-12)  # rounding
    np.testing.assert_allclose(spread[:, valid], 0.03, rtol=1e-6)  # single precision


def test_a_pixel_between_two_that_fail_takes_the_slope_from_the_next() -> None:
    x = np.arange(40.0)
    omega = 0.01 * x * np.ones((2, 12, 1))
    valid = np.ones((12, 40), dtype=bool)
    valid[:, [10, 12]] = False  # on both sides of column 11
    valid[:, [29, 28, 31, 32]] = False  # two on both sides of column 30
    gradient = np.zeros((2, 12, 40))
    gradient[0] = 1.0
    shift, spread = texture_shift(omega, valid, gradient, 3.0 * gradient)
    np.testing.assert_allclose(shift[:, :, 11], 0.01, atol=1e-12)  # rounding
    np.testing.assert_allclose(spread[:, :, 11], 0.03, rtol=1e-6)  # single precision
    texture = SeenTexture(gradient, gradient, 3.0 * gradient, valid, 1)
    far, doubtful = texture.beside(0.1, 1.0)
    # Of column 30 nothing tells how phases change along rows: where its light comes from is not known.
    np.testing.assert_array_equal(far, valid & (x == 30.0))
    assert not doubtful.any()


def test_roughness_is_how_much_the_brightness_changes() -> None:
    image = np.full((5, 9), 2.0)
    image[:, 5:] = 6.0
    found = roughness(image)
    np.testing.assert_array_equal(found[1], 0.0)
    # At columns 4 and 5 the central difference is 2 and the second one 4, in units of 2 and of 6.
    length = np.sqrt(20.0)
    np.testing.assert_allclose(found[0][2], [0, 0, 0, 0, length / 2, length / 6, 0, 0, 0], atol=1e-15)


@pytest.mark.parametrize("seed", [1, 2])
def test_dark_pixels_of_a_speckle_and_its_rim_are_as_good_as_stated(seed: int) -> None:
    """By the second difference alone, as far as it reaches: 0.91 in the dark and 1.13 at the rim."""
    calibration, campaign = tension_panel("panel", "small")
    assert campaign.scene is not None
    assert campaign.scene.speckle is not None
    scene = replace(campaign.scene, seed=seed, speckle=replace(campaign.scene.speckle, seed=seed))
    shelf = Shelf(replace(campaign, scene=scene), 1)
    subject = Subject(campaign.name, campaign.reference.label, campaign.views[0])
    shelf.record(subject)
    shelf.records[CALIBRATION, subject] = {"calibration": calibration}
    shelf.run(KIND, subject, ReconstructParameters())
    made = shelf.records["reconstruct", subject]
    surface, modulation = made["surface"], made["phase"].modulation.mean(axis=0)
    score = (surface.position - shelf.shape(subject).xyz)[2] / np.sqrt(surface.covariance[5])
    modulation = modulation / np.median(modulation[surface.reason == 0])
    for least, most in ((0.0, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 1.1), (1.1, 1.5)):
        own = score[(surface.reason == 0) & (least < modulation) & (modulation <= most)]
        # What it leaves between dark and rim is known (docs/adr/0066): 0.96 to 1.07; noise of a bin is 2 %.
        assert np.sqrt(np.mean(own**2)) == pytest.approx(1.0, abs=0.09)


def test_the_blur_is_found_from_gaps(rng: np.random.Generator) -> None:
    n, sigma, variance = 4000, 0.02, 0.34
    change = rng.normal(scale=0.3, size=n)
    gap = rng.normal(scale=sigma, size=n) - variance * change
    gap[:100] += 5.0  # pixels that see two surfaces
    found = estimate_blur(gap, np.full(n, sigma), change, np.abs(change))
    # sigma / (0.3 sqrt(n)) = 1e-3, and it is said so; four times that.
    assert found.variance == pytest.approx(variance, abs=4e-3)
    assert found.variance_sigma == pytest.approx(1.05e-3, rel=0.1)
    # Chi-square of 4000 degrees of freedom scatters by 2 %: of noise sigma against a gap of 0.3 mm / px.
    assert found.rough_px < 0.02


def test_what_the_correction_leaves_is_measured_too(rng: np.random.Generator) -> None:
    n, sigma, variance, unseen = 20_000, 0.005, 0.34, 0.08
    change = rng.normal(scale=0.3, size=n)
    rough = np.abs(rng.normal(scale=0.4, size=n))
    gap = rng.normal(scale=sigma, size=n) - variance * change + unseen * rough * rng.normal(size=n)
    found = estimate_blur(gap, np.full(n, sigma), change, rough)
    # Each point tells its variance to sqrt(2): 1 % of it in all, half of that of its root; four times that.
    assert found.variance == pytest.approx(variance, abs=4e-3)
    assert found.rough_px == pytest.approx(unseen, rel=0.03)


def test_a_gap_from_calibration_is_not_the_textures(rng: np.random.Generator) -> None:
    n, sigma, variance = 20_000, 0.02, 0.34
    change = rng.normal(scale=0.3, size=n)
    gap = 0.08 + rng.normal(scale=sigma, size=n) - variance * change
    found = estimate_blur(gap, np.full(n, sigma), change, np.abs(rng.normal(scale=0.3, size=n)))
    # 0.08 / (0.3 sqrt(n)) = 2e-3, as the offset is noise to the fit; four times that.
    assert found.variance == pytest.approx(variance, abs=8e-3)
    # The excess, 0.0064 mm^2, scatters by 0.0033, its slope over squares that scatter by 0.13 by 1.8e-4.
    assert found.rough_px < 0.03


def test_without_texture_the_spot_is_the_pixels_own_area(rng: np.random.Generator) -> None:
    gap = rng.normal(size=500)
    nothing = np.zeros(0)
    for found in (
        estimate_blur(gap, np.ones(500), np.zeros(500), np.zeros(500)),
        estimate_blur(nothing, nothing, nothing, nothing),
    ):
        assert (found.variance, found.variance_sigma) == (pytest.approx(1.0 / 12.0), UNKNOWN.variance_sigma)
        assert found.rough_px == pytest.approx(UNKNOWN.rough_px)


def test_edges_and_plain_surface_do_not_tell_the_blur() -> None:
    valid = np.ones((9, 11), dtype=bool)
    valid[4, 8] = False
    gradient = np.full((2, 9, 11), 0.3)
    gradient[:, 7, 2] = 0.01  # no texture
    inside = textured_interior(valid, gradient, margin=1)
    expected = np.zeros_like(valid)
    expected[1:-1, 1:-1] = True
    expected[3:6, 7:10] = False
    expected[7, 2] = False
    np.testing.assert_array_equal(inside, expected)


@pytest.mark.parametrize(
    "plate",
    [
        TexturedPlate("squares", 6.0, 0.0, 0.002),
        TexturedPlate("squares", 12.0, 0.25, 0.004),
        TexturedPlate("speckle", 0.0, 0.5, 0.002),
        TexturedPlate("plain", 0.0, 0.5, 0.002),
    ],
    ids=lambda plate: f"{plate.pattern} {plate.square_mm}",
)
def test_points_and_their_means_are_as_good_as_stated(rng: np.random.Generator, plate: TexturedPlate) -> None:
    """Squares of two tones, 5 : 1, without a texture's part: z up to 2.7, and 192 points beyond 10."""
    seen = record(rng, plate, FringeSequence((32, 31, 30, 28, 24, 16), orientations_rad=(0.0, 0.5 * np.pi)))
    score, valid = scores(seen, {})
    assert valid > 0.98
    # The thousandfold points tell their rms to 1 %; the roughness knows an edge's place to within the pixel,
    # and errors of edges are no normal deviates: a tenth, and tails of up to 8.
    assert np.sqrt(np.mean(np.square(score))) == pytest.approx(1.0, abs=0.12)
    assert score.max() < 10.0
    records = {"measurement": seen.measurement, "calibration": seen.calibration}
    output = run_kind(KIND, Subject("plate", "S00", "C1P1"), records, 1, ReconstructParameters())
    surface = output.records["surface"]
    assert isinstance(surface, Surface)
    means, stated = blocks(surface, surface.position - seen.point, 12)
    # Of 150 means the rms is known to 6 %: three and a half of these.
    assert 0.8 < np.sqrt(np.mean(means**2 / stated)) < 1.2


def blocks(surface: Surface, error: Floats, size: int) -> tuple[Floats, Floats]:
    """Return errors along the ray as means of square blocks by their weights, and the variances stated.

    What texture hides counts at the rim of a block, which cuts its blobs.
    """
    along = np.sign(error[2]) * np.linalg.norm(error, axis=0)
    weight = 1.0 / np.asarray(surface.covariance, float)[[0, 3, 5]].sum(axis=0)
    rows, columns = (n // size for n in along.shape)
    row, column = (at % size for at in np.indices(along.shape))
    at_rim = np.isin(row, (0, size - 1)) | np.isin(column, (0, size - 1))
    every = np.where(at_rim, surface.covariance, independent_covariance(surface))
    alone = every[[0, 3, 5]].sum(axis=0)

    def of(values: Floats) -> Floats:
        cut = values[: rows * size, : columns * size].reshape(rows, size, columns, size)
        return np.asarray(cut.sum(axis=(1, 3)))

    total = of(weight)
    means, stated = of(weight * along) / total, of(weight**2 * alone) / total**2
    whole = np.isfinite(means)
    return means[whole], stated[whole]
