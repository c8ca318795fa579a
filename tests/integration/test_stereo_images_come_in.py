"""Images of two cameras are imported as a person does it: every command then tells what there is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.command import answer, inside

STATES = ("00", "01", "02")
RECORDED = {f"panel/{state}/{camera}" for state in STATES for camera in ("C1", "C2")}
USAGE = 2
PLAN = """
name = "planned"
rig = "pair"
views = ["C1C2"]

[specimen]
name = "panel"

[[states]]
label = "00"
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a home with a campaign of two cameras that look at one speckle pattern."""
    folder = tmp_path_factory.mktemp("images")
    levels = np.random.default_rng(5).integers(0, 256, (2, len(STATES), 40, 60)).astype(np.uint8)
    for name, images in zip(("left", "right"), levels, strict=True):
        for state, image in zip(STATES, images, strict=True):
            Image.fromarray(image).save(folder / f"{name}_{state}.png")
    made = tmp_path_factory.mktemp("stereo") / "home"
    assert inside("init", "--home", str(made)).returncode == 0
    cameras = ("--cameras", "left=C1 right=C2", "--rig", "pair", "--yes")
    told = run(made, "import", "images", str(folder), "-c", "panel", *cameras)
    assert {f"panel/{t['state']}/{t['view']}" for t in told["tuples"]} == RECORDED
    return made


def run(home: Path, *arguments: str) -> Any:
    return answer(*arguments, "--home", str(home))


def found(home: Path, query: str = "measurement") -> set[str]:
    return {one["subject"] for one in run(home, "data", "find", query, "-c", "panel")}


def test_the_campaign_has_one_view_and_each_image_once(home: Path) -> None:
    assert run(home, "campaign", "show", "panel")["campaign"]["views"] == ["C1C2"]
    shown = inside("campaign", "show", "panel", "--home", str(home)).stdout
    assert "C1C2" in shown
    assert "fringes" not in shown
    assert found(home) == RECORDED
    assert found(home, "measurement where camera = C2") == {s for s in RECORDED if s.endswith("C2")}


def test_its_states_are_recorded_and_judged_by_nobody(home: Path) -> None:
    states = run(home, "acquire", "show", "panel")
    told = [(s["label"], s["recording"], s["views"], s["judged"]) for s in states]
    assert told == [(label, "recorded", 2, 0) for label in STATES]


def test_what_needs_a_projector_says_so(home: Path) -> None:
    refused = inside("job", "submit", "reconstruct", "-c", "panel", "--home", str(home))
    assert refused.returncode == USAGE
    assert "3 states measured by C1C2 without a projector" in " ".join(refused.stderr.split())


def test_a_plan_of_cameras_alone_goes_on_with_an_import(home: Path, tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(PLAN)
    made = inside("campaign", "create", str(plan), "--home", str(home))
    assert made.returncode == 0, made.stderr
    assert "next: sms import images FOLDER --campaign planned" in " ".join(made.stderr.split())


def test_it_travels_whole(home: Path, tmp_path: Path) -> None:
    run(home, "data", "pack", "-c", "panel", "--to", str(tmp_path / "bag"))
    assert inside("init", "--home", str(tmp_path / "other")).returncode == 0
    run(tmp_path / "other", "data", "unpack", str(tmp_path / "bag"))
    assert found(tmp_path / "other") == RECORDED


def test_its_catalogue_is_rebuilt_from_its_files(home: Path, tmp_path: Path) -> None:
    rebuilt = tmp_path / "rebuilt"
    assert inside("init", "--home", str(rebuilt)).returncode == 0
    (rebuilt / "archive").rename(tmp_path / "empty")
    (rebuilt / "archive").symlink_to(home / "archive")
    run(rebuilt, "archive", "reindex")
    assert found(rebuilt) == RECORDED
    assert run(rebuilt, "campaign", "show", "panel")["campaign"]["views"] == ["C1C2"]
