"""The accounts of a recording: the messages that its nodes made against their firing records.

A message without a record shows that records were lost, however whole the others look. Where a recording ends before
its run did (its writer was killed, the run failed), that is a *cut*: what lies after it cannot be verified.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.recording.layout import OUTCOME, RECOVERED
from dataflow.recording.streams.cutting import Cut, cut_of
from dataflow.records.comparison import Verification
from dataflow.verification.record_totals import GraphRecordTotals

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
        """Reports to a verification what its recording cannot account for."""
        account = self.accounts[verification.operator]
        verification.not_stored = account.not_stored
        lacking = self.torn and bool(account.not_stored or verification.beyond)
        verification.cut = not self.ended and (not account.finished or lacking or self.part is not None)
        if verification.cut and self.part is None:
            verification.after_cut = account.unaccounted
        else:
            verification.unaccounted = account.unaccounted
            verification.unfinished = not account.finished and self.part is None


def read_ledger(recording: Recording, graph: Graph, books: GraphRecordTotals, nodes: Collection[str]) -> Ledger:
    """The accounts of `nodes`. Raises `RecordingError` for records that cannot be read."""
    for name in graph.nodes:
        books.of(name)
    accounts = {name: _account(recording, graph, books, name) for name in nodes}
    outcome = recording.metadata.get(OUTCOME, {}).get("outcome")
    part, torn = cut_of(recording.metadata), recording.torn or RECOVERED in recording.metadata
    return Ledger(accounts, not torn and part is None and outcome == COMPLETE, torn, part)


def incomplete_streams(
    recording: Recording, graph: Graph, books: GraphRecordTotals, nodes: Iterable[str]
) -> frozenset[str]:
    """The recorded streams of operators among `nodes` that lack messages that are in their firing records.

    A record is stored before its message, so a process that is killed leaves records of messages that went no further
    than to its own operators. What took them can be repeated all the same: the records hold how to make them again.
    """
    return frozenset(
        stream
        for node in (graph.nodes[name] for name in nodes)
        if not (node.source or node.external)
        for stream, count in books.of(node.name).sent.items()
        if stream in recording.streams
        and not graph.streams[stream].static
        and count > sum(recording.counts(stream).values())
    )


def _account(recording: Recording, graph: Graph, books: GraphRecordTotals, node: str) -> Account:
    unaccounted = not_stored = 0
    book = books.of(node)
    for stream, made in book.made.items():
        told, since = made.counts(), book.since.get(stream)
        stored = recording.counts(stream, None if since is None else since.stamp)
        if graph.streams[stream].static:  # recorded once, however often it was made
            unaccounted += bool(sum(stored.values())) and not told
            not_stored += stream in recording.streams and not sum(stored.values()) and bool(told)
            continue
        excess = sum(max(0, count - told.get(incarnation, 0)) for incarnation, count in stored.items())
        taken = books.taken[stream].beyond(made, None if since is None else (0, since.seq))
        unaccounted += max(excess, taken)
        if stream in recording.streams:
            not_stored += sum(max(0, count - stored.get(incarnation, 0)) for incarnation, count in told.items())
    return Account(unaccounted, not_stored, book.lost, book.finished)
