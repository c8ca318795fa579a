"""What is wrong with imports ends in one clear sentence, and nothing of it is in catalogue or archive."""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from support.homes import initialised
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.catalogue import campaigns
from sms_jobs.cli.importing.group import app
from sms_jobs.errors import NotFound, SmsError
from sms_jobs.jobs.archiving.registration import register_calibration
from sms_jobs.virtual_rig.campaigns import small_plate
from tests.support.foreign_frames import fringes, save

Spoil = Callable[[Path], None]
USUAL = ("--densities", "16 1", "--steps", "3", "--rig", "desk")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("home")
    initialised(folder)
    return folder


def frame(folder: Path, number: int) -> Path:
    return folder / "S00" / f"frame_{number:02d}.png"


def cut(path: str, part: float = 0.6) -> Spoil:
    def spoil(folder: Path) -> None:
        file = folder / path
        content = file.read_bytes()
        file.write_bytes(content[: int(part * len(content))])

    return spoil


def cut_as(suffix: str) -> Spoil:
    def spoil(folder: Path) -> None:
        frame(folder, 3).unlink()
        save(folder / "S00", fringes()[3:4], f"frame_{{:02d}}.{suffix}", 3)
        cut(f"S00/frame_03.{suffix}", 0.9)(folder)

    return spoil


def content(path: str, data: bytes) -> Spoil:
    return lambda folder: (folder / path).write_bytes(data) and None


def removed(*numbers: int) -> Spoil:
    def spoil(folder: Path) -> None:
        for number in numbers:
            frame(folder, number).unlink()

    return spoil


def replaced(image: Image.Image, name: str = "frame_03.tif", **options: object) -> Spoil:
    def spoil(folder: Path) -> None:
        frame(folder, 3).unlink()
        image.save(folder / "S00" / name, **options)

    return spoil


def resaved(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    def spoil(folder: Path) -> None:
        file = str(frame(folder, 2))
        cv2.imwrite(file, change(cv2.imread(file, cv2.IMREAD_UNCHANGED)))

    return spoil


def copied(source: str, target: str) -> Spoil:
    return lambda folder: (folder / target).write_bytes((folder / source).read_bytes()) and None


def linked(target: Callable[[Path], Path]) -> Spoil:
    def spoil(folder: Path) -> None:
        outside = folder.parent / "outside.png"
        outside.write_bytes(frame(folder, 1).read_bytes())
        frame(folder, 1).unlink()
        frame(folder, 1).symlink_to(target(folder))

    return spoil


def pipe(folder: Path) -> None:
    frame(folder, 1).unlink()
    os.mkfifo(frame(folder, 1))


def folder_for_a_file(folder: Path) -> None:
    frame(folder, 1).unlink()
    frame(folder, 1).mkdir()


def emptied(folder: Path) -> None:
    for file in (folder / "S00").iterdir():
        file.unlink()


def huge(folder: Path) -> None:
    """Write a PNG that says that it is 60,000 px square, in some bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    frame(folder, 2).write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b""))
        + chunk(b"IEND", b"")
    )


def as_raw(size: int, level: int = 5) -> Spoil:
    def spoil(folder: Path) -> None:
        emptied(folder)
        for number in range(6):
            levels = np.full(size // 2, level + number, "<u2")
            (folder / "S00" / f"frame_{number:02d}.raw").write_bytes(levels.tobytes())

    return spoil


def as_dark_16_bits(folder: Path) -> None:
    emptied(folder)
    save(folder / "S00", fringes(), dtype=np.uint16)


def written(name: str, text: str) -> Spoil:
    return lambda folder: (folder.parent / name).write_text(text, encoding="utf-8") and None


def nothing(folder: Path) -> None:
    del folder


GREY = Image.fromarray(np.zeros((24, 40), np.uint8))
RAW = ("--pattern", "{state}/frame_{number}.raw", *USUAL)
PNG = ("--pattern", "{state}/frame_{number}.png", *USUAL)
ANY = ("--pattern", "{state}/frame_{number}.*", *USUAL)
LAYOUT = ("--rig", "desk", "--layout", "../layout.toml")
SEQUENCE = "[sequence]\ndensities = [16, 1]\nsteps = 3\n"

CASES: dict[str, tuple[Spoil, tuple[str, ...], str]] = {
    # Files
    "truncated PNG": (cut("S00/frame_02.png"), PNG, "frame_02.png is no image, or is damaged"),
    "PNG cut to its header": (cut("S00/frame_02.png", 0.02), PNG, "frame_02.png is no image, or is damaged"),
    "truncated TIFF": (cut_as("tif"), ANY, "frame_03.tif is no image, or is damaged"),
    "truncated JPEG": (cut_as("jpg"), ANY, "frame_03.jpg is no image, or is damaged"),
    "empty file": (content("S00/frame_02.png", b""), PNG, "frame_02.png is empty"),
    "text for an image": (content("S00/frame_02.png", b"no image\n" * 9), PNG, "frame_02.png is no image"),
    "mixed sizes": (resaved(lambda i: i[:20]), PNG, "different sizes"),
    "mixed depths": (resaved(lambda i: i.astype(np.uint16) * 256), PNG, "different depths"),
    "several pages": (replaced(GREY, save_all=True, append_images=[GREY]), ANY, "has 2 pages"),
    "floating point": (replaced(Image.fromarray(np.zeros((24, 40), np.float32))), ANY, "of the kind 'F'"),
    "32 bits": (replaced(Image.fromarray(np.full((24, 40), 99_999, np.int32))), ANY, "of the kind 'I'"),
    "CMYK": (replaced(GREY.convert("CMYK"), "frame_03.jpg"), ANY, "of the kind 'CMYK'"),
    "far too large": (huge, PNG, "is larger than the 128 Mpx"),
    "one frame twice": (copied("S00/frame_01.png", "S00/frame_1.png"), PNG, "are the same frame"),
    "two formats of a frame": (copied("S00/frame_01.png", "S00/frame_01.bmp"), ANY, "are the same frame"),
    "same content": (copied("S00/frame_01.png", "S00/frame_02.png"), PNG, "have the same content"),
    "above full scale": (nothing, (*PNG, "--full-scale", "50"), "above the full scale 50"),
    # Names and numbers
    "missing step": (removed(4), PNG, "frames 4 are missing of 6"),
    "missing first step": (removed(0), PNG, "frames 6 are missing of 6"),
    "missing many": (removed(1, 2, 3, 4), PNG, "frames 1, 2, 3, 4 are missing"),
    "too many frames": (copied("S00/frame_01.png", "S00/frame_17.png"), PNG, "frames 17 are more than"),
    "link that leaves": (linked(lambda f: f.parent / "outside.png"), PNG, "frames 1 are missing"),
    "link to nowhere": (linked(lambda f: f / "gone.png"), PNG, "frames 1 are missing"),
    "link to itself": (linked(lambda f: frame(f, 1)), PNG, "frames 1 are missing"),
    "pipe": (pipe, PNG, "frames 1 are missing"),
    "folder for a file": (folder_for_a_file, PNG, "frames 1 are missing"),
    "odd file name": (
        lambda f: frame(f, 1).rename(f / "S00" / "frame_\n01.png") and None, PNG, "frames 1 are missing",
    ),
    "state that is no label": (
        lambda f: (f / "S00").rename(f / "load 1") and None, PNG, "cannot be the name of a state",
    ),
    "empty folder": (emptied, PNG, "has no image among 0 files"),
    "nothing fits": (nothing, ("--pattern", "{state}/image_{number}.png", *USUAL), "fits the pattern"),
    # Patterns
    "pattern that climbs": (nothing, ("--pattern", "../{state}/{number}.png", *USUAL), "leaves the folder"),
    "absolute pattern": (nothing, ("--pattern", "/etc/{number}.png", *USUAL), "leaves the folder"),
    "unknown placeholder": (nothing, ("--pattern", "{stat}/{number}.png", *USUAL), r"has \{stat\}; known"),
    "placeholder twice": (nothing, ("--pattern", "{number}/{number}.png", *USUAL), r"has \{number\} twice"),
    "half a brace": (nothing, ("--pattern", "{state}/{number.png", *USUAL), "without its other half"),
    "nothing tells frames": (nothing, ("--pattern", "{state}/*.png", *USUAL), r"needs \{number\}"),
    "frame said twice": (
        nothing, ("--pattern", "{state}/{step}_{number}.png", *USUAL), "must be said once",
    ),
    "camera without projector": (nothing, ("--pattern", "{camera}/{number}.png", *USUAL), "needs both"),
    # Options
    "no view": (nothing, (*PNG, "--view", "X1"), "'X1' is not a view"),
    "densities unknown": (nothing, (*PNG[:2], "--rig", "desk"), "give `densities`"),
    "densities no numbers": (nothing, (*PNG, "--densities", "16 x"), "should be numbers"),
    "density twice": (nothing, (*PNG, "--densities", "16 16"), "has one twice"),
    "two steps": (nothing, (*PNG, "--steps", "2"), "at least 3 phase steps"),
    "unknown block": (nothing, (*PNG, "--frames", "fringes grey"), "frames has 'grey'"),
    "fringes twice": (nothing, (*PNG, "--frames", "fringes fringes"), "name every orientation once"),
    "gray without bits": (nothing, (*PNG, "--frames", "fringes gray", "--gray-bits", "0"), "gray.bits"),
    "bits without gray": (nothing, (*PNG, "--frames", "fringes", "--gray-bits", "6"), "names no gray"),
    "orientation that is none": (nothing, (*PNG, "--frames", "fringes@45"), "the orientation 45 deg"),
    "order of half the axes": (nothing, (*PNG, "--order", "step density"), "order should be"),
    "direction": (nothing, (*PNG, "--direction", "2"), "phase.direction"),
    "origin": (nothing, (*PNG, "--origin", "corner"), "phase.origin"),
    "time without zone": (nothing, (*PNG, "--recorded-at", "2026-05-04T10:00:00"), "should be a time"),
    "no rig": (nothing, PNG[:-2], "name the `rig` that measured"),
    "plan that is missing": (nothing, (*PNG, "--plan", "gone.toml"), "there is no campaign file"),
    # Raw and 16 bits
    "raw without description": (as_raw(1920), RAW, "is raw data: give its columns"),
    "raw of another size": (as_raw(1900), (*RAW, "--raw", "40x24x12"), "are 1920: correct --raw"),
    "raw above its bits": (as_raw(1920, 5000), (*RAW, "--raw", "40x24x12"), "above the 4095 of 12 bits"),
    "raw description": (as_raw(1920), (*RAW, "--raw", "40 by 24"), "described as in"),
    "raw of 17 bits": (as_raw(1920), (*RAW, "--raw", "40x24x17"), "1 to 16 bits"),
    "dark 16 bits": (as_dark_16_bits, PNG, "full scale cannot be guessed"),
    # Layout files
    "layout that is missing": (nothing, LAYOUT, "there is no layout file"),
    "layout that is no TOML": (written("layout.toml", "pattern = {"), LAYOUT, "is not valid TOML"),
    "unknown key": (written("layout.toml", SEQUENCE + "step = 3\n"), LAYOUT, "has no key 'step'"),
    "wrong type": (written("layout.toml", "first = 'one'\n" + SEQUENCE), LAYOUT, "first"),
    "pattern that is no text": (written("layout.toml", "pattern = 3\n" + SEQUENCE), LAYOUT, "text in quotes"),
    "more stripes than bits": (
        written("layout.toml", 'frames = "fringes gray"\n' + SEQUENCE + "[gray]\nbits = 3\nstripes = 9.0\n"),
        LAYOUT,
        "3 patterns has 2 to 8 stripes across the projector, not 9",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_malformed_folder_is_refused_as_a_whole(
    name: str, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil, options, complaint = CASES[name]
    folder = tmp_path / "frames"
    save(folder / "S00", fringes())
    spoil(folder)
    # Relative paths of the options are below the folder.
    monkeypatch.chdir(folder)
    found = refusal("frames", str(folder), "-c", "spoilt", *options, "--yes", "--home", str(home))
    assert_says(found, complaint)
    nothing_was_entered(home)


def refusal(*arguments: str) -> str:
    """Run a command that must not do what it is asked, and return what it says."""
    done = CliRunner().invoke(app, list(arguments))
    assert done.exit_code != 0
    if isinstance(done.exception, SmsError):
        return str(done.exception)
    # All tuples refused: the list says why.
    assert done.exit_code == 6, done.exception
    return done.stderr


def assert_says(text: str, complaint: str) -> None:
    assert re.search(complaint, " ".join(text.split())), text


def nothing_was_entered(home: Path) -> None:
    with bootstrap.services(home) as services:
        assert not list(services.archive.files())
        assert not list(services.archive.unfinished())
        with services.catalogue.reading() as session, pytest.raises(NotFound):
            campaigns.campaign_row(session, "spoilt")


def test_there_are_as_many_cases_as_promised() -> None:
    assert len(CASES) + len(TABLES) >= 60


def test_twenty_thousand_files_are_judged_by_their_names(home: Path, tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    (folder / "S00").mkdir(parents=True)
    for number in range(20_000):
        frame(folder, number).touch()
    found = refusal("frames", str(folder), "-c", "spoilt", *PNG, "--yes", "--home", str(home))
    assert_says(found, "frames 6, 7, 8, 9, 10, 11, 12, 13 and 19986 more are more than the 6 of the layout")
    # Nothing has been read: empty files would be told besides.
    assert "is empty" not in found
    nothing_was_entered(home)


def test_frames_that_the_calibration_does_not_fit_are_told(home: Path, tmp_path: Path) -> None:
    initialised(tmp_path / "home")
    calibration, _ = small_plate("plate")
    save(tmp_path / "frames" / "S00", fringes())
    with bootstrap.services(tmp_path / "home") as services:
        register_calibration(services.catalogue, services.archive, calibration, datetime.now(UTC))
    done = CliRunner().invoke(
        app,
        [
            "frames",
            str(tmp_path / "frames"),
            "-c",
            "other",
            *PNG[:-2],
            "--rig",
            calibration.rig.name,
            "--yes",
            "--home",
            str(tmp_path / "home"),
            "--dry-run",
        ],
    )
    assert done.exit_code == 0, done.exception
    assert_says(done.stderr, r"C1 of rig .* is calibrated for \d+ x \d+ px, and these frames have 40 x 24")


HEAD = "state,Force [kN],SG1\n"
MAPS = ("--map", "Force [kN]=load[kN]", "--map", "SG1=gauge_1[um/m]")
TABLES: dict[str, tuple[str | bytes, tuple[str, ...], str]] = {
    "empty": ("", MAPS, "is empty: a header"),
    "header alone": (HEAD, MAPS, "a header and no row"),
    "column twice": ("state,a,a\nS00,1,2\n", (), "has the column 'a' twice"),
    "short row": (HEAD + "S00,1\n", MAPS, "line 2 has 2 cells, but the header has 3"),
    "text": (HEAD + "S00,one,2\n", MAPS, "line 2: 'one' in column 'Force .kN.' is no finite number"),
    "infinite": (HEAD + "S00,inf,2\n", MAPS, "'inf' in column"),
    "out of range": (HEAD + "S00,1e999,2\n", MAPS, "'1e999' in column"),
    "underscores": (HEAD + "S00,1_0,2\n", MAPS, "'1_0' in column"),
    "state twice": (HEAD + "S00,1,2\nS00,3,4\n", MAPS, "has state S00 twice, in lines 2 and 3"),
    "unknown states": (HEAD + "S77,1,2\n", MAPS, "no state 'S77'"),
    "binary": (b"state\0,a\n", MAPS, "is no CSV text"),
    "unknown column": (HEAD + "S00,1,2\n", ("--map", "Load=load[kN]"), "has no column 'Load'"),
    "map without channel": (HEAD + "S00,1,2\n", ("--map", "SG1"), "a column is mapped as in"),
    "map to no name": (HEAD + "S00,1,2\n", ("--map", "SG1=1 2"), "is no channel"),
    "load without unit": (HEAD + "S00,1,2\n", ("--map", "SG1=load"), "is load in ''"),
    "load in degrees": (HEAD + "S00,1,2\n", ("--map", "SG1=load[deg]"), "is load in 'deg'"),
    "odd unit": (HEAD + "S00,1,2\n", ("--map", "SG1=flow[l/min]"), "cannot end a name"),
    "one channel twice": (
        HEAD + "S00,1,2\n", ("--map", "SG1=a", "--map", "Force [kN]=a"), "two columns become a",
    ),
    "no state column": ("x,y\n1,2\n", (), "has no column 'state' or 'time'"),
    "both columns": (HEAD + "S00,1,2\n", ("--state-column", "a", "--time-column", "b"), "not both"),
    "no time zone": ("time,y\n2026-05-04T10:00:00,2\n", (), "has no zone"),
    "unknown time zone": (
        "time,y\n2026-05-04T10:00:00,2\n", ("--time-zone", "Europe/Nowhere"), "no time zone",
    ),
    "no time": ("time,y\nnoon,2\n", ("--time-zone", "UTC"), "'noon' is no time"),
    "far from every state": ("time,y\n2031-05-04T10:00:00Z,2\n", (), r"\(--within\)"),
    "long delimiter": (HEAD + "S00,1,2\n", ("--delimiter", ";;"), "one character"),
    "decimal mark": (HEAD + "S00,1,2\n", ("--decimal", "x"), "should be . or ,"),
    "broken over lines": ('state,a\nS00,"1\n2"\n', (), "over several lines"),
}  # fmt: skip


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with a campaign of one state."""
    folder = tmp_path_factory.mktemp("measured")
    initialised(folder)
    save(folder / "frames" / "S00", fringes())
    done = CliRunner().invoke(
        app, ["frames", str(folder / "frames"), "-c", "plate", *USUAL, "--yes", "--home", str(folder)]
    )
    assert done.exit_code == 0, done.exception
    return folder


def test_gauges_that_read_nothing_are_told_and_left_out(measured: Path, tmp_path: Path) -> None:
    file = tmp_path / "gauges.csv"
    file.write_text("state,SG1,SG2\nS00,NaN,nan\n", encoding="utf-8")
    done = CliRunner().invoke(
        app, ["gauges", str(file), "-c", "plate", "--yes", "--home", str(measured), "--dry-run"]
    )
    assert not isinstance(done.exception, SmsError), done.exception
    assert_says(done.stderr, "(?i)nan|empty|no number")


@pytest.mark.parametrize("name", TABLES)
def test_a_malformed_table_is_refused_as_a_whole(name: str, measured: Path, tmp_path: Path) -> None:
    text, options, complaint = TABLES[name]
    file = tmp_path / "readings.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with bootstrap.services(measured) as services, services.catalogue.reading() as session:
        before = campaigns.definition(campaigns.campaign_row(session, "plate"))
        files = sorted(services.archive.files())
    found = refusal("channels", str(file), "-c", "plate", *options, "--yes", "--home", str(measured))
    assert_says(found, complaint)
    with bootstrap.services(measured) as services, services.catalogue.reading() as session:
        assert campaigns.definition(campaigns.campaign_row(session, "plate")) == before
        assert sorted(services.archive.files()) == files
