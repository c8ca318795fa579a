"""What artefacts with certificates show of a measuring system: errors at positions in its volume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.quantity import array

Tested: TypeAlias = Literal["probing-form", "probing-size", "sphere-distance", "length", "flatness"]
"""The errors that are told; `docs/acceptance.md` says how each is defined."""
TESTED: tuple[Tested, ...] = get_args(Tested)
_ROWS = ("tested",)


@dataclass(frozen=True)
class SystemTest:
    """Errors of a measuring system, by quantity, state and view.

    Attributes
    ----------
    artefact, certificate
        What was shown, and what is certified of it, in words.
    quantities
        Of each row, one of `TESTED`.
    states, views
        Of each row.
    missing
        Of each row, why it has no value; empty where it has one.
    """

    artefact: str
    certificate: str
    quantities: tuple[str, ...]
    states: tuple[str, ...]
    views: tuple[str, ...]
    missing: tuple[str, ...]
    error: NDArray[np.float64] = array("mm", "measured less certified, or the span of form", _ROWS)
    sigma: NDArray[np.float64] = array("mm", "standard uncertainty of the error", _ROWS)
    certified_sigma: NDArray[np.float64] = array("mm", "part of that from the certificate", _ROWS)
    points: NDArray[np.int64] = array("1", "points that took part", _ROWS)
    left_out: NDArray[np.int64] = array("1", "points off the surface that were left out", _ROWS)
