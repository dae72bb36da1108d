"""Compares a re-execution with its records: what was repeated, what differs, and whose fault it is."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import PurePath

import xxhash

from dataflow.execution.failure import readable
from dataflow.execution.snapshots import alike_but_for_fields, differing_fields
from dataflow.messages.base import Message
from dataflow.records.comparison import Difference, Verification
from dataflow.records.firing import WITHHELD, Emission, FiringRecord
from dataflow.records.reading import Digests
from dataflow.sync import Entry, Firing
from dataflow.sync.entries import entries_of

_ADDRESS = re.compile(r"0x[0-9a-fA-F]+")


class Comparator:
    """Compares what one operator does with its records, and keeps the result. A difference is the operator's own when
    everything that it was given until then is known to be as recorded."""

    def __init__(self, operator: str, ports: tuple[str, ...], inputs: Digests) -> None:
        self.result = Verification(operator)
        self._ports, self._inputs = ports, inputs
        self._differences = xxhash.xxh3_128()
        self._erred: FiringRecord | None = None
        """The call whose error, or want of one, is counted as a difference: its first output that differs is not."""
        self._altered: set[tuple[str, int, int]] = set()
        """Messages that arrived, and are not known to be the recorded ones, as long as none was given."""

    def arrived(self, stream: str, entry: Entry) -> None:
        """Looks at a message that firings will be given: messages come in the order of their stream. One whose digest
        was not recorded (a record that is lost) is not known to be the recorded one."""
        if self.result.tainted is None:
            digests, place = self._inputs.get(stream), (stream, entry.incarnation, entry.seq)
            if digests is None or digests.get((entry.incarnation, entry.seq)) != entry.digest:
                self._altered.add(place)
            elif self._altered:
                self._altered.discard(place)

    def given(self, record: FiringRecord, firing: Firing) -> None:
        """Looks at what a firing is given."""
        if self._altered and not self._as_recorded(firing):
            self.result.tainted = record.index
            self._altered.clear()

    def outputs(self, record: FiringRecord, messages: Mapping[str, Message]) -> Iterator[tuple[str, Message, int]]:
        """Compares what came out; yields port, message and recorded number of what was sent in the recorded run."""
        for name, expected in zip(self._ports, record.outputs or (None,) * len(self._ports), strict=True):
            got = messages.get(name)
            if expected is None and got is None:
                continue
            self.result.outputs += 1
            if expected is None or got is None:
                self.differ(record, name, _word(expected), _word(got), "" if got is None else got.digest().hex())
            elif got.digest() != expected.digest:
                self.differ(record, name, expected.digest.hex(), got.digest().hex())
            if expected is not None and got is not None and expected.seq != WITHHELD:
                yield name, got, expected.seq

    def statics(self, record: FiringRecord, messages: Mapping[str, Message]) -> None:
        """Compares the static messages of an operator that was restarted, which are not sent again."""
        for name, expected in zip(self._ports, record.outputs, strict=True):
            got = messages.get(name)
            if expected is not None and (got is None or got.digest() != expected.digest):
                made = "" if got is None else got.digest().hex()
                self.differ(record, name, expected.digest.hex(), "another static message", made)

    def error(self, record: FiringRecord, error: BaseException | None) -> None:
        """Compares what a call raised, if anything; addresses in memory, which texts may hold, are left out."""
        expected = f"error: {record.detail.get('error', '')}" if record.outcome == "error" else "no error"
        got = "no error" if error is None else f"error: {readable(error)}"
        if _ADDRESS.sub("", expected) != _ADDRESS.sub("", got):
            self.differ(record, "", expected, got, _ADDRESS.sub("", got))
            self._erred = record

    def summary(self, record: FiringRecord, got: Mapping[str, float | int | str]) -> None:
        """Compares what the operator sums up at its end: all that a sink makes."""
        expected = record.detail["summary"]
        name = next((n for n in (*expected, *got) if repr(expected.get(n)) != repr(got.get(n))), None)
        if name is not None:
            then, now = (f"summary {name}: {values.get(name, 'nothing')}" for values in (expected, got))
            self.differ(record, "", then, now, repr(sorted(got.items())))

    def state(self, record: FiringRecord, packed: bytes | None) -> None:
        """Compares a snapshot, if its state was not too large to be recorded. Where the code has changed, the fields
        that one of the two lacks are none that can be compared: the outputs decide."""
        if "state" in record.detail and (packed or b"") != (then := record.detail["state"]):
            if self.result.code_changed and alike_but_for_fields(then, packed or b""):
                return
            self.result.states += 1
            what = differing_fields(then, packed or b"")
            digest = xxhash.xxh3_64_hexdigest(packed or b"")  # so that two runs that differ each show that they do
            self.differ(record, "", "the recorded state", f"another state ({digest}): {what}")

    def files(self, record: FiringRecord, now: Mapping[str, str]) -> None:
        """Notes files whose content is that of no file of the same name that was read then, wherever that lay."""
        known = {(PurePath(file).name, digest) for file, digest in record.detail.get("files", {}).items()}
        changed = [file for file, digest in now.items() if (PurePath(file).name, digest) not in known]
        self.result.files_changed = sorted(changed)

    def code(self, then: Mapping[str, str], now: Mapping[str, str]) -> None:
        """Notes modules whose code is not as recorded; a recording from before these were noted has none."""
        self.result.code_known = bool(then)
        changed = {name for name, digest in then.items() if now.get(name) != digest}
        self.result.code_changed = sorted(changed.union(self.result.code_changed))

    def packages(self, then: Mapping[str, str], now: Mapping[str, str]) -> None:
        """Notes packages of the operator's environment whose versions are not as recorded."""
        changed = [name for name, version in now.items() if then.get(name) != version]
        self.result.packages_changed = [f"{name} {then.get(name, '–')} -> {now[name]}" for name in changed]

    def differ(self, record: FiringRecord, port: str, expected: str, got: str, made: str = "") -> None:
        """Notes one difference. `made`: what was made, where `got` does not show all of it."""
        self._differences.update(f"{record.incarnation} {record.index} {port} {made or got}\n".encode())
        self.result.differences = self._differences.hexdigest()
        if self._erred is record:
            self._erred = None
        else:
            self.result.differing += 1
        if self.result.first is None:
            self.result.own_fault = self.result.tainted is None
            self.result.first = Difference(
                record.index, record.kind, record.stamp, port, expected, got, record.incarnation
            )

    def _as_recorded(self, firing: Firing) -> bool:
        return all(
            (entry.stream, entry.incarnation, entry.seq) not in self._altered
            for given in firing.inputs.values()
            for entry in entries_of(given)
        )


def _word(emission: Emission | Message | None) -> str:
    return "nothing" if emission is None else f"a message at stamp {emission.stamp}"
