"""Names of the numbers by which results are found, those that more than one module knows.

A name carries its unit at its end. What is made of a name and of something else, as a channel, is put
together and taken apart here alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final, Literal, TypeAlias

from sms_jobs.records.reasons import Reason

# Of every field.
VALID_FRACTION: Final = "valid_fraction"
"""Which part of what could be measured is valid."""
VALID_FRACTION_OF_IMAGE: Final = "valid_fraction_of_image"

# Of recordings.
DOUBTS: Final = "doubts"
SATURATED_FRACTION: Final = "saturated_fraction"
LIT_FRACTION: Final = "lit_fraction"
MODULATION: Final = "modulation"
RECORDINGS: Final = "recordings"
"""How often a set was recorded until it was good enough."""
RETAKEN_FRAMES: Final = "retaken_frames"
SINCE_START_S: Final = "since_start_s"
SINCE_EVENT_S: Final = "since_event_s"
"""When a state of a stream was recorded."""

# Of gauges.
GAUGES: Final = "gauges"
GAUGES_READ: Final = "gauges_read"
"""How many have a value."""
GAUGE_QUANTITIES: Final = ("extension_mm", "x_mm", "y_mm", "z_mm")
"""Of a gauge: the growth of the distance of its ends, and the displacement of its middle along each axis."""

MAXIMUM_PRINCIPAL_STRAIN: Final = "maximum_principal_strain"

ErrorsOf: TypeAlias = Literal["shape", "displacement", "strain"]
_UNIT_OF_ERRORS: Mapping[ErrorsOf, str] = {"shape": "_mm", "displacement": "_mm", "strain": ""}
_IN_UNIT = ("rms", "bias", "largest")

_BEFORE = "_before"


def before(channel: str) -> str:
    """Return the name of what a channel read before a recording."""
    return channel + _BEFORE


def after(channel: str) -> str:
    """Return the name of what a channel read after a recording."""
    return f"{channel}_after"


def channels_before(statistics: Mapping[str, float]) -> dict[str, float]:
    """Return what channels read before a recording, by their names."""
    return {name.removesuffix(_BEFORE): value for name, value in statistics.items() if name.endswith(_BEFORE)}


def lost_to(reason: Reason) -> str:
    """Return the name of the part of the pixels that a reason keeps from a value: `lost_to_large_ray_gap`."""
    return f"lost_to_{_word(reason)}"


def fraction_of_points(reason: Reason) -> str:
    """Return the name of the part of the matched points that has a reason."""
    return f"{_word(reason)}_fraction_of_points"


def losses(statistics: Mapping[str, float], part: Callable[[Reason], str]) -> dict[str, float]:
    """Return which part is lost by what, in words: of the pixels by `lost_to`, else `fraction_of_points`."""
    names = {part(reason): _word(reason).replace("_", " ") for reason in Reason}
    return {names[name]: value for name, value in statistics.items() if name in names}


def _word(reason: Reason) -> str:
    return str(reason.name).lower()


def of_gauge(gauge: str, quantity: str) -> str:
    """Return the name of one of `GAUGE_QUANTITIES` of a gauge."""
    return f"{gauge}_{quantity}"


def with_sigma(quantity: str) -> str:
    """Return how the standard deviation of one of `GAUGE_QUANTITIES` is called."""
    stem, _, unit = quantity.rpartition("_")
    return f"{stem}_sigma_{unit}"


def gauges_in(statistics: Iterable[str]) -> Iterator[str]:
    """Yield the names of the gauges that have a value."""
    ending = of_gauge("", GAUGE_QUANTITIES[0])
    return (name.removesuffix(ending) for name in statistics if name.endswith(ending))


def of_stream(what: str) -> str:
    """Return the name of what became of the frames of a stream."""
    return f"stream_{what}"


def of_camera(name: str, camera: str) -> str:
    """Return the name of a number that each camera of a result has."""
    return f"{name}_{camera}"


def maximum_displacement(unit: str) -> str:
    """Return the name of the largest displacement."""
    return f"maximum_displacement_{unit}"


def of_errors(of: ErrorsOf, what: str) -> str:
    """Return the name of one of the numbers of `records.assessment.Errors`."""
    return f"{of}_{what}{_UNIT_OF_ERRORS[of] if what in _IN_UNIT else ''}"
