"""The texts of OpenCV's FileStorage are read as OpenCV writes them, and hostile ones do no harm."""

from __future__ import annotations

import random
from pathlib import Path

import cv2
import numpy as np
import pytest

from sms_jobs.errors import ConfigurationError, NotFound
from sms_jobs.formats.interchange.found_sensors import numbers
from sms_jobs.formats.interchange.opencv_text import parse_storage
from sms_jobs.formats.interchange.text_files import LARGEST_FILE_BYTES, read_text

DIALECTS = ["yml", "xml", "json"]
AWKWARD = 'a "b" <c> & d\\e: ü\n2, {x} [y] it\'s # no'


def storage(dialect: str) -> cv2.FileStorage:
    return cv2.FileStorage(f".{dialect}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_what_opencv_writes_is_read(dialect: str, rng: np.random.Generator) -> None:
    matrix = rng.normal(0.0, 1.0, (3, 3)) * 10.0 ** rng.integers(-300, 300, (3, 3))
    file = storage(dialect)
    file.write("awkward", AWKWARD)
    for name, word in (("word", "two words"), ("number_in_quotes", "12"), ("empty", "")):
        file.write(name, word)
    file.write("whole", -7)
    file.write("real", 0.1)
    file.writeComment("said beside")
    file.startWriteStruct("table", cv2.FileNode_MAP)
    file.write("matrix", matrix)
    file.write("single", np.full((1, 3), 0.1, np.float32))
    file.endWriteStruct()
    file.startWriteStruct("list", cv2.FileNode_SEQ | cv2.FileNode_FLOW)
    for value in (1.5, -2.0, 3e-7):
        file.write("", value)
    file.endWriteStruct()
    file.startWriteStruct("flow", cv2.FileNode_MAP | cv2.FileNode_FLOW)
    file.write("a", 1.0)
    file.write("b", "c d")
    file.endWriteStruct()
    file.startWriteStruct("matrices", cv2.FileNode_SEQ)
    file.write("", np.eye(2))
    file.write("", np.eye(3))
    file.endWriteStruct()
    file.startWriteStruct("tables", cv2.FileNode_SEQ)
    for k in range(2):
        file.startWriteStruct("", cv2.FileNode_MAP)
        file.write("k", k)
        file.endWriteStruct()
    file.endWriteStruct()
    found = parse_storage(file.releaseAndGetString(), f"file.{dialect}")
    assert found["awkward"] == AWKWARD
    assert (found["word"], found["number_in_quotes"], found["empty"]) == ("two words", "12", "")
    assert (found["whole"], found["real"]) == (-7, 0.1)
    # OpenCV writes 17 digits, so doubles come back bit for bit; and 9 digits of a single.
    np.testing.assert_array_equal(numbers(found["table"]["matrix"], "matrix"), matrix)
    np.testing.assert_array_equal(
        np.float32(numbers(found["table"]["single"], "single")), np.float32([[0.1] * 3])
    )
    assert found["list"] == [1.5, -2.0, 3e-7]
    assert found["flow"] == {"a": 1.0, "b": "c d"}
    np.testing.assert_array_equal(numbers(found["matrices"][1], "second"), np.eye(3))
    assert found["tables"] == [{"k": 0}, {"k": 1}]


def test_yaml_as_others_write_it() -> None:
    text = """%YAML:1.0
# ROS writes tables without a tag
image_width: 640   # px
camera_name: 'it''s left'
camera_matrix:
  rows: 1
  cols: 3
  data: [1, 2.5,
         .5e1]
items:
- a: 1
  b: x
-
  a: 2
- [3, "4"]
nothing:
"""
    assert parse_storage(text, "left.yaml") == {
        "image_width": 640,
        "camera_name": "it's left",
        "camera_matrix": {"rows": 1, "cols": 3, "data": [1, 2.5, 5.0]},
        "items": [{"a": 1, "b": "x"}, {"a": 2}, [3, "4"]],
        "nothing": "",
    }


def refusal(text: str, name: str) -> str | None:
    """Return why a text is refused; None where it is read."""
    try:
        parse_storage(text, name)
    except ConfigurationError as error:
        return str(error)
    return None


def test_damaged_files_are_refused_in_one_sentence() -> None:
    # OpenCV's own reader ends the process on some of these; ours says what is wrong or reads what is left.
    generator = random.Random(5)
    pieces = [*"[]{}:\"'<>&#\n\t", "- ", "  ", "</", "!!", "<!--", "1e999"]
    refusals = []
    for dialect in DIALECTS:
        file = storage(dialect)
        file.write("M1", np.eye(3))
        file.write("word", "it's")
        text = file.releaseAndGetString()
        for _ in range(400):
            letters = list(text)
            for _ in range(generator.randint(1, 6)):
                place = generator.randrange(len(letters))
                if generator.random() < 0.4:
                    del letters[place : place + generator.randint(1, 20)]
                else:
                    letters.insert(place, generator.choice(pieces))
            refusals.append(refusal("".join(letters), f"file.{dialect}"))
    said = [why for why in refusals if why is not None]
    assert len(said) > 300
    assert all("file." in why for why in said)


LONG = 300_000
HOSTILE = {
    "brackets.yml": "%YAML:1.0\nA: " + "[" * LONG,
    "brackets_in_lines.yml": "%YAML:1.0\nA: [" + "[\n" * LONG,
    "dashes.yml": "%YAML:1.0\n" + "- " * LONG,
    "quotes.yml": '%YAML:1.0\na: "' + '\\"' * LONG,
    "apostrophes.yml": "%YAML:1.0\n" + " 'a" * LONG,
    "blanks.yml": "%YAML:1.0\na: [" + " " * LONG,
    "words.yml": "%YAML:1.0\n" + "a " * LONG,
    "names.yml": "%YAML:1.0\n" + "a:\n" * LONG,
    "colons.yml": "%YAML:1.0\n" + "a" + " " * LONG + ":b",
    "braces.json": '{"a":' * LONG,
    "comments.json": "{" + "/*" * LONG,
    "digits.json": '{"a": ' + "9" * LONG + "}",
    "elements.xml": "<opencv_storage>" + "<a>" * LONG,
    "words.xml": "<opencv_storage><a>" + '"' * LONG + "</a></opencv_storage>",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_texts_cost_no_time(name: str) -> None:
    # Reading is linear in the letters, 0.1 s for these; anything quadratic would not come to an end.
    why = refusal(HOSTILE[name], name)
    if name in ("digits.json", "words.xml", "quotes.yml"):
        assert why is None  # odd, and harmless
    else:
        assert why is not None
        assert name in why
        assert len(why) < 300


def test_a_number_that_is_beyond_all_numbers_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="not finite"):
        numbers(parse_storage(HOSTILE["digits.json"], "digits.json")["a"], "a")


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    path = tmp_path / "hall.yml"
    with pytest.raises(NotFound, match=r"there is no calibration file .*hall\.yml"):
        read_text(path, "calibration file")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_text(tmp_path, "calibration file")
    path.write_bytes(b"\xff\xfe%YAML")
    with pytest.raises(ConfigurationError, match="not UTF-8"):
        read_text(path, "calibration file")
    path.write_bytes(b"#" * (LARGEST_FILE_BYTES + 1))
    with pytest.raises(ConfigurationError, match="larger than the 1048576 bytes"):
        read_text(path, "calibration file")
