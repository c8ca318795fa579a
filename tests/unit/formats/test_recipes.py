"""What campaign files say of recording: repeats, and poses of a stage by their number."""

from __future__ import annotations

from math import radians

import pytest

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.configuration import parse_campaign
from sms_jobs.jobs.recording.recordings import Turn, turns
from sms_jobs.records.campaign import Campaign

TEST = """
name = "plate"
rig = "hall-3"
views = ["C1P1"]
specimen = { name = "plate" }
states = [{ label = "S00", repeats = 3, load_n = 0.0 }, { label = "S01", load_n = 500.0 }]
"""
SESSION = """
name = "calibration-7"
rig = "hall-3"
views = ["C1P1"]
specimen = { name = "board and bar" }
states = [{ label = "B01", artefact = "chess" }, { label = "B02", artefact = "chess" }]

[session]
sensors = [{ name = "P1", columns = 1024, rows = 768 }, { name = "C1", columns = 2048, rows = 2048 }]
artefacts.chess = { shape = "chessboard", columns = 9, rows = 6, pitch_mm = 25.0 }

[session.artefacts.bar]
shape = "ball-bar"
length_mm = 500
length_sigma_mm = 0.01
radius_mm = 25
radius_sigma_mm = 0.01

[session.stage_poses]
artefact = "bar"
count = 25
pan_deg = [-45, 45]
tilt_deg = [-45, 45]
"""


def parsed(text: str) -> Campaign:
    return parse_campaign(text, "plan.toml").campaign


def test_a_repeated_state_is_several_states() -> None:
    states = parsed(TEST).states
    assert [s.label for s in states] == ["S00", "S00.2", "S00.3", "S01"]
    assert [s.load_n for s in states] == [0.0, 0.0, 0.0, 500.0]


def test_a_repeat_that_another_state_is_called_after_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="two states of one label"):
        parsed(TEST.replace('label = "S01"', 'label = "S00.2"'))


def test_poses_of_a_stage_follow_from_their_number() -> None:
    states = parsed(SESSION).states
    assert [s.label for s in states] == ["B01", "B02", *(f"S{n:02d}" for n in range(1, 26))]
    bars = states[2:]
    # Thesis Table 3, whose 315 and 337.5 degrees are -45 and -22.5 here.
    found = [(round(s.channels["pan_rad"] / radians(22.5)), s.channels["tilt_rad"]) for s in bars[:6]]
    assert [pan for pan, _ in found] == [-2, -1, 0, 1, 2, 2]
    assert [tilt for _, tilt in found] == pytest.approx([radians(-45.0)] * 5 + [radians(-22.5)])
    assert {s.artefact for s in bars} == {"bar"}
    assert not any(s.deformation for s in bars)


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("count = 25", "count = 23", "ask for"),
        ("pan_deg = [-45, 45]", "pan_deg = [45, -45]", "lower end first"),
        ('artefact = "bar"\ncount', 'artefact = "rod"\ncount', "the artefact rod"),
        ("tilt_deg = [-45, 45]", "tilt_deg = [-45, 45]\ntripod = {}", "leave it out"),
    ],
)
def test_poses_that_cannot_be_are_refused(old: str, new: str, why: str) -> None:
    assert old in SESSION
    with pytest.raises(ConfigurationError, match=why):
        parsed(SESSION.replace(old, new, 1))


def test_boards_are_placed_one_by_one_and_a_bar_is_mounted_once() -> None:
    by_hand = turns(parsed(SESSION).states)
    assert by_hand[:2] == [Turn("B01: place the chess", ("B01",)), Turn("B02: place the chess", ("B02",))]
    assert by_hand[2].by_hand == "S01: mount the bar on the stage"
    assert len(by_hand) == 3
    assert len(by_hand[2].labels) == 25
    assert turns(parsed(TEST).states) == [Turn("", ("S00", "S00.2", "S00.3", "S01"))]
    assert turns(()) == []


def test_each_state_is_a_turn_of_its_own_where_somebody_presses_a_key() -> None:
    states = ("S00", "S00.2", "S00.3", "S01")
    assert turns(parsed(TEST).states, at_key=True) == [Turn(f"{one} is next", (one,)) for one in states]
    poses = [turn.by_hand for turn in turns(parsed(SESSION).states, at_key=True)]
    assert poses[:3] == ["B01: place the chess", "B02: place the chess", "S01: mount the bar on the stage"]
    assert poses[3:] == [f"S{number:02d} is next" for number in range(2, 26)]
