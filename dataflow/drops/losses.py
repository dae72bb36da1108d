"""Losses of a recorded run by its firing records: messages that operators did not get, or not in time."""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from dataflow.graph.model import Node
from dataflow.operator import InputPort
from dataflow.records.firing import CALLS, WITHHELD, FiringRecord
from dataflow.sync import FOREVER, messages_of

LOST = frozenset({"late", "overflow", "refused", "reset"})
"""Reasons of drops that are none of the operator's own; the others (a join without a partner) follow from these."""
Place = tuple[int, int]
"""Incarnation and number of a message."""
Sent = Mapping[str, Sequence[tuple[Place, int]]]
"""By stream, place and stamp (ns) of its messages, in order."""


@dataclass(frozen=True, slots=True, order=True)
class Loss:
    """A message that did not reach an input in time, or a tick that was left out (input `TICK`, no stream).

    `stamp`: the message's, in ns. `until`: the last firing (ns) that had to do without it; `FOREVER`: all. `reason`: of
    the drop; "waited" for one that came after the wait for it had run out, "missed" for one that no record names.
    """

    stamp: int
    operator: str
    input: str
    stream: str
    reason: str
    until: int = FOREVER


def sent_by(outputs: Sequence[str], records: Sequence[FiringRecord]) -> Sent:
    """Returns what an operator or a source sent on its streams, by its records."""
    found: dict[str, list[tuple[Place, int]]] = {stream: [] for stream in outputs}
    for record in records:
        for stream, emission in zip(outputs, record.outputs, strict=False):
            if emission is not None and emission.seq != WITHHELD:
                found[stream].append(((record.incarnation, emission.seq), emission.stamp))
    return found


def losses_of(node: Node, records: Sequence[FiringRecord], sent: Sent, static: frozenset[str]) -> list[Loss]:
    """Returns what an operator did not get in time. `sent`: on the streams that it takes."""
    found: dict[tuple[str, str, int], Loss] = {}
    drops = [drop for record in records for drop in record.drops]
    for drop in drops:
        if drop.reason in LOST:
            place = drop.input, drop.stream, drop.stamp
            found[place] = Loss(drop.stamp, node.name, drop.input, drop.stream, drop.reason)
    dropped = {(drop.input, drop.stream, drop.incarnation, drop.seq) for drop in drops}
    for name, streams in node.inputs.items():
        port = node.operator.spec.inputs[name]
        for stream in streams:
            if stream in static or stream not in sent:
                continue
            there = [(place, at) for place, at in sent[stream] if (name, stream, *place) not in dropped]
            firings = _firings(records, name, stream)
            for at, until in _without(port, firings, there):
                reason = "missed" if until == FOREVER else "waited"
                found.setdefault((name, stream, at), Loss(at, node.name, name, stream, reason, until))
    return sorted(found.values())


def bursts_of(losses: Sequence[Loss], sent: Sent) -> list[list[Loss]]:
    """Returns the losses by bursts: an operator lost every message of a stream between the first and the last, and what
    it lost of its other streams meanwhile. They are ordered by their first losses."""
    number = {(stream, stamp): k for stream, messages in sent.items() for k, (_, stamp) in enumerate(messages)}
    runs: dict[tuple[str, str, str], list[list[Loss]]] = {}
    for loss in sorted(losses):
        here = runs.setdefault((loss.operator, loss.input, loss.stream), [])
        before = number.get((loss.stream, here[-1][-1].stamp), -2) if here else -2
        if number.get((loss.stream, loss.stamp)) == before + 1:
            here[-1].append(loss)
        else:
            here.append([loss])
    found: list[list[Loss]] = []
    last: dict[str, list[Loss]] = {}
    for run in sorted(run for each in runs.values() for run in each):
        burst = last.get(run[0].operator)
        if burst is not None and run[0].stamp <= max(loss.stamp for loss in burst):
            burst += run
        else:
            last[run[0].operator] = run
            found.append(run)
    return found


def _firings(records: Sequence[FiringRecord], name: str, stream: str) -> list[tuple[int, list[Place]]]:
    """Stamps of the firings, with what they were given of a stream; and of those that were none for want of it."""
    found: list[tuple[int, list[Place]]] = []
    for record in records:
        found += [(drop.stamp, []) for drop in record.drops if drop.because == name]
        if record.kind in CALLS and record.kind != "finish":
            given = messages_of(record.inputs.get(name))
            found.append((record.stamp, [(one.incarnation, one.seq) for one in given if one.stream == stream]))
    return sorted(found)


def _without(
    port: InputPort, firings: Sequence[tuple[int, list[Place]]], there: Sequence[tuple[Place, int]]
) -> Iterator[tuple[int, int]]:
    """Yields stamp and `until` of those messages of a stream that came too late, or never, though not dropped."""
    stamps = [stamp for stamp, _ in firings]
    if port.kind == "sampled":
        until: dict[int, int] = {}
        ats = [at for _, at in there]
        for stamp, places in firings:
            for k in range(bisect.bisect_right(ats, stamp - port.before) - 1, -1, -1):
                place, at = there[k]
                if (places and place <= places[-1]) or (port.max_age is not None and stamp - at > port.max_age):
                    break
                until[at] = stamp
        yield from until.items()
        return
    taken = {place: stamp for stamp, places in firings for place in places}
    for place, at in there:
        if stamps and place not in taken and at <= stamps[-1]:
            yield at, FOREVER
        elif port.kind == "batch" and place in taken:
            first = bisect.bisect_left(stamps, at)
            if stamps[first] < taken[place]:
                yield at, stamps[bisect.bisect_left(stamps, taken[place]) - 1]
