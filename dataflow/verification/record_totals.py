"""Adds up the firing records of a recording, in one pass over them before anything is repeated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

from dataflow.graph.model import Graph, Node
from dataflow.messages.digest import StreamDigest
from dataflow.recording import RecordingError
from dataflow.records.cuts import held_by
from dataflow.records.firing import CALLS, WITHHELD, Emission, FiringRecord
from dataflow.records.order import Outliner, Place
from dataflow.records.reading import FiringLog, Repeatable
from dataflow.sync import InputRef, MessageRef, messages_of

_BITS = 10
_LAST = (1 << _BITS) - 1


class MessageSet:
    """A set of messages of one stream, by their places: a bit for each, since numbers follow each other."""

    def __init__(self) -> None:
        self._pages: dict[Place, int] = {}
        """(incarnation, number without its last bits) → a bit for each number."""
        self._life = self._begin = self._end = 0
        """The messages that were added last, from one number to before another: they are not among the pages yet."""

    def add(self, incarnation: int, seq: int) -> None:
        """Adds a message."""
        if incarnation == self._life:
            if seq == self._end:
                self._end += 1
                return
            if self._begin <= seq < self._end:
                return
        self._settle()
        self._life, self._begin, self._end = incarnation, seq, seq + 1

    def _settle(self) -> None:
        while self._begin < self._end:
            page = self._begin >> _BITS
            end = min(self._end, (page + 1) << _BITS)
            bits = ((1 << (end - self._begin)) - 1) << (self._begin & _LAST)
            self._pages[self._life, page] = self._pages.get((self._life, page), 0) | bits
            self._begin = end

    def __contains__(self, place: Place) -> bool:
        self._settle()
        incarnation, seq = place
        return bool(self._pages.get((incarnation, seq >> _BITS), 0) >> (seq & _LAST) & 1)

    def counts(self) -> Mapping[int, int]:
        """Returns the number of messages by incarnation."""
        self._settle()
        found = Counter[int]()
        for (incarnation, _), bits in self._pages.items():
            found[incarnation] += bits.bit_count()
        return found

    def beyond(self, others: MessageSet, since: Place | None = None) -> int:
        """Returns how many of them are not among `others`, all or those from a place on."""
        self._settle()
        others._settle()
        first = None if since is None else (since[0], since[1] >> _BITS)
        found = 0
        for page, bits in self._pages.items():
            if first is None or page > first:
                found += (bits & ~others._pages.get(page, 0)).bit_count()
            elif since is not None and page == first:
                found += (bits & ~others._pages.get(page, 0) & (-1 << (since[1] & _LAST))).bit_count()
        return found


class NodeRecordTotals:
    """The records of one node, added up. `begin`: the index from which on there are all; None where none is missing in
    front.

    - `records`, `calls`, `duration` (ns): how many there are, how many are calls, and how long these took, whether or
      not they were handed over twice. `lost`: calls that follow missing records.
    - `only_calls`: nothing happened to the node but `setup()` and calls, and none is missing.
    - `ports`: outputs it was recorded with; None where no record has any. `replayed`: a replay made the records.
    - `sent`, `digests`: messages sent and their digest, by stream; `made`: their places; `since`: the first one behind
      records that were not read. `outputs`: messages made, whether or not they were sent.
    - `finished`: the last call is that of `finish()`.
    """

    def __init__(self, node: Node, begin: int | None) -> None:
        self._outputs, self._begin = tuple(node.outputs.values()), begin
        self.records = self.calls = self.duration = self.outputs = self.lost = 0
        self.ports: int | None = None
        self.replayed = self.finished = False
        self.sent = dict.fromkeys(self._outputs, 0)
        self.digests = {stream: StreamDigest() for stream in self._outputs}
        self.made = {stream: MessageSet() for stream in self._outputs}
        self.since: dict[str, Emission] = {}
        self.outliner = Outliner(self._outputs)
        self._last = (-1, -1)
        self._start_order()

    @property
    def only_calls(self) -> bool:
        return self._plain and self._kept > 0 and not self.lost

    def take(self, number: int, record: FiringRecord) -> None:
        """Adds the next record of the file, which is in batch `number`."""
        if not self.records:
            self.replayed = bool(record.detail.get("replayed"))
        self.records += 1
        self.calls += record.kind in CALLS
        self.duration += record.duration
        if self.ports is None and record.outcome == "ok" and record.outputs:
            self.ports = len(record.outputs)
        self.outliner.take(number, record)
        if self.outliner.in_order:
            self._follow(record)
        self._take_outputs(record)

    def _take_outputs(self, record: FiringRecord) -> None:
        counts = self.counts(record)
        for stream, emission in zip(self._outputs, record.outputs, strict=False):  # a failed call has none
            if emission is None:
                continue
            self.outputs += 1
            if emission.seq == WITHHELD:
                continue
            self.sent[stream] += 1
            self.digests[stream].update(emission.digest)
            if counts:
                self.made[stream].add(record.incarnation, emission.seq)
                if self._begin is not None and record.kind != "setup":
                    self.since.setdefault(stream, emission)
        if not counts:
            return
        for held in held_by(record) if record.kind == "cut" else ():
            if held.stream in self.made:
                self.made[held.stream].add(*held.place)
        place = (record.incarnation, record.index)
        if record.kind in CALLS and place > self._last:
            self._last, self.finished = place, record.kind == "finish"

    def counts(self, record: FiringRecord) -> bool:
        """Returns whether a record counts: one of those that are all there, or the beginning."""
        return self._begin is None or record.index >= self._begin or record.kind == "setup"

    def _start_order(self) -> None:
        self.lost = self._kept = 0
        self._plain = True
        self._repeatable = Repeatable()

    def _follow(self, record: FiringRecord) -> None:
        """Looks at the next record in the order of the calls."""
        known = self._repeatable.take(record)
        if known:
            self._kept += 1
            self._plain = self._plain and (record.kind == "setup" if self._kept == 1 else record.kind in CALLS)
        elif known is not None:
            self.lost += record.kind in CALLS

    def follow_anew(self, ordered: Iterator[FiringRecord]) -> None:
        """Goes through the records in the order of the calls, where the file has them otherwise."""
        self._start_order()
        for record in ordered:
            self._follow(record)


class GraphRecordTotals:
    """The books of all nodes of a graph, and the messages that any of them took."""

    def __init__(self, log: FiringLog, graph: Graph) -> None:
        """Reads all records. Those that cannot be read are an error of the node that they are asked for."""
        self.operators = log.operators
        self.taken = {stream: MessageSet() for stream in graph.streams}
        self._books = {name: NodeRecordTotals(node, log.begins.get(name)) for name, node in graph.nodes.items()}
        self._errors: dict[str, RecordingError] = {}
        numbers = dict.fromkeys(graph.nodes, 0)
        for name, payload in log.all_batches():
            if name not in numbers or name in self._errors:
                continue
            try:
                records = log.decoded(name, payload)
            except RecordingError as error:
                self._errors[name] = error
                continue
            for record in records:
                self._books[name].take(numbers[name], record)
                if record.inputs and self._books[name].counts(record):
                    self._take_inputs(record.inputs)
            numbers[name] += 1
        for name, book in self._books.items():
            if name not in self._errors:
                in_order = book.outliner.in_order
                log.outlined(graph.nodes[name], book.outliner)
                if not in_order:
                    book.follow_anew(log.ordered(graph.nodes[name]))

    def _take_inputs(self, inputs: Mapping[str, InputRef]) -> None:
        for ref in inputs.values():
            for message in (ref,) if isinstance(ref, MessageRef) else messages_of(ref):
                if message.stream in self.taken:
                    self.taken[message.stream].add(message.incarnation, message.seq)

    def of(self, name: str) -> NodeRecordTotals:
        """The book of a node. Raises `RecordingError` for records that cannot be read."""
        if name in self._errors:
            raise self._errors[name].with_traceback(None)  # each raise adds to it
        return self._books[name]
