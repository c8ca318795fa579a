"""Signatures of kernels are read as they were written."""

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import types

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.signatures import signature_of, text_of
from sms_jobs.virtual_rig.rays import unit_to
from sms_jobs.virtual_rig.surfaces import Packed

_NUMBERS = st.sampled_from([types.float64, types.float32, types.int64, types.uint16, types.boolean])
_ARRAYS = st.builds(
    types.Array, _NUMBERS, st.integers(1, 4), st.sampled_from("CFA"), readonly=st.booleans()
).filter(lambda array: array.ndim > 1 or array.layout != "F")
_SINGLE = st.one_of(
    st.just(types.none),
    st.builds(types.literal, st.integers(-9, 99)),
    st.builds(types.Optional, _NUMBERS),
    st.builds(types.Omitted, st.sampled_from([None, 1, 2.5, True])),
    st.just(numba.typeof(unit_to)),
)
_TUPLES = st.recursive(
    st.one_of(_NUMBERS, _ARRAYS),
    lambda parts: st.lists(parts, max_size=3).map(types.BaseTuple.from_types),
    max_leaves=6,
)


@given(st.lists(st.one_of(_SINGLE, _TUPLES), max_size=5))
def test_what_is_written_is_read(signature):
    assert signature_of(text_of(tuple(signature))) == tuple(signature)


def test_named_tuples_are_read():
    arrays = Packed(*(np.zeros((2, 2)) for _ in Packed._fields))
    signature = (numba.typeof(arrays), numba.typeof(3))
    text = text_of(signature)
    assert text.startswith("(sms_jobs.virtual_rig.surfaces.Packed(float64[:, ::1]")
    assert signature_of(text) == signature


def test_what_has_no_name_is_refused():
    with pytest.raises(InvalidInput, match="has no name"):
        text_of((types.unicode_type,))


@pytest.mark.parametrize("text", ["(", "(float63,)", "(1 + 1,)", "(sms_jobs.nowhere.Thing(int64),)"])
def test_what_is_no_signature_is_refused(text):
    with pytest.raises(InvalidInput, match="write"):
        signature_of(text)
