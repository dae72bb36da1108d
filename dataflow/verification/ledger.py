"""The books of a recording: the messages that its nodes made against the firing records that tell of them.

A message without a record shows that records were lost, however whole the others look. Where a recording ends before
its run did (its writer was killed, the run failed), that is a *cut*: what lies after it cannot be verified.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.recording.layout import OUTCOME, RECOVERED
from dataflow.recording.streams.cutting import Cut, cut_of
from dataflow.records.comparison import Verification
from dataflow.records.cuts import held_by
from dataflow.records.firing import CALLS, WITHHELD, Emission
from dataflow.records.reading import FiringLog, Place, whole
from dataflow.sync import messages_of

COMPLETE = "complete"


@dataclass(frozen=True, slots=True)
class Account:
    """The messages of one node, by the account of its recording.

    `unaccounted` were stored, or taken by another operator, and no firing record made them; `not_stored` were made by a
    record and are not in a stream that was recorded. `lost` calls follow a gap in the records. `finished`: the last
    call is that of `finish()`. Records that may follow it are no calls: a parameter that was changed, the `setup()` of
    a process that was restarted when the node had ended.
    """

    unaccounted: int
    not_stored: int
    lost: int
    finished: bool


@dataclass(frozen=True, slots=True)
class Ledger:
    """The accounts of nodes, and whether the recording covers its run to the end.

    `ended` is False for a file without a proper end (`torn`) and for a run that failed or was interrupted. Records are
    stored before messages: messages that a torn file lacks may have followed, those that an intact file lacks were
    never sent. `part`: the file is a part of a recording, cut out of it.
    """

    accounts: Mapping[str, Account]
    ended: bool
    torn: bool
    part: Cut | None = None

    def enter(self, verification: Verification) -> None:
        """Tells a verification what its recording cannot account for."""
        account = self.accounts[verification.operator]
        verification.not_stored = account.not_stored
        lacking = self.torn and bool(account.not_stored or verification.beyond)
        verification.cut = not self.ended and (not account.finished or lacking or self.part is not None)
        if verification.cut and self.part is None:
            verification.after_cut = account.unaccounted
        else:
            verification.unaccounted = account.unaccounted
            verification.unfinished = not account.finished and self.part is None


def read_ledger(recording: Recording, graph: Graph, log: FiringLog, nodes: Collection[str]) -> Ledger:
    """The accounts of `nodes`. Raises `RecordingError` for records that cannot be read."""
    made: dict[str, set[Place]] = {s: set() for name in nodes for s in graph.nodes[name].outputs.values()}
    taken: dict[str, set[Place]] = {s: set() for s in made}
    finished, lost = dict.fromkeys(nodes, False), dict.fromkeys(nodes, 0)
    since: dict[str, Emission] = {}
    for name, node in graph.nodes.items():
        outputs, last = list(node.outputs.values()), (-1, -1)
        for record in log.of(name):
            if record.index < log.begins.get(name, 0) and record.kind != "setup":
                continue
            for ref in record.inputs.values():
                for message in messages_of(ref):
                    if message.stream in taken:
                        taken[message.stream].add((message.incarnation, message.seq))
            if name not in finished:
                continue
            for stream, emission in zip(outputs, record.outputs, strict=False):  # a failed call has none
                if emission is not None and emission.seq != WITHHELD:
                    made[stream].add((record.incarnation, emission.seq))
                    if name in log.begins and record.kind != "setup":
                        since.setdefault(stream, emission)
            for held in held_by(record):
                if held.stream in made:
                    made[held.stream].add(held.place)
            if (record.incarnation, record.index) > last:
                last = (record.incarnation, record.index)
                finished[name] = record.kind == "finish" or (finished[name] and record.kind not in CALLS)
        if name in lost:
            lost[name] = whole(log.of(name))[1]
    for stream, first in since.items():
        taken[stream] = {place for place in taken[stream] if place >= (0, first.seq)}
    stored = {s: recording.counts(s, since[s].stamp if s in since else None) for s in made}
    accounts = {
        name: _account(recording, stored, graph, name, made, taken, lost[name], finished[name]) for name in nodes
    }
    outcome = recording.metadata.get(OUTCOME, {}).get("outcome")
    part, torn = cut_of(recording.metadata), recording.torn or RECOVERED in recording.metadata
    return Ledger(accounts, not torn and part is None and outcome == COMPLETE, torn, part)


def incomplete_streams(recording: Recording, graph: Graph, log: FiringLog, nodes: Iterable[str]) -> frozenset[str]:
    """The recorded streams of operators among `nodes` that lack messages their firing records tell of.

    A record is stored before its message, so a process that is killed leaves records of messages that went no further
    than to its own operators. What took them can be repeated all the same: the records tell how to make them again.
    """
    incomplete: set[str] = set()
    for node in (graph.nodes[name] for name in nodes):
        if node.source or node.external:
            continue
        told = Counter(
            stream
            for record in log.of(node.name)
            for stream, emission in zip(node.outputs.values(), record.outputs, strict=False)  # a failed call has none
            if emission is not None and emission.seq != WITHHELD
        )
        incomplete.update(
            stream
            for stream, count in told.items()
            if stream in recording.streams
            and not graph.streams[stream].static
            and count > sum(recording.counts(stream).values())
        )
    return frozenset(incomplete)


def _account(
    recording: Recording,
    counts: Mapping[str, Mapping[int, int]],
    graph: Graph,
    node: str,
    made: Mapping[str, set[Place]],
    taken: Mapping[str, set[Place]],
    lost: int,
    finished: bool,
) -> Account:
    unaccounted = not_stored = 0
    for stream in graph.nodes[node].outputs.values():
        told = Counter(incarnation for incarnation, _ in made[stream])
        stored = counts[stream]
        if graph.streams[stream].static:  # recorded once, however often it was made
            unaccounted += bool(sum(stored.values())) and not told
            not_stored += stream in recording.streams and not sum(stored.values()) and bool(told)
            continue
        excess = sum(max(0, count - told[incarnation]) for incarnation, count in stored.items())
        unaccounted += max(excess, len(taken[stream] - made[stream]))
        if stream in recording.streams:
            not_stored += sum(max(0, count - stored.get(incarnation, 0)) for incarnation, count in told.items())
    return Account(unaccounted, not_stored, lost, finished)
