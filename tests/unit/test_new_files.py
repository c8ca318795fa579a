"""A file that a person names is written whole or not at all, and what is no file is never replaced."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sms_jobs.app.writing import check_new_file, new_file, new_folder, write_file
from sms_jobs.errors import Conflict, InvalidInput


def odd(folder: Path) -> list[Path]:
    os.mkfifo(folder / "pipe")
    (folder / "folder").mkdir()
    (folder / "device").symlink_to("/dev/null")
    (folder / "loop").symlink_to("loop")
    (folder / "dangling").symlink_to("nowhere")
    (folder / "empty").touch()
    names = (
        "pipe",
        "folder",
        "device",
        "loop",
        "dangling",
        "empty/below",
        "missing/below",
        "a" * 300,
        "a\x00b",
    )
    return [folder / name for name in names]


def test_what_cannot_become_a_file_is_refused_before_any_work(tmp_path: Path) -> None:
    for out in odd(tmp_path):
        for force in (False, True):
            with pytest.raises(InvalidInput):
                check_new_file(out, force)
    before = sorted(tmp_path.iterdir())
    for out in odd_again(tmp_path):
        with pytest.raises(InvalidInput):
            write_file(out, "text", force=True)
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "device").readlink() == Path("/dev/null")


def odd_again(folder: Path) -> list[Path]:
    return [
        folder / name for name in ("pipe", "folder", "device", "loop", "dangling", "empty/below", "a" * 300)
    ]


def test_an_error_leaves_what_was_there(tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    out.write_text("precious")
    with pytest.raises(Conflict, match="set `force`"):
        write_file(out, "text", force=False)
    with pytest.raises(ZeroDivisionError):
        _half_written(out)
    assert out.read_text() == "precious"
    write_file(out, "whole \u00e4", force=True)
    assert out.read_bytes() == "whole \u00e4".encode()
    assert list(tmp_path.iterdir()) == [out]


def _half_written(out: Path) -> None:
    with new_file(out, force=True) as part:
        assert part.suffix == out.suffix
        part.write_text("half")
        raise ZeroDivisionError


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    for name in ("file", "file/below", "loop/below", "a" * 300):
        with pytest.raises(InvalidInput, match="the folder"):
            new_folder(tmp_path / name)
