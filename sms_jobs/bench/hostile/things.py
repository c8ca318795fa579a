"""Files and folders that strangers might bring: damaged, endless, mislabelled, or asking for terabytes."""

from __future__ import annotations

import json
import os
import re
import stat
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random

from sms_jobs.bench.hostile.values import NUMBERS, SECRET, TEXTS, TIMES
from sms_jobs.formats import configuration
from sms_jobs.formats.rig_configuration import example_rig

_NUMBER = re.compile(r"(?<![\w.])-?\d[\d_]*(?:\.\d+)?(?:e-?\d+)?(?![\w.])")
_QUOTED = re.compile(r'"[^"\n]*"')
_TIME = re.compile(r"\d{4}-\d\d-\d\dT[\d:]+(?:Z|[+-]\d\d:\d\d)")
_ODD = (*TEXTS, "\x00", "a\x00b", "\x1b[2J", "\\u0000", "\\u001b[2J", "\\u009b31m", "\ud800")
_BOARD = 'shape = "circles"\ncolumns = 9\nrows = 7\npitch_mm = 20.0\ndot_diameter_mm = 10.0\n'
_LAYOUT = (
    'pattern = "{state}-{view}-{index}.png"\nframes = "fringes"\n[sequence]\ndensities = [16, 1]\nsteps = 4\n'
    'orientations_deg = [0.0]\n[camera]\nfull_scale = 255\n[states]\nS00 = "S00"\n'
)
_READINGS = (
    "state,load [kN],gauge_1 [um/m],time\nS00,0,0,2026-03-01T12:00:00Z\nS01,1.5,120,2026-03-01T12:01:00Z\n"
)
_POINTS = "state,board_x_mm,board_y_mm,camera_x_px,camera_y_px\n" + "".join(
    f"S0{s},{20 * x},{20 * y},{100 + 30 * x + s},{90 + 31 * y}\n"
    for s in range(3)
    for x in range(4)
    for y in range(4)
)
_XML = (
    "<sms><filename><campaign>seven</campaign></filename><hardware><rig>hall</rig><views>C1P1</views></hardware>"
    "<acquisition><densities>fdr-64</densities><steps>4</steps></acquisition><specimen><name>a</name></specimen>"
    "<states type='list'><state><label>S00</label><load_n>1</load_n></state></states></sms>"
)
_MATRIX = {"type_id": "opencv-matrix", "dt": "d"}
_CALIBRATION = json.dumps(
    {
        "camera_matrix": _MATRIX | {"rows": 3, "cols": 3, "data": [900, 0, 64, 0, 900, 64, 0, 0, 1]},
        "distortion_coefficients": _MATRIX | {"rows": 1, "cols": 5, "data": [0, 0, 0, 0, 0]},
        "image_width": 128,
        "image_height": 128,
    },
    indent=1,
)  # fmt: skip
_YAML = """%YAML:1.0
---
image_width: 128
image_height: 128
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 900., 0., 64., 0., 900., 64., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
"""
_OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 3 4\n"
_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
_STL = "solid a\nfacet\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n"
_SETTINGS = (
    f'workers = 2\nthreads = 1\nlease_s = 30.0\nbroker_url = "redis://:{SECRET}@127.0.0.1:1/0"\n'
    f'archive = "archive"\ndatabase_url = ""\ncrash_budget = 3\n'
)


def written_plan() -> str:
    """Return a plan in which every value can be replaced, times too."""
    return configuration.example_campaign().replace(
        'label = "S00"', 'label = "S00"\ntime = 2026-03-01T12:00:00Z', 1
    )


_TEXTS: Mapping[str, tuple[str, Callable[[], str]]] = {
    "plan": ("toml", written_plan),
    "session": ("toml", configuration.example_session),
    "xml": ("xml", lambda: _XML),
    "rig": ("toml", example_rig),
    "board": ("toml", lambda: _BOARD),
    "layout": ("toml", lambda: _LAYOUT),
    "readings": ("csv", lambda: _READINGS),
    "points": ("csv", lambda: _POINTS),
    "calibration": ("json", lambda: _CALIBRATION),
    "storage": ("yml", lambda: _YAML),
    "obj": ("obj", lambda: _OBJ),
    "ply": ("ply", lambda: _PLY),
    "stl": ("stl", lambda: _STL),
}

FITTING = {
    "plan": ("plan", "session", "xml"),
    "layout": ("layout",),
    "board": ("board",),
    "readings": ("readings",),
    "mask": ("image",),
    "file": ("obj", "ply", "stl", "readings", "points", "rig"),
    "files": ("calibration", "storage", "xml"),
    "folder": ("frames", "odd-images", "bag"),
    "image": ("image",),
    "again": ("image",),
}
"""Which of the things an option of that name asks for."""


def make_things(folder: Path, rng: Random) -> dict[str, list[str]]:
    """Fill a folder with hostile files; return their names by kind."""
    folder.mkdir()
    made: dict[str, list[str]] = {}
    for kind, (suffix, text) in _TEXTS.items():
        names = []
        for number in range(4):
            path = folder / f"{kind}-{number}.{suffix}"
            path.write_bytes(_altered(text(), rng, number).encode("utf-8", "surrogatepass"))
            names.append(path.name)
        made[kind] = names
    made["readings"] += _tables(folder)
    for name, content in _meshes().items():
        (folder / name).write_bytes(content)
        made[name.rsplit(".", 1)[1]].append(name)
    made["plan"] += _dotted(folder)
    made["image"] = _images(folder, rng)
    made["frames"] = [_frames(folder / "frames", rng)]
    made["odd-images"] = [_odd_images(folder / "odd-images", rng)]
    made["bag"] = [_bag(folder / "bag", rng)]
    made["odd"] = _odd(folder)
    return made


def _altered(text: str, rng: Random, number: int) -> str:
    """Return a text with a few of its values replaced; the first of a kind is left as it is."""
    if number == 0:
        return text
    way = rng.random()
    if way < 0.05:
        return text[: rng.randrange(len(text))]
    if way < 0.1:
        lines = text.splitlines()
        lines.insert(rng.randrange(len(lines)), rng.choice(lines))
        return "\n".join(lines)
    if way < 0.15:
        lines = text.splitlines()
        del lines[rng.randrange(len(lines))]
        return "\n".join(lines)
    if way < 0.18:
        return "\n".join(rng.sample(text.splitlines(), len(text.splitlines())))
    for _ in range(rng.choice((1, 1, 2, 4))):
        pattern = rng.choice((_NUMBER, _QUOTED, _TIME, _NUMBER, _QUOTED))
        found = list(pattern.finditer(text))
        if not found:
            continue
        place = rng.choice(found)
        if pattern is _QUOTED:
            inner = rng.choice(_ODD)
            if rng.random() < 0.4:
                inner = place[0][1:-1] + inner
            value = f'"{inner if rng.random() < 0.3 else _escaped(inner)}"'
        else:
            value = rng.choice(TIMES if pattern is _TIME else NUMBERS)
        text = text[: place.start()] + value + text[place.end() :]
    return text


def _escaped(text: str) -> str:
    """Return a text as it can stand between the quotation marks of TOML and JSON."""
    return "".join(c if c.isprintable() and c not in '"\\' else f"\\u{min(ord(c), 0xFFFD):04x}" for c in text)


def _tables(folder: Path) -> list[str]:
    """Write tables that readers of CSV stumble over."""
    tables = {
        "wide-cell.csv": "state,gauge\nS00," + "1" * 200_000 + "\n",
        "quoted.csv": 'state,gauge\n"S00' + "\n" * 10,
        "deep.csv": "state,gauge\nS00," + "(" * 100_000 + "\n",
        "many-columns.csv": ",".join(f"c{i}" for i in range(5_000)) + "\n",
        "years.csv": "time,gauge\n0001-01-01T00:00:00+14:00,1\n9999-12-31T23:59:59-14:00,2\n",
        "large.csv": "state,gauge,load[kN]\nS00,1e308,1e308\nS01,-1e308,1e308\n",
        "markup.csv": "state,[/x],\x1b[31m\nS00,1,2\n[/x],1,2\n\x1b[31m,1,2\n",
        "carriage.csv": "state,gauge\rS00,1\rS01,2",
        "header.csv": "state,gauge",
    }
    for name, text in tables.items():
        (folder / name).write_bytes(text.encode())
    return list(tables)


def _meshes() -> dict[str, bytes]:
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex %d\nproperty float x\nproperty float y\n"
    return {
        "only.ply": b"ply",
        "line.ply": b"ply\n",
        "endless.ply": b"ply\nformat ascii 1.0\nelement vertex 3\n",
        "huge.ply": header % 10**13 + b"property float z\nend_header\n",
        "huge-text.ply": _PLY.replace("vertex 3", f"vertex {10**13}").encode(),
        "huge-faces.ply": _PLY.replace("face 1", f"face {10**13}").encode(),
        "negative.ply": _PLY.replace("vertex 3", "vertex -3").encode(),
        "long-list.ply": _PLY.replace("3 0 1 2", "4000000000 0 1 2").encode(),
        "far.ply": _PLY.replace("3 0 1 2", "3 0 1 9").encode(),
        "noise.ply": header % 4 + b"property float z\nend_header\n" + bytes(range(256)),
        "short.obj": b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n",
        "ragged.obj": b"v 0 0 0\nv 1 0\nv 0 1 0 0 0\nf 1 2 3\n",
        "zero.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n",
        "behind.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -3\n",
        "far.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999\n",
        "words.obj": b"v a b c\nf x y z\n",
        "one.obj": b"v 0 0 0\nf 1\n",
        "mixed.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 1/1 2/2 3/3\nf 1 2 3 4\n",
        "large.obj": b"v 1e308 0 0\nv 0 1e308 0\nv 0 0 1e308\nf 1 2 3\n",
        "nan.obj": b"v nan 0 0\nv 0 inf 0\nv 0 0 1\nf 1 2 3\n",
        "short.stl": b"\0" * 84,
        "huge.stl": b"\0" * 80 + b"\xff\xff\xff\xff",
        "ragged.stl": b"solid\nvertex 0 0\nvertex 1 2 3\n",
        "words.stl": b"solid\n" + b"vertex a b c\n" * 3,
        "spaces.stl": b"solid\nvertex" + b" " * 100_000 + b"\n",
        "long.stl": b"solid\nvertex " + b"1" * 100_000 + b" 0 0\n",
        "empty.stl": b"",
    }


def _dotted(folder: Path) -> list[str]:
    """Write TOML whose keys are many, dotted, deep or alike."""
    texts = {
        "dotted.toml": "\n".join(f"a.b.c.k{n} = {n}" for n in range(20_000)),
        "deep-keys.toml": ".".join(["a"] * 20_000) + " = 1",
        "headers.toml": "\n".join(f"[a.b.c{n}]" for n in range(20_000)),
        "arrays.toml": "[[a]]\n" * 20_000,
        "nested.toml": "a = " + "[" * 20_000,
        "inline.toml": "a = " + "{b = " * 5_000,
        "digits.toml": "a = " + "9" * 900_000,
        "blanks.toml": "\n".join([" " * 5_000] * 150),
        "brackets.toml": "[" * 100_000,
        "quotes.toml": '"' * 100_000 + " = 1",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    return list(texts)


def png(columns: int, rows: int, pixels: bytes, bits: int = 8) -> bytes:
    """Return a grey PNG that declares this size, whatever its pixels are."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", columns, rows, bits, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(pixels))
        + chunk(b"IEND", b"")
    )


def _levels(rng: Random, columns: int, rows: int) -> bytes:
    return b"".join(b"\0" + rng.randbytes(columns) for _ in range(rows))


def _images(folder: Path, rng: Random) -> list[str]:
    images = {
        "noise.png": png(40, 24, _levels(rng, 40, 24)),
        "black.png": png(40, 24, b"\0" * 41 * 24),
        "white.png": png(40, 24, b"\0" + b"\xff" * 40 + (b"\0" + b"\xff" * 40) * 23),
        "one.png": png(1, 1, b"\0\xff"),
        "giant.png": png(60_000, 60_000, b"\0" * 100),
        "wide.png": png(2_000_000_000, 1, b"\0" * 100),
        "nothing.png": png(0, 0, b""),
        "cut.png": png(40, 24, _levels(rng, 40, 24))[:80],
        "empty.png": b"",
        "checker.png": png(1500, 1500, (b"\0" + b"\0\xff" * 750 + b"\0" + b"\xff\0" * 750) * 750),
        "bomb.png": png(30_000, 30_000, b"\0" * 30_001 * 200),
        "giant.pgm": b"P5 99999999 99999999 255\n",
        "negative.pgm": b"P5 -4 4 255\n0000",
        "text.tif": b"II*\0" + b"\xff" * 100,
        "loop.tif": b"II*\0\x08\0\0\0\x01\0\0\x01\x03\0\x01\0\0\0\x04\0\0\0\x08\0\0\0",
        "giant.bmp": b"BM" + struct.pack("<IIIIiiHH", 60, 0, 54, 40, 100_000, 100_000, 1, 8) + b"\0" * 24,
    }
    for name, content in images.items():
        (folder / name).write_bytes(content)
    return list(images)


def _frames(folder: Path, rng: Random) -> str:
    """Write a folder of frames that can be taken in."""
    folder.mkdir()
    for number in range(8):
        (folder / f"S00-C1P1-{number:02d}.png").write_bytes(png(40, 24, _levels(rng, 40, 24)))
    return folder.name


def _odd_images(folder: Path, rng: Random) -> str:
    """Write a folder in which hardly anything is an image."""
    folder.mkdir()
    for name in ("S00_\x1b[31m_0.png", "S00_[bold]_1.png", "S01_C1_2.png"):
        (folder / name).write_bytes(png(40, 24, _levels(rng, 40, 24)))
    (folder / "S02_C1_3.png").write_bytes(png(60_000, 60_000, b""))
    os.mkfifo(folder / "S03_C1_4.png")
    (folder / "S04_C1_5.png").symlink_to("S04_C1_5.png")
    (folder / "S05_C1_6.png").mkdir()
    (folder / "inside").symlink_to(".")
    Path(os.fsdecode(bytes(folder) + b"/S06_\xff_7.png")).write_bytes(b"\x89PNG")
    return folder.name


def _bag(folder: Path, rng: Random) -> str:
    """Write a portable folder whose files are none."""
    (folder / "data" / "plate" / "S00").mkdir(parents=True)
    listed = []
    for name in ("plate/S00/strain-20260301T120000Z-0123456789ab-1.h5", "plate/S00/\x1b[31m.h5"):
        (folder / "data" / name).write_bytes(b"\x89HDF\r\n\x1a\n" + rng.randbytes(200))
        listed.append(f"{'0' * 64}  data/{name}")
    listed.append(f"{'0' * 64}  ../../../etc/passwd")
    (folder / "manifest-sha256.txt").write_text("\n".join(listed))
    (folder / "bagit.txt").write_text("BagIt-Version: 1.0\nTag-File-Character-Encoding: UTF-8\n")
    return folder.name


def _odd(folder: Path) -> list[str]:
    """Make what is no regular file, or none that can be read."""
    os.mkfifo(folder / "pipe")
    (folder / "loop").symlink_to("loop")
    (folder / "dangling").symlink_to("nowhere/at/all")
    for minor, device in ((3, "null"), (5, "zero"), (7, "full")):
        try:
            # Nodes of our own, so that no mistake can replace those of the machine.
            os.mknod(folder / device, stat.S_IFCHR | 0o600, os.makedev(1, minor))
        except PermissionError:
            (folder / device).symlink_to(f"/dev/{device}")
    (folder / "folder").mkdir()
    (folder / "empty").touch()
    (folder / "bytes.bin").write_bytes(bytes(range(256)) * 40)
    with (folder / "sparse.bin").open("wb") as file:
        file.truncate(1 << 40)
    return [
        *("pipe", "loop", "dangling", "null", "zero", "full", "folder", "empty", "bytes.bin", "sparse.bin"),
        *("missing", "empty/below", "missing/below", "a" * 300, "\udcff", "[/x]", "\x1b[31m", "x" * 5_000),
    ]


def make_homes(folder: Path, rng: Random) -> list[str]:
    """Make folders that are no homes, or have settings that cannot be used; return their names."""
    folder.mkdir()
    for number in range(8):
        own = folder / f"settings-{number}"
        own.mkdir()
        (own / "sms.toml").write_bytes(_altered(_SETTINGS, rng, number).encode("utf-8", "surrogatepass"))
        (own / "catalogue.sqlite").write_bytes(b"" if number % 2 else rng.randbytes(4096))
    (folder / "file").write_text("no folder")
    (folder / "bare").mkdir()
    (folder / "toml").mkdir()
    (folder / "toml" / "sms.toml").mkdir()
    (folder / "dotted").mkdir()
    (folder / "dotted" / "sms.toml").write_text("\n".join(f"a.b.c.k{n} = {n}" for n in range(20_000)))
    return [*(f"settings-{n}" for n in range(8)), *NOWHERE, "bare", "toml", "dotted"]


NOWHERE = ("file", "missing", "file/below")
"""Of these homes, those that no environment makes usable."""


ENVIRONMENTS = (
    {"SMS_ARCHIVE": "things/null"},
    {"SMS_ARCHIVE": "things/empty"},
    {"SMS_ARCHIVE": "things/loop"},
    {"SMS_ARCHIVE": "a" * 5_000},
    {"SMS_SPOOL": "things/null"},
    {"SMS_WORKERS": "9" * 5_000},
    {"SMS_WORKERS": "\u0661"},
    {"SMS_THREADS": "-1"},
    {"SMS_LEASE_S": "nan"},
    {"SMS_JOB_TIME_LIMIT_S": "inf"},
    {"SMS_LEAST_ROOM_MB": "1e309"},
    {"SMS_STOP_GRACE_S": "\x1b[31m"},
    {"SMS_BROKER_URL": f"redis://:{SECRET}@127.0.0.1:1/0"},
    {"SMS_BROKER_URL": f"redis://:{SECRET}@127.0.0.1:port/0"},
    {"SMS_BROKER_URL": f"amqp://u:{SECRET}@127.0.0.1/"},
    {"SMS_BROKER_URL": f"redis://:{SECRET}@[::1/0"},
    {"SMS_BROKER_URL": f"{SECRET}"},
    {"SMS_DATABASE_URL": f"postgresql+psycopg://sms:{SECRET}@127.0.0.1:1/sms"},
    {"SMS_DATABASE_URL": f"postgresql+psycopg://sms:{SECRET}@127.0.0.1:port/sms"},
    {"SMS_DATABASE_URL": f"oracle://scott:{SECRET}@127.0.0.1/sms"},
    {"SMS_DATABASE_URL": "sqlite:///things/folder"},
    {"SMS_DATABASE_URL": f"postgresql+psycopg://u:{SECRET}@127.0.0.1:1/x?{SECRET}=1"},
    {"SMS_DATABASE_URL": SECRET},
    {"SMS_DATABASE_URL": "sqlite:///things/bytes.bin"},
    {"SMS_DATABASE_URL": "sqlite:///things/empty"},
    {"SMS_DEBUG": "perhaps"},
    {"SMS_HOME": "\udcff"},
)
"""Settings of the environment that cannot be used, or lead nowhere."""
