"""Finer subsets are tried where bias is more than their noise, and taken where the whole error is less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from sms_jobs.bench.correlated.lone_camera import DEFORMED, correlated
from sms_jobs.bench.correlated.speckle_pairs import speckle_pair
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.metrology.deformation.matching.finer_subsets import (
    Subsets,
    Verdict,
    better_of,
    ladder,
    worth_trying,
)
from sms_jobs.metrology.deformation.matching.verification import Verified

SHAPE = (60, 80)


def verdict(value: float, variance: float, bias: np.ndarray, step: int = 0) -> Verdict:
    one = np.ones((2, *SHAPE))
    agrees = np.ones(SHAPE, dtype=bool)
    verified = Verified(one * bias, agrees, ~agrees)
    return Verdict(value * one, variance * one, verified, np.full(SHAPE, step, dtype=np.uint8))


def half(right: float) -> np.ndarray:
    """Return a bias that is `right` in the right half and nothing in the left one."""
    return np.where(np.arange(SHAPE[1]) < 40, 0.0, right) * np.ones(SHAPE)


def test_the_ladder_leads_from_quiet_to_fine() -> None:
    assert ladder(Subsets(10, 1)) == (Subsets(10, 1), Subsets(10, 2), Subsets(7, 2))
    assert ladder(Subsets(10, 2)) == (Subsets(10, 2), Subsets(7, 2))
    assert ladder(Subsets(4, 2)) == (Subsets(4, 2),)


def test_finer_subsets_are_tried_where_bias_is_more_than_their_noise() -> None:
    now = verdict(0.0, 1e-4, half(1.1e-4))
    np.testing.assert_array_equal(worth_trying(now), half(1.0) > 0.0)
    assert not worth_trying(verdict(0.0, 1e-4, half(0.9e-4))).any()
    now.value[:, :10] = np.nan
    assert not worth_trying(now)[:10].any()
    now.verified.agrees[30, 5] = False
    assert worth_trying(now)[30, 5]


def test_the_smaller_whole_error_is_taken_without_a_step() -> None:
    now, finer = verdict(0.0, 1e-4, half(9e-4)), verdict(1.0, 3e-4, half(0.0), 1)
    found = better_of(now, finer, 7)
    # Gains of 2e-4 on the left against and 7e-4 on the right for it balance in a square two ninths of which
    # lie on the right; from there a mean over 7 px leads from the one to the other, at most 1 / 7 a pixel.
    assert (found.step == np.broadcast_to(np.arange(80) >= 39, SHAPE)).mean() > 0.97
    assert (found.value[:, :, :32] == 0.0).all()
    np.testing.assert_allclose(found.value[:, :, 46:], 1.0, atol=1e-9)
    assert np.abs(np.diff(found.value, axis=2)).max() <= 1.0 / 7.0 + 1e-9
    np.testing.assert_allclose(found.variance, 1e-4 + 2e-4 * found.value, rtol=1e-9)
    finer.value[:, 20:40] = np.nan
    held = better_of(now, finer, 7)
    assert np.isfinite(held.value).all()
    assert (held.value[:, 20:40] == 0.0).all()


def test_what_disagrees_is_regained_where_finer_subsets_agree() -> None:
    now, finer = verdict(0.0, 1e-4, half(9e-4)), verdict(1.0, 3e-4, half(0.0), 1)
    now.verified.agrees[30, 70] = False
    other = replace(finer.verified, agrees=np.ones(SHAPE, dtype=bool))
    found = better_of(now, replace(finer, verified=other), 7)
    assert found.verified.agrees.all()


def recorded(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.rint(light + rng.normal(0.0, 10.0, light.shape)).astype(np.uint16)


def test_short_waves_are_followed_and_still_pairs_stay_as_they_are(rng: np.random.Generator) -> None:
    def wave(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.where(x < 120.0, 0.0, 0.5 * np.sin(2.0 * np.pi * (x - 120.0) / 30.0)), 0.0 * y

    light, moved = speckle_pair((160, 280), wave, 8)
    reference, still, deformed = (recorded(one, rng) for one in (light, light, moved))
    inner = np.s_[:, 25:-25, 25:-25]
    x = np.arange(280.0)
    true = np.stack(wave(np.broadcast_to(x, (160, 280)), np.zeros((160, 280))))[inner]
    error, noise, records = {}, {}, {}
    for how in ("fixed", "adaptive"):
        parameters = CorrelateParameters(subsets=how)
        records[how] = correlated(reference, deformed, 10.0, parameters, 1).records["correlate", DEFORMED]
        at_rest = correlated(reference, still, 10.0, parameters, 1).records["correlate", DEFORMED]
        field = records[how]["displacement"]
        wrong = (field.image_displacement[inner] - true)[:, :, 115:]
        sigma = np.sqrt(field.covariance[[0, 2]])[inner][:, :, 115:]
        error[how] = np.sqrt(np.nanmean(wrong**2))
        noise[how] = np.sqrt(np.nanmean(at_rest["displacement"].image_displacement[inner] ** 2))
        # The bias of waves is stated with up to twice its size (docs/correlation.md).
        assert 0.7 < np.sqrt(np.nanmean(sigma**2)) / error[how] < 2.0
    # Of a wave of 30 px the default leaves 0.6, quadratic subsets of the same size 0.94.
    assert error["adaptive"] < 0.4 * error["fixed"]
    # A bias of the variance of noise is found by chance in few places.
    assert noise["adaptive"] < 1.05 * noise["fixed"]
    matches, field = records["adaptive"]["matches"], records["adaptive"]["displacement"]
    assert records["fixed"]["matches"].subset_radius is None
    bent = (matches.x > 140) & (matches.x < 250) & (matches.reason == 0)
    # Where the wave crosses zero it has no curvature, and the first subsets are as good: a third at most.
    assert np.mean(matches.shape_order[bent] == 2) > 0.65
    assert np.mean(matches.shape_order[matches.x < 90] == 1) > 0.9
    assert set(np.unique(matches.subset_radius)) <= {7, 10}
    resolved = field.resolution
    assert np.nanmedian(resolved[:, 140:250]) < 0.7 * np.nanmedian(resolved[:, :90])


def test_adaptive_subsets_want_a_direct_match_by_subsets() -> None:
    for other in ({"reference": "previous"}, {"method": "fourier-newton"}):
        with pytest.raises(ValidationError, match="subsets = adaptive goes with method = gauss-newton"):
            CorrelateParameters(subsets="adaptive", **other)
