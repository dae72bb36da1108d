"""Operators in the state that they had in the middle of a recorded run, and the messages that they held then."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from dataflow.execution.failure import RESTORE, OperatorFailure
from dataflow.graph.model import Graph, Node
from dataflow.operator import Operator
from dataflow.recording import Recorded, Recording
from dataflow.records.cuts import is_known, taken_by
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.records.reading import FiringLog, recorded_firings
from dataflow.reexecution.engine import Recomputation, plan_feeding
from dataflow.reexecution.recorded_run import ReplayError, recorded_graph
from dataflow.sync import Entry, messages_of


@dataclass(frozen=True, slots=True)
class WarmStart:
    """An operator as it was just before a stamp. `began`: what was repeated to get there, as in `Verification`."""

    operator: Operator
    began: str


def fresh_because(recording: Recording, graph: Graph, node: Node, stamp: int) -> str | None:
    """Returns why an operator must begin with fresh state at `stamp`, in words; None where its recorded state is
    available."""
    if node.operator.stateless:
        return None
    try:
        recorded = recorded_graph(recording).nodes.get(node.name)
    except ReplayError:
        return "the recording does not hold the graph that made it"
    if recorded is None or (recorded.use, recorded.params, recorded.inputs) != (node.use, node.params, node.inputs):
        return "it is not the operator that was recorded"
    if not recording.firing_batches().get(node.name):
        return "it left no firing records"
    if _is_unknown(recorded_firings(recording, node.name), stamp):
        return "the recording was cut, and holds no state of it before that"
    try:
        plan_feeding(recording, graph, [node.name])
    except ReplayError as error:
        return str(error)
    return None


def warm_start(path: Path, graph: Graph, node: Node, stamp: int) -> WarmStart | None:
    """The operator with the state it had before `stamp`: its last recorded snapshot, and the firings since repeated.

    Without snapshots, where its inputs were not recorded, or where the snapshot does not fit the class as it is now,
    everything before is repeated. None where it begins with
    fresh state. Raises `OperatorFailure`.
    """
    with Recording(path) as recording:
        if node.operator.stateless or fresh_because(recording, graph, node, stamp) is not None:
            return None
        feeding = plan_feeding(recording, graph, [node.name])
        log = FiringLog.read(recording)

        def repeated(begin: int | None) -> WarmStart | None:
            work = Recomputation(
                recording, graph, feeding, log, made=lambda stream, entry: None, begin=begin, end=stamp
            )
            result = work.run(close=False)[node.name]
            work.close(besides=node.name)
            if result.unverifiable or result.lost_records or result.unknown:
                work.runners[node.name].operator.close()
                return None
            return WarmStart(work.runners[node.name].operator, result.began)

        if feeding.operators != (node.name,):
            return repeated(None)
        try:
            return repeated(stamp - 1)  # a state at `stamp` has seen its messages
        except OperatorFailure as failure:
            if failure.when != RESTORE:
                raise
            return repeated(None)  # the class has other fields now


def _is_unknown(records: Iterable[FiringRecord], stamp: int) -> bool:
    """Returns whether records were left out, and no state was recorded between there and `stamp`."""
    unknown = False
    for record in records:
        if record.stamp > stamp and record.kind in CALLS:
            break
        if taken_by(record) is not None or is_known(record):
            unknown = not is_known(record)
        elif record.kind == "setup":
            unknown = False
    return unknown


def held_before(path: Path, node: Node, stamp: int, static: frozenset[str]) -> tuple[list[Entry], bool]:
    """Returns what the operator's aligner held just before `stamp`, as far as it matters, and whether it had fired
    before.

    By the firing records these are the messages that later firings took: partners of a join, the beginning of a batch,
    samples. Without records, the last message before `stamp` on each stream that is only sampled.
    """
    sampled, others = set[str](), set[str]()
    for port in node.operator.spec.inputs.values():
        (sampled if port.kind == "sampled" else others).update(node.inputs.get(port.name, ()))
    with Recording(path) as recording:
        known = [
            s for s in sorted((sampled | others) - static) if s in recording.streams and not recording.streams[s].static
        ]
        if not known:
            return [], False
        before = {stream: recording.index(stream, end=stamp - 1) for stream in known}
        newest = {stream: index.read(len(index) - 1) for stream, index in before.items() if len(index)}
        last = {stream: (item.incarnation, item.seq) for stream, item in newest.items()}
        taken, began = _taken_from(recorded_firings(recording, node.name), stamp, last)
        held: list[Entry] = []
        for stream, item in newest.items():
            earlier = (before[stream].read(at) for at in reversed(range(len(before[stream]) - 1)))
            found = _last_taken(chain([item], earlier), taken.get(stream, set()), or_newest=stream not in others)
            held += reversed(found)
        return held, began


def _last_taken(items: Iterable[Recorded], taken: Collection[tuple[int, int]], *, or_newest: bool) -> list[Entry]:
    """Of the messages of a stream, the newest first, those that are among `taken` (incarnation, number); of none, the
    newest if `or_newest`. Only what lies after the first of them is read."""
    found: list[Entry] = []
    newest: Entry | None = None
    first = min(taken, default=None)
    if first is None and not or_newest:
        return found
    for item in items:
        message, place = item.message, (item.incarnation, item.seq)
        entry = Entry(message.stamp, message, item.seq, item.incarnation, message.digest(), item.stream)
        newest = newest or entry
        if place in taken:
            found.append(entry)
        if first is None or place <= first:
            break
    return found or ([newest] if or_newest and newest is not None else [])


def _taken_from(
    records: Iterable[FiringRecord], stamp: int, newest: Mapping[str, tuple[int, int]]
) -> tuple[Mapping[str, set[tuple[int, int]]], bool]:
    """By stream, (incarnation, number) of what the recorded firings from `stamp` on took, up to the message `newest`;
    and whether there are any before."""
    taken: dict[str, set[tuple[int, int]]] = {}
    began = False
    for record in records:
        began = began or taken_by(record) is not None or (record.kind in CALLS and record.stamp < stamp)
        if record.kind in CALLS and record.stamp >= stamp:
            for message in (message for ref in record.inputs.values() for message in messages_of(ref)):
                place = (message.incarnation, message.seq)
                if place <= newest.get(message.stream, (-1, -1)):
                    taken.setdefault(message.stream, set()).add(place)
    return taken, began
