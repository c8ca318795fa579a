"""The lenses of an adjustment: of which models they are, and which parameters are held, `k2` or `k2=0`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isfinite
from typing import Any

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.kinds.calibration.session_adjustment import Start
from sms_jobs.metrology.geometry.lens import HELD, LENS, MODELS, Model, fixed_by_default, foreign
from sms_jobs.records.sensors import Rig

NONE = "none"
"""Said in place of names to hold nothing."""


def parted(value: Any) -> Any:
    """Return the names of a text, `k1` or `k2=0,k3`, or none of them; anything else as it is."""
    if isinstance(value, str):
        value = [name.strip() for name in value.split(",") if name.strip()]
    if not isinstance(value, list | tuple):
        return value
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
        if name == "fisheye":
            raise ValueError(f"'{entry}' is set by the lens: give lens=fisheye, or lens=plain")
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


def values_of(entries: Sequence[str] | None) -> dict[str, float]:
    """Return the values that entries give, by name; those without one are left out."""
    pairs = (entry.partition("=") for entry in entries or ())
    return {name: float(text) for name, equals, text in pairs if equals}


def names_of(entries: Sequence[str] | None, model: Model) -> tuple[str, ...]:
    """Return what is held of a lens: what is said, else the model's own, and what no session finds of it."""
    said = fixed_by_default(model) if entries is None else (entry.partition("=")[0] for entry in entries)
    return tuple(dict.fromkeys([*said, *HELD, *foreign(model)]))


def at_values(start: Start, values: Mapping[str, float]) -> Start:
    """Return a start with some parameters of all lenses at given values."""
    if not values:
        return start
    sensors = tuple(replace(s, intrinsics=replace(s.intrinsics, **values)) for s in start.rig.sensors)
    return replace(start, rig=Rig(start.rig.name, sensors))


def held_values(rig: Rig, entries: Sequence[str] | None, models: Mapping[str, Model]) -> dict[str, float]:
    """Return what the lenses of a rig were held at by name, but for what is at its usual 0."""
    found = {}
    for sensor in rig.sensors:
        model = models[sensor.name]
        for name in names_of(entries, model):
            value = getattr(sensor.intrinsics, name)
            if not (name in fixed_by_default(model) and value == 0.0):
                found[f"{name} of {sensor.name}, held [{LENS[name].unit}]"] = float(value)
    return found


def as_models(rig: Rig, models: Mapping[str, Model]) -> None:
    """Refuse lenses of a start that another model would have to take over.

    Raises `CalibrationFailed`: a fisheye and a lens of another model share no parameter's meaning.
    """
    for sensor in rig.sensors:
        asked, has = models[sensor.name], sensor.intrinsics.model
        if asked != has and (asked, has) != ("rational", "plain"):
            raise CalibrationFailed(
                f"the lens of {sensor.name} is asked for as {asked}, but the calibration that this one "
                f"starts from has a {has} one: calibrate from boards alone with lens={asked} first"
            )


def lenses_of(entries: Sequence[str], usual: Mapping[str, Model]) -> dict[str, Model]:
    """Return the model of each sensor's lens: as entries say, C1=fisheye or rational for all, else as usual.

    Raises `InvalidInput` for a sensor that the session does not have.
    """
    found = dict(usual)
    for entry in sorted(entries, key=lambda one: "=" in one):
        name, equals, model = entry.rpartition("=")
        if equals and name not in usual:
            raise InvalidInput(f"lens={entry} names {name}, but the sensors are {', '.join(usual)}")
        for sensor in [name] if equals else usual:
            found[sensor] = next(one for one in MODELS if one == model)
    return found


def checked_lenses(entries: Sequence[str]) -> tuple[str, ...]:
    """Return entries that each name a lens model, one a sensor at most; raise `ValueError` for any other."""
    for entry in entries:
        if entry.rpartition("=")[2] not in MODELS:
            raise ValueError(
                f"there is no lens '{entry}': say {', '.join(MODELS)}, or C1=fisheye for one sensor alone"
            )
    names = [entry.rpartition("=")[0] for entry in entries]
    if len(set(names)) < len(names):
        raise ValueError(f"{', '.join(entries)} names a lens twice: name it once")
    return tuple(entries)
