"""What file names and layouts say of frames: conventions of other rigs come out as this program's phases."""

from __future__ import annotations

import struct
import tomllib
import zlib
from dataclasses import replace
from datetime import UTC, datetime
from math import pi
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.folders import list_folder, natural
from sms_jobs.formats.importers.frames import arrange
from sms_jobs.formats.importers.guess import guess_layout, guess_pattern
from sms_jobs.formats.importers.image_files import RawFormat, read_image
from sms_jobs.formats.importers.inspection import camera_models, inspect, measurement_of, source_hash
from sms_jobs.formats.importers.layout import FrameLayout, layout_of
from sms_jobs.kinds.shape.foreign_patterns import coarse_gradient, offsets_of
from sms_jobs.metrology.phase.frame_noise import noise_of_steps
from sms_jobs.metrology.phase.temporal_unwrapping import unwrap
from sms_jobs.records.measurement import Measurement
from tests.support.foreign_frames import COLUMNS, ROWS, fringes, gray_frames, omega, save

NOW = datetime(2026, 5, 4, tzinfo=UTC)


def imported(folder: Path, layout: FrameLayout) -> Measurement:
    listing = list_folder(folder)
    (one,) = arrange(listing, layout).tuples
    inspected = inspect(listing.folder, one, layout.raw, layout.full_scale, sequence=layout.sequence)
    assert not inspected.found.faults
    camera = camera_models([inspected], layout)[0][0]
    return measurement_of(listing.folder, inspected, layout, camera, NOW)


def gradients(measurement: Measurement) -> NDArray[np.float64]:
    sequence = measurement.sequence
    frames = measurement.frames.rows(0, ROWS)
    found = []
    for k in range(len(sequence.orientations_rad)):
        mine = frames[sequence.frames_of(k)]
        one = unwrap(
            mine,
            sequence.densities,
            sequence.steps,
            full_scale=measurement.full_scale,
            gain=measurement.gain,
            read_noise=measurement.read_noise,
            offsets=offsets_of(measurement),
            coarse=coarse_gradient(measurement, k, measurement.frames.rows(0, ROWS)),
        )
        assert not one.ambiguous.any()
        found.append(one.omega)
    return np.stack(found)


@pytest.mark.parametrize("steps", [3, 4, 5])
@pytest.mark.parametrize(
    ("direction", "origin", "offset_deg"),
    [(1, "middle", 0.0), (-1, "edge", 0.0), (1, "edge", 180.0), (-1, "middle", -90.0), (1, "edge", 37.0)],
)
def test_phases_of_any_convention_come_out_alike(
    tmp_path: Path, steps: int, direction: int, origin: str, offset_deg: float
) -> None:
    # Density 3 is odd: from the edge its phase is off by half a fringe. Scaled to 16 bits: rounding is small.
    shown = fringes(
        (9, 3, 1), steps, (0.0, 90.0), direction=direction, edge=origin == "edge", offset_deg=offset_deg
    )
    save(tmp_path, 200.0 * shown, dtype=np.uint16)
    layout = layout_of(
        {
            "pattern": "frame_{number}.png",
            "state": "S00",
            "view": "C1P1",
            "sequence": {"densities": (9, 3, 1), "steps": steps, "orientations_deg": (0.0, 90.0)},
            "phase": {"direction": direction, "origin": origin, "offset_deg": offset_deg},
            "camera": {"full_scale": 65_535, "gain": 0.0, "read_noise": 1.0},
        },
        "here",
    )
    found = gradients(imported(tmp_path, layout))
    # Rounding of 0.29 levels against a modulation of 9,800: 3e-5 rad a phase, 3e-6 over the densities.
    assert np.abs(found - np.stack([omega(), omega(90.0)])).max() < 2e-5


def test_whole_steps_are_put_in_order_and_the_rest_is_noted() -> None:
    table = {
        "pattern": "{state}/{number}.png",
        "view": "C1P1",
        "sequence": {"densities": (16, 1), "steps": 4},
        "phase": {"direction": -1, "origin": "edge"},
    }
    assert layout_of(table, "here").phase_offsets_rad == ()
    table["sequence"] = {"densities": (16, 1), "steps": 3}
    # Half a fringe is one and a half steps of three.
    assert layout_of(table, "here").phase_offsets_rad == pytest.approx((0.0, pi))


@pytest.mark.parametrize("first", ["coarse-first", "fine-first"])
@pytest.mark.parametrize("threshold", ["fringes", "inverse", "white-black"])
def test_gray_code_tells_the_order_of_one_density(tmp_path: Path, first: str, threshold: str) -> None:
    code = gray_frames(6)
    bright = np.full((1, ROWS, COLUMNS), 200.0)
    inverse = 2.0 * 0.85 * 110.0 - code
    inverse = np.clip(inverse, 0, 255)
    if first == "fine-first":
        code, inverse = code[::-1], inverse[::-1]
    both = np.stack([code, inverse], axis=1).reshape(-1, ROWS, COLUMNS)
    shown = {
        "fringes": ("fringes gray", [fringes((32,), 12), code]),
        "inverse": ("gray+inverse fringes", [both, fringes((32,), 12)]),
        "white-black": (
            "white black gray skip fringes",
            [bright, bright - 190.0, code, bright - 100.0, fringes((32,), 12)],
        ),
    }[threshold]
    save(tmp_path, np.concatenate(shown[1]), "{}.bmp", first=1)
    layout = layout_of(
        {
            "pattern": "{number}.bmp",
            "state": "S00",
            "view": "C1P1",
            "frames": shown[0],
            "sequence": {"densities": (32,), "steps": 12},
            "gray": {"bits": 6, "order": first},
            "camera": {"gain": 0.0, "read_noise": 0.5},
        },
        "here",
    )
    measurement = imported(tmp_path, layout)
    assert measurement.sequence.gray is not None
    assert measurement.sequence.gray.threshold == threshold
    # Rounding of 0.29 levels against a modulation of at least 49 in 12 frames: 0.0024 rad over 32; 6 sigma.
    assert np.abs(gradients(measurement)[0] - omega()).max() < 6.0 * 0.0024 / 32
    expected = 200 if threshold == "white-black" else np.rint(fringes((32,), 12)).mean(axis=0)
    assert np.abs(measurement.texture - expected).max() <= 0.51


def test_names_that_say_density_and_step_need_no_numbers(tmp_path: Path) -> None:
    shown = 200.0 * fringes((9, 1), 4, (0.0, 90.0))
    names = [f"{o}_f{t}_{90 * k}.png" for o in "xy" for t in (9, 1) for k in range(4)]
    for name, frame in zip(names, shown, strict=True):
        save(tmp_path / "S07" / "C2P1", frame[None], name, dtype=np.uint16)
    layout = layout_of(
        {
            "pattern": "{state}/{view}/{orientation}_f{density}_{step}.png",
            "sequence": {"densities": (9, 1), "steps": 4, "orientations_deg": (0.0, 90.0)},
        },
        "here",
    )
    (one,) = arrange(list_folder(tmp_path), layout).tuples
    assert (one.state, one.view, one.faults) == ("S07", "C2P1", ())
    assert [n.rsplit("/", 1)[1] for n in one.fringes] == names


def test_a_guess_finds_names_steps_and_gray_code(tmp_path: Path) -> None:
    save(tmp_path / "load_0" / "C1P1", np.concatenate([fringes((8,), 12), gray_frames(4)]))
    save(
        tmp_path / "load_10" / "C1P1", np.concatenate([fringes((8,), 12, seed=1, noise=1.0), gray_frames(4)])
    )
    listing = list_folder(tmp_path)
    guess = guess_layout(listing, {"sequence": {"densities": (8,)}}, None)
    assert guess.table["pattern"] == "{state}/{view}/frame_{number}.png"
    assert guess.table["frames"] == "fringes gray"
    assert guess.table["gray"]["bits"] == 4
    assert guess.table["sequence"]["steps"] == 12
    arrangement = arrange(listing, layout_of(guess.table, "here"))
    assert arrangement.states == ("load_0", "load_10")
    with pytest.raises(InvalidInput, match="1 run of 12 steps"):
        guess_layout(listing, {}, None)


@pytest.mark.parametrize(
    ("names", "pattern"),
    [
        (["a/f_1.png", "a/f_2.png"], "a/f_{number}.png"),
        (["s1/1.bmp", "s1/2.bmp", "s2/1.bmp", "s2/2.bmp"], "{state}/{number}.bmp"),
        (["C1P1/s1/1.bmp", "C2P1/s1/2.bmp", "C1P1/s2/1.bmp"], "{view}/{state}/{number}.bmp"),
        (["load3_f1.tif", "load3_f2.tif", "load4_f1.tif"], "load{state}_f{number}.tif"),
        (["run/x/1.png", "run/y/2.png", "notes/old.png"], "run/{state}/{number}.png"),
    ],
)
def test_a_pattern_is_guessed_from_names(names: list[str], pattern: str) -> None:
    assert guess_pattern(names) == pattern


def test_a_layout_that_is_printed_is_the_same_layout(tmp_path: Path) -> None:
    save(tmp_path / "S01", fringes((16, 1), 3))
    guess = guess_layout(
        list_folder(tmp_path), {"sequence": {"densities": (16, 1)}, "states": {"S01": "S00"}}, None
    )
    again = tomllib.loads(guess.as_toml())
    assert layout_of(again, "here") == layout_of(guess.table, "here")


def test_the_hash_follows_content_and_reading_alone(tmp_path: Path) -> None:
    paths = save(tmp_path / "S01", fringes((16, 1), 3))
    table = {
        "pattern": "{state}/frame_{number}.png",
        "view": "C1P1",
        "sequence": {"densities": (16, 1), "steps": 3},
    }

    def told(**changes: object) -> str:
        layout = layout_of({**table, **changes}, "here")
        listing = list_folder(tmp_path)
        return source_hash(inspect(listing.folder, arrange(listing, layout).tuples[0], layout.raw), layout)

    first = told()
    paths[0].touch()
    assert told() == first
    assert told(phase={"direction": -1}) != first
    assert told(camera={"full_scale": 4095}) != first
    assert told(camera={"raw": "8x4x8"}) == first  # no file here is raw
    other = cv2.imread(str(paths[2]), cv2.IMREAD_UNCHANGED)
    other[0, 0] += 1
    cv2.imwrite(str(paths[2]), other)
    assert told() != first


@pytest.mark.parametrize("suffix", ["png", "tif", "bmp", "jpg", "pgm"])
def test_grey_levels_are_those_of_opencv(tmp_path: Path, suffix: str, rng: np.random.Generator) -> None:
    # Blocks of 8 px of one level each: JPEG keeps them to a level or two.
    levels = np.kron(rng.integers(0, 256, (3, 5)), np.ones((8, 8))).astype(np.uint8)
    cv2.imwrite(str(tmp_path / f"a.{suffix}"), levels)
    grey, facts = read_image(tmp_path / f"a.{suffix}")
    assert np.abs(grey.astype(int) - levels).max() <= (2 if suffix == "jpg" else 0)
    assert (facts.rows, facts.columns, facts.dtype) == (24, 40, "uint8")


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_16_bits_stay_16_bits_and_colours_become_grey(
    tmp_path: Path, suffix: str, channels: int, rng: np.random.Generator
) -> None:
    levels = rng.integers(0, 65_536, (6, 7, channels), dtype=np.uint16)
    cv2.imwrite(str(tmp_path / f"a.{suffix}"), levels)
    grey, facts = read_image(tmp_path / f"a.{suffix}")
    blue, green, red = (levels[..., min(i, channels - 1)].astype(float) for i in range(3))
    expected = levels[..., 0] if channels == 1 else np.rint(0.299 * red + 0.587 * green + 0.114 * blue)
    assert facts.dtype == "uint16"
    # Halves may be rounded either way.
    assert np.abs(grey - expected.astype(float)).max() <= (0 if channels == 1 else 1)


def noted(whole: bytes, suffix: str, turned: int) -> bytes:
    """Return an image file with a note on how it is to be turned when it is shown."""
    entry = struct.pack("<HHIHH", 274, 3, 1, turned, 0)
    note = b"II*\0\x08\0\0\0\x01\0" + entry + b"\0\0\0\0"
    if suffix == "tif":  # a second directory, with one entry more
        (at,) = struct.unpack("<I", whole[4:8])
        (count,) = struct.unpack("<H", whole[at : at + 2])
        entries = [whole[at + 2 + 12 * k :][:12] for k in range(count)] + [entry]
        entries.sort(key=lambda one: struct.unpack("<H", one[:2]))
        directory = struct.pack("<H", len(entries)) + b"".join(entries) + b"\0\0\0\0"
        return whole[:4] + struct.pack("<I", len(whole)) + whole[8:] + directory
    if suffix == "png":
        chunk = b"eXIf" + note
        return (
            whole[:33]
            + struct.pack(">I", len(note))
            + chunk
            + struct.pack(">I", zlib.crc32(chunk))
            + whole[33:]
        )
    body = b"Exif\0\0" + note
    return whole[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + whole[2:]


@pytest.mark.parametrize("turned", range(1, 9))
@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [("jpg", np.uint8), ("png", np.uint8), ("png", np.uint16), ("tif", np.uint8), ("tif", np.uint16)],
)
@pytest.mark.parametrize("channels", [1, 3])
def test_an_orientation_is_told_and_not_followed(
    tmp_path: Path, suffix: str, dtype: type, channels: int, turned: int, rng: np.random.Generator
) -> None:
    levels = np.kron(rng.integers(0, 256, (2, 3)), np.ones((16, 16))).astype(dtype)
    plain = tmp_path / f"plain.{suffix}"
    cv2.imwrite(str(plain), levels if channels == 1 else np.repeat(levels[..., None], 3, axis=-1))
    file = tmp_path / f"noted.{suffix}"
    file.write_bytes(noted(plain.read_bytes(), suffix, turned))
    expected, _ = read_image(plain)
    grey, facts = read_image(file)
    np.testing.assert_array_equal(grey, expected)
    assert ("orientation" in " ".join(facts.remarks)) == (turned > 1)


@pytest.mark.parametrize("highest", [100, 255, 1023, 4095, 65_535])
@pytest.mark.parametrize("kind", ["P2", "P3", "P5", "P6"])
def test_levels_of_pnm_are_not_stretched(
    tmp_path: Path, kind: str, highest: int, rng: np.random.Generator
) -> None:
    levels = rng.integers(0, highest + 1, (6, 7), dtype=np.uint16)
    values = np.repeat(levels.ravel(), 3) if kind in ("P3", "P6") else levels.ravel()
    deep = ">u2" if highest > 255 else "u1"
    data = values.astype(deep).tobytes() if kind in ("P5", "P6") else " ".join(map(str, values)).encode()
    file = tmp_path / "a.pnm"
    file.write_bytes(f"{kind}\n7 6\n{highest}\n".encode() + data)
    if kind in ("P2", "P3") and highest == 100:
        with pytest.raises(InvalidInput, match="has levels that cannot be read"):
            read_image(file)
        return
    grey, facts = read_image(file)
    np.testing.assert_array_equal(grey, levels)
    assert facts.dtype == ("uint16" if highest > 255 else "uint8")
    whole = file.read_bytes()
    file.write_bytes(whole[:-1] if kind in ("P5", "P6") else whole.rpartition(b" ")[0])
    with pytest.raises(InvalidInput, match="damaged"):
        read_image(file)


@pytest.mark.parametrize(("text", "kind"), [("7x5x8", "u1"), ("7x5x12+16", "<u2"), ("7x5x16be", ">u2")])
def test_raw_files_are_read_as_described(
    tmp_path: Path, text: str, kind: str, rng: np.random.Generator
) -> None:
    raw = RawFormat.parse(text)
    levels = rng.integers(0, 1 << raw.bits, (5, 7)).astype(kind)
    (tmp_path / "a.raw").write_bytes(b"x" * raw.header_bytes + levels.tobytes())
    grey, _ = read_image(tmp_path / "a.raw", raw)
    np.testing.assert_array_equal(grey, levels)
    assert grey.dtype == (np.uint8 if raw.bits == 8 else np.uint16)


def test_names_are_in_the_order_of_people() -> None:
    assert sorted(["f10", "f9", "f1a", "f1"], key=natural) == ["f1", "f1a", "f9", "f10"]


def test_the_noise_of_frames_is_found(rng: np.random.Generator) -> None:
    level = np.linspace(300.0, 3000.0, 60_000).reshape(200, 300)
    phases = rng.uniform(0, 2 * pi, (2, 200, 300))
    angles = 2.0 * pi * np.arange(4) / 4
    clean = level * (1.0 + 0.4 * np.cos(phases[:, None] + angles[None, :, None, None]))
    frames = clean + rng.normal(0.0, 1.0, clean.shape) * np.sqrt(8.0**2 + 0.5 * clean)
    for groups in (frames, frames[:1]):
        found = noise_of_steps(groups, 65_535)
        assert found is not None
        # 12 bins of 5,000 values: 1.7 % each; slope and start by a line through them: 3 % and 15 %; 3 sigma.
        assert found.gain == pytest.approx(0.5, rel=0.1)
        assert found.read_noise == pytest.approx(8.0, rel=0.5)
    assert noise_of_steps(frames[:1, :3], 65_535) is None


@pytest.mark.parametrize("steps", [3, 4, 5])
@pytest.mark.parametrize("groups", [1, 2])
@pytest.mark.parametrize(
    ("full_scale", "sigma"), [(255, 0.3), (255, 0.6), (255, 1.0), (255, 3.0), (4095, 6.0)]
)
def test_the_noise_of_frames_is_no_multiple_of_anything(
    rng: np.random.Generator, steps: int, groups: int, full_scale: int, sigma: float
) -> None:
    if groups == 1 and steps == 3:
        return
    level = np.linspace(0.1 * full_scale, 0.6 * full_scale, 40_000).reshape(160, 250)
    phases = rng.uniform(0.0, 2.0 * pi, (groups, 1, 160, 250))
    angles = 2.0 * pi * np.arange(steps)[:, None, None] / steps
    clean = level * (1.0 + 0.5 * np.cos(phases + angles))
    frames = np.rint(clean + rng.normal(0.0, sigma, clean.shape)).astype(np.uint16)
    # As it really was: of the recorded frames, with their rounding.
    true = float((frames - clean).std())
    found = noise_of_steps(frames, full_scale)
    assert found is not None
    # A line through 12 bins of 3,300 values, good to 1.3 % each; its start is four times worse: 5 %, twice.
    assert found.read_noise == pytest.approx(true, rel=0.1)
    assert found.read_noise**2 + found.gain * float(level.mean()) == pytest.approx(true**2, rel=0.04)


@pytest.mark.parametrize("unit", [1, 16])
def test_a_dark_background_is_no_part_of_the_noise_of_what_is_lit(
    rng: np.random.Generator, unit: int
) -> None:
    """Frames of 12 bits, as they are and in the upper bits of 16: a background at 0, a rim, a specimen."""
    rim = np.linspace(0.3, 300.0, 16)
    level = np.tile(np.concatenate([np.full(186, 0.3), rim, np.linspace(300.0, 900.0, 198)]), (160, 1))
    phases = rng.uniform(0.0, 2.0 * pi, (3, 1, 160, 400))
    angles = 2.0 * pi * np.arange(4)[:, None, None] / 4
    clean = level * (1.0 + 0.6 * np.cos(phases + angles))
    noisy = clean + rng.normal(0.0, 1.0, clean.shape) * np.sqrt(2.5**2 + 0.14 * clean)
    found = noise_of_steps(np.clip(np.rint(noisy), 0, 4095).astype(np.uint16) * np.uint16(unit), 65_535)
    assert found is not None
    # Bins of 2,000 values and more, good to 1.6 % each.
    stated = np.sqrt(found.read_noise**2 + found.gain * unit * np.array([200.0, 900.0])) / unit
    assert stated == pytest.approx(np.sqrt(2.5**2 + 1.0 / 12.0 + 0.14 * np.array([200.0, 900.0])), rel=0.04)


def test_every_state_has_the_noise_of_its_own_frames(tmp_path: Path, rng: np.random.Generator) -> None:
    clean = fringes((9, 3, 1), 4, (0.0, 90.0))
    true = {"S00": 0.4, "S01": 2.5}
    for state, sigma in true.items():
        save(tmp_path / state, clean + rng.normal(0.0, sigma, clean.shape))
    layout = layout_of(
        {
            "pattern": "{state}/frame_{number}.png",
            "view": "C1P1",
            "sequence": {"densities": (9, 3, 1), "steps": 4, "orientations_deg": (0.0, 90.0)},
        },
        "here",
    )
    listing = list_folder(tmp_path)
    inspected = [
        inspect(listing.folder, one, sequence=layout.sequence) for one in arrange(listing, layout).tuples
    ]
    models, remarks = camera_models(inspected, layout)
    for model, sigma in zip(models, true.values(), strict=True):
        # 960 pixels and 5 differences of each, of which neighbours share a half: 2.5 %; four times that.
        mean = model.read_noise**2 + model.gain * float(clean.mean())
        assert mean == pytest.approx(sigma**2 + 1.0 / 12.0, rel=0.1)
    assert "each of 2 tuples" in remarks[0]
    silent = [inspected[1], replace(inspected[0], noise=None)]
    models, remarks = camera_models(silent, layout)
    assert models[0] == models[1]
    assert "S00/C1P1" in remarks[1]


def test_a_folder_whose_name_no_disk_takes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="cannot be read: File name too long"):
        list_folder(tmp_path / ("a" * 300))
