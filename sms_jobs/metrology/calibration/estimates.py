"""What a calibration finds beside its sensors: lengths and shapes of artefacts, the blur of cameras."""

from __future__ import annotations

from enum import StrEnum


class Estimated(StrEnum):
    """What of an artefact or of a camera a calibration estimates."""

    LENGTH = "length"
    """Of a bar: the distance of the centres of its spheres."""
    RADIUS = "radius"
    """Of one of its spheres."""
    PITCH_SCALE = "pitch-scale"
    """Of a board: its pitch over what is stated."""
    BOW_ALONG_X = "bow-along-x"
    BOW_ALONG_Y = "bow-along-y"
    TWIST = "twist"
    """Of a board that is not flat: see `board_shape`."""
    DIAMETER = "diameter"
    """Of the cylinder about which a board is wrapped."""
    BLUR = "blur"
    """Of a camera: how much wider than a point its images are."""

    @property
    def words(self) -> str:
        """How people call it."""
        return self.value.replace("-", " ")

    @property
    def unit(self) -> str:
        """Of its values: mm, px, or 1 for a ratio."""
        return {Estimated.PITCH_SCALE: "1", Estimated.BLUR: "px"}.get(self, "mm")


SHAPE = (Estimated.BOW_ALONG_X, Estimated.BOW_ALONG_Y, Estimated.TWIST)
"""What the shape of a board is made of."""


def name_of(what: Estimated, owner: str, sphere: int | None = None) -> str:
    """Return how people call what is estimated of an artefact or camera, as 'radius of sphere 1 of bar'."""
    return f"{what.words} of {owner}" if sphere is None else f"{what.words} of sphere {sphere} of {owner}"
