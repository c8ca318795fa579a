"""NumPy's NPZ: every array of a record, exact, under a name with its unit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sms_jobs.formats.exporters.exporter import Exporter
from sms_jobs.formats.exporters.record_arrays import arrays_of


def write(record: Any, path: Path) -> None:
    """Write the arrays of a record, uncompressed; `names`, `units` and `meanings` tell what they are."""
    named = list(arrays_of(record))
    arrays = {one.name: one.values for one in named}
    about = {
        "names": np.array([one.name for one in named]),
        "units": np.array([one.unit for one in named]),
        "meanings": np.array([one.meaning for one in named]),
    }
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays, **about)


EXPORTER = Exporter("npz", "NumPy arrays, exact, with units", ".npz", "application/x-npz", write, (object,))
