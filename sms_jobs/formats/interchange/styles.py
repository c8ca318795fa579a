"""The styles of files in which calibrations go to other programs."""

from __future__ import annotations

from typing import Literal, TypeAlias

Style: TypeAlias = Literal["opencv-yaml", "opencv-xml", "opencv-json", "thesis-xml"]
