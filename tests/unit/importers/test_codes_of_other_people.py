"""Folders of micro and embedded phase shifting: described they are read, and guessed they are refused."""

from __future__ import annotations

from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import ConfigurationError, InvalidInput
from sms_jobs.formats.importers.folders import list_folder
from sms_jobs.formats.importers.frames import arrange
from sms_jobs.formats.importers.guess import guess_layout
from sms_jobs.formats.importers.inspection import camera_models, inspect, measurement_of, source_hash
from sms_jobs.formats.importers.layout import layout_of
from sms_jobs.kinds.shape.foreign_patterns import joint_codes
from sms_jobs.metrology.phase.joint_fit import fit_jointly
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.times import UNTIMED
from tests.support.foreign_frames import MEAN, MODULATION, omega, save, texture

MICRO = ((15.2, 14.1, 14.6, 15.7, 16.1, 16.5), (3, 1, 1, 1, 1, 1))
EMBEDDED = ((12, 13, 15.5), (4, 2, 2))
Code = tuple[tuple[float, ...], tuple[int, ...]]


def shown(code: Code, direction: int, edge: bool, white: bool = False) -> NDArray[np.float64]:
    """Return the frames of a foreign rig, in 8 bit; two steps are a quarter of a turn apart."""
    frames = []
    for density, count in zip(*code, strict=True):
        for k in range(count):
            turn = pi / 2 * k if count == 2 else 2.0 * pi * k / count
            phase = omega() * density + (pi * density if edge else 0.0) + direction * turn
            frames.append(texture() * (MEAN + MODULATION * np.cos(phase)))
    return np.stack([*frames, *([texture() * 200.0] if white else [])])


def described(code: Code, **more: Any) -> dict[str, Any]:
    return {
        "pattern": "frame_{number}.png",
        "state": "S00",
        "view": "C1P1",
        "sequence": {"densities": code[0], "steps": code[1]},
        **more,
    }


def imported(folder: Path, table: dict[str, Any]) -> Measurement:
    layout = layout_of(table, "here")
    (found,) = arrange(list_folder(folder), layout).tuples
    assert found.faults == ()
    one = inspect(folder, found, sequence=layout.sequence)
    (camera,), _ = camera_models([one], layout)
    assert source_hash(one, layout)
    return measurement_of(folder, one, layout, camera, UNTIMED)


@pytest.mark.parametrize("code", [MICRO, EMBEDDED], ids=["micro", "embedded"])
@pytest.mark.parametrize(("direction", "origin"), [(1, "middle"), (-1, "middle"), (-1, "edge")])
def test_a_described_code_gives_the_phase_gradient(
    tmp_path: Path, code: Code, direction: int, origin: str
) -> None:
    save(tmp_path, shown(code, direction, origin == "edge"))
    camera = {"gain": 0.0, "read_noise": 0.3}
    phase = {"direction": direction, "origin": origin}
    measurement = imported(tmp_path, described(code, phase=phase, camera=camera))
    frames = measurement.frames.rows(0, measurement.frames.shape[1])
    found = fit_jointly(frames, joint_codes(measurement)[0], measurement.grey_levels)
    sure = ~found.ambiguous
    assert sure.mean() > 0.7
    # Rounding to whole levels, 0.3, of a modulation of 50 or more: 0.004 rad a phase; 6 deviations.
    assert np.abs(found.omega - omega())[sure].max() < 6.0 * 0.006 / 12


def test_the_texture_is_the_mean_of_whole_turns_alone(tmp_path: Path) -> None:
    save(tmp_path, shown(EMBEDDED, 1, edge=False))
    found = imported(tmp_path, described(EMBEDDED, camera={"gain": 0.0, "read_noise": 0.3}))
    assert np.abs(found.texture - texture() * MEAN).max() <= 1.0


def test_frames_of_one_step_are_not_taken_for_a_gray_code(tmp_path: Path) -> None:
    save(tmp_path, shown(MICRO, 1, edge=False))
    for sequence in ({"densities": MICRO[0]}, {}):
        with pytest.raises(
            InvalidInput, match="neither runs of phase steps nor patterns of two levels"
        ) as said:
            guess_layout(list_folder(tmp_path), {"sequence": sequence}, None)
        assert "steps = [3, 1, 1]" in str(said.value)


def test_with_its_steps_a_folder_is_guessed_to_be_fringes(tmp_path: Path) -> None:
    save(tmp_path, shown(MICRO, 1, edge=False))
    sequence = {"densities": MICRO[0], "steps": MICRO[1]}
    guess = guess_layout(list_folder(tmp_path), {"sequence": sequence}, None)
    assert guess.table["frames"] == "fringes"
    layout = layout_of(guess.table, "here")
    assert layout.sequence.counts == MICRO[1]
    assert "steps = [3, 1, 1, 1, 1, 1]" in guess.as_toml()


def test_a_frame_too_many_is_asked_about(tmp_path: Path) -> None:
    save(tmp_path, shown(MICRO, 1, edge=False, white=True))
    sequence = {"densities": MICRO[0], "steps": MICRO[1]}
    with pytest.raises(InvalidInput, match="make 8 frames of fringes, and there are 9: say what the others"):
        guess_layout(list_folder(tmp_path), {"sequence": sequence}, None)


def test_names_cannot_say_steps_that_differ() -> None:
    table = described(MICRO) | {"pattern": "{density}_{step}.png"}
    with pytest.raises(ConfigurationError, match=r"need \{number\}"):
        layout_of(table, "here")
    with pytest.raises(ConfigurationError, match="one for each of the 6 densities"):
        layout_of(described((MICRO[0], (3, 1))), "here")
