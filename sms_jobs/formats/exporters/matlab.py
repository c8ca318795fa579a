"""MATLAB, version 5: every array of a record, exact, in the order that MATLAB expects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.exporters.exporter import Exporter
from sms_jobs.formats.exporters.record_arrays import NamedArray, arrays_of
from sms_jobs.records.fields import Mesh

_HEADER = b"MATLAB 5.0 MAT-file, written by sms_jobs"
_HEADER_BYTES = 116
_MOST_BYTES = 2**31 - 1


def _as_in_matlab(record: Any, one: NamedArray) -> NDArray[Any]:
    """Return an array with images first and components last; vertices counted from 1, texts in cells."""
    if isinstance(record, Mesh):
        return one.values + np.int32(1) if one.name == "faces" else one.values
    if one.values.dtype.kind == "U":  # a cell array: a matrix of characters would pad them
        return one.values.astype(object)
    # (3, rows, columns) becomes (rows, columns, 3)
    return np.moveaxis(one.values, (-2, -1), (0, 1)) if one.values.ndim > 2 else one.values


def write(record: Any, path: Path) -> None:
    """Write the arrays of a record, and the structs `units` and `meanings` with a text for each.

    Raises `InvalidInput` for an array of 2 GiB and more, which this version of the format cannot hold.
    """
    from scipy.io import savemat

    named = list(arrays_of(record))
    for one in named:
        if one.values.nbytes > _MOST_BYTES:
            raise InvalidInput(
                f"{one.name} has {one.values.nbytes / 2**30:.1f} GiB and a MATLAB file takes 2 GiB at most: "
                "choose fewer fields, or the format hdf5, which MATLAB reads too"
            )
    content: dict[str, Any] = {one.name: _as_in_matlab(record, one) for one in named}
    content["units"] = {one.name: one.unit for one in named}
    content["meanings"] = {one.name: one.meaning for one in named}
    savemat(path, content, appendmat=False, long_field_names=True, oned_as="column")
    with path.open("r+b") as file:
        # Without the time of writing: the same result has the same bytes.
        file.write(_HEADER.ljust(_HEADER_BYTES))


EXPORTER = Exporter(
    "matlab", "MATLAB 5, exact, with units", ".mat", "application/x-matlab-data", write, (object,)
)
