"""`sms calibration export` and `import`, as a person runs them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from support.command import answer, inside

WRONG = Path(__file__).parent / "wrong_calibrations"
SINCE = "2026-05-04T10:00:00+02:00"
SAID = ("--rig", "desk", "--valid-from", SINCE, "--volume", "-200", "-200", "500", "200", "200", "900")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with calibration 1 of rig desk, from a file in SLStudio's layout."""
    folder = tmp_path_factory.mktemp("interchange")
    home = folder / "home"
    assert inside("init", "--home", str(home)).returncode == 0
    storage = cv2.FileStorage(str(folder / "desk.xml"), cv2.FILE_STORAGE_WRITE)
    for name, focal in (("Kc", 2195.0), ("Kp", 2601.0)):
        storage.write(name, np.array([[focal, 0.0, 843.5], [0.0, focal, 675.5], [0.0, 0.0, 1.0]]))
    for name, value in (("kc", -0.058), ("kp", -0.031)):
        storage.write(name, np.array([[value, 0.0, 0.0, 0.0, 0.0]]))
    storage.write("Rp", cv2.Rodrigues(np.array([0.1, 0.2, 0.1]))[0])
    storage.write("Tp", np.array([[-145.0], [-36.0], [68.0]]))
    for name, side in (
        ("frameWidth", 1688),
        ("frameHeight", 1352),
        ("screenResX", 1824),
        ("screenResY", 1140),
    ):
        storage.write(name, side)
    storage.write("stereo_error", 0.42)
    storage.release()
    found = answer("calibration", "import", str(folder / "desk.xml"), *SAID, "--home", str(home))
    assert found["new"] is True
    assert found["sensors"] == ["C1", "P1"]
    assert found["valid_from"] == "2026-05-04T08:00:00+00:00"
    first, second = found["remarks"]
    assert first == f"not taken over from {folder / 'desk.xml'}: stereo_error"
    assert second == (
        f"{folder / 'desk.xml'} says no unit of length: taken for mm, C1 and P1 are 164.1 mm apart; "
        "`unit_mm` gives another"
    )
    return home


def contents(home: Path) -> set[str]:
    return {str(path.relative_to(home)) for path in (home / "archive").rglob("*") if path.is_file()}


def test_what_goes_out_is_known_when_it_comes_back(made: Path, tmp_path: Path) -> None:
    style = "opencv-json"
    before = contents(made)
    out = tmp_path / "out.json"
    told = answer("calibration", "export", "1", "--as", style, "--out", str(out), "--home", str(made))
    assert told == {"schema": 1, "calibration": 1, "style": style, "file": str(out), "remarks": []}
    again = answer("calibration", "import", str(out), "--home", str(made))
    assert (again["calibration"], again["new"]) == (1, False)
    assert contents(made) == before


def test_the_thesiss_parameters_become_a_calibration_of_their_own(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "desk.xml"
    done = inside("calibration", "export", "1", "--as", "thesis-xml", "--out", str(out), "--home", str(made))
    assert done.returncode == 0, done.stderr
    assert "C1: distortion carried over within" in done.stderr
    done = inside("calibration", "import", str(out), "--rig", "thesis", "--home", str(made))
    assert done.returncode == 0, done.stderr
    assert "of rig thesis (C1 P1) is entered" in done.stderr
    (listed,) = answer("calibration", "list", "--rig", "thesis", "--home", str(made))
    back = tmp_path / "back.json"
    answer(
        "calibration",
        "export",
        str(listed["id"]),
        "--as",
        "opencv-json",
        "-o",
        str(back),
        "--home",
        str(made),
    )
    storage = cv2.FileStorage(str(back), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("P1").getNode("camera_matrix").mat()
    storage.release()
    # Millimetres and back: a few roundings.
    np.testing.assert_allclose(matrix, [[2601.0, 0, 843.5], [0, 2601.0, 675.5], [0, 0, 1]], rtol=1e-12)


def test_a_second_calibration_of_a_rig_waits_for_a_word(made: Path, tmp_path: Path) -> None:
    out, at = tmp_path / "next.json", ("--home", str(made))
    assert answer("calibration", "export", "1", "--out", str(out), *at)["style"] == "opencv-json"
    later = ("--valid-from", "2026-05-05T10:00:00+02:00")
    told = " ".join(inside("calibration", "import", str(out), *later, *at).stderr.split())
    number = told.split()[1]
    assert f"inactive, since the rig has another in use: 'sms calibration accept {number}' takes it" in told
    (waiting,) = answer("calibration", "list", "--inactive", *at)
    assert (str(waiting["id"]), waiting["in_use"], waiting["campaigns"]) == (number, False, [])
    listed = inside("calibration", "list", "--rig", "desk", *at)
    assert "inactive" in listed.stdout
    assert f"calibration {number} is inactive; 'sms calibration accept {number}'" in listed.stderr
    accepted = inside("calibration", "accept", number, *at)
    assert f"calibration {number} is used for rig desk from 2026-05-05" in " ".join(accepted.stderr.split())
    assert answer("calibration", "accept", number, *at)["new"] is False
    assert answer("calibration", "list", "--inactive", *at) == []
    assert answer("calibration", "withdraw", number, *at)["in_use"] is False
    assert inside("calibration", "accept", number, "-c", "nobody", *at).returncode == 3
    larger = tmp_path / "larger.json"
    larger.write_text(out.read_text().replace("1688", "1700"))
    before = contents(made)
    refused = inside("calibration", "import", str(larger), *at)
    assert refused.returncode == 4
    assert "C1 (1700 x 1352 px)" in " ".join(refused.stderr.split())
    assert "a rig with other sensors needs a name of its own" in " ".join(refused.stderr.split())
    assert contents(made) == before


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("accept", "99"), 3, "there is no calibration 99"),
        (("import", str(WRONG / "skew.yml"), *SAID), 2, "350 px, 0.2 of fx, allowed is 0.1 of fx"),
        (("import", "no-such-file.yml", *SAID), 3, "there is no calibration file no-such-file.yml"),
        (("import", str(WRONG / "skew.yml"), "--size", "P1=big"), 2, "as in P1=1920x1080, not 'P1=big'"),
        (("export", "99", "--as", "opencv-yaml", "--out", "x.yml"), 3, "99"),
        (("export", "1", "--as", "matlab", "--out", "x.m"), 2, "the style should be one of opencv-yaml"),
        (("export", "1", "--as", "opencv-yaml", "--out", "x.json"), 2, "must end in .yml or .yaml"),
        (
            ("export", "1", "--out", "x.xml"),
            2,
            "or thesis-xml; say which, as in 'sms calibration export NUMBER --as",
        ),
        (("export", "1", "--out", "x.m"), 2, "opencv-json (*.json)"),
        (("export", "1", "--as", "opencv-yaml", "--out", str(WRONG / "skew.yml")), 4, "set --force"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_wrong_input_changes_nothing(arguments: tuple[str, ...], code: int, words: str, made: Path) -> None:
    before = contents(made)
    done = inside("calibration", *arguments, "--home", str(made))
    assert done.returncode == code, done.stderr
    assert words in " ".join(done.stderr.split())
    assert done.stderr.count("error:") == 1
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert contents(made) == before


def test_the_help_has_examples() -> None:
    for name, example in (("import", "intrinsics.yml"), ("accept", "3")):
        assert f"Example: sms calibration {name} {example}" in inside("calibration", name, "--help").stdout


def test_the_plan_of_a_campaign_is_kept_letter_by_letter(made: Path, tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "configuration.md").read_text(encoding="utf-8")
    text = page.partition("```xml\n")[2].partition("```")[0].replace("plate 7", "Blech 7, 20 \u00b0C")
    path = tmp_path / "plate.xml"
    path.write_bytes(text.encode())
    assert answer("campaign", "create", str(path), "--home", str(made))["views"] == ["C1P1", "C2P1"]
    assert inside("campaign", "show", "plate-tension", "--plan", "--home", str(made)).stdout == text
    assert answer("campaign", "show", "plate-tension", "--home", str(made))["plan"] == text
