"""The demo: what it prints, how near it comes to the exact truth, and that it can be run again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient
from support.command import answer, inside

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demo")


@pytest.fixture(scope="module")
def first(folder: Path) -> Any:
    """What the demo prints in an empty folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("SMS_HOME", raising=False)
        return answer("demo", "--out", str(folder), timeout=900.0)


def test_it_says_what_it_did(first: Any) -> None:
    assert first["schema"] == 1
    assert first["campaign"] == "top-hat-small"
    # Of the calibration: 31 poses recorded, 6 x 4 views of the board and 25 x 4 of the bar observed, and two
    # adjustments. Of the test: 4 acquisitions, 16 shapes, 12 displacement and 12 strain fields, 3 merges,
    # 3 exports of 6 files each, 16 assessments and the report.
    assert first["jobs"] == {"succeeded": 157 + 67, "failed": 0, "reused": 0}
    assert Path(first["report"]).is_file()
    assert len(first["exports"]) == 18
    assert all(Path(path).is_file() for path in first["exports"])


def test_it_is_as_accurate_as_it_claims(first: Any) -> None:
    # The product's own promise for the small size: a ten-thousandth of the volume's diagonal, over all valid
    # pixels, and valid wherever the truth says that a pixel is seen and lit, in nine of ten cases.
    assert first["shape_rms_mm"] <= first["volume_diagonal_mm"] / 10_000
    assert first["displacement_rms_mm"] <= first["volume_diagonal_mm"] / 10_000
    assert first["displacement_relative"] == pytest.approx(
        first["displacement_rms_mm"] / first["volume_diagonal_mm"]
    )
    assert first["valid_fraction"] >= 0.9
    assert first["strain_rms_microstrain"] > 0


def test_it_measures_with_a_calibration_that_proves_itself(first: Any) -> None:
    calibration = first["calibration"]
    # The target for lengths that took no part, and what the calibration says of itself: the error of points
    # through the volume is one draw of about as many degrees of freedom as the gauge and the lenses have, so
    # three times what is expected would be a wrong covariance.
    assert calibration["held_out_bar_relative"] <= 1.0 / 20_000
    assert calibration["point_error_rms_mm"] <= 3.0 * calibration["expected_point_rms_mm"]
    assert calibration["expected_point_rms_mm"] <= first["volume_diagonal_mm"] / 100_000


def test_again_in_the_same_folder_every_result_is_reused(first: Any, folder: Path) -> None:
    again = answer("demo", "--out", str(folder), timeout=300.0)
    assert again["jobs"] == {"succeeded": 224, "failed": 0, "reused": 224}
    for same in (
        "calibration",
        "report",
        "exports",
        "shape_rms_mm",
        "displacement_rms_mm",
        "strain_rms_microstrain",
    ):
        assert again[same] == first[same]


def test_the_archive_can_be_asked_afterwards(first: Any, folder: Path, tmp_path: Path) -> None:
    home = ("--home", str(folder))
    (strain,) = answer("data", "find", "--kind", "strain", "--state", "S02", "--view", "C1P1", *home)
    shown = answer("data", "show", str(strain["id"]), *home)
    assert shown["records"]["strain"]["strain"]["shape"] == [3, 512, 512]
    assert shown["statistics"]
    ancestors = answer("data", "tree", str(strain["id"]), *home)
    sources = str(ancestors)
    assert all(source in sources for source in ("correlate", "reconstruct", "measurement", "calibration"))
    picture = tmp_path / "strain.png"
    done = inside(
        "data", "plot", str(strain["id"]), "--field", "strain", "--component", "xx", "-o", str(picture), *home
    )
    assert done.returncode == 0, done.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_report_stands_alone(first: Any) -> None:
    page = Path(first["report"]).read_text(encoding="utf-8")
    assert "data:image/png;base64," in page
    assert 'src="http' not in page
    assert 'href="http' not in page
    for word in ("top-hat-small", "S03", "C1", "strain", "mm"):
        assert word in page


def test_the_notebook_shows_the_demo_with_its_uncertainty(
    first: Any, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SMS_HOME", str(folder))
    # Pictures go into the notebook, as they do where somebody looks at it.
    monkeypatch.delenv("MPLBACKEND")
    notebook = nbformat.read(ROOT / "docs" / "demo.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "leave out what the notebook printed"
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    given = [one for cell in notebook.cells for one in cell.get("outputs", [])]
    assert sum("image/png" in one.get("data", {}) for one in given) == 3
    said = "".join(one.get("text", "") for one in given)
    assert said.count("median standard deviation") == 3
    assert first["campaign"] in said
