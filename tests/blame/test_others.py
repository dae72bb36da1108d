"""Which inputs a firing may lack, and what it is then given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from dataflow.blame.repeated_calls import Slot
from dataflow.blame.substitutes import without
from dataflow.messages import FeatureVector
from dataflow.operator import Batch, In, Operator, Sampled
from dataflow.sync import Entry, Firing, InputValue


class Join(Operator):
    x: In[FeatureVector]
    needed: Sampled[FeatureVector]
    image: Sampled[FeatureVector] = Sampled(required=False)
    imu: Batch[FeatureVector]

    def process(self, x: Any, needed: Any, image: Any, imu: Any) -> None:
        return None


class Merge(Operator, merge=True):
    x: In[FeatureVector]
    y: In[FeatureVector]
    many: In[FeatureVector] = In(many=True)

    def process(self, x: Any, y: Any, many: Any) -> None:
        return None


def entry(stream: str, seq: int = 0) -> Entry:
    return Entry(100, None, seq, stream=stream)


JOINED: dict[str, InputValue] = {
    "x": entry("x"),
    "needed": entry("needed"),
    "image": entry("image"),
    "imu": tuple(entry("imu", seq) for seq in range(3)),
}
MERGED: dict[str, InputValue] = {"x": entry("x"), "y": None, "many": {name: entry(name) for name in "ab"}}


@pytest.mark.parametrize(
    ("operator", "inputs", "slots", "lacking"),
    [
        (Join, JOINED, [("image", 0)], {"image": None}),
        (Join, JOINED, [("imu", 0), ("imu", 2)], {"imu": (entry("imu", 1),)}),
        (Join, JOINED, [("imu", 1), ("image", 0)], {"imu": (entry("imu", 0), entry("imu", 2)), "image": None}),
        (Join, JOINED, [("x", 0)], None),
        (Join, JOINED, [("needed", 0)], None),
        (Join, JOINED, [("image", 0), ("needed", 0)], None),
        (Merge, MERGED, [("x", 0)], {"x": None}),
        (Merge, MERGED, [("many", 0)], {"many": {"b": entry("b")}}),
        (Merge, MERGED, [("many", 0), ("many", 1)], {"many": None}),
        (Merge, MERGED, [("x", 0), ("many", 0), ("many", 1)], None),  # nothing would trigger it
    ],
)
def test_a_message_is_left_out_where_the_operator_is_called_without_it(
    operator: type[Operator],
    inputs: Mapping[str, InputValue],
    slots: Sequence[Slot],
    lacking: Mapping[str, InputValue] | None,
) -> None:
    node: Any = SimpleNamespace(operator=operator)

    found = without(node, Firing(100, "fire", inputs=inputs), slots)

    assert found == (None if lacking is None else {**inputs, **lacking})
