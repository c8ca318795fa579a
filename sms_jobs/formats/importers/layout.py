"""The layout of a folder of frames: what file names mean, and which pattern each frame shows.

Frames are recorded in blocks: fringes, Gray code, white, black. Foreign fringes may step the other way and
begin elsewhere; steps are put into this program's order where that is all, and offsets are noted where it is
not. No pixel is changed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from math import degrees, pi, radians
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from sms_jobs.errors import ConfigurationError, InvalidInput
from sms_jobs.formats.importers.folders import NamePattern, printable
from sms_jobs.formats.importers.image_files import RawFormat
from sms_jobs.formats.interchange.text_files import read_text
from sms_jobs.formats.record_tables import Counts, GrayTable, Number, Table
from sms_jobs.formats.written_files import read_toml
from sms_jobs.records.gray_code import GrayCode, Threshold
from sms_jobs.records.measurement import FringeSequence

MOST_FRAMES = 4096

_BLOCK = re.compile(
    r"(fringes|gray\+inverse|gray|inverse|white|black|skip)(?::(\d{1,3}))?(?:@(-?\d+(?:\.\d+)?))?"
)
_AXES = ("orientation", "density", "step")
_OFFSET_TOLERANCE = 1e-6  # rad; below, an offset is that of a whole step

Kind = Literal["fringe", "code", "white", "black", "skip"]


@dataclass(frozen=True)
class Role:
    """What a frame is: its kind, and its place in the measurement's stack of that kind."""

    kind: Kind
    index: int = 0


class _Sequence(Table):
    densities: tuple[Number, ...] = ()
    steps: Counts | None = None
    orientations_deg: tuple[float, ...] = (0.0,)


class _Phase(Table):
    direction: Literal[1, -1] = 1
    origin: Literal["middle", "edge"] = "middle"
    offset_deg: float = 0.0


class _Gray(GrayTable):
    order: Literal["coarse-first", "fine-first"] = "coarse-first"


class _Camera(Table):
    full_scale: Annotated[int, Field(ge=1, le=65_535)] | None = None
    gain: Annotated[float, Field(ge=0.0)] | None = None
    read_noise: Annotated[float, Field(ge=0.0)] | None = None
    raw: str | None = None


class LayoutTable(Table):
    """A layout file, and the options of the command line that say the same."""

    pattern: str
    state: str | None = None
    view: str | None = None
    states: dict[str, str | Literal[False]] = Field(default_factory=dict)
    orientations: dict[str, float] = Field(default_factory=dict)
    frames: str = "fringes"
    order: str = "orientation density step"
    first: Annotated[int, Field(ge=0)] | None = None
    sequence: _Sequence = _Sequence()
    phase: _Phase = _Phase()
    gray: _Gray | None = None
    camera: _Camera = _Camera()


@dataclass(frozen=True)
class Block:
    """Frames that were recorded one after the other: of one orientation, or of all."""

    kind: str
    count: int = 1
    orientation_deg: float | None = None


@dataclass(frozen=True)
class FrameLayout:
    """What file names mean, and which pattern each frame shows.

    Attributes
    ----------
    pattern
        Of file names.
    state, view
        Where the names do not say them.
    states
        Labels of states by what the names call them; False for those that are left out.
    orientation_names
        Angles in degrees by what the names call them.
    sequence
        Fringes and Gray code, as this program orders them.
    blocks
        In order of recording.
    order
        Of the frames of fringes, slowest first.
    first
        Number of the first frame; the least that is found if None.
    direction, origin, offset_rad
        Step k adds direction * 2 pi k / q to the phase; the first step is cos(offset) at the projector's
        middle or edge.
    fine_first
        Whether the finest pattern of the Gray code is shown first.
    full_scale, gain, read_noise
        Of the camera; found from the frames if None.
    raw
        How raw files are laid out.
    """

    pattern: NamePattern
    sequence: FringeSequence
    state: str | None = None
    view: str | None = None
    states: Mapping[str, str | Literal[False]] = field(default_factory=dict)
    orientation_names: Mapping[str, float] = field(default_factory=dict)
    blocks: tuple[Block, ...] = (Block("fringes"),)
    order: tuple[str, ...] = _AXES
    first: int | None = None
    direction: int = 1
    origin: str = "middle"
    offset_rad: float = 0.0
    fine_first: bool = False
    full_scale: int | None = None
    gain: float | None = None
    read_noise: float | None = None
    raw: RawFormat | None = None

    @property
    def numbered(self) -> bool:
        """Whether names number the frames; otherwise they say density and step."""
        return "number" in self.pattern.names

    @cached_property
    def roles(self) -> tuple[Role, ...]:
        """What the frames of a tuple are, in order of recording."""
        found = [role for block in self.blocks for role in self._roles_of(block)]
        if len(found) > MOST_FRAMES:
            raise InvalidInput(f"a tuple may have {MOST_FRAMES} frames, this layout has {len(found)}")
        return tuple(found)

    @cached_property
    def _shifts(self) -> tuple[float, ...]:
        """What the patterns add to omega t, by density, in steps."""
        step = 2.0 * pi / self.sequence.steps
        added = [
            self.offset_rad + (pi * t if self.origin == "edge" else 0.0) for t in self.sequence.densities
        ]
        return tuple((a % (2.0 * pi)) / step for a in added)

    @cached_property
    def phase_offsets_rad(self) -> tuple[float, ...]:
        """What patterns still add to omega t, by density, once the steps are in order; empty for nothing."""
        step = 2.0 * pi / self.sequence.steps
        left = [0.0 if self._whole(s) is not None else s * step for s in self._shifts]
        offsets = tuple(o if o <= pi else o - 2.0 * pi for o in left)
        return offsets if any(offsets) else ()

    def _whole(self, shift: float) -> int | None:
        """Return a shift that is a whole number of steps, all of which are shown; None for any other."""
        if self.sequence.joint:
            return None
        near = round(shift)
        step = 2.0 * pi / self.sequence.steps
        return near % self.sequence.steps if abs(shift - near) * step < _OFFSET_TOLERANCE else None

    @cached_property
    def _places(self) -> dict[tuple[int, int, int], int]:
        """Where a fringe frame stands in the stack, by orientation, density and this program's step."""
        sequence = self.sequence
        names = [
            (o, d, k)
            for o in range(len(sequence.orientations_rad))
            for d, t in enumerate(sequence.densities)
            for k in sequence.steps_of(t)
        ]
        return {name: i for i, name in enumerate(names)}

    def fringe(self, orientation: int, density: int, step: int) -> Role:
        """Return what the frame of a foreign step is; orientation and density by their places."""
        sequence = self.sequence
        if sequence.densities[density] and not sequence.joint:
            shift = self._whole(self._shifts[density]) or 0
            step = (self.direction * step + shift) % sequence.steps
        return Role("fringe", self._places[orientation, density, step])

    def _roles_of(self, block: Block) -> Iterator[Role]:
        which = self._orientations_of(block)
        if block.kind == "fringes":
            yield from self._fringes(which)
        elif block.kind in ("gray", "inverse", "gray+inverse"):
            yield from self._codes(block.kind, which)
        else:
            kind: Kind = "white" if block.kind == "white" else "black" if block.kind == "black" else "skip"
            for _ in range(block.count):
                yield Role(kind)

    def _orientations_of(self, block: Block) -> list[int]:
        angles = [round(degrees(a), 6) for a in self.sequence.orientations_rad]
        if block.orientation_deg is None:
            return list(range(len(angles)))
        if block.orientation_deg not in angles:
            listed = ", ".join(f"{a:g}" for a in angles)
            raise InvalidInput(
                f"frames name the orientation {block.orientation_deg:g} deg; there is {listed}"
            )
        return [angles.index(block.orientation_deg)]

    def _fringes(self, orientations: list[int]) -> Iterator[Role]:
        sequence = self.sequence
        ranges = {
            "orientation": orientations,
            "density": range(len(sequence.densities)),
            "step": range(max(np.atleast_1d(sequence.counts))),
        }
        for values in product(*(ranges[axis] for axis in self.order)):
            at = dict(zip(self.order, values, strict=True))
            shown = sequence.steps_of(sequence.densities[at["density"]])
            if sequence.joint and at["step"] < len(shown):
                yield self.fringe(at["orientation"], at["density"], shown[at["step"]])
            elif not sequence.joint and at["step"] in shown:
                yield self.fringe(at["orientation"], at["density"], at["step"])

    def _codes(self, kind: str, orientations: list[int]) -> Iterator[Role]:
        assert self.sequence.gray is not None
        bits, each = self.sequence.gray.bits, self.sequence.gray.frames_each
        apart = each // bits
        order = range(bits - 1, -1, -1) if self.fine_first else range(bits)
        for orientation in orientations:
            for bit in order:
                if kind != "inverse":
                    yield Role("code", orientation * each + apart * bit)
                if kind != "gray":
                    yield Role("code", orientation * each + apart * bit + 1)


def load_layout(path: Path) -> dict[str, Any]:
    """Return the table of a layout file; raise `NotFound` or `ConfigurationError` where there is none."""
    return read_toml(read_text(path, "layout file"), str(path))[0]


def layout_of(table: Mapping[str, Any], source: str) -> FrameLayout:
    """Return the layout that a table describes; `source` names it in messages.

    Raises
    ------
    ConfigurationError
        A key is unknown or missing, or a value impossible or contradictory; the message names it.
    """
    try:
        return _as_layout(LayoutTable.model_validate(_tuples(table)))
    except ValidationError as error:
        first, *more = error.errors(include_url=False)
        where = ".".join(str(part) for part in first["loc"]) or "it"
        message = first["msg"].replace("Input should", "should").replace("Field required", "is missing")
        rest = f" (and {len(more)} more)" if more else ""
        raise ConfigurationError(f"{source}: {where} {message}{rest}; see docs/import.md") from None
    except InvalidInput as error:
        raise ConfigurationError(f"{source}: {error}") from error


def _tuples(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _tuples(v) for key, v in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _as_layout(table: LayoutTable) -> FrameLayout:
    pattern = NamePattern.parse(table.pattern)
    blocks = _blocks(table.frames)
    layout = FrameLayout(
        pattern=pattern,
        sequence=_shown_sequence(table, blocks),
        state=table.state,
        view=table.view,
        states=table.states,
        orientation_names=table.orientations,
        blocks=blocks,
        order=_order(table.order),
        first=table.first,
        direction=table.phase.direction,
        origin=table.phase.origin,
        offset_rad=radians(table.phase.offset_deg),
        fine_first=table.gray is not None and table.gray.order == "fine-first",
        full_scale=table.camera.full_scale,
        gain=table.camera.gain,
        read_noise=table.camera.read_noise,
        raw=None if table.camera.raw is None else RawFormat.parse(table.camera.raw),
    )
    _check_names(layout)
    _check_frames(layout)
    return layout


def _shown_sequence(table: LayoutTable, blocks: tuple[Block, ...]) -> FringeSequence:
    """Return what a table shows; where only some steps are shown, these as the foreign rig turns them."""
    angles = tuple(radians(a) for a in table.sequence.orientations_deg)
    densities, steps = table.sequence.densities, table.sequence.steps
    gray = _gray(table.gray, blocks)
    if gray is not None and not any(b.kind == "fringes" for b in blocks):
        if densities or steps is not None:
            raise InvalidInput(
                "sequence has densities or steps, but frames names no fringes: add them where they were "
                "recorded, or leave them out"
            )
        return FringeSequence((), orientations_rad=angles, gray=gray)
    if not densities or steps is None:
        raise InvalidInput("sequence.densities or sequence.steps is missing: give both for fringes")
    told = FringeSequence.with_counts(densities, steps, angles, gray=gray)
    turned = tuple(tuple(table.phase.direction * k % told.steps for k in steps) for steps in told.shown)
    return replace(told, shown=turned)


def _order(text: str) -> tuple[str, ...]:
    order = tuple(text.split())
    if sorted(order) != sorted(_AXES):
        raise InvalidInput(
            f"order should be orientation, density and step, the slowest first, not '{printable(text)}'"
        )
    return order


def _blocks(text: str) -> tuple[Block, ...]:
    blocks = []
    for word in text.split():
        found = _BLOCK.fullmatch(word)
        plain = found is not None and found[1] in ("white", "black", "skip")
        if found is None or (found[2] and found[1] != "skip") or (found[3] and plain):
            raise InvalidInput(
                f"frames has '{printable(word)}': write fringes, gray, inverse or gray+inverse, each with "
                "@90 for one orientation alone, white, black, skip or skip:3, in order of recording"
            )
        blocks.append(Block(found[1], int(found[2] or 1), float(found[3]) if found[3] else None))
    return tuple(blocks)


def _gray(table: _Gray | None, blocks: tuple[Block, ...]) -> GrayCode | None:
    kinds = [b.kind for b in blocks]
    if not {"gray", "inverse", "gray+inverse"} & set(kinds):
        if table is not None:
            raise InvalidInput("gray is described, but frames names no gray: add it where it was recorded")
        return None
    if table is None:
        raise InvalidInput(
            "frames has a Gray code: give its patterns per orientation, for example [gray] bits = 6"
        )
    both = {"white", "black"} <= set(kinds)
    inverted = "gray+inverse" in kinds or "inverse" in kinds
    threshold: Threshold = "inverse" if inverted else "white-black" if both else "fringes"
    return table.code(threshold)


def _check_names(layout: FrameLayout) -> None:
    names = set(layout.pattern.names)
    if "view" in names and names & {"camera", "projector"}:
        raise InvalidInput("the pattern has {view}, and {camera} or {projector} besides: leave one out")
    if len(names & {"camera", "projector"}) == 1:
        raise InvalidInput("the pattern needs both of {camera} and {projector}, or {view}, or neither")
    if not names & {"view", "camera"} and layout.view is None:
        raise InvalidInput("the names do not contain the view: give it, for example view = 'C1P1'")
    if "state" not in names and layout.state is None:
        raise InvalidInput("the names do not contain the state: give it, for example state = 'S00'")
    spoken = names & {"density", "step", "orientation"}
    if layout.numbered and spoken:
        raise InvalidInput(
            f"the pattern has {{number}} and {', '.join('{' + n + '}' for n in sorted(spoken))}: which frame "
            "it is must be said once; write * for the other"
        )
    if not layout.numbered:
        lacking = [n for n in ("density", "step") if n not in names]
        if len(layout.sequence.densities) == 1 and lacking == ["density"]:
            lacking = []
        if lacking:
            raise InvalidInput("the pattern needs {number}, or {density} and {step}, to distinguish frames")
        if any(b.kind != "fringes" for b in layout.blocks) or layout.sequence.joint:
            raise InvalidInput(
                "frames other than fringes, and densities with steps of their own, need {number} in the "
                "pattern"
            )


def _check_frames(layout: FrameLayout) -> None:
    """Raise `InvalidInput` unless every frame of the measurement is there once."""
    sequence, roles = layout.sequence, layout.roles
    if len(set(sequence.densities)) < len(sequence.densities):
        raise InvalidInput(f"densities has one twice: {', '.join(map(str, sequence.densities))}")
    coded = 0 if sequence.gray is None else sequence.gray.frames(len(sequence.orientations_rad))
    apart = 2 if sequence.gray is not None and sequence.gray.threshold == "white-black" else 0
    expected = {Role("fringe", i) for i in range(sequence.frames - coded)}
    expected |= {Role("code", i) for i in range(coded - apart)}
    shown = [r for r in roles if r.kind in ("fringe", "code")]
    if set(shown) != expected or len(shown) != len(expected):
        raise InvalidInput(
            f"frames describe {len(shown)} frames of fringes and Gray code, {len(set(shown))} of them "
            f"different, but the sequence has {len(expected)}: name every orientation once"
        )
    for kind in ("white", "black"):
        if sum(r.kind == kind for r in roles) > 1:
            raise InvalidInput(f"frames names {kind} more than once: write skip for the others")
