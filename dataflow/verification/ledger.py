"""What a recording can account for: the messages that operators made against the firing records that tell of them.

A message without a record shows that records were lost, however whole the others look. Where a recording ends before
its run did (its writer was killed, the run failed), that is a *cut*: what lies after it cannot be verified.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.recording.layout import OUTCOME
from dataflow.records.comparison import Verification
from dataflow.records.firing import WITHHELD
from dataflow.reexecution.recorded import recorded_firings
from dataflow.sync import messages_of

COMPLETE = "complete"

Place = tuple[int, int]
"""(incarnation, number) of a message in its stream."""


@dataclass(frozen=True, slots=True)
class Account:
    """What the recording says of one operator's messages.

    `unaccounted` were stored, or taken by another operator, and no firing record made them; `not_stored` were made by a
    record and are not in a stream that was recorded. `finished`: the last record is that of `finish()`.
    """

    unaccounted: int
    not_stored: int
    finished: bool


@dataclass(frozen=True, slots=True)
class Ledger:
    """The accounts of operators, and whether the recording tells of its run to the end.

    `ended` is False for a file without a proper end and for a run that failed or was left at once.
    """

    accounts: Mapping[str, Account]
    ended: bool

    def enter(self, verification: Verification) -> None:
        """Tells a verification what its recording cannot account for."""
        account = self.accounts[verification.operator]
        verification.not_stored = account.not_stored
        verification.cut = not self.ended and not account.finished
        if verification.cut:
            verification.after_cut = account.unaccounted
        else:
            verification.unaccounted = account.unaccounted
            verification.unfinished = not account.finished


def read_ledger(recording: Recording, graph: Graph, operators: Collection[str]) -> Ledger:
    """The accounts of `operators`. Raises `FiringRecordError`."""
    made: dict[str, set[Place]] = {s: set() for name in operators for s in graph.nodes[name].outputs.values()}
    taken: dict[str, set[Place]] = {s: set() for s in made}
    finished = dict.fromkeys(operators, False)
    for name, node in graph.nodes.items():
        if node.source:
            continue
        outputs, last = list(node.outputs.values()), (-1, -1)
        for record in recorded_firings(recording, name):
            for ref in record.inputs.values():
                for message in messages_of(ref):
                    if message.stream in taken:
                        taken[message.stream].add((message.incarnation, message.seq))
            if name not in finished:
                continue
            for stream, emission in zip(outputs, record.outputs, strict=False):  # a failed call has none
                if emission is not None and emission.seq != WITHHELD:
                    made[stream].add((record.incarnation, emission.seq))
            if (record.incarnation, record.index) > last:
                last = (record.incarnation, record.index)
                finished[name] = record.kind == "finish"
    accounts = {name: _account(recording, graph, name, made, taken, finished[name]) for name in operators}
    outcome = recording.metadata.get(OUTCOME, {}).get("outcome")
    return Ledger(accounts, not recording.torn and outcome == COMPLETE)


def _account(
    recording: Recording,
    graph: Graph,
    operator: str,
    made: Mapping[str, set[Place]],
    taken: Mapping[str, set[Place]],
    finished: bool,
) -> Account:
    unaccounted = not_stored = 0
    for stream in graph.nodes[operator].outputs.values():
        told = Counter(incarnation for incarnation, _ in made[stream])
        stored = recording.counts(stream)
        excess = sum(max(0, count - told[incarnation]) for incarnation, count in stored.items())
        unaccounted += max(excess, len(taken[stream] - made[stream]))
        if stream in recording.streams:
            not_stored += sum(max(0, count - stored.get(incarnation, 0)) for incarnation, count in told.items())
    return Account(unaccounted, not_stored, finished)
