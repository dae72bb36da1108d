"""The gate of one machine, through which its processes send to those of other machines, and get from them.

To its own machine's processes a gate is one more process, linked to them by rings. A stream passes to each other
machine once, however many processes take it there. Control messages pass through the same pipe, behind what was sent
before them: so, as on one machine, what a process had sent before a report arrives before the report.
"""

from __future__ import annotations

import struct
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgpack

from dataflow.machines.pipe import Pipe
from dataflow.process.streams.inbox import Inbox
from dataflow.sync import NEVER
from dataflow.transport import DecodeError, Envelope, Fanout, Kind, decode_head
from dataflow.transport.envelope import Head

PUSH_WITHIN = 2.0
MOST_LOOKS = 64
"""Looks at the rings, each of which takes up to a thousand messages of each, before a control message passes."""
_CONTROL = 0xFFFF
_KEY = struct.Struct("!H")  # place of the key among those that pass between machines, or that it is a control message
Word = tuple[str, str, dict[str, Any]]
"""A control message: the process that it is from or for ("" for the agent itself), kind and fields."""


@dataclass(frozen=True, slots=True)
class Routes:
    """The keys that pass between machines, and by key the machines that it comes from and those that take it. `static`:
    those of static streams; `raw`: those whose content is no envelope (firing records)."""

    keys: Sequence[str]
    makers: Mapping[str, Sequence[str]]
    takers: Mapping[str, Sequence[str]]
    static: frozenset[str]
    raw: frozenset[str]

    def to_json(self) -> dict[str, Any]:
        lists = {"static": sorted(self.static), "raw": sorted(self.raw)}
        return {"keys": self.keys, "makers": self.makers, "takers": self.takers, **lists}

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> Routes:
        return Routes(data["keys"], data["makers"], data["takers"], frozenset(data["static"]), frozenset(data["raw"]))


def _frame_of(word: Word) -> bytes:
    packed: bytes = msgpack.packb(word, use_bin_type=True)
    return _KEY.pack(_CONTROL) + packed


class Gate:
    """Carries between the links of this machine's processes and the pipes to other machines."""

    def __init__(
        self, inbox: Inbox, fanout: Fanout, pipes: Mapping[str, Pipe], routes: Routes, said: Callable[[str, Word], None]
    ) -> None:
        """`said` takes control messages, with the machine that each came from."""
        self.inbox, self._fanout, self._pipes, self._routes, self._said = inbox, fanout, pipes, routes, said
        self._numbers = {key: number for number, key in enumerate(routes.keys)}
        self._once: dict[str, list[bytes]] = {}
        """The messages and ends of static streams: a process that was started again gets them again."""
        self._counted = ""
        self.extra = 0
        """Copies that were made of envelopes beyond one of each, for the proof of quiescence."""
        self.malformed = 0

    def handle(self, item: tuple[Any, ...]) -> None:
        """Takes one item of the inbox that concerns the gate."""
        match item:
            case ("envelope", key, payload):
                self._leave(key, bytes(payload))
            case ("frame", machine, frame):
                self._arrive(machine, frame)
            case ("say", machine, word):
                self._take_rings()
                self.inbox.put(("say on", machine, word))
            case ("say on", machine, word):
                self._pipes[machine].send(_frame_of(word))

    def say_now(self, machine: str, word: Word) -> None:
        """Sends a control message that is soon out of date ahead of all that waits; it may be lost. On any thread."""
        self._pipes[machine].send_with_beat(_frame_of(word))

    def _take_rings(self) -> None:
        """Takes what is in the rings into the inbox: what processes had sent before they reported something."""
        for _ in range(MOST_LOOKS):
            before = self.inbox.qsize()
            if self.inbox.empty() or self.inbox.qsize() == before:
                return

    def add_extra(self, label: str, said: Mapping[str, Any]) -> None:
        """Counts `extra` in the state that a process reports: always in that of the same one."""
        if said["kind"] == "state":
            self._counted = self._counted or label
            if label == self._counted:
                said["fields"]["sent"] += self.extra

    def push(self) -> None:
        """Sends what has waited for room in the links, and static messages to restarted processes."""
        if self._fanout.quiet():
            return
        for keys, link in self._fanout.joined():
            for number, key in enumerate(keys):
                for payload in self._once.get(key, ()):
                    link.send(number, [payload], len(payload), droppable=False)
                    self.extra += 1
        self._fanout.flush()

    def push_all(self) -> None:
        """Waits (bounded) until everything that came has room in the links."""
        deadline = time.monotonic() + PUSH_WITHIN
        while not self._fanout.flush() and time.monotonic() < deadline:
            time.sleep(0.001)

    # Out

    def _leave(self, key: str, payload: bytes) -> None:
        head = None if key in self._routes.raw else decode_head(payload)
        frame = _KEY.pack(self._numbers[key]) + payload
        self._count(head, self._send(key, frame, head, but=None))

    def _send(self, key: str, frame: bytes, head: Head | None, *, but: str | None) -> int:
        """Sends a frame to the machines that take its key; returns how many those are."""
        sent = 0
        for machine in self._routes.takers.get(key, ()):
            if machine != but and machine in self._pipes:
                self._pipes[machine].send(frame, droppable=self._droppable(key, head))
                sent += 1
        return sent

    def _droppable(self, key: str, head: Head | None) -> bool:
        if head is None or key in self._routes.static:
            return False
        return head.kind in (Kind.MESSAGE, Kind.PROBE) or (head.kind is Kind.FRONTIER and head.stamp != NEVER)

    def _count(self, head: Head | None, copies: int) -> None:
        if head is None or head.kind is not Kind.PROBE:
            self.extra += copies - 1

    # In

    def _arrive(self, machine: str, frame: bytes) -> None:
        try:
            (number,) = _KEY.unpack_from(frame)
            if number == _CONTROL:
                label, kind, fields = msgpack.unpackb(frame[_KEY.size :], raw=False, strict_map_key=False)
                self._said(machine, (label, kind, fields))
                return
            key = self._routes.keys[number]
            if machine not in self._routes.makers.get(key, ()):
                raise ValueError(f"it does not make {key}")
            payload = frame[_KEY.size :]
            head = None if key in self._routes.raw else decode_head(payload)
        except (DecodeError, ValueError, TypeError, LookupError, struct.error) as error:
            self.malformed += 1
            print(f"dropped a malformed frame from machine {machine!r}: {error}", file=sys.stderr)
            return
        sent = self._send(key, frame, head, but=machine)
        self._count(head, sent + self._deliver(key, payload, head))

    def _deliver(self, key: str, payload: bytes, head: Head | None) -> int:
        """Sends an envelope to the processes here that take its key; returns how many those are."""
        if head is None:
            return self._fanout.send(key, [payload], droppable=False)
        if key in self._routes.static and head.kind is Kind.MESSAGE:
            self._once[key] = [payload]
        elif key in self._routes.static and head.kind is Kind.END:
            self._once.setdefault(key, []).append(payload)
        said = Envelope(head.kind, head.stream, head.incarnation, head.seq, head.stamp, None, head.reason, head.wall)
        return self._fanout.send(key, [payload], said, droppable=self._droppable(key, head))
