"""Tests of single operators: `play` runs one operator on streams, through the real aligner, without a graph.

outputs = play(CloudBuilder(stride=4), {"depth": depths, "image": images, "camera": [info]})
assert len(outputs["cloud"]) == len(depths)
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from dataflow.arguments import checked
from dataflow.firing.runner import OperatorRunner
from dataflow.firing.source import SourceRunner
from dataflow.graph.model import Live, Node
from dataflow.messages.base import Message
from dataflow.operator import Operator, Source
from dataflow.records.firing import FiringRecord
from dataflow.sync import Entry

NAMESPACE = "test"


@dataclass(slots=True)
class Played:
    """Result of a play: the messages of each output port, the firing records, and the drops by (input, reason)."""

    outputs: dict[str, list[Message]]
    records: list[FiringRecord]
    drops: dict[tuple[str, str], int] = field(default_factory=dict)

    def __getitem__(self, port: str) -> list[Message]:
        return self.outputs[port]

    def digests(self) -> dict[str, list[str]]:
        """The digests of each port's messages, to compare two plays."""
        return {port: [m.digest().hex() for m in messages] for port, messages in self.outputs.items()}


class _Collector:
    def __init__(self, node: Node) -> None:
        self.ports = {stream: port for port, stream in node.outputs.items()}
        self.played = Played({port: [] for port in node.outputs}, [])

    def message(self, stream: str, entry: Entry) -> None:
        self.played.outputs[self.ports[stream]].append(entry.value)

    def frontier(self, stream: str, frontier: int) -> None:
        """No consumer waits for it."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        """No consumer waits for it."""

    def record(self, record: FiringRecord) -> None:
        self.played.records.append(record)


@checked
def play(
    operator: Operator,
    streams: Mapping[str, Sequence[Message] | Mapping[str, Sequence[Message]]] | None = None,
    *,
    static: Sequence[str] = (),
    seed: int = 0,
    paranoid: bool = True,
) -> Played:
    """Runs an operator from `setup()` to `close()` on whole streams, oldest stamp first.

    `streams` maps each input to its messages, or, for an input with `many=True`, to {stream name: messages}. `static`
    names the inputs that are static. A source takes no streams. Operators that fail raise `OperatorFailure`, and inputs
    that an operator wrote into `InputMutated`, as in a graph.
    """
    spec = operator.spec
    wired = {
        name: {f"{NAMESPACE}/{name}/{s}": m for s, m in given.items()}
        if isinstance(given, Mapping)
        else {f"{NAMESPACE}/{name}/messages": given}
        for name, given in (streams or {}).items()
    }
    unknown = [name for name in (*wired, *static) if name not in spec.inputs]
    if unknown:
        raise ValueError(f"{spec.name} has no input {unknown[0]!r}; its inputs: {', '.join(spec.inputs) or 'none'}")
    node = Node(
        name="operator",
        use=f"{type(operator).__module__}:{type(operator).__qualname__}",
        params=json.loads(operator.params.model_dump_json()),
        inputs={name: tuple(sorted(wired.get(name, ()))) for name in spec.inputs},
        outputs={port: f"{NAMESPACE}/operator/{port}" for port in spec.outputs},
        live=Live("block", 64, {}),
        tolerance=spec.tolerance,
        every=spec.every,
    )
    collector = _Collector(node)
    try:
        if isinstance(operator, Source):
            _play_source(SourceRunner(node, collector, operator=operator, seed=seed))
            return collector.played
        statics = frozenset(stream for name in static for stream in wired.get(name, ()))
        runner = OperatorRunner(node, collector, static=statics, seed=seed, paranoid=paranoid, operator=operator)
        _play_operator(runner, {s: m for given in wired.values() for s, m in given.items()})
        collector.played.drops = dict(runner.drops)
    finally:
        operator.close()
    return collector.played


def _play_source(runner: SourceRunner) -> None:
    runner.setup()
    while runner.look_ahead() is not None:
        runner.admit()
    runner.finish()


def _play_operator(runner: OperatorRunner, streams: Mapping[str, Sequence[Message]]) -> None:
    runner.setup()
    arrivals = sorted(
        ((m.stamp, stream, seq, m) for stream, messages in streams.items() for seq, m in enumerate(messages)),
        key=lambda arrival: arrival[:3],
    )
    static = runner.aligner.spec.static
    arrivals.sort(key=lambda arrival: arrival[1] not in static)
    for stamp, stream, seq, message in arrivals:
        runner.push(stream, Entry(stamp, message, seq, 0, message.digest(), stream))
        while runner.step():
            pass
    for stream, messages in streams.items():
        runner.end(stream, messages[-1].stamp if messages else None, "end of test")
    while runner.step():
        pass
