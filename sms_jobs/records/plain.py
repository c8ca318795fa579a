"""How what is shown becomes JSON, for the command line and over the network alike."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from datetime import date
from enum import Enum
from pathlib import Path
from typing import Any

SCHEMA = 1
"""Version of every JSON object that is given out."""
_AS_THEY_ARE = frozenset({str, int, bool})


def plain(value: Any) -> Any:
    """Return a value as JSON holds it: records as objects, dates as ISO 8601, what is no number as null."""
    # Most values are these, and lists have thousands of them.
    if value is None or type(value) in _AS_THEY_ARE:
        return value
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, date):  # or a time, which is one
        return value.isoformat()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
