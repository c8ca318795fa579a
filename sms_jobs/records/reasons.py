"""Why a pixel or a point has no value: one bit a reason, stored beside every field."""

from __future__ import annotations

from enum import IntFlag


class Reason(IntFlag):
    """A value is valid exactly when its reason is `VALID`; its numbers are NaN otherwise."""

    VALID = 0
    LOW_MODULATION = 1 << 0
    """Fringe modulation below its threshold, thesis Eq. (3.2)."""
    HIGH_PHASE_ERROR = 1 << 1
    """Residual of the phase against the fringe density above its threshold, thesis Eq. (3.1)."""
    SATURATED = 1 << 2
    """Too many frames of the pixel are at the sensor's full scale."""
    OUT_OF_VOLUME = 1 << 3
    """Outside the measurement volume, thesis Eq. (3.3)."""
    LARGE_RAY_GAP = 1 << 4
    """Camera and projector ray pass too far from each other."""
    AMBIGUOUS_UNWRAPPING = 1 << 5
    """The fringe orders of the sequence contradict each other."""
    OUTSIDE_REGION = 1 << 6
    """On a discontinuity, or in a region too small to keep."""
    NO_TEXTURE = 1 << 7
    """The subset has too little contrast to be matched."""
    NO_MATCH = 1 << 8
    """No counterpart was found in the other image, or one below the accepted score."""
    LEFT_IMAGE = 1 << 9
    """The counterpart lies outside the image."""
    NO_SHAPE_AT_END = 1 << 10
    """The end point has no measured shape of its own region to interpolate."""
    TOO_FEW_NEIGHBOURS = 1 << 11
    """Too few valid neighbours in the gauge area."""
    AMBIGUOUS_PAIR = 1 << 12
    """Two ways of pairing the returns of the fringe orientations are about as likely, at different points."""
    OFF_REFERENCE = 1 << 13
    """No part of the reference surface faces the point: beside its rim, too far away, or turned away."""
    BETWEEN_SURFACES = 1 << 14
    """The pixel sees two surfaces, and its point lies between them, on neither."""
    IMAGES_DISAGREE = 1 << 15
    """Both images differ by more than their noise and a displacement: a crack, dust, something in front."""
    AMBIGUOUS_TEXTURE = 1 << 16
    """The texture repeats itself within the search range: a match might be off by a whole period."""
