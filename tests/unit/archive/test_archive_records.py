"""Every record class goes into the archive and comes out the same, whatever it holds."""

from __future__ import annotations

import types
from dataclasses import fields, is_dataclass, replace
from datetime import UTC, datetime, timedelta, timezone
from enum import Enum
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sms_jobs.archive import Archive, FolderStore, MemoryStore, Provenance
from sms_jobs.archive.codec import layout_of, plain_to_json, record_classes, record_from_parts
from sms_jobs.errors import ArchiveCorrupt
from sms_jobs.metrology.geometry.lens import LENS, Intrinsics
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.gray_code import GrayCode
from sms_jobs.records.measurement import ArrayStack, FrameStack, FringeSequence, Measurement
from sms_jobs.records.numbers import LARGEST
from sms_jobs.records.quantity import QUANTITY, Quantity
from sms_jobs.records.scene import AT_ORIGIN, Cylinder, HalvesApart, Plane, Rigid, Scene, TopHat
from sms_jobs.records.sensors import Rig, Sensor
from sms_jobs.records.specimen_frame import SpecimenFrame
from sms_jobs.records.subject import Subject
from sms_jobs.records.texts import NAME_LETTERS, REMARK_LETTERS, harmless
from sms_jobs.records.times import EARLIEST, LATEST
from sms_jobs.records.views import sensor_name

LENGTHS = {"row": 5, "column": 7, "frame": 6, "point": 4, "vertex": 9, "face": 3, "corner": 3}
# How the instruments of a rig are wired stays in its file, and has laws that chance does not keep.
WIRING = {
    f"sms_jobs.records.{name}" for name in ("bursts", "instruments", "optical_instruments", "serial_links")
}
STORED = sorted(
    (c for c in record_classes().values() if c not in (Quantity, ArrayStack) and c.__module__ not in WIRING),
    key=lambda c: c.__name__,
)


def provenance(**changes: Any) -> Provenance:
    made = Provenance(
        kind="example",
        kind_version=1,
        subject=Subject("test", "S00", "C1P1"),
        job_id="0123456789abcdef",
        attempt=1,
        created_at=datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC),
        parameters={"threshold": 0.5},
        inputs=(),
        program_version="0.1.0",
        host="here",
        operator="somebody",
    )
    return replace(made, **changes)


def example(hint: Any, rng: np.random.Generator, meta: Any = None) -> Any:
    """Make a value of a type; arrays take their shape from their declaration."""
    if meta is not None:
        return example_array(hint, meta, rng)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return example(arguments[rng.integers(len(arguments))], rng)
    if origin is Literal:
        return arguments[rng.integers(len(arguments))]
    if origin is tuple:
        parts = [arguments[0]] * int(rng.integers(1, 4)) if arguments[-1] is ... else arguments
        return tuple(example(part, rng) for part in parts)
    if origin is dict:
        return {f"k{i}": example(arguments[1], rng) for i in range(2)}
    if is_dataclass(hint):
        hints = get_type_hints(hint)
        values = {f.name: example(hints[f.name], rng, f.metadata.get(QUANTITY)) for f in fields(hint)}
        if hint is FringeSequence:
            values["exposures"] = tuple(np.abs(values["exposures"]).tolist())
            # Steps that are shown of each density have to tell a phase, which chance does not know.
            density = float(rng.uniform(9.0, 99.0))
            values |= {
                "densities": (8, density),
                "steps": 4,
                "shown": ((0, 1, 2, 3), (int(rng.integers(4)),)),
            }
        if hint is GrayCode:
            values["stripes"] = (float(rng.uniform(2.0, 2.0 ** values["bits"])),)
        if hint is Sensor:
            values["name"] = sensor_name(values["role"], int(rng.integers(1, 1000)))
        if hint is Intrinsics:
            values["fx"], values["fy"] = LENS["fx"].low, LENS["fx"].high
            values["skew"] = LENS["skew"].low
            values["fisheye"] = 0.0  # a fisheye has none of some others
        if hint is SpecimenFrame:
            values["placement"] = AT_ORIGIN
        made = hint(**values)
        # An artefact must be one of those that its campaign describes, which chance does not know.
        return replace(made, artefact=None) if isinstance(made, LoadState) else made
    if isinstance(hint, type) and issubclass(hint, Enum):
        return list(hint)[rng.integers(len(hint))]
    if hint is datetime:
        zone = timezone(timedelta(hours=int(rng.integers(-11, 12))))
        return datetime(2026, 1, 1, 12, 0, int(rng.integers(60)), 123_456, tzinfo=zone)
    # As long as the name of a sensor may be.
    name = f"S{rng.integers(10**7):07}"
    simple = {int: int(rng.integers(3, 9)), float: float(rng.normal()), str: name}
    return {**simple, bool: True, type(None): None}[hint]


def example_array(hint: Any, quantity: Quantity, rng: np.random.Generator) -> Any:
    shape = tuple(
        len(quantity.components) if axis == "component" and quantity.components else LENGTHS.get(axis, 2)
        for axis in quantity.axes
    )
    if get_origin(hint) in (Union, types.UnionType):
        hint = get_args(hint)[rng.integers(2)]
    if hint is FrameStack:
        return ArrayStack(rng.integers(0, 4096, shape, dtype=np.uint16))
    if hint is types.NoneType:
        return None
    dtype = np.dtype(get_args(get_args(hint)[1])[0])
    if dtype.kind == "f":
        values = rng.normal(size=shape).astype(dtype)
        values[..., :1] = np.nan
        return values
    return rng.integers(0, 2, shape).astype(dtype)


def assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    for name in layout_of(type(a)).plain_names:
        assert getattr(a, name) == getattr(b, name)
    for name, field in layout_of(type(a)).arrays.items():
        one, two = getattr(a, name), getattr(b, name)
        if one is None or two is None:
            assert one is two
            continue
        if field.streamed:
            assert one.shape == two.shape
            one, two = one.rows(0, one.shape[1]), two.rows(0, two.shape[1])
        assert one.dtype == two.dtype
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("record_class", STORED, ids=lambda c: c.__name__)
def test_every_record_class_comes_back_as_it_was(record_class: type) -> None:
    archive = Archive(MemoryStore())
    for seed in range(3):
        record = example(record_class, np.random.default_rng(seed))
        sealed = archive.seal_dataset({"it": record}, provenance(attempt=seed))
        with archive.open(sealed) as dataset:
            assert dataset.record_class("it") is record_class
            assert_same(dataset.read("it", record_class), record)


def test_empty_lists_of_points_are_stored_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LENGTHS, "point", 0)
    matches = example(record_classes()["ImageMatches"], np.random.default_rng(0))
    archive = Archive(MemoryStore())
    sealed = archive.seal_dataset({"matches": matches}, provenance())
    archive.verify(sealed.path, sealed.content_hash)
    with archive.open(sealed) as dataset:
        assert_same(dataset.read("matches", type(matches)), matches)


def texts(most: int) -> st.SearchStrategy[str]:
    letters = st.characters(codec="utf-8").filter(lambda letter: harmless(letter) == letter)
    lines = st.lists(st.text(letters, max_size=16), max_size=3).map("\r\n".join)
    return st.one_of(lines, st.just("\N{SNOWMAN}" * most))


# What a scene describes is not limited; what is planned and read is.
floats = st.floats(allow_nan=False, width=64)
numbers = st.floats(-LARGEST, LARGEST) | st.sampled_from([-LARGEST, LARGEST])
LAST = LATEST - timedelta(microseconds=1)
times = st.one_of(
    st.datetimes(EARLIEST.replace(tzinfo=None), LAST.replace(tzinfo=None), timezones=st.just(UTC)),
    st.sampled_from([EARLIEST, LAST]),
)
motions = st.one_of(
    st.builds(HalvesApart, gap_mm=floats),
    st.builds(Rigid, rotation_rad=st.tuples(floats, floats, floats)),
)
surfaces = st.one_of(
    st.builds(Plane, width_mm=floats, height_mm=floats),
    st.builds(Cylinder, radius_mm=floats, width_mm=floats, height_mm=floats),
    st.just(TopHat()),
)
states = st.builds(
    LoadState,
    label=st.from_regex(r"S[0-9]{2}", fullmatch=True),
    load_n=st.none() | numbers,
    time=st.none() | times,
    channels=st.dictionaries(texts(NAME_LETTERS), numbers, max_size=3),
    deformation=st.lists(motions, max_size=2).map(tuple),
)
campaigns = st.builds(
    Campaign,
    name=st.just("test"),
    specimen=st.builds(Specimen, name=texts(NAME_LETTERS), material=texts(REMARK_LETTERS)),
    rig=st.just("rig"),
    states=st.lists(states, min_size=1, max_size=3, unique_by=lambda s: s.label).map(tuple),
    views=st.just(("C1P1",)),
    scene=st.none() | st.builds(Scene, rig=st.just(Rig("rig", ())), surface=surfaces),
)


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(campaigns)
def test_plain_data_survive_json_exactly(campaign: Campaign) -> None:
    assert record_from_parts(Campaign, plain_to_json(campaign), {}, "here") == campaign


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('"full_scale":4095', '"full_scale":"4095"', "full_scale"),
        ('"full_scale":4095', '"full_scale":4095,"colour":1', "colour"),
        ('"full_scale":4095,', "", "full_scale"),
        ('"steps":4', '"steps":4.5', "steps"),
    ],
    ids=["text for a number", "unknown field", "missing field", "fraction"],
)
def test_reading_is_strict(old: str, new: str, complaint: str) -> None:
    record = replace(example(Measurement, np.random.default_rng(0)), full_scale=4095)
    record = replace(record, sequence=replace(record.sequence, steps=4))
    text = plain_to_json(record)
    assert old in text
    arrays = {"texture": record.texture, "frames": record.frames}
    with pytest.raises(ArchiveCorrupt, match=complaint):
        record_from_parts(Measurement, text.replace(old, new), arrays, "here")


@pytest.mark.parametrize(
    ("field", "value", "complaint"),
    [
        ("texture", np.zeros((5, 7), np.float64), "declared uint16"),
        ("texture", np.zeros((2, 5, 7), np.uint16), "declared over"),
        ("frames", ArrayStack(np.zeros((6, 5, 7), np.float32)), "uint8 or uint16"),
    ],
)
def test_arrays_that_break_their_declaration_are_refused(
    field: str, value: Any, complaint: str, tmp_path: Path
) -> None:
    record = replace(example(Measurement, np.random.default_rng(0)), **{field: value})
    with pytest.raises(TypeError, match=complaint):
        Archive(FolderStore(tmp_path)).seal_dataset({"measurement": record}, provenance())
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []
