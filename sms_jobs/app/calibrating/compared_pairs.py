"""Calibrations of a rig compared with an earlier one, each once, and in a process that ends with it.

What computes a comparison takes 50 MB, which a process that serves pages would keep from then on. Run as
`python -m sms_jobs.app.calibrating.compared_pairs HOME FIRST OTHERS...`, it prints what it found as JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import NamedTuple, TypeAlias

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.errors import ArchiveCorrupt, InvalidInput, NotFound, OtherFormat, SmsError, StorageUnusable
from sms_jobs.records.shown.files import CalibrationView

_KEPT = 1000
_WITHIN_S = 120.0  # a dozen take some seconds; where an archive does not answer, no page may wait for ever


class Pair(NamedTuple):
    """How far the points of a view, as C1P1, have moved against each other, and what was to be expected.

    Verdict is that of the comparison of all sensors.
    """

    view: str
    rms_mm: float
    expected_mm: float | None
    verdict: str


Compared: TypeAlias = tuple[Pair, ...] | str
"""View by view, none where they are of other sensors; or why they could not be compared, in a sentence."""


class ComparedPairs:
    """Comparisons by what was sealed, which never changes: pages are opened again and again.

    A file that is gone or of another size is read, which says so. What else may be wrong with it is found by
    those who read or verify it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._found: dict[tuple[str, str], tuple[Pair, ...]] = {}

    def of(
        self, services: Services, first: CalibrationView, others: Sequence[CalibrationView]
    ) -> dict[int, Compared]:
        """Return by its number how each of some calibrations compares with the first.

        Whoever asks while others are compared waits for that; what could not be read is tried again.
        """
        with self._lock:
            there = {one.id for one in others if _are_there(services, first, one)}
            new = [one for one in others if one.id not in there or self._key(first, one) not in self._found]
            found: dict[int, Compared] = {
                one.id: self._found[self._key(first, one)] for one in others if one not in new
            }
            if new:
                found |= _apart(services.settings.home, first.id, [one.id for one in new])
            for one in new:
                if not isinstance(known := found[one.id], str):
                    self._found[self._key(first, one)] = known
            while len(self._found) > _KEPT:
                del self._found[next(iter(self._found))]
        return found

    @staticmethod
    def _key(first: CalibrationView, one: CalibrationView) -> tuple[str, str]:
        return first.content_hash, one.content_hash


def _are_there(services: Services, *views: CalibrationView) -> bool:
    return all(services.archive.size(view.path) == view.size_bytes for view in views)


def _apart(home: Path, first: int, others: Sequence[int]) -> Mapping[int, Compared]:
    """Compare in a process of its own."""
    command = [sys.executable, "-P", "-m", __name__, str(home), *map(str, (first, *others))]
    # Matrices are small: a second thread would only wait for the first, at full speed.
    alone = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, env=alone, capture_output=True, text=True, check=False, timeout=_WITHIN_S
        )
    except subprocess.TimeoutExpired as error:
        raise StorageUnusable(
            f"calibrations {first} and {others[0]} could not be compared within {_WITHIN_S:g} s; check "
            "whether the archive's disk answers, and open the page again"
        ) from error
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise SmsError(f"calibrations {first} and {others[0]} could not be compared: {said}; report it")
    told: dict[str, str | list[list[str | float | None]]] = json.loads(done.stdout.splitlines()[-1])
    return {
        int(number): one if isinstance(one, str) else tuple(Pair(*pair) for pair in one)  # type: ignore[arg-type]
        for number, one in told.items()
    }


def _compare(services: Services, first: int, other: int) -> Compared:
    """Read two calibrations and compare them, view by view."""
    from sms_jobs.jobs.archiving import calibrations

    try:
        changed, _ = calibrations.compare(services.catalogue, services.archive, first, other, None)
    except InvalidInput:
        return ()
    except (ArchiveCorrupt, NotFound, OtherFormat) as error:
        return str(error)
    return tuple(
        Pair(
            f"{pair.camera}{pair.projector}",
            pair.aligned_rms_mm,
            pair.expected_aligned_rms_mm if isfinite(pair.expected_aligned_rms_mm) else None,
            changed.verdict,
        )
        for pair in changed.pairs
    )


def main(home: Path, first: int, others: Sequence[int]) -> None:
    """Print how calibrations compare with the first."""
    with bootstrap.services(home) as services:
        found = {number: _compare(services, first, number) for number in others}
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), [int(number) for number in sys.argv[3:]])
