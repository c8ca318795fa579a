"""Files of strangers are read within limits of size, depth, memory and time."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from sms_jobs.errors import ConfigurationError, InvalidInput
from sms_jobs.formats.foreign_meshes import read_node_fields
from sms_jobs.formats.gauge_descriptions import read_gauge_file
from sms_jobs.formats.importers.board_points import read_points
from sms_jobs.formats.importers.readings import read_table
from sms_jobs.formats.interchange.text_files import read_text
from sms_jobs.formats.masks import region_of_mask
from sms_jobs.formats.written_files import read_toml


@pytest.mark.parametrize("text", [".".join(["a"] * 20_000) + " = 1", "[" + ".".join(["a"] * 20_000) + "]"])
def test_keys_of_thousands_of_parts_are_refused_at_once(text: str) -> None:
    before = time.process_time()
    with pytest.raises(ConfigurationError, match="a key with more than 24 parts"):
        read_toml(text, "plan.toml")
    # The parser alone takes 20 s and more.
    assert time.process_time() - before < 5.0


def test_a_dotted_text_is_no_key() -> None:
    text = 'a.b."c.d" = "' + ".".join(["a"] * 50) + '"\n[x.y]\nz = 1.5'
    content, _ = read_toml(text, "plan.toml")
    assert content["x"] == {"y": {"z": 1.5}}


def test_numbers_of_thousands_of_digits_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="not valid TOML"):
        read_toml("a = " + "9" * 5_000, "plan.toml")


def test_cells_without_end_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("state,gauge,microstrain\nS00," + "1" * 200_000 + ",1\n")
    for read in (read_table, read_gauge_file):
        with pytest.raises(InvalidInput, match="cannot be read as a table"):
            read(path)
    path.write_text("state,board_x_mm,board_y_mm,camera_x_px,camera_y_px\n" + "1" * 200_000)
    with pytest.raises(InvalidInput, match="cannot be read as a table"):
        read_points(path, "C1", 0.1)


@pytest.mark.parametrize("letter", ["\x1b", "\x9b", "\x00", "\u202e"])
def test_a_text_that_steers_a_terminal_is_refused(letter: str, tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(f"# a comment {letter}[2J")
    with pytest.raises(ConfigurationError, match="no letter that can be printed"):
        read_text(path, "campaign file")


@pytest.mark.parametrize("content", [b"", b"P5 99999999 99999999 255\n", b"\x89PNG"])
def test_masks_that_are_empty_or_giant_are_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "mask.pgm"
    path.write_bytes(content)
    with pytest.raises(InvalidInput, match=r"mask\.pgm"):
        region_of_mask(path)


@pytest.mark.parametrize(
    "content",
    [b"ply", b"ply\nformat ascii 1.0\nelement vertex 10000000000000\nproperty float x\nend_header\n"],
)
def test_meshes_that_never_end_or_ask_for_terabytes_are_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "field.ply"
    path.write_bytes(content)
    with pytest.raises(InvalidInput, match="cannot be read as a mesh"):
        read_node_fields(path)
