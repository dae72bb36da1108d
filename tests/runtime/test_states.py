"""Operator states travel unchanged, and equal states have equal bytes."""

from __future__ import annotations

from typing import Any

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.execution.comparator import Comparator
from dataflow.execution.snapshots import differing_fields, pack_state, unpack_state
from dataflow.records.firing import FiringRecord
from dataflow.state import StateError

arrays = hnp.arrays(
    st.one_of(
        hnp.boolean_dtypes(), hnp.integer_dtypes(endianness="<"), hnp.floating_dtypes(endianness="<", sizes=(32, 64))
    ),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)
leaves = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats(), st.text(), st.binary(max_size=20), arrays
)
values = st.recursive(
    leaves,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=5), inner, max_size=4)),
    max_leaves=12,
)
states = st.dictionaries(st.text(max_size=8), values, max_size=5)


def same(a: Any, b: Any) -> bool:
    """Equal types and bits."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float):
        return isinstance(b, float) and np.float64(a).tobytes() == np.float64(b).tobytes()
    return type(a) is type(b) and bool(a == b)


@settings(max_examples=150)
@given(states)
def test_state_is_restored_bit_for_bit(state: dict[str, Any]) -> None:
    assert same(unpack_state(pack_state(state)), state)


@settings(max_examples=60)
@given(states)
def test_equal_states_have_equal_bytes_whatever_the_order_of_their_keys(state: dict[str, Any]) -> None:
    assert pack_state(dict(reversed(state.items()))) == pack_state(state)


def test_array_of_any_layout_is_restored_and_writable() -> None:
    state = {"columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)), "part": np.arange(10)[::3]}

    restored = unpack_state(pack_state(state))

    assert np.array_equal(restored["columns"], state["columns"])
    assert restored["part"].tolist() == [0, 3, 6, 9]
    restored["part"][0] = 1


def test_numbers_of_numpy_come_back_as_arrays_without_dimensions() -> None:
    restored = unpack_state(pack_state({"x": np.float32(0.1)}))

    assert restored["x"].shape == ()
    assert restored["x"].dtype == np.float32
    assert restored["x"] == np.float32(0.1)


@pytest.mark.parametrize(
    ("state", "words"),
    [
        ({"tracks": [{"box": object()}]}, r"state.tracks\[0\].box is a object"),
        ({"seen": {1, 2}}, "state.seen is a set"),
        ({"by_id": {3: "cup"}}, "state.by_id: key 3 is no string"),
        ({"names": np.array(["a", None], object)}, "state.names is a ndarray"),
    ],
)
def test_unpackable_state_is_refused_with_its_place(state: dict[str, Any], words: str) -> None:
    with pytest.raises(StateError, match=words):
        pack_state(state)


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x81\xa1x"])
def test_bytes_that_are_no_state_are_refused(data: bytes) -> None:
    with pytest.raises(StateError, match="not an operator's state"):
        unpack_state(data)


@pytest.mark.parametrize(
    ("recorded", "here", "words"),
    [
        ({"a": 1, "b": np.zeros(2)}, {"a": 1, "b": np.ones(2)}, "in b"),
        (
            {"a": 1},
            {"a": 1, "b": 2},
            "of another version of the operator: the recorded one lacks b and has none besides",
        ),
        (
            {"a": {"b": {"c": 1}}},
            {"a": {"b": {"d": 1}}},
            "of another version of the operator: the recorded one lacks d and has c besides in a.b",
        ),
        (
            {"counts": {"seen": 1}},
            {"counts": [["seen", 1]]},
            "of another version of the operator: the recorded one holds counts in another form",
        ),
        ({"a": {"b": None}}, {"a": {"b": {"c": 1}}}, "in a"),
        ({"a": None}, {"a": 5}, "in a"),
        ({"a": {"schema": "Pose", "b": 1}}, {"a": {"schema": "Odometry", "c": 1}}, "in a"),
        ({}, None, "none is given now"),
        (None, {}, "none was recorded"),
    ],
)
def test_differing_fields_of_two_states_are_named(recorded: Any, here: Any, words: str) -> None:
    packed = [b"" if state is None else pack_state(state) for state in (recorded, here)]

    assert differing_fields(packed[0], packed[1]) == words


@pytest.mark.parametrize(
    ("recorded", "here", "alike"),
    [
        ({"a": 1}, {"a": 1, "b": 2}, True),
        ({"a": [{"c": np.ones(2), "gone": 1}]}, {"a": [{"c": np.ones(2), "new": 2}]}, True),
        ({"a": 1}, {"a": 2, "b": 2}, False),
        ({"a": [{"c": 1}]}, {"a": [{"c": 1}, {"c": 1}], "b": 2}, False),
        ({"a": {"schema": "Pose", "b": 1}}, {"a": {"schema": "Pose", "c": 1}}, False),
    ],
)
def test_states_of_changed_code_are_compared_in_the_fields_of_both(recorded: Any, here: Any, alike: bool) -> None:
    record = FiringRecord("op", 0, 3, "snapshot", 5, detail={"state": pack_state(recorded)})

    for changed in ({"robot": "before"}, {}):
        comparator = Comparator("op", (), {})
        comparator.code(changed, {"robot": "now"})
        comparator.state(record, pack_state(here))
        assert (comparator.result.differing == 0) == (alike and bool(changed))
