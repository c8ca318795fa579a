"""Names for the types of arrays: what an axis means, and in which unit, is said where they are used."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
"""Positions, displacements, and whatever is computed with."""
Singles: TypeAlias = NDArray[np.float32]
"""Deviations, scores and images that are stored."""
Complexes: TypeAlias = NDArray[np.complex128]
Ints: TypeAlias = NDArray[np.int64]
"""Indices and counts."""
Ints32: TypeAlias = NDArray[np.int32]
Labels: TypeAlias = NDArray[np.int32]
"""Of regions; 0 for none."""
Reasons: TypeAlias = NDArray[np.uint32]
"""Why pixels have no value: bits of `Reason`."""
Mask: TypeAlias = NDArray[np.bool_]
