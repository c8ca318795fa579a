"""Parameters of lenses that an adjustment holds: `k2`, `k2=0`, or none at all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isfinite
from typing import Any

from sms_jobs.kinds.calibration.session_adjustment import Start
from sms_jobs.metrology.geometry.lens import HELD, KEPT, LENS
from sms_jobs.records.sensors import Rig

NONE = "none"
"""Said in place of names to hold nothing."""


def parted(value: Any) -> Any:
    """Return the names of a text, `k1` or `k2=0,k3`, or none of them; anything else as it is."""
    if isinstance(value, str):
        value = [name.strip() for name in value.split(",") if name.strip()]
    return () if list(value) == [NONE] else tuple(value)


def checked(entries: Sequence[str]) -> tuple[str, ...]:
    """Return entries that name parameters of a lens, once each, with values within their limits.

    Raises `ValueError` for any other.
    """
    for entry in entries:
        name, equals, text = entry.partition("=")
        known = LENS.get(name)
        if known is None:
            raise ValueError(
                f"a lens has no parameter '{name}'; hold {', '.join(LENS)}, one of them at a value as k2=0, "
                f"or say {NONE}"
            )
        if not equals:
            continue
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not (isfinite(value) and known.low <= value <= known.high):
            raise ValueError(
                f"{name} cannot be held at '{text}': give a number from {known.low:g} to {known.high:g}"
            )
    names = [entry.partition("=")[0] for entry in entries]
    if len(set(names)) < len(names):
        raise ValueError(f"{', '.join(entries)} holds a parameter twice: name it once")
    return tuple(entries)


def values_of(entries: Sequence[str]) -> dict[str, float]:
    """Return the values that entries give, by name; those without one are left out."""
    pairs = (entry.partition("=") for entry in entries)
    return {name: float(text) for name, equals, text in pairs if equals}


def names_of(entries: Sequence[str]) -> tuple[str, ...]:
    """Return what is held, with what sessions always hold."""
    return tuple(dict.fromkeys([*(entry.partition("=")[0] for entry in entries), *HELD]))


def at_values(start: Start, values: Mapping[str, float]) -> Start:
    """Return a start with some parameters of all lenses at given values."""
    if not values:
        return start
    sensors = tuple(replace(s, intrinsics=replace(s.intrinsics, **values)) for s in start.rig.sensors)
    return replace(start, rig=Rig(start.rig.name, sensors))


def told(rig: Rig, entries: Sequence[str]) -> dict[str, float]:
    """Return what the lenses of a rig were held at by name, but for what is at its usual 0."""
    found = {}
    for sensor in rig.sensors:
        for name in names_of(entries):
            value = getattr(sensor.intrinsics, name)
            if not (name in KEPT and value == 0.0):
                found[f"{name} of {sensor.name}, held [{LENS[name].unit}]"] = float(value)
    return found
