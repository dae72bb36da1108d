"""Bags for a graph: which of its sources' streams the topics of a bag stand in for."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dataflow.graph.model import Graph
from dataflow.interop.bag import Bag, BagError, is_static
from dataflow.interop.clocks import Choice
from dataflow.interop.conversions import offers, proposed
from dataflow.interop.mapping import AvailableTopic, MappingError, Proposal, SourceStream, parse_map, propose
from dataflow.interop.opening import open_bag
from dataflow.interop.streams import BagStreams, MappedTopic
from dataflow.interop.topics import Reading, is_known
from dataflow.messages import CompressedDepth, DepthImage, Image, Image16, Message, Transforms
from dataflow.messages.depth_units import MILLIMETRES


@dataclass(frozen=True, slots=True)
class Matching:
    """The streams of a graph's sources, the topics of a bag, and what is proposed."""

    path: Path
    wanted: tuple[SourceStream, ...]
    readings: tuple[Reading, ...]
    proposal: Proposal

    def played(self) -> dict[str, MappedTopic]:
        """Stream → what stands in for it. Raises `MappingError` where the proposal is not settled."""
        if not self.proposal.settled:
            raise MappingError(self.explanation())
        return {m.wanted.stream: MappedTopic(m.topic, m.type, m.wanted.static) for m in self.proposal.matches}

    def options(self) -> list[str]:
        """The proposal as words of `--map`."""
        return [f"{m.topic}={m.wanted.name}" for m in self.proposal.matches]

    def explanation(self) -> str:
        """Explains why the proposal is not settled, and what would settle it."""
        lines = [f"{self.path}: which topics feed the graph must be said with --map"]
        for wanted in self.proposal.missing:
            lines.append(f"  no topic holds what {wanted.name} takes: {' or '.join(wanted.types)}")
        lines.append("topics:")
        width = max((len(r.topic.name) for r in self.readings), default=0)
        for r in self.readings:
            what = " or ".join(_types(r)) if r.playable else r.reason
            lines.append(f"  {r.topic.name:{width}}  {r.topic.count:>8,}  {what}")
        if self.proposal.matches:
            lines.append("proposed, from types and names:")
            lines.append("  " + " ".join(f"--map {word}" for word in self.options()))
        return "\n".join(lines)


def wanted_streams(graph: Graph) -> tuple[SourceStream, ...]:
    """The streams of a graph's sources, and whether an operator cannot do without."""
    found = []
    for node in graph.sources():
        for stream in node.outputs.values():
            declared = graph.streams[stream]
            needed = any(consumer.input_port(port).required for consumer, port in graph.consumers(stream))
            found.append(SourceStream(stream, graph.relative(stream), declared.types, declared.static, needed))
    return tuple(found)


def match(path: Path, graph: Graph, words: Sequence[str]) -> Matching:
    """Returns what of a bag can feed a graph. `words`: TOPIC=STREAM. Raises `BagError` and `MappingError`."""
    bag = open_bag(path)
    try:
        readings = readings_of(bag)
    finally:
        bag.close()
    wanted = wanted_streams(graph)
    given = parse_map(words, wanted, list(bag.topics))
    for reading in readings:
        if reading.topic.name in given.values() and not reading.playable:
            raise MappingError(f"{path}: topic {reading.topic.name} cannot be played: {reading.reason}")
    offered = [
        AvailableTopic(r.topic.name, _types(r, r.topic.name in given.values()), r.topic.count)
        for r in readings
        if r.playable
    ]
    return Matching(path, wanted, readings, propose(wanted, offered, given))


def readings_of(bag: Bag, names: Collection[str] | None = None) -> tuple[Reading, ...]:
    """Returns how the topics of a bag can be read."""
    return tuple(Reading(bag, topic) for name, topic in bag.topics.items() if names is None or name in names)


def play(
    path: Path,
    graph: Graph,
    words: Sequence[str] = (),
    clock: Choice = "auto",
    watch: Callable[[int], None] | None = None,
) -> BagStreams:
    """Opens a bag as the streams of a graph's sources. Raises `BagError` and `MappingError`."""
    return BagStreams(path, match(path, graph, words).played(), clock, watch=watch)


@dataclass(frozen=True, slots=True)
class BagReadOptions:
    """Options for reading a bag: `depth`, topics of 16-bit depth, be it that their messages do not say so, and
    how many of their units a metre has; `lossy`, whether 16-bit images become 8-bit ones; `strict`, whether a message
    that cannot be read is an error."""

    depth: Mapping[str, float] = field(default_factory=dict)
    lossy: bool = False
    strict: bool = False


PLAIN = BagReadOptions()


def readable(
    bag: Bag,
    path: Path,
    clock: Choice = "auto",
    topics: Collection[str] | None = None,
    wishes: BagReadOptions = PLAIN,
    *,
    accounting: bool = False,
) -> BagStreams:
    """Opens all topics of a bag, or some, that a message type fits, each under its own name.

    Topics called `tf_static` are static: all their transforms as one message. Raises `BagError`.
    """
    for name in wishes.depth:
        if name not in bag.topics:
            raise BagError(f"{path} has no topic {name!r}; it has {', '.join(bag.topics) or 'none'}")
    readings = readings_of(bag, topics)
    found = [r for r in readings if r.playable and r.topic.count]
    played = {
        r.topic.name: MappedTopic(
            r.topic.name,
            _wished(r, wishes).SCHEMA,
            r.read_as is Transforms and is_static(r.topic.name),
            wishes.depth.get(r.topic.name, MILLIMETRES),
        )
        for r in found
        if r.read_as is not None
    }
    streams = BagStreams(path, played, clock, strict=wishes.strict, accounting=accounting)
    kept = [r for r in readings if r.topic.count and not r.playable and is_known(r.topic)]
    streams.account.notes += [f"topic {r.topic.name} stays as it is, since it cannot be read: {r.reason}" for r in kept]
    empty = [r.topic.name for r in readings if not r.topic.count and is_known(r.topic)]
    if empty:
        streams.account.notes.append(f"declared without a message: {', '.join(empty)}")
    return streams


def _wished(reading: Reading, wishes: BagReadOptions) -> type[Message]:
    assert reading.read_as is not None
    if reading.topic.name in wishes.depth and reading.read_as not in (DepthImage, CompressedDepth):
        if DepthImage not in offers(reading.read_as):
            raise BagError(f"topic {reading.topic.name} is read as {reading.read_as.SCHEMA}, which cannot be depth")
        return DepthImage
    return Image if wishes.lossy and reading.read_as is Image16 else reading.read_as


def _types(reading: Reading, told: bool = False) -> tuple[str, ...]:
    """Returns the types that a topic can be played as; `told`: including those that a mapping has to name."""
    if reading.read_as is None:
        return ()
    return tuple(t.SCHEMA for t in (offers if told else proposed)(reading.read_as))
