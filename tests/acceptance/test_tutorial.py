"""The tutorial says what happens: each of its commands is run, and prints what stands there."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.console import alike, sections, shell

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
SECTIONS = sections((ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8"))
QUICK = "Boards become a calibration"
"""The section that every run of the tests goes through; the others take a minute and more."""

pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"put the published images into {DATA} for the tutorial"
)


def test_the_tutorial_has_its_four_ways() -> None:
    assert len(SECTIONS) == 4
    assert QUICK in SECTIONS


def walk(heading: str, folder: Path) -> None:
    """Type the commands of a section, and compare each answer with the document's."""
    (folder / "data").symlink_to(DATA)
    with shell(folder) as screen:
        for command in SECTIONS[heading]:
            printed = screen.run(command.text)
            said = "\n".join(command.printed)
            assert alike(command.printed, printed), (
                f"$ {command.text}\n{printed}\n--- but it says ---\n{said}"
            )


def test_boards_become_a_calibration(tmp_path: Path) -> None:
    walk(QUICK, tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("heading", [h for h in SECTIONS if h != QUICK])
def test_the_longer_ways(heading: str, tmp_path: Path) -> None:
    walk(heading, tmp_path)
