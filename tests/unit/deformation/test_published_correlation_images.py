"""Real and benchmark images, where they are at hand beside the checkout."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from scipy import ndimage
from scipy.optimize import least_squares

from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    MatchSettings,
    Noise,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import GridSettings, match_grid
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings
from sms_jobs.metrology.images.region_of_interest import (
    inside_outlines,
    outlines_of,
    parse_outlines,
    written,
)
from sms_jobs.metrology.images.spline import Interpolant

FOLDER = Path(__file__).resolve().parents[4] / "shared" / "data" / "dic"


def image(name: str) -> np.ndarray:
    path = FOLDER / name
    if not path.exists():
        pytest.skip(f"{name} is not there: put the benchmark images into {FOLDER}")
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    return grey


@pytest.mark.parametrize(("shift", "order"), [(1, 1), (3, 1), (3, 2), (5, 1), (5, 2)])
def test_whole_pixel_shifts_of_a_real_image_are_exact(shift: int, order: Literal[1, 2]) -> None:
    reference, deformed = image("pixel_shift/ref.tif"), image(f"pixel_shift/def_{shift}.tif")
    images = prepare_images(reference, deformed, np.ones(reference.shape, np.int32))
    grid = GridSettings(spacing=12)
    found = match_grid(images, deformed, MatchSettings(shape_order=order), grid, SearchSettings(10, 10))
    assert (found.matches.ending == CONVERGED).mean() > 0.98
    inner = (np.minimum(found.x, found.y) > 30) & (np.maximum(found.x, found.y) < 480)
    error = found.matches.warp[inner][:, [0, 3]] - shift
    # The required 0.0005 px for both.
    assert np.abs(error.mean(axis=0)).max() < 5e-4
    assert error.std(axis=0).max() < 5e-4


@pytest.mark.parametrize(
    ("interpolant", "clear", "any_point"),
    [("local-cubic", 0.0002, 0.0008), ("cubic", 0.0012, 0.0028), ("quintic", 0.0045, 0.006)],
)
def test_open_hole_tension_agrees_with_an_independent_program(
    interpolant: Interpolant, clear: float, any_point: float
) -> None:
    """OpenCorr's first-order result, which rests on the local cubic: with that, the required 0.001 px.

    Our default stays the quintic, which differs by 0.004 and 0.005 px, all of it the local cubic's bias:
    `test_the_quintic_has_less_bias_than_the_cubics` has the truth to compare both with.
    """
    reference, deformed = (image(f"oht_cfrp_pair/oht_cfrp_{k}.bmp") for k in (0, 4))
    theirs = np.genfromtxt(
        FOLDER / "oht_cfrp_pair" / "oht_cfrp_4_fftcc_icgn1_r16.csv", delimiter=",", names=True
    )
    images = prepare_images(reference, deformed, np.ones(reference.shape, np.int32), interpolant=interpolant)
    x, y = theirs["x"].astype(np.int64), theirs["y"].astype(np.int64)
    guess = np.zeros((len(x), 6))
    guess[:, 0], guess[:, 3] = theirs["u0"], theirs["v0"]
    # At the default tolerance 0.0010 and 0.0009 px are left, here 0.0006 and 0.0008.
    found = match_points(images, x, y, guess, MatchSettings(radius=16, tolerance=1e-5), threads=2)
    mine = (found.ending == CONVERGED) & (found.score > 0.8)
    good = (theirs["ZNCC"] > 0.8) & (theirs["convergence"] < 1e-3)
    if interpolant == "local-cubic":
        assert mine.sum() >= good.sum()
    assert mine.sum() > good.sum() - 0.002 * len(x)
    both = mine & good
    # The points about the hole, a fiftieth of all, whose subsets show two things at once, differ by more.
    sure = both & (found.sigma.max(axis=1) < 0.01)
    assert sure.sum() > 0.97 * both.sum()
    for mine_at, their_at in ((found.warp[:, 0], theirs["u"]), (found.warp[:, 3], theirs["v"])):
        assert rms((mine_at - their_at)[sure]) < clear
        assert rms((mine_at - their_at)[both]) < any_point


def nodes(shape: tuple[int, int], rim: int, dx: int, dy: int) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = shape
    x, y = np.meshgrid(np.arange(rim, columns - rim, dx), np.arange(rim, rows - rim, dy))
    return x.ravel().astype(np.int64), y.ravel().astype(np.int64)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_sinusoidal_stretch_has_its_amplitude_and_its_scatter() -> None:
    """Sample 14 of the DIC Challenge: u = 0.1 sin(phase), the phase quadratic in x; v = 0."""
    reference = image("sample14/Sample14_Reference.tif")
    images = prepare_images(
        reference, image("sample14/Sample14_L1_Amp0.1b.tif"), np.ones(reference.shape, np.int32)
    )
    x, y = nodes((589, 2048), 25, 11, 11)
    found = match_points(images, x, y, np.zeros((len(x), 6)), MatchSettings(radius=16), threads=2)
    assert (found.ending == CONVERGED).all()
    u, sigma = found.warp[:, 0], found.sigma[:, 0]

    def expected(c: np.ndarray, at: np.ndarray) -> np.ndarray:
        return c[0] + c[1] * np.sin(np.polynomial.polynomial.polyval(at / 1000.0, c[2:]))

    fit = least_squares(lambda c: (u - expected(c, x)) / sigma, [0.0, 0.1, 0.0, 0.0, 2.7])
    column = np.arange(2048.0)
    # Published: 0.1 px and 1290 microstrain. Subsets of 33 px blunt a period of 490 px by
    # (2 pi 33 / 490)^2 / 24 = 0.8 %, and 9000 deviates of 0.011 px that overlap tenfold are worth 0.5 %.
    assert fit.x[1] == pytest.approx(0.1, rel=0.02)
    assert np.abs(np.gradient(expected(fit.x, column))).max() == pytest.approx(1290e-6, rel=0.02)
    # Reported sigma within 20 % of scatter, along and across.
    assert 0.8 < rms((u - expected(fit.x, x)) / sigma) < 1.2
    assert 0.8 < rms(found.warp[:, 3] / found.sigma[:, 1]) < 1.2


@pytest.mark.parametrize(("order", "limit"), [(1, 0.036), (2, 0.0215)])
def test_strongly_curved_fields_err_no_more_than_elsewhere(order: Literal[1, 2], limit: float) -> None:
    """Sample 15 of the DIC Challenge, subsets of 33 px, over every row and all four images."""
    reference = image("sample15/Reference.tif")
    imposed = np.genfromtxt(FOLDER / "sample15" / "imposed_v.csv", delimiter=",", names=True)
    x, y = nodes((1000, 2000), 20, 107, 3)
    errors = []
    for k in (250, 300, 350, 400):
        column = imposed[f"v_K{k}_px"]
        images = prepare_images(
            reference, image(f"sample15/P200_K{k}_N2.tif"), np.ones(reference.shape, np.int32)
        )
        v = np.zeros(len(x))
        for _ in range(50):  # the imposed field is given at the end point
            v = np.interp(y + v, imposed["y_px"], column)
        guess = np.zeros((len(x), 6))
        guess[:, 3] = v
        found = match_points(images, x, y, guess, MatchSettings(radius=16, shape_order=order), threads=2)
        assert (found.ending == CONVERGED).mean() > 0.999
        end = y + found.warp[:, 3]
        errors.append((found.warp[:, 3] - np.interp(end, imposed["y_px"], column))[found.ending == CONVERGED])
    # OpenCorr's 0.035 px and 0.0215 px; the first is all from the shape function, the same for any program,
    # and depends on the rows that are taken: 0.0340 to 0.0356 px for several grids.
    assert rms(np.concatenate(errors)) < limit


def test_seeds_find_a_shift_of_ten_pixels_with_strong_gradients() -> None:
    """Sample 15 again, from nothing: v falls from 0 to -9.6 px and waves on the way."""
    reference, deformed = image("sample15/Reference.tif"), image("sample15/P200_K300_N2.tif")
    images = prepare_images(reference, deformed, np.ones(reference.shape, np.int32))
    settings = MatchSettings(radius=16, shape_order=2), GridSettings(spacing=25), SearchSettings()
    found = match_grid(images, deformed, *settings, threads=2)
    inner = (found.y > 30) & (found.y < 970) & (found.x > 30) & (found.x < 1970)
    assert (found.matches.ending == CONVERGED)[inner].mean() > 0.99


def test_a_foam_with_holes_is_matched_to_their_rims() -> None:
    """Polymer foam in compression; the published mask is the image with its holes painted black."""
    first, second, painted = (
        image(f"foam/{name}.tif")
        for name in (
            "dit155_0p01_3_1_3hz_000001", "dit155_0p01_3_1_3hz_000021", "ImgMask_dit155_0p01_3_1_3hz_100001",
        )
    )  # fmt: skip
    # Without the dark pixels of the texture, and without what lies beside the specimen.
    holes = ndimage.binary_propagation(ndimage.binary_opening(painted == 0, iterations=8), mask=painted == 0)
    mask = ~holes
    mask[:, :250] = mask[:, 1500:] = mask[:10] = False
    outlines = parse_outlines(written(outlines_of(mask)))
    np.testing.assert_array_equal(inside_outlines(outlines, mask.shape), mask)
    images = prepare_images(first, second, mask.astype(np.int32))
    settings = MatchSettings(radius=12), GridSettings(spacing=12), SearchSettings()
    found = match_grid(images, second, *settings, threads=2)
    good = found.matches.ending == CONVERGED
    off = ndimage.distance_transform_edt(mask)[found.y, found.x]
    below = found.y > 30  # it moves up by 11 px, and what was above has left
    assert good[below & (off > 17)].mean() > 0.999
    assert good[below & (off <= 17)].mean() > 0.95


def image_noise(grey: np.ndarray) -> float:
    """Return the standard deviation of white noise from the frequencies that speckle does not have."""
    window = np.outer(np.hanning(grey.shape[0]), np.hanning(grey.shape[1]))
    power = np.abs(np.fft.fft2((grey - grey.mean()) * window)) ** 2 / np.sum(window**2)
    high = (np.abs(np.fft.fftfreq(grey.shape[0])) > 0.4)[:, None] & (
        np.abs(np.fft.fftfreq(grey.shape[1])) > 0.4
    )
    return float(np.sqrt(power[high].mean()))


@pytest.mark.parametrize("radius", [8, 10, 16])
def test_noise_is_that_of_theory_on_the_star(radius: int) -> None:
    """The star of the DIC Challenge 2.0: sigma_v against sigma_n / sqrt(sum Iy^2), of two noisy images."""
    grey = [image(f"star/DIC_Challenge_Star_Noise_{which}.tiff").astype(float) for which in ("Ref", "Def")]
    noise = [image_noise(one) for one in grey]
    models = (Noise(noise[0] ** 2, 0.0), Noise(noise[1] ** 2, 0.0))
    images = prepare_images(*grey, np.ones(grey[0].shape, np.int32), models)
    width = 2 * radius + 1
    x = np.arange(2300, 3960, width)  # periods above 175 px, which a subset follows
    scatter, sigma, theory = [], [], []
    for row in 250 + width * np.arange(-4, 5):
        y = np.full(len(x), row)
        guess = np.zeros((len(x), 6))
        guess[:, 3] = 0.5 * np.cos(2.0 * np.pi * (row - 250) / (10.0 + 290.0 * x / 4000.0))
        found = match_points(images, x, y, guess, MatchSettings(radius=radius))
        assert (found.ending == CONVERGED).all()
        fit = np.polynomial.Polynomial.fit(x, found.warp[:, 3], 6)
        scatter.append((found.warp[:, 3] - fit(x)) * np.sqrt(len(x) / (len(x) - 7)))
        sigma.append(found.sigma[:, 1])
        for column in x:
            about = np.s_[row - radius : row + radius + 1, column - radius : column + radius + 1]
            theory.append(np.hypot(*noise) / np.sqrt(np.sum(images.gradient_y[about] ** 2)))
    expected = np.reshape(theory, np.shape(scatter))
    # The required 15 %; 459 points and more give a standard deviation to 3.3 %.
    assert 0.85 < rms(np.array(scatter) / expected) < 1.15
    assert 0.85 < rms(np.array(sigma) / expected) < 1.15
    assert 0.8 < rms(np.array(scatter) / np.array(sigma)) < 1.2
