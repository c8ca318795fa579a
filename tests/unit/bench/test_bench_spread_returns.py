"""Light that is spread over the projector's image: it is refused, or its deviations say so."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.bench.fringes.spread_returns import CROSSED, DIAGONAL, Plate, choice
from sms_jobs.kinds.shape.phase_task import PhaseParameters
from sms_jobs.records.reasons import Reason

TWO = PhaseParameters(method="fdr", returns=2)
NOISE = 200.0  # B / sigma


@pytest.fixture(scope="module")
def crossed() -> Plate:
    return Plate.seen(40, CROSSED)


@pytest.fixture(scope="module")
def diagonal() -> Plate:
    return Plate.seen(40, DIAGONAL)


def test_sharp_direct_light_scatters_as_stated(crossed: Plate, diagonal: Plate) -> None:
    for plate in (crossed, diagonal):
        found = plate.measured(plate.frames([plate.direct()], NOISE, 1), TWO)
        # The plate reaches beyond the volume.
        inside = np.abs(plate.xyz).max(axis=-1) < 300.0
        assert found.valid[inside].mean() > 0.9
        # 1400 points: 1.9 % scatter of an rms, four times that.
        assert found.scatter() == pytest.approx(1.0, abs=0.08)


@pytest.mark.parametrize("spread_px", [2.0, 3.0])
def test_a_plate_out_of_focus_is_not_taken_for_one_beside_it(diagonal: Plate, spread_px: float) -> None:
    found = diagonal.measured(diagonal.frames([diagonal.direct(1.0, spread_px)], NOISE, 1), TWO)
    # Two sharp returns that fit as well, and 5 mm off: of those a quarter were valid.
    assert np.isfinite(found.returns.omega[:, 1]).all()
    assert not found.valid.any()
    assert (found.reason & Reason.AMBIGUOUS_PAIR != 0).mean() > 0.9


def test_what_one_orientation_hides_another_shows(crossed: Plate) -> None:
    # Along the hinge the returns of a brushed mirror are close to the direct ones, and hide their spread.
    found = crossed.measured(crossed.frames([crossed.direct(), crossed.mirrored(0.5, 1.0)], NOISE, 1), TWO)
    assert found.valid.mean() > 0.8
    # Of a thousand points eighty were wrong. Two deviations, and not seven, are left.
    assert not found.wrong().any()
    assert found.scatter() < 2.5


def test_spread_light_tells_no_amplitude() -> None:
    """The wall's light loses modulation in each orientation in its own way: shared, 85.2 % were valid."""
    plate = Plate.seen(64, CROSSED)
    found = plate.measured(plate.frames([plate.direct(), plate.scattered(0.8)], 50.0, 1), TWO)
    assert found.valid.mean() > 0.857
    assert found.wrong().sum() <= 1


def test_a_wall_s_light_is_the_sum_over_its_patches(crossed: Plate) -> None:
    wall = crossed.scattered(0.8)
    columns, rows = crossed.geometry.pair.projector.columns, crossed.geometry.pair.projector.rows
    z = wall.signal(0.0, columns, rows)
    assert z.shape == (1600, 64)
    np.testing.assert_allclose(z[:, 0], wall.strength.sum(axis=1))
    # A wall without end at 120 degrees fills (1 + cos 120) / 2 of a half space, and is lit at most 1.8
    # times as squarely here.
    assert (z[:, 0].real < 0.25 * 0.8 * 1.8).all()
    # It is spread over many bins: hardly any is left of dense fringes.
    assert (np.abs(z[:, 40:]) < 0.2 * z[:, :1].real + 1e-3).mean() > 0.95


def test_widths_do_not_choose_better(diagonal: Plate) -> None:
    measurement = diagonal.frames([diagonal.direct(), diagonal.mirrored(0.5, 2.0)], NOISE, 1)
    found = choice(diagonal, measurement)
    assert abs(int(found.wrong.sum()) - int(found.wrong_by_width.sum())) <= 2
    # Widths are there to be seen, but not in what is chosen wrongly.
    assert (found.width > 4.0).mean() > 0.1
