"""Every record can be archived: it is a frozen dataclass whose arrays say what they are."""

from __future__ import annotations

import enum
import importlib
import inspect
import pkgutil
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints

import pytest

import sms_jobs.records
from sms_jobs.records.measurement import ArrayStack
from sms_jobs.records.quantity import SYMMETRIC, UNIT, quantities

MODULES = [
    importlib.import_module(f"sms_jobs.records.{m.name}")
    for m in pkgutil.iter_modules(sms_jobs.records.__path__)
]
CLASSES = [
    cls
    for module in MODULES
    for cls in vars(module).values()
    if inspect.isclass(cls) and cls.__module__ == module.__name__
]
RECORDS = [cls for cls in CLASSES if is_dataclass(cls)]
WITH_ARRAYS = [cls for cls in RECORDS if quantities(cls)]

UNITS = {"mm", "mm^2", "rad", "px", "s", "N", "1", "count", "bit", "mixed"}


def named(cls: type) -> str:
    return cls.__name__


@pytest.mark.parametrize("cls", CLASSES, ids=named)
def test_a_class_of_records_is_plain_and_immutable_data(cls: Any) -> None:
    if issubclass(cls, enum.Enum) or getattr(cls, "_is_protocol", False):
        return
    assert is_dataclass(cls), f"{cls.__name__} is no dataclass"
    assert cls.__dataclass_params__.frozen, f"{cls.__name__} can be changed after it is made"
    assert cls.__doc__
    assert not cls.__doc__.startswith(f"{cls.__name__}("), f"{cls.__name__} has no docstring"


@pytest.mark.parametrize("cls", RECORDS, ids=named)
def test_every_array_says_what_it_is(cls: type) -> None:
    if cls is ArrayStack:
        return  # the frames in memory of a field that is declared in Measurement
    hints = get_type_hints(cls)
    declared = quantities(cls)
    for f in fields(cls):
        is_array = "ndarray" in str(hints[f.name]) or "FrameStack" in str(hints[f.name])
        assert is_array == (f.name in declared), f"{cls.__name__}.{f.name} is declared as what it is not"


@pytest.mark.parametrize("cls", WITH_ARRAYS, ids=named)
def test_units_axes_and_components_are_complete(cls: type) -> None:
    for name, quantity in quantities(cls).items():
        where = f"{cls.__name__}.{name}"
        assert quantity.unit.replace(UNIT, "mm") in UNITS, where
        assert quantity.meaning, where
        assert quantity.axes, where
        assert len(set(quantity.axes)) == len(quantity.axes), where
        # Components have names exactly where there is an axis for them.
        assert ("component" in quantity.axes) == bool(quantity.components), where
        if quantity.unit.endswith("^2"):
            assert quantity.components == SYMMETRIC, where


@pytest.mark.parametrize("cls", WITH_ARRAYS, ids=named)
def test_a_field_over_an_image_leads_with_its_components(cls: type) -> None:
    for name, quantity in quantities(cls).items():
        if {"row", "column"} & set(quantity.axes):
            assert quantity.is_image, f"{cls.__name__}.{name}"


@pytest.mark.parametrize("cls", [c for c in WITH_ARRAYS if "reason" in quantities(c)], ids=named)
def test_what_can_be_missing_has_its_uncertainty_or_counts(cls: type) -> None:
    # A record with a reason mask holds measured values, and those come with an uncertainty.
    names = " ".join(quantities(cls))
    assert "sigma" in names or "covariance" in names, cls.__name__
