"""Recorded firings are made again: a message is held until its last firing, however many take it."""

from __future__ import annotations

import pytest

from dataflow.sync import AlignSpec, Entry, FiringInputs, MessageRef, RecordedAligner, SampledSpec, TriggerSpec, Uses

SPEC = AlignSpec((TriggerSpec("x", ("x",)),), (SampledSpec("map", ("map",)),))
MAP = MessageRef("map", 0, 0)


@pytest.mark.parametrize("firings", [1, 254, 255, 256, 257, 600])
def test_a_message_is_held_until_the_last_firing_that_takes_it(firings: int) -> None:
    uses = Uses()
    records = [
        FiringInputs(stamp, "fire", inputs={"x": MessageRef("x", 0, stamp), "map": MAP}) for stamp in range(firings)
    ]
    for record in records:
        uses.add(record.inputs)
    aligner = RecordedAligner(SPEC, uses)
    aligner.push("map", Entry(0, "the map"))
    assert aligner.take(records[0]) is None
    assert aligner.missing() == MessageRef("x", 0, 0)

    for stamp, record in enumerate(records):
        assert aligner.buffered() == {"map": 1, "x": 0}
        aligner.push("x", Entry(stamp, seq=stamp))
        firing = aligner.take(record)
        assert firing is not None
        assert firing.inputs["map"].value == "the map"

    assert aligner.buffered() == {"map": 0, "x": 0}
    assert not aligner.takes("map", Entry(0))
