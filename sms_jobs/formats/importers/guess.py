"""A guess at the layout of a folder, from names and a look at one tuple, to be confirmed or corrected."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from math import degrees
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.folders import Listing, NamePattern, natural
from sms_jobs.formats.importers.frames import is_image
from sms_jobs.formats.importers.image_files import RawFormat, read_image
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.sizes import number_of
from sms_jobs.records.views import FRINGES_PATTERN

if TYPE_CHECKING:
    from sms_jobs.metrology.phase.frame_order import FrameOrder

_VIEW = re.compile(FRINGES_PATTERN)
_MOST_LOOKED_AT = 64
_PIXELS = 20_000


@dataclass(frozen=True)
class Guess:
    """The table of a layout, complete, and what of it was guessed, in words."""

    table: dict[str, Any]
    remarks: tuple[str, ...]

    def as_toml(self) -> str:
        """Return it as a layout file."""
        plain = [f"{k} = {_toml(v)}" for k, v in self.table.items() if not isinstance(v, dict)]
        tables = [
            "\n".join([f"\n[{name}]", *(f"{_key(k)} = {_toml(v)}" for k, v in inner.items())])
            for name, inner in self.table.items()
            if isinstance(inner, dict) and inner
        ]
        notes = [f"# {remark}" for remark in self.remarks]
        return "\n".join([*notes, *plain, *tables]) + "\n"


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _toml(name)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return f"{value}"


def with_options(table: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return a layout's table with what options say; their names are keys with dots, None for nothing."""
    merged: dict[str, Any] = deepcopy(dict(table))
    for name, value in options.items():
        if value is None:
            continue
        outer, dot, inner = name.partition(".")
        if dot:
            inside = merged.setdefault(outer, {})
            if isinstance(inside, dict):
                inside[inner] = value
        else:
            merged[name] = value
    return merged


def guess_layout(listing: Listing, given: Mapping[str, Any], sequence: FringeSequence | None) -> Guess:
    """Complete a layout's table: pattern and view from the names, frames from a look at one tuple.

    Parameters
    ----------
    listing
        The files.
    given
        What is known already; it is not changed.
    sequence
        Of the campaign, where there is one.

    Raises
    ------
    InvalidInput
        There is no image, or the fringe densities, which no image tells, are not known.
    """
    table = with_options(given, {})
    remarks: list[str] = []
    images = [name for name in listing.files if is_image(name)]
    if not images:
        raise InvalidInput(
            f"{listing.folder} has no image among {number_of(len(listing.files), 'file')}: "
            "give the folder of the frames"
        )
    if "pattern" not in table:
        table = {"pattern": guess_pattern(images), **table}
        remarks.append(f"guessed: the names are {table['pattern']}")
    names = NamePattern.parse(_text(table["pattern"])).names
    if not {"state"} & set(names) and "state" not in table:
        table["state"] = "S00"
        remarks.append("guessed: all frames are of one state, S00")
    if not {"view", "camera", "projector"} & set(names) and "view" not in table:
        table["view"] = "C1P1"
        remarks.append("guessed: all frames are of one view, C1P1")
    _guess_sequence(listing, images, table, sequence, remarks)
    return Guess(table, tuple(remarks))


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise InvalidInput("pattern should be text in quotes, as '{state}/{view}/frame_{number}.bmp'")
    return value


def guess_pattern(images: list[str]) -> str:
    """Return the pattern of the names that most images have.

    The last number of a name that varies is the frame's; a folder C1P1 is the view, the innermost other
    folder whose name varies is the state; what else varies may be anything.
    """
    shapes = Counter(_shape(name) for name in images)
    depth, suffix, stem = shapes.most_common(1)[0][0]
    alike = [PurePosixPath(n) for n in images if _shape(n) == (depth, suffix, stem)]
    folders = [_folder({p.parts[i] for p in alike}) for i in range(depth)]
    varying = [i for i, f in enumerate(folders) if f == "*"]
    if varying:
        folders[varying[-1]] = "{state}"
    tokens = [re.split(r"(\d+)", p.stem) for p in alike]
    parts = []
    numbers = [i for i in range(1, len(tokens[0]), 2) if len({t[i] for t in tokens}) > 1]
    for i, token in enumerate(tokens[0]):
        if i % 2 == 0:
            parts.append(token)
        elif numbers and i == numbers[-1]:
            parts.append("{number}")
        elif i in numbers:
            parts.append("{state}" if not varying and i == numbers[0] else "*")
        else:
            parts.append(token)
    if not numbers:
        # One file, or the same name in every folder.
        last = max((i for i in range(1, len(tokens[0]), 2)), default=None)
        parts = [t if i != last else "{number}" for i, t in enumerate(tokens[0])]
    return "/".join([*folders, "".join(parts) + suffix])


def _shape(name: str) -> tuple[int, str, str]:
    path = PurePosixPath(name)
    return len(path.parts) - 1, path.suffix, re.sub(r"\d+", "0", path.stem)


def _folder(names: set[str]) -> str:
    if all(_VIEW.fullmatch(n) for n in names):
        return "{view}"
    return next(iter(names)) if len(names) == 1 else "*"


_FRAMES_OF_CODE = {
    "inverse": ("gray+inverse", "fringes gray+inverse"),
    "white-black": ("gray white black", "fringes gray white black"),
    "fringes": ("", "fringes gray"),
}
"""What frames of a Gray code are called, by its threshold: alone, and beside fringes."""


def _guess_sequence(
    listing: Listing,
    images: list[str],
    table: dict[str, Any],
    sequence: FringeSequence | None,
    remarks: list[str],
) -> None:
    inner = dict(table.get("sequence", {})) if isinstance(table.get("sequence", {}), dict) else {}
    table["sequence"] = inner
    if sequence is not None and not {"densities", "steps"} & inner.keys():
        if sequence.densities:
            inner["densities"], inner["steps"] = sequence.densities, sequence.counts
        if sequence.gray is not None and "gray" not in table:
            table["gray"] = {"bits": sequence.gray.bits, "stripes": sequence.gray.stripes}
            table.setdefault("frames", _FRAMES_OF_CODE[sequence.gray.threshold][bool(sequence.densities)])
        inner.setdefault("orientations_deg", tuple(round(degrees(a), 9) for a in sequence.orientations_rad))
        remarks.append("the fringes are those of the campaign")
    if "frames" in table and "fringes" not in str(table["frames"]):
        return
    known = {"densities", "steps"} <= inner.keys() and "frames" in table
    seen = None if known else _look(listing, images, table)
    if "steps" not in inner and seen is not None and seen.steps:
        inner["steps"] = seen.steps
        remarks.append(f"guessed: {_runs(seen)} phase steps")
    if "frames" not in table and "gray" in table:
        table["frames"] = "fringes gray"
    if "frames" not in table:
        table["frames"] = _guess_frames(inner, seen, remarks)
    if seen is not None and not seen.fringes.all() and "gray" in table["frames"]:
        each = max(len(inner.get("orientations_deg", (0.0,))), 1)
        bits = int((~seen.fringes).sum()) // each
        inside = table.setdefault("gray", {})
        if isinstance(inside, dict) and "bits" not in inside:
            inside["bits"] = bits
            remarks.append(f"guessed: {bits} patterns of a Gray code, the coarsest first")
    if "steps" not in inner:
        raise InvalidInput(
            "the frames do not show the number of phase steps: give `steps`, for example 4; the names of the "
            f"frames are {table['pattern']}"
        )
    if "densities" not in inner:
        runs = f" of the {_runs(seen)} steps" if seen is not None and seen.steps else ""
        raise InvalidInput(
            f"images do not show how many fringes cross the projector: give `densities`{runs}, in order of "
            "recording, for example '16 1', and `orientations` '0 90' if there are two directions"
        )


def _refuse_uncertain(steps: Any, expected: int, seen: FrameOrder) -> None:
    """Raise `InvalidInput` where frames beside the fringes are not told, nor patterns of two levels."""
    if isinstance(steps, tuple | list):
        raise InvalidInput(
            f"steps {', '.join(map(str, steps))} make {expected} frames of fringes, and there are "
            f"{len(seen.fringes)}: say what the others are, for example frames = 'fringes white'"
        )
    if seen.uncertain:
        raise InvalidInput(
            f"of the {len(seen.fringes)} frames {int((~seen.fringes).sum())} are neither runs of phase steps "
            "nor patterns of two levels, so that what they show is not guessed: where some densities have "
            "fewer than three steps, as in micro or embedded phase shifting, write a layout with [sequence] "
            "densities = [16, 15.2, 14.6] and steps = [3, 1, 1], or give `steps` '3 1 1'"
        )


def _runs(seen: FrameOrder) -> str:
    return f"{seen.runs} run{'s' * (seen.runs != 1)} of {seen.steps}"


def _guess_frames(sequence: Mapping[str, Any], seen: FrameOrder | None, remarks: list[str]) -> str:
    steps = sequence.get("steps", 0)
    alike = isinstance(steps, int)
    if seen is None or (alike and steps and not seen.steps):
        return "fringes"
    count = len(seen.fringes)
    expected = 0
    if {"densities", "steps"} <= sequence.keys():
        shown = [steps if t else 2 for t in sequence["densities"]] if alike else steps
        expected = sum(shown) * len(sequence.get("orientations_deg", (0.0,)))
    if (alike and seen.fringes.all()) or expected == count:
        return "fringes"
    if alike and expected and count == expected + 1:
        text = "white fringes" if seen.fringes[-1] and not seen.fringes[0] else "fringes white"
    else:
        _refuse_uncertain(steps, expected, seen)
        if not seen.steps:
            return "fringes"
        words = ["fringes" if stepped else "gray" for stepped in seen.fringes]
        text = " ".join(w for i, w in enumerate(words) if i == 0 or words[i - 1] != w)
    remarks.append(f"guessed: the {count} frames are {text}")
    return text


def _look(listing: Listing, images: list[str], table: Mapping[str, Any]) -> FrameOrder | None:
    """Look at the frames of the first tuple; None where their names do not number them."""
    from sms_jobs.metrology.phase.frame_order import frame_order  # whose kernels load slowly

    pattern = NamePattern.parse(_text(table["pattern"]))
    if "number" not in pattern.names:
        return None
    groups: dict[tuple[str, ...], dict[int, str]] = {}
    for name in images:
        said = pattern.match(name)
        if said is not None:
            key = tuple(v for k, v in said.items() if k != "number")
            groups.setdefault(key, {}).setdefault(int(said["number"]), name)
    if not groups:
        return None
    first = groups[min(groups, key=lambda k: tuple(natural(part) for part in k))]
    names = [first[n] for n in sorted(first)][:_MOST_LOOKED_AT]
    camera = table.get("camera", {})
    raw = camera.get("raw") if isinstance(camera, dict) else None
    try:
        levels = [
            read_image(listing.folder / n, None if raw is None else RawFormat.parse(raw))[0] for n in names
        ]
    except InvalidInput:
        return None
    if len({one.shape for one in levels}) > 1:
        return None
    step = max(1, levels[0].size // _PIXELS)
    return frame_order(np.stack([one.ravel()[::step] for one in levels]))
