"""Sets in the spool: which are whole, which broke off, and what is known of each.

Beside the frames of a view lies a file of facts, once its set is whole. Cameras that were exposed together
have one set: it counts as whole when the facts of all of them are there, and name each other's frames.
"""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.judging import LOOKED_AT
from sms_jobs.instruments.spool import Spooled, SpooledFrames, SpoolHeader, SpoolWriter
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.recording import InterruptedRecording, Recording, Verdict
from sms_jobs.records.scene import Simulation
from sms_jobs.records.views import view_of

SIMULATION = TypeAdapter(Simulation)
_SYNC_EVERY_S = 1.0
_WAITING_FRAMES = 4
"""Of each camera that may wait for the disk."""
_FRAMES = ".frames"
_INTERRUPTED = ".interrupted"


def frames_of(view: str, sequence: FringeSequence) -> int:
    """Return how many frames are recorded of a view: fringes and white, or the image of a camera alone."""
    return sequence.frames + 1 if view_of(view).projectors else 1


@dataclass(frozen=True)
class Finished:
    """What is known of a whole set of a view.

    Attributes
    ----------
    path
        Its frames.
    verdict
        On them.
    retaken, recordings, channels_after, apart_s
        As in `Recording`.
    """

    path: Path
    verdict: Verdict
    retaken: int
    recordings: int
    channels_after: dict[str, float]
    apart_s: float | None = None


def keep(finished: Mapping[str, Finished], *, together: bool) -> None:
    """Mark the sets of some views as whole, in place of what was kept of them before.

    Parameters
    ----------
    together
        Whether none of them counts without the others.
    """
    files = {view: one.path.name for view, one in finished.items()} if together else {}
    for view, one in finished.items():
        marker = _marker(one.path.parent, view)
        facts = {
            "file": one.path.name,
            "verdict": vars(one.verdict),
            "retaken": one.retaken,
            "recordings": one.recordings,
            "channels": one.channels_after,
            **({"apart_s": one.apart_s, "together": files} if together else {}),
        }
        beside = marker.with_suffix(".new")
        beside.write_text(json.dumps(facts), encoding="utf-8")
        before = _read(marker)["file"] if marker.is_file() else None
        beside.replace(marker)
        if before is not None:
            (marker.parent / before).unlink()


def finished_sets(spool: Path) -> dict[str, Finished]:
    """Return what is whole in a spool, by view."""
    facts = {path.stem: _read(path) for path in sorted(spool.glob("*.json"))}
    files = {view: one["file"] for view, one in facts.items()}
    return {
        view: Finished(
            spool / one["file"],
            Verdict(**{**one["verdict"], "doubts": tuple(one["verdict"]["doubts"])}),
            one["retaken"],
            one["recordings"],
            one["channels"],
            one.get("apart_s"),
        )
        for view, one in facts.items()
        if all(files.get(other) == file for other, file in one.get("together", {}).items())
    }


def forget(spool: Path, view: str) -> None:
    """Have a set recorded again; its frames stay, as those of one that broke off."""
    _marker(spool, view).unlink()


def keep_dimming(spool: Path, projector: str, dimming: NDArray[np.float32]) -> str:
    """Keep where a projector is dimmed beside the frames, and return the name of the file."""
    name = f"dimming.{projector}.{hashlib.sha256(dimming.tobytes()).hexdigest()[:16]}.npy"
    beside = spool / f"{name}.new"
    with beside.open("wb") as file:
        np.save(file, dimming)
    beside.replace(spool / name)
    return name


def _as_shown(
    spool: Path, file: Spooled, sequence: FringeSequence
) -> tuple[FringeSequence, NDArray[np.float32] | None]:
    """Return the sequence with the exposures that it was recorded with, and where its light was dimmed."""
    about = file.header.about
    if "exposures" not in about:
        return FringeSequence(), None  # of a camera alone
    dimmed = None if about["dimming"] is None else np.load(spool / about["dimming"])
    return replace(sequence, exposures=tuple(about["exposures"])), dimmed


def recorded(spool: Path, view: str, sequence: FringeSequence) -> tuple[Measurement, Recording]:
    """Return a finished set; its frames are read from the spool as they are asked for.

    Of a camera without a projector the image is the texture, and the only frame.
    """
    known = finished_sets(spool)[view]
    file = Spooled(known.path)
    about, frames = file.header.about, file.header.frames
    projected = bool(view_of(view).projectors)
    shown, dimming = _as_shown(spool, file, sequence)
    numbers, times = file.numbers_and_times(file.complete)
    measurement = Measurement(
        file.header.recorded_at,
        shown,
        about["full_scale"],
        about["gain"],
        about["read_noise"],
        file.frame(frames - 1).astype(np.uint16),
        SpooledFrames(file, frames - 1 if projected else frames),
        None if about["simulation"] is None else SIMULATION.validate_python(about["simulation"]),
        dimming,
    )
    return measurement, Recording(
        about["rig"],
        known.verdict,
        known.retaken,
        known.recordings,
        about["channels"],
        known.channels_after,
        None if about["stage_rad"] is None else tuple(about["stage_rad"]),
        known.apart_s,
        numbers=numbers,
        times_s=times,
    )


def interrupted(spool: Path, view: str, sequence: FringeSequence) -> list[InterruptedRecording]:
    """Return the sets of a view that broke off after one complete frame or more, in order."""
    projected, found = bool(view_of(view).projectors), []
    for path in _files(spool, view):
        file = Spooled(path)
        shown, _ = _as_shown(spool, file, sequence)
        count = min(file.complete, shown.frames if projected else file.header.frames)
        if path.suffix == _INTERRUPTED and count:
            numbers, times = file.numbers_and_times(count)
            found.append(
                InterruptedRecording(
                    file.header.recorded_at,
                    shown,
                    file.header.about["full_scale"],
                    numbers,
                    times,
                    SpooledFrames(file, count),
                )
            )
    return found


def set_aside_interrupted(spool: Path) -> None:
    """Mark the files of sets that broke off, so that nobody takes them for more than they are."""
    whole = finished_sets(spool)
    for marker in spool.glob("*.json"):
        if marker.stem not in whole:  # of cameras that were exposed together, and not all were kept
            marker.unlink()
    names = {one.path.name for one in whole.values()}
    for path in spool.glob(f"*{_FRAMES}"):
        if path.name not in names:
            path.rename(path.with_suffix(_INTERRUPTED))


def new_path(spool: Path, view: str) -> Path:
    """Return the file for the next set of a view; those before keep theirs."""
    before = [int(path.stem.rpartition(".")[2]) for path in _files(spool, view)]
    return spool / f"{view}.{max(before, default=0) + 1:03d}{_FRAMES}"


class SetWriter:
    """Writes frames from a thread of its own, so that the next pattern need not wait for the disk."""

    def __init__(self, path: Path, header: SpoolHeader, clock: Clock) -> None:
        self.path = path
        self._file = SpoolWriter(path, header)
        self._clock = clock
        self._synced = clock.monotonic()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="spool")
        self._pending: deque[Future[None]] = deque()
        self._full_scale = header.about["full_scale"]
        self.saturated = np.zeros((header.rows, header.columns), np.bool_)[LOOKED_AT]

    def append(self, number: int, time_s: float, image: NDArray[Any], looked_at: bool) -> None:
        """Have a frame written and looked at; raise `StorageFull` when one before could not be."""
        while len(self._pending) >= _WAITING_FRAMES:
            self._pending.popleft().result()
        if looked_at:
            self.saturated |= image[LOOKED_AT] >= self._full_scale
        self._pending.append(self._thread.submit(self._file.append, number, time_s, image))
        if self._clock.monotonic() > self._synced + _SYNC_EVERY_S:
            self._synced = self._clock.monotonic()
            self._pending.append(self._thread.submit(self._file.sync))

    def __enter__(self) -> SetWriter:
        """Return itself."""
        return self

    def __exit__(self, *problem: object) -> None:
        """Write what waits and close the file, whatever happened."""
        try:
            while self._pending:
                self._pending.popleft().result()
        finally:
            self._thread.shutdown()
            self._file.close()


def _marker(spool: Path, view: str) -> Path:
    return spool / f"{view}.json"


def _read(marker: Path) -> dict[str, Any]:
    facts: dict[str, Any] = json.loads(marker.read_text(encoding="utf-8"))
    return facts


def _files(spool: Path, view: str) -> list[Path]:
    return sorted(spool.glob(f"{view}.[0-9]*"))
