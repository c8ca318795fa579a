"""The files of a tuple read: whether they fit together, and the measurement that they are."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.frames import FoundTuple, abridged
from sms_jobs.formats.importers.image_files import ImageFacts, RawFormat, read_image
from sms_jobs.formats.importers.layout import FrameLayout
from sms_jobs.metrology.phase.frame_noise import FrameNoise, noise_of_steps
from sms_jobs.records.measurement import FrameStack, Measurement

_NOISE_ROWS = 64
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
    """

    found: FoundTuple
    facts: Mapping[str, ImageFacts]
    remarks: tuple[str, ...]
    recorded_at: datetime


@dataclass(frozen=True)
class CameraModel:
    """Full scale and noise of the camera, and where they are from."""

    full_scale: int
    gain: float
    read_noise: float
    remarks: tuple[str, ...] = field(default=(), compare=False)


def inspect(
    folder: Path,
    found: FoundTuple,
    raw: RawFormat | None = None,
    full_scale: int | None = None,
    progress: Progress = lambda: None,
) -> Inspected:
    """Read every file of a tuple once and say whether they fit together.

    Of a tuple that is refused by its names already nothing is read, however many files it has.
    """
    facts: dict[str, ImageFacts] = {}
    faults = list(found.faults)
    remarks: dict[str, None] = {}
    times: list[float] = []
    for name in () if found.faults else found.files:
        if name in facts:
            continue
        try:
            _, about = read_image(folder / name, raw)
        except InvalidInput as error:
            faults.append(str(error))
        else:
            facts[name] = about
            remarks |= dict.fromkeys(about.remarks)
            times.append((folder / name).stat().st_mtime)
            if about.dtype == "uint8" and Path(name).suffix.lower() in (".jpg", ".jpeg"):
                remarks["JPEG files have lost detail by their compression"] = None
        progress()
    if not found.faults:
        faults += _differences(facts, found.fringes, full_scale)
    at = datetime.fromtimestamp(min(times), UTC) if times else datetime(1970, 1, 1, tzinfo=UTC)
    return Inspected(replace(found, faults=abridged(faults)), facts, tuple(remarks), at)


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
    parts = {
        "fringes": [one.facts[n].sha256 for n in one.found.fringes],
        "code": [one.facts[n].sha256 for n in one.found.code],
        "white": None if one.found.white is None else one.facts[one.found.white].sha256,
        "sequence": [layout.sequence.densities, layout.sequence.steps, layout.sequence.orientations_rad],
        "offsets": layout.phase_offsets_rad,
        "gray": None if layout.gray is None else [layout.gray.stripes, layout.gray.threshold],
        "camera": [layout.full_scale, layout.gain, layout.read_noise],
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def camera_model(folder: Path, inspected: Sequence[Inspected], layout: FrameLayout) -> CameraModel:
    """Return the camera's full scale and noise: as the layout says, else as the frames show.

    Raises `InvalidInput` where the full scale cannot be inferred.
    """
    remarks: list[str] = []
    facts = [about for one in inspected for about in one.facts.values()]
    full_scale = layout.full_scale
    if full_scale is None:
        full_scale = full_scale_of(facts, layout.raw, remarks)
    gain, read_noise = layout.gain, layout.read_noise
    if gain is None or read_noise is None:
        found = _noise(folder, inspected[0], layout, full_scale)
        if found is None:
            found = usual_noise(full_scale, remarks)
        else:
            remarks.append(
                f"noise found in the frames of {inspected[0].found.state}: gain {found.gain:.3g}, read noise "
                f"{found.read_noise:.3g} grey levels"
            )
        gain = found.gain if gain is None else gain
        read_noise = found.read_noise if read_noise is None else read_noise
    return CameraModel(full_scale, gain, read_noise, tuple(remarks))


def usual_noise(full_scale: int, remarks: list[str]) -> FrameNoise:
    """Return the noise of a sensor of 10,000 electrons, with half a level besides, and remark on it."""
    found = FrameNoise(full_scale / 10_000.0, float(np.hypot(0.5, full_scale / 4096.0)))
    remarks.append(
        f"noise is taken for that of a sensor of 10,000 electrons, gain {found.gain:.3g} and read noise "
        f"{found.read_noise:.3g} grey levels: give gain and read noise where they are known"
    )
    return found


def full_scale_of(facts: Sequence[ImageFacts], raw: RawFormat | None, remarks: list[str]) -> int:
    """Return the grey level at which the camera saturates, as the files show it, and remark on guesses.

    Raises `InvalidInput` where it cannot be inferred.
    """
    if raw is not None and any(f.dtype == raw.dtype.newbyteorder("=").name for f in facts):
        return (1 << raw.bits) - 1
    if all(f.dtype == "uint8" for f in facts):
        return 255
    highest = max(f.highest for f in facts)
    unused = min(f.lowest_bits for f in facts)
    if 0 < unused < 8 and highest > 255:
        full_scale = 65_535 >> unused << unused
        remarks.append(f"the lowest {unused} bits are never used: full scale {full_scale}")
        return full_scale
    if highest <= 255:
        raise InvalidInput(
            f"the highest grey level of 16-bit files is {highest}, from which their full scale cannot be "
            "told: say it, as in --full-scale 4095"
        )
    full_scale = next(s for s in _FULL_SCALES if s >= highest)
    remarks.append(
        f"full scale {full_scale} found from the highest grey level {highest}: say --full-scale if it is "
        "another"
    )
    return full_scale


def _noise(folder: Path, one: Inspected, layout: FrameLayout, full_scale: int) -> FrameNoise | None:
    """Return the noise that the fringe frames of a tuple show; None where they do not."""
    stack = FileFrames(folder, one.found.fringes, one.facts, layout.raw)
    height = stack.shape[1]
    rows = sorted({height * (2 * i + 1) // (2 * _NOISE_ROWS) for i in range(_NOISE_ROWS)})
    sample = np.stack([stack.frame(i)[rows] for i in range(stack.shape[0])])
    sequence = layout.sequence
    each = len(sequence.orientations_rad)
    shown = np.concatenate([sample[sequence.frames_of(k, uniform=False)] for k in range(each)])
    return noise_of_steps(shown.reshape(-1, sequence.steps, *shown.shape[1:]), full_scale)


def measurement_of(
    folder: Path, one: Inspected, layout: FrameLayout, camera: CameraModel, recorded_at: datetime
) -> Measurement:
    """Return the measurement that the files of a tuple are; its frames are read as they are asked for."""
    frames: FrameStack = FileFrames(folder, one.found.fringes, one.facts, layout.raw)
    code = FileFrames(folder, one.found.code, one.facts, layout.raw) if one.found.code else None
    return Measurement(
        recorded_at=recorded_at,
        sequence=layout.sequence,
        full_scale=camera.full_scale,
        gain=camera.gain,
        read_noise=camera.read_noise,
        texture=_texture(folder, one, layout, frames),
        frames=frames,
        phase_offsets_rad=layout.phase_offsets_rad,
        gray_code=layout.gray,
        code_frames=code,
    )


def _texture(folder: Path, one: Inspected, layout: FrameLayout, frames: FrameStack) -> NDArray[np.uint16]:
    """Return the white frame, or the mean of the fringe frames, in which fringes cancel."""
    if one.found.white is not None:
        levels, _ = read_image(folder / one.found.white, layout.raw)
        return levels.astype(np.uint16)
    count, rows, columns = frames.shape
    total = np.zeros((rows, columns), np.uint32)
    for index in range(count):
        total += frames.frame(index)
    return np.asarray((total + count // 2) // count, np.uint16)
