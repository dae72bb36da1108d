"""Tests of single operators: `play` runs one operator on streams, through the real aligner, without a graph.

outputs = play(CloudBuilder(stride=4), {"depth": depths, "image": images, "camera": [info]})
assert len(outputs["cloud"]) == len(depths)
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from dataflow.arguments import checked
from dataflow.execution.driver import Driver, LocalEmitter
from dataflow.execution.runner import OperatorRunner
from dataflow.execution.source import SourceRunner
from dataflow.graph.model import Live, Node
from dataflow.messages.base import Message
from dataflow.operator import Operator, Source
from dataflow.records.firing import FiringRecord
from dataflow.sync import NEVER, Entry

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


class _Collector(LocalEmitter):
    """Keeps what the operator emits."""

    def __init__(self, driver: Driver, node: Node) -> None:
        super().__init__(driver)
        self.ports = {stream: port for port, stream in node.outputs.items()}
        self.played = Played({port: [] for port in node.outputs}, [])

    def message(self, stream: str, entry: Entry) -> None:
        self.played.outputs[self.ports[stream]].append(entry.value)

    def record(self, record: FiringRecord) -> None:
        self.played.records.append(record)


class _Arrivals:
    """Whole streams as a feed, one message at a time: static ones first, else the oldest stamp."""

    def __init__(self, emitter: LocalEmitter, streams: Mapping[str, Sequence[Message]], static: frozenset[str]) -> None:
        self.firings, self.last, self.ended = 0, NEVER, False
        self._emitter, self._streams = emitter, streams
        arrivals = [(s not in static, m.stamp, s, seq, m) for s in streams for seq, m in enumerate(streams[s])]
        self._left = sorted(arrivals, key=lambda arrival: arrival[:4], reverse=True)

    def look_ahead(self) -> int | None:
        return self._left[-1][1] if self._left else None

    def admit(self) -> tuple[int, int]:
        _, self.last, stream, seq, message = self._left.pop()
        self._emitter.message(stream, Entry(message.stamp, message, seq, 0, message.digest(), stream))
        return 1, 0

    def promise(self) -> None:
        """Promises nothing: firings wait for messages."""

    def finish(self, reason: str) -> None:
        self.ended = True
        for stream, messages in self._streams.items():
            self._emitter.end(stream, messages[-1].stamp if messages else None, reason)


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
    driver = Driver()
    collector = _Collector(driver, node)
    runner: OperatorRunner | None = None
    try:
        if isinstance(operator, Source):
            driver.sources.append(source := SourceRunner(node, collector, operator=operator, seed=seed))
            driver.feeding.feeds.append(source)
        else:
            statics = frozenset(stream for name in static for stream in wired.get(name, ()))
            runner = OperatorRunner(node, collector, static=statics, seed=seed, paranoid=paranoid, operator=operator)
            driver.add(runner)
            given = {stream: messages for streams in wired.values() for stream, messages in streams.items()}
            driver.feeding.feeds.append(_Arrivals(LocalEmitter(driver), given, statics))
        driver.set_up()
        while driver.turn():
            pass
    finally:
        operator.close()
    collector.played.drops = {} if runner is None else dict(runner.drops)
    return collector.played
