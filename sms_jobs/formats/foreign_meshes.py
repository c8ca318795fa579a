"""Meshes with fields at their nodes, read by meshio in a process of its own.

Its readers believe what a file says of itself: a line can have them make room for terabytes, or read for
ever. The process has limits for memory and time, which grow with the size of the file.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import resource
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput, NotFound

LARGEST_BYTES = 4 << 30
_MEMORY_BYTES = 2 << 30
_MEMORY_PER_BYTE = 30
_TIME_S = 8.0
_BYTES_PER_S = 2e6
_ADVICE = "save it as VTU, XDMF, Gmsh, Abaqus, Nastran, or as an unstructured grid of legacy VTK"

_ALONG_X = re.compile(r"(?<![A-Za-z0-9])[Xx](?![A-Za-z0-9])")

NodeFields = dict[str, NDArray[np.float64]]


def read_node_fields(path: Path) -> tuple[NDArray[np.float64], NodeFields]:
    """Return the nodes of a mesh, (n, 2) or (n, 3), and the fields with three components at them, by name.

    Raises
    ------
    NotFound
        There is no such file.
    InvalidInput
        It cannot be read within the limits.
    """
    if not path.is_file():
        raise NotFound(f"there is no file {path}; give a mesh file with a field at its nodes")
    size = path.stat().st_size
    if size > LARGEST_BYTES:
        raise InvalidInput(f"{path} is larger than the {LARGEST_BYTES >> 30} GiB that a mesh may have")
    seconds = _TIME_S + size / _BYTES_PER_S
    memory = _MEMORY_BYTES + _MEMORY_PER_BYTE * size
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", __name__, str(path.absolute()), str(memory), str(seconds)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=4.0 * seconds,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise InvalidInput(f"{path} cannot be read as a mesh within {seconds:.0f} s; {_ADVICE}") from error
    if done.returncode != 0:
        reason = (
            done.stdout.decode("utf-8", "replace")[:200] or f"it takes more than {seconds:.0f} s or memory"
        )
        raise InvalidInput(f"{path} cannot be read as a mesh: {reason}; {_ADVICE}")
    with np.load(io.BytesIO(done.stdout)) as arrays:
        names = json.loads(str(arrays["names"]))
        return arrays["points"], {name: arrays[f"field{k}"] for k, name in enumerate(names)}


def _vectors(fields: NodeFields) -> NodeFields:
    """Return the vectors; where there are none, numbers of which three have names that differ in X, Y, Z."""
    found = {name: values for name, values in fields.items() if values.ndim == 2 and values.shape[1] == 3}
    if found:
        return found
    numbers = {name: values.ravel() for name, values in fields.items() if values.size == len(values)}
    for name in numbers:
        along = _ALONG_X.search(name)
        if along is not None:
            before, after = name[: along.start()], name[along.end() :]
            three = [f"{before}{axis}{after}" for axis in ("XYZ" if along[0] == "X" else "xyz")]
            whole = " ".join(f"{before}{after}".split()).strip("_ ") or "vector"
            if whole not in found and all(one in numbers for one in three):
                found[whole] = np.stack([numbers[one] for one in three], axis=1)
    return found


def _packed(path: str) -> bytes:
    import meshio

    mesh: Any = meshio.read(path)
    fields = {str(name): np.asarray(values, np.float64) for name, values in mesh.point_data.items()}
    vectors = _vectors(fields)
    packed = io.BytesIO()
    numbered = {f"field{k}": values for k, values in enumerate(vectors.values())}
    points = np.asarray(mesh.points, np.float64)
    np.savez(packed, allow_pickle=False, points=points, names=np.array(json.dumps(list(vectors))), **numbered)
    return packed.getvalue()


def _read_here(path: str, memory: int, seconds: int) -> int:
    """Read a mesh in this process, which may end of it, and write what it holds, or why not, to stdout."""
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    output = os.fdopen(os.dup(1), "wb")
    spoken = io.StringIO()
    try:
        # Readers speak on stdout.
        with contextlib.redirect_stdout(spoken), warnings.catch_warnings(action="ignore"):
            packed = _packed(path)
    except MemoryError:
        return 1
    except (Exception, SystemExit) as error:  # noqa: BLE001 - readers raise anything on damaged files
        # A format in which nothing was found ends the process, and has said why.
        why = spoken.getvalue() if isinstance(error, SystemExit) else str(error)
        words = " ".join(why.split()).rstrip(".") or type(error).__name__
        output.write(words.encode("utf-8", "replace"))
        output.close()
        return 1
    output.write(packed)
    output.close()
    return 0


if __name__ == "__main__":
    sys.exit(_read_here(sys.argv[1], int(sys.argv[2]), round(float(sys.argv[3]))))
