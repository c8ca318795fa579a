"""Frames that hold light of their neighbours, or of a lamp: corrected, stated, or refused by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.bench.fringes.code_mishaps import CODED, coded_session
from sms_jobs.bench.fringes.fringe_mishaps import (
    SUBJECT,
    Session,
    perfect_session,
    reconstructed,
    under_a_lamp,
    with_light_of,
)
from sms_jobs.kinds.shape.phases import account_for
from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.kinds.shape.watched_frames import OtherLight, WatchedFrames
from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.phase.frame_lag import NEIGHBOURS, FrameLag, Neighbour
from sms_jobs.records.fields import PhaseMaps, ReturnMaps, Surface
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.testing.in_memory import run_kind

LINEAR = FringeSequence(tuple(range(12)))
RANGED = ReconstructParameters(method="fdr", returns=2)


def errors(session: Session, surface: Surface) -> NDArray[np.float64]:
    """Return error over stated deviation of the valid points, 3 px inside what is lit."""
    inside = ndimage.binary_erosion(session.shape.lit, iterations=3)
    valid = (surface.reason == Reason.VALID) & inside
    off = np.linalg.norm(surface.position - session.shape.xyz, axis=0)
    return np.asarray((off / np.sqrt(trace(position_covariance(surface))))[valid])


def run(
    session: Session, measurement: Measurement, parameters: ReconstructParameters
) -> tuple[Surface, dict[str, float], str]:
    """Return the surface, the statistics, and what was said last."""
    said: list[str] = []
    output = run_kind(
        KIND,
        SUBJECT,
        {"measurement": measurement, "calibration": session.calibration},
        1,
        parameters,
        progress=lambda fraction, message="": said.append(message),
    )
    return output.records["surface"], output.statistics, said[-1]


@pytest.mark.parametrize("neighbour", NEIGHBOURS)
@pytest.mark.parametrize(
    ("sequence", "parameters"), [(None, ReconstructParameters()), (LINEAR, RANGED)], ids=["drawn", "ranged"]
)
def test_light_of_a_neighbour_is_taken_out_of_the_phases(
    neighbour: Neighbour, sequence: FringeSequence | None, parameters: ReconstructParameters
) -> None:
    session = perfect_session(np.random.default_rng(11), sequence)
    surface, statistics, said = run(session, with_light_of(session, neighbour, 0.02), parameters)
    found = errors(session, surface)
    # 10,000 points; left as it is, this light moves them by 2 to 5 of their deviations.
    assert np.sqrt(np.mean(found**2)) < 1.1
    assert found.max() < 6.0
    assert statistics["frame_lag"] == pytest.approx(0.02 if neighbour == "before" else -0.02, abs=0.001)
    # What its residual was is no excess beside it.
    assert statistics.get("phase_excess", 0.0) < 0.1
    assert f"hold {abs(statistics['frame_lag']):.1%} of the light of the frame {neighbour} each" in said


def test_a_code_beside_one_density_tells_of_it_too() -> None:
    session = coded_session(np.random.default_rng(1), CODED[1], plain=True)
    measurement = with_light_of(session, "before", 0.02)
    surface, _ = reconstructed(session, measurement)
    assert surface is not None
    found = errors(session, surface)
    # Of the first frame of a direction alone, whose neighbour is another pattern: 1.6 without, 1.1 with.
    assert np.sqrt(np.mean(found**2)) < 1.2


def test_more_of_it_than_is_taken_out_is_refused_where_nothing_else_tells() -> None:
    session = coded_session(np.random.default_rng(0), CODED[0], plain=True)
    surface, said = reconstructed(session, with_light_of(session, "before", 0.1))
    assert surface is None
    assert "% of the light of the frame before each" in said


def test_what_is_found_is_taken_out_and_stated_of_all_returns() -> None:
    session = perfect_session(np.random.default_rng(11), LINEAR)
    measurement = session.measurement
    maps = PhaseMaps.unset((0.0, 1.0), 2, 3)
    returns = ReturnMaps.unset((0.0, 1.0), 2, 2, 3)
    maps.mean_intensity[:] = 900.0
    for omega, sigma, modulation in (
        (maps.omega, maps.omega_sigma, maps.modulation),
        (returns.omega, returns.omega_sigma, returns.amplitude),
    ):
        omega[:], sigma[:], modulation[:] = 0.5, 3e-3, 300.0
    lag = FrameLag("before", 0.02, 0.001, (0.01, -0.02), (4e-3, 0.0), 1e3)
    account_for(OtherLight(lag, (0.0, 8.0)), measurement, maps, returns)
    # Noise of a gradient: that of a phase over the root of the squared densities.
    noise = (
        measurement.noise(np.array(900.0)) * np.sqrt(2.0 / 4.0) / 300.0 / np.sqrt(np.sum(np.arange(12) ** 2))
    )
    for omega, sigma in ((maps.omega, maps.omega_sigma), (returns.omega, returns.omega_sigma)):
        np.testing.assert_allclose(omega[0], 0.49, rtol=1e-6)  # single precision
        np.testing.assert_allclose(omega[1], 0.52, rtol=1e-6)
        np.testing.assert_allclose(sigma[0], 5e-3, rtol=1e-6)
        np.testing.assert_allclose(sigma[1], np.hypot(3e-3, np.sqrt(8.0) * noise), rtol=1e-6)


@pytest.mark.parametrize("gain", [2.0, 9.5])
@pytest.mark.parametrize("part", [0.1, 0.3])
def test_it_is_named_where_the_noise_was_estimated_from_such_frames(part: float, gain: float) -> None:
    session = perfect_session(np.random.default_rng(11), FringeSequence((16, 15, 14, 12, 8)))
    seen = replace(with_light_of(session, "before", part), gain=gain)
    surface, said = reconstructed(session, seen)
    assert surface is None
    assert "of the light of the frame before each" in said


@pytest.mark.parametrize("part", [0.1, 0.3, 0.45])
@pytest.mark.parametrize("neighbour", NEIGHBOURS)
def test_more_of_it_is_refused_by_name(part: float, neighbour: Neighbour) -> None:
    session = perfect_session(np.random.default_rng(12))
    surface, said = reconstructed(session, with_light_of(session, neighbour, part))
    assert surface is None
    assert f"they hold {part:.0%} of the light of the frame {neighbour} each" in said
    assert "let it settle longer (settle_ms of the rig)" in said


@pytest.mark.parametrize(
    ("sequence", "parameters"), [(None, ReconstructParameters()), (LINEAR, RANGED)], ids=["drawn", "ranged"]
)
def test_a_lamp_that_flickers_is_in_the_deviations(
    sequence: FringeSequence | None, parameters: ReconstructParameters
) -> None:
    random = np.random.default_rng(13)
    found = []
    for _ in range(4):
        session = perfect_session(random, sequence)
        surface, statistics, said = run(session, under_a_lamp(session, 0.02, random), parameters)
        found.append(errors(session, surface))
        assert ("phases scatter" in said) == (statistics.get("phase_excess", 0.0) > 1.0)
    every = np.concatenate(found)
    # 1.4 and 1.3 without; noise that repeats itself along fringes leaves a little more than noise.
    assert np.sqrt(np.mean(every**2)) < 1.1
    assert np.mean(every > 6.0) < 1e-4


def test_overexposed_frames_are_not_taken_for_other_light() -> None:
    session = perfect_session(np.random.default_rng(11), FringeSequence((16, 15, 14, 12, 8)))
    frames = session.measurement.frames.rows(0, 128)
    lit = frames[:, session.shape.lit]
    most = int(np.percentile(lit.max(axis=0), 60))
    told = replace(session.measurement, full_scale=most)
    seen = WatchedFrames(told, np.minimum(lit, most).astype(np.uint16), 0.02, ranged=False)
    assert max(fit.excess for fit in seen.fits) > 1.0
    light = seen.other_light()
    assert light.lag is None
    assert max(light.excess) == 0.0
    # Of hardly any pixel nothing is said.
    few = replace(seen, levels=np.concatenate([seen.levels[:, :50], np.full_like(seen.levels, most)], axis=1))
    assert few.other_light() == OtherLight()


def test_nothing_is_said_of_frames_as_they_should_be() -> None:
    session = perfect_session(np.random.default_rng(11))
    _, statistics, said = run(session, session.measurement, ReconstructParameters())
    assert "frame_lag" not in statistics
    assert statistics.get("phase_excess", 0.0) < 0.3
    assert said == "triangulated"
