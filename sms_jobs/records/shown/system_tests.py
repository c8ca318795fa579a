"""What a test of a measuring system found, and what is decided of it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True)
class MeasuredError:
    """One error.

    Attributes
    ----------
    quantity, campaign, state, view
        What, and where.
    error_mm, sigma_mm, certified_sigma_mm
        With its standard uncertainty, and the part of that from the certificate; None without a value.
    points, left_out
        How many took part, and how many lay off the surface.
    missing
        Why there is no value; empty where there is one.
    probability
        That it lies within the limit; None without a limit or a value.
    """

    quantity: str
    campaign: str
    state: str
    view: str
    error_mm: float | None
    sigma_mm: float | None
    certified_sigma_mm: float | None
    points: int
    left_out: int
    missing: str
    probability: float | None


@dataclass(frozen=True)
class Judgement:
    """What is decided of a quantity, or of all of them together.

    Attributes
    ----------
    quantity
        Which.
    limit_mm
        Largest error that is allowed; None for all of them together.
    largest_mm
        The error of largest magnitude; None where none has a value.
    values, missing
        How many errors were to be measured, and how many of them have no value.
    least, most
        Bounds of the probability that all conform.
    decision
        At the risk: conform, not conform, undecided.
    """

    quantity: str
    limit_mm: float | None
    largest_mm: float | None
    values: int
    missing: int
    least: float
    most: float
    decision: str


@dataclass(frozen=True)
class CalibrationTested:
    """A calibration that errors were measured with."""

    number: int
    valid_from: datetime | None
    origin: str
    content_hash: str


@dataclass(frozen=True)
class ErrorSource:
    """A result that a test rests on, and the calibrations that it was computed with."""

    campaign: str
    artefact: str
    certificate: str
    path: str
    content_hash: str
    kind_version: int
    program_version: str
    created_at: datetime
    calibrations: tuple[CalibrationTested, ...]


@dataclass(frozen=True)
class SystemVerdict:
    """A test of a measuring system, judged.

    Attributes
    ----------
    rig
        That was tested.
    risk
        Largest probability that a decision is wrong.
    whole
        What is decided of all quantities with a limit together.
    judgements
        Of each quantity with a limit.
    values
        Every error.
    sources
        Where they come from.
    doubts
        What has to be looked at before anybody signs: errors of another calibration than holds now, or of
        several.
    """

    rig: str
    risk: float
    whole: Judgement
    judgements: tuple[Judgement, ...]
    values: tuple[MeasuredError, ...]
    sources: tuple[ErrorSource, ...]
    doubts: tuple[str, ...]
