"""A graph of a camera, two relays and a join, and records of calls in it."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.graph.model import Graph
from dataflow.records.firing import Emission, FiringRecord
from dataflow.sync import InputRef, MessageRef

MS = 1_000_000
DIAMOND = """
graph: diamond
operators:
  camera: {use: latency_operators:Device}
  lidar: {use: latency_operators:Device}
  fast: {use: latency_operators:Relay, inputs: {x: camera/value}}
  slow: {use: latency_operators:Relay, inputs: {x: camera/value}}
  join: {use: latency_operators:Join, inputs: {a: fast/y, b: slow/y, hint: lidar/value}}
"""


def record(
    operator: str,
    index: int,
    begin: float,
    work: float,
    inputs: Mapping[str, InputRef] | None = None,
    seq: int = -2,
    stamp: int | None = None,
) -> FiringRecord:
    """A call that began at `begin` ms and took `work` ms, and emitted its `index`-th message, or that of `seq`. Its
    stamp is its index where none is given."""
    stamp = index if stamp is None else stamp
    output = Emission(index if seq == -2 else seq, stamp, bytes(16))
    return FiringRecord(
        operator,
        0,
        index,
        "fire",
        stamp,
        inputs=inputs or {},
        outputs=(output,),
        wall_start=round(begin * MS),
        duration=round(work * MS),
    )


def message(graph: Graph, operator: str, seq: int) -> MessageRef:
    return MessageRef(next(iter(graph.nodes[operator].outputs.values())), 0, seq)


def one_round(graph: Graph, index: int, begin: float, slow: float) -> dict[str, list[FiringRecord]]:
    """The camera gives at `begin`; `fast` works 1 ms, `slow` as long as said, the join 2 ms after a wait of 3."""
    camera, end = message(graph, "camera", index), begin + 1 + slow
    return {
        "camera": [record("camera", index, begin, 0.5)],
        "fast": [record("fast", index, begin + 1, 1, {"x": camera})],
        "slow": [record("slow", index, begin + 1, slow, {"x": camera})],
        "join": [
            record(
                "join",
                index,
                end + 3,
                2,
                {"a": message(graph, "fast", index), "b": message(graph, "slow", index), "hint": None},
            )
        ],
    }
