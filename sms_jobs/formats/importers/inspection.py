"""The files of a tuple read: whether they fit together, and the measurement that they are.

What finds noise loads kernels, which few of those need who import this: the server, for one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.frames import FoundTuple, abridged
from sms_jobs.formats.importers.image_files import ImageFacts, RawFormat, read_image
from sms_jobs.formats.importers.layout import FrameLayout
from sms_jobs.records.measurement import FrameStack, FringeSequence, Measurement

if TYPE_CHECKING:
    from sms_jobs.metrology.phase.frame_noise import FrameNoise

_NOISE_ROWS = 64
_NOISE_GROUPS = 8  # sets of phase steps: seven differences of each of some ten thousand pixels are plenty
_NAMED = 3  # tuples in a remark
_FULL_SCALES = (1023, 4095, 16_383, 65_535)

Progress = Callable[[], None]


@dataclass(frozen=True)
class Inspected:
    """A tuple whose files have all been read once.

    Attributes
    ----------
    found
        With the faults that reading has shown.
    facts
        Of every file, by relative path.
    remarks
        What was done to some of them.
    recorded_at
        The earliest time of change of its files.
    noise
        Of its fringe frames, in all grey levels; None where they do not show it, or nobody asked.
    """

    found: FoundTuple
    facts: Mapping[str, ImageFacts]
    remarks: tuple[str, ...]
    recorded_at: datetime
    noise: FrameNoise | None = None


@dataclass(frozen=True)
class CameraModel:
    """Full scale of a camera, and its noise in the frames of one tuple."""

    full_scale: int
    gain: float
    read_noise: float


def inspect(
    folder: Path,
    found: FoundTuple,
    raw: RawFormat | None = None,
    full_scale: int | None = None,
    progress: Progress = lambda: None,
    sequence: FringeSequence | None = None,
) -> Inspected:
    """Read every file of a tuple once and say whether they fit together; with a sequence find their noise.

    Of a tuple that is refused by its names already nothing is read, however many files it has.
    """
    telling = [] if found.faults or sequence is None else _telling(found, sequence)
    sampled: dict[str, NDArray[Any]] = {}
    facts: dict[str, ImageFacts] = {}
    faults = list(found.faults)
    remarks: dict[str, None] = {}
    times: list[float] = []
    for name in () if found.faults else found.files:
        if name in facts:
            continue
        try:
            levels, about = read_image(folder / name, raw)
        except InvalidInput as error:
            faults.append(str(error))
        else:
            facts[name] = about
            if name in telling:
                sampled[name] = levels[_spread_rows(len(levels))]
            remarks |= dict.fromkeys(about.remarks)
            times.append((folder / name).stat().st_mtime)
            if about.dtype == "uint8" and Path(name).suffix.lower() in (".jpg", ".jpeg"):
                remarks["JPEG files have lost detail by their compression"] = None
        progress()
    if not found.faults:
        faults += _differences(facts, found.fringes, full_scale)
    at = datetime.fromtimestamp(min(times), UTC) if times else datetime(1970, 1, 1, tzinfo=UTC)
    noise = None
    if sequence is not None and not faults:
        noise = _noise([sampled[name] for name in telling], sequence.anchor_steps, full_scale)
    return Inspected(replace(found, faults=abridged(faults)), facts, tuple(remarks), at, noise)


def _telling(found: FoundTuple, sequence: FringeSequence) -> list[str]:
    """Return the names of the frames that are to tell the noise: whole sets of steps, of no density 0."""
    stack = np.arange(len(found.stack))
    each = range(len(sequence.orientations_rad))
    shown = np.concatenate([stack[sequence.whole_turns_of(k)] for k in each])
    groups = shown.reshape(-1, sequence.anchor_steps)
    chosen = groups[:: -(-len(groups) // _NOISE_GROUPS)]
    return [found.stack[index] for index in chosen.ravel()]


def _spread_rows(rows: int) -> list[int]:
    """Return at most so many rows as tell the noise, evenly spread."""
    return sorted({rows * (2 * i + 1) // (2 * _NOISE_ROWS) for i in range(_NOISE_ROWS)})


def _noise(sample: list[NDArray[Any]], steps: int, full_scale: int | None) -> FrameNoise | None:
    """Return the noise that some rows of phase-stepped frames show; None where they do not.

    Where the full scale is not known the highest level that there is will do: nothing lies above it.
    """
    from sms_jobs.metrology.phase.frame_noise import noise_of_steps

    stack = np.stack(sample).reshape(-1, steps, *sample[0].shape)
    return noise_of_steps(stack, full_scale or int(stack.max()))


def _differences(
    facts: Mapping[str, ImageFacts], fringes: Sequence[str], full_scale: int | None
) -> list[str]:
    """Say what does not fit together."""
    faults = []
    sizes = _by(facts, lambda f: f"{f.columns} x {f.rows} px")
    kinds = _by(facts, lambda f: {"uint8": "8 bits", "uint16": "16 bits"}[f.dtype])
    for what, groups in (("sizes", sizes), ("depths", kinds)):
        if len(groups) > 1:
            listed = ", ".join(f"{len(names)} of {value} ({names[0]})" for value, names in groups.items())
            faults.append(f"its frames have different {what}: {listed}")
    for name, about in facts.items():
        if full_scale is not None and about.highest > full_scale:
            faults.append(f"{name} has grey level {about.highest}, above the full scale {full_scale}")
    # Patterns of a code may look alike where little of them is seen; fringes never do.
    same = _by({name: facts[name] for name in fringes if name in facts}, lambda f: f.sha256)
    faults += [
        f"{' and '.join(names[:3])} have the same content: one frame was copied over another"
        for names in same.values()
        if len(names) > 1
    ]
    return faults


def _by(facts: Mapping[str, ImageFacts], key: Callable[[ImageFacts], str]) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name, about in facts.items():
        groups.setdefault(key(about), []).append(name)
    return groups


@dataclass(frozen=True)
class FileFrames:
    """Frames in image files, each read when it is asked for; what has changed since is refused."""

    folder: Path
    names: tuple[str, ...]
    facts: Mapping[str, ImageFacts]
    raw: RawFormat | None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(frames, rows, columns)."""
        first = self.facts[self.names[0]]
        return len(self.names), first.rows, first.columns

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 or uint16."""
        return np.dtype(self.facts[self.names[0]].dtype)

    def frame(self, index: int) -> NDArray[Any]:
        """Return one frame, (rows, columns); raise `InvalidInput` when its file has changed."""
        name = self.names[index]
        levels, about = read_image(self.folder / name, self.raw)
        if about.sha256 != self.facts[name].sha256:
            raise InvalidInput(f"{name} was changed while it was imported: import it again")
        return levels

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Return a slab of every frame, (frames, stop - start, columns)."""
        return np.stack([self.frame(i)[start:stop] for i in range(len(self.names))])


def source_hash(one: Inspected, layout: FrameLayout) -> str:
    """Return the SHA-256 of what a measurement is made of: its files in order, and how they are read.

    What is found from the frames of the whole folder, such as the noise, is no part of it: more states beside
    a state do not make it another.
    """
    gray = layout.sequence.gray
    parts: dict[str, object] = {
        "fringes": [one.facts[n].sha256 for n in one.found.fringes],
        "code": [one.facts[n].sha256 for n in one.found.code],
        "white": None if one.found.white is None else one.facts[one.found.white].sha256,
        "sequence": [layout.sequence.densities, layout.sequence.steps, layout.sequence.orientations_rad],
        "shown": layout.sequence.shown,
        "offsets": layout.phase_offsets_rad,
        "gray": None if gray is None else [gray.stripes, gray.threshold],
        "camera": [layout.full_scale, layout.gain, layout.read_noise],
    }
    if layout.raw is not None:
        parts |= layout.raw.said_of(one.facts)
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def camera_models(
    inspected: Sequence[Inspected], layout: FrameLayout
) -> tuple[tuple[CameraModel, ...], tuple[str, ...]]:
    """Return the camera of each tuple, and remarks: as the layout says, else as the tuple's frames show.

    A tuple whose frames do not show their noise takes that of the first that does, whatever its camera.
    Raises `InvalidInput` where the full scale cannot be inferred.
    """
    remarks: list[str] = []
    full_scales = full_scales_of(inspected, layout.full_scale, layout.raw, remarks)
    if layout.gain is not None and layout.read_noise is not None:
        given = [CameraModel(level, layout.gain, layout.read_noise) for level in full_scales]
        return tuple(given), tuple(remarks)
    telling = [one for one in inspected if one.noise is not None]
    found = [one.noise for one in telling if one.noise is not None]
    if found:
        remarks += _noise_remarks(inspected, telling, found)
    usual = {} if found else {level: usual_noise(level, remarks) for level in dict.fromkeys(full_scales)}
    models = []
    for one, full_scale in zip(inspected, full_scales, strict=True):
        own = one.noise or (found[0] if found else usual[full_scale])
        gain = own.gain if layout.gain is None else layout.gain
        read_noise = own.read_noise if layout.read_noise is None else layout.read_noise
        models.append(CameraModel(full_scale, gain, read_noise))
    return tuple(models), tuple(remarks)


def _noise_remarks(
    inspected: Sequence[Inspected], telling: Sequence[Inspected], found: Sequence[FrameNoise]
) -> list[str]:
    """Say which noise the frames of tuples show, and which tuples take that of another."""
    first = telling[0].found
    if len(found) == 1:
        gain, read_noise = f"{found[0].gain:.3g}", f"{found[0].read_noise:.3g}"
        of = first.state
    else:
        gain = _range([one.gain for one in found])
        read_noise = _range([one.read_noise for one in found])
        of = f"each of {len(found)} tuples"
    remarks = [f"noise found in the frames of {of}: gain {gain}, read noise {read_noise} grey levels"]
    silent = [f"{one.found.state}/{one.found.view}" for one in inspected if one.noise is None]
    if silent:
        named = ", ".join(silent[:_NAMED]) + (f" and {len(silent) - _NAMED} more" if silent[_NAMED:] else "")
        remarks.append(
            f"too few pixels of {named} tell their noise: it is taken for that of {first.state}/{first.view}"
        )
    return remarks


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.3g} to {max(values):.3g}"


def usual_noise(full_scale: int, remarks: list[str]) -> FrameNoise:
    """Return the noise of a sensor of 10,000 electrons, with half a level besides, and remark on it."""
    from sms_jobs.metrology.phase.frame_noise import FrameNoise

    found = FrameNoise(full_scale / 10_000.0, float(np.hypot(0.5, full_scale / 4096.0)))
    remarks.append(
        f"noise is taken for that of a sensor of 10,000 electrons, gain {found.gain:.3g} and read noise "
        f"{found.read_noise:.3g} grey levels: give gain and read noise where they are known"
    )
    return found


def full_scales_of(
    inspected: Sequence[Inspected], given: int | None, raw: RawFormat | None, remarks: list[str]
) -> tuple[int, ...]:
    """Return of each tuple the grey level at which its camera saturates, and remark on guesses.

    Files of 8 bits and of 16 bits have each their own, whatever else is imported with them.
    """
    facts = [about for one in inspected for about in one.facts.values()]
    scales = {
        depth: _full_scale_of([about for about in facts if about.dtype == depth], raw, remarks)
        if given is None
        else given
        if depth == "uint16"
        else min(given, 255)
        for depth in dict.fromkeys(about.dtype for about in facts)
    }
    if len(scales) > 1:
        names = {about.dtype: name for one in inspected for name, about in one.facts.items()}
        remarks.append(
            f"{names['uint8']} has 8 bits and {names['uint16']} 16: their full scales are {scales['uint8']} "
            f"and {scales['uint16']}"
        )
    return tuple(scales[next(iter(one.facts.values())).dtype] for one in inspected)


def _full_scale_of(facts: Sequence[ImageFacts], raw: RawFormat | None, remarks: list[str]) -> int:
    """Return the grey level at which the camera saturates, as files of one depth show it."""
    if raw is not None and any(f.dtype == raw.dtype.newbyteorder("=").name for f in facts):
        return (1 << raw.bits) - 1
    if all(f.dtype == "uint8" for f in facts):
        return 255
    highest = max(f.highest for f in facts)
    unused = min(f.lowest_bits for f in facts)
    if 0 < unused < 8 and highest > 255:
        possible = [scale >> unused << unused for scale in _FULL_SCALES]
        low = [scale for scale in possible if highest <= scale < 4096]
        if low:
            raise InvalidInput(
                f"the lowest {unused} bits of 16-bit files are never used, and their highest grey level is "
                f"{highest}: their full scale can be {low[0]} or {possible[-1]}, with a noise to match; give "
                "`full_scale`"
            )
        # A camera that ends below the highest bits is known by a level that is exactly its last.
        full_scale = highest if highest in possible else possible[-1]
        remarks.append(f"the lowest {unused} bits are never used: full scale {full_scale}")
        return full_scale
    if highest <= 255:
        raise InvalidInput(
            f"the highest grey level of 16-bit files is {highest}, from which their full scale cannot be "
            "guessed: give `full_scale`, for example 4095"
        )
    full_scale = next(s for s in _FULL_SCALES if s >= highest)
    remarks.append(
        f"full scale {full_scale} guessed from the highest grey level {highest}: give `full_scale` if it is "
        "another"
    )
    return full_scale


def measurement_of(
    folder: Path, one: Inspected, layout: FrameLayout, camera: CameraModel, recorded_at: datetime
) -> Measurement:
    """Return the measurement that the files of a tuple are; its frames are read as they are asked for."""
    frames: FrameStack = FileFrames(folder, one.found.stack, one.facts, layout.raw)
    return Measurement(
        recorded_at=recorded_at,
        sequence=layout.sequence,
        full_scale=camera.full_scale,
        gain=camera.gain,
        read_noise=camera.read_noise,
        texture=_texture(folder, one, layout, frames),
        frames=frames,
        phase_offsets_rad=layout.phase_offsets_rad,
    )


def _texture(folder: Path, one: Inspected, layout: FrameLayout, frames: FrameStack) -> NDArray[np.uint16]:
    """Return the white frame, or the mean of all fringe frames whose fringes cancel, or of all stripes."""
    if one.found.white is not None:
        levels, _ = read_image(folder / one.found.white, layout.raw)
        return levels.astype(np.uint16)
    count, rows, columns = frames.shape
    every, sequence = np.arange(count), layout.sequence
    if not (sequence.joint or sequence.striped):
        every = every[: len(one.found.fringes)]
    else:
        each = range(len(sequence.orientations_rad))
        every = np.concatenate([every[sequence.whole_turns_of(k)] for k in each])
    total = np.zeros((rows, columns), np.uint32)
    for index in every.tolist():
        total += frames.frame(index)
    count = len(every)
    return np.asarray((total + count // 2) // count, np.uint16)
