"""The inlet of a process: from the bytes that arrive on its keys to envelopes that belong to its streams.

Whatever does not belong there is dropped, counted and complained about: bytes that are no envelope (`malformed`), and
envelopes that contradict what their stream has said so far (`misplaced`). Neither ends a process.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import Any

from dataflow.process.channel import Channel
from dataflow.process.streams.losses import LosslessPolicy
from dataflow.process.streams.stream_order import StreamOrder
from dataflow.process.throttled_warnings import ThrottledWarnings
from dataflow.transport import DecodeError, Envelope, Kind, decode

Deliver = Callable[[str, Envelope], None]
"""Takes the next envelope of a stream."""


class Inlet:
    """Takes payloads by stream, and delivers the envelopes that count, in order."""

    def __init__(
        self,
        channel: Channel,
        deliver: Deliver,
        *,
        static: Collection[str],
        losses: LosslessPolicy,
        from_start: bool = False,
        complaints: ThrottledWarnings | None = None,
    ) -> None:
        """`from_start`: this process takes its streams from their first message on, so one that is missing was lost."""
        self._losses = losses
        self._first = (0, 0) if from_start else None
        self.received = 0
        """Envelopes that counted, for the proof of quiescence."""
        self.malformed = self.misplaced = 0
        self._channel, self._deliver, self._static = channel, deliver, frozenset(static)
        self._complaints = complaints or ThrottledWarnings()
        self._orders: dict[str, StreamOrder] = {}
        self._seen: set[str] = set()
        self._probed: set[str] = set()

    def take(self, stream: str, payload: Any) -> None:
        """Takes what arrived on a stream's key. Raises `StreamDamaged` for a gap, where nothing may be lost."""
        try:
            envelope = decode(payload)
        except DecodeError as error:  # from outside: of our own, the next number would show the gap
            self.refuse_malformed(stream, error)
            return
        order = self._orders.get(stream)
        if order is not None and envelope.stream == stream and order.goes_on(envelope):
            self.received += 1
            self._deliver(stream, envelope)
        else:
            self._take_any(stream, envelope)

    def _take_any(self, stream: str, envelope: Envelope) -> None:
        if envelope.kind is Kind.PROBE:
            if stream not in self._probed:
                self._probed.add(stream)
                self._channel.send("seen", stream=stream)
        elif envelope.stream != stream:
            self.refuse(stream, f"an envelope of {envelope.stream!r}")
        elif stream in self._static:
            self._take_static(stream, envelope)
        else:
            self._take_in_order(stream, envelope)

    def refuse(self, stream: str, what: str) -> None:
        """Counts, and complains about, what arrived on a key and does not belong to its stream."""
        self.misplaced += 1
        self._complaints.say(f"misplaced {stream}", f"dropped {what} on {stream!r}: it does not go on from that stream")

    def refuse_malformed(self, stream: str, error: Exception) -> None:
        """Counts, and complains about, bytes that mean nothing."""
        self.malformed += 1
        self._complaints.say(f"malformed {stream}", f"dropped a malformed message on {stream!r}: {error}")

    def restarted(self, streams: Iterable[str]) -> None:
        """Notes that the process that makes these streams was restarted: it is to be probed again."""
        for stream in streams:
            self._probed.discard(stream)

    def statics_missing(self, streams: Iterable[str]) -> set[str]:
        """Returns those of some streams that are static and have not come."""
        return {stream for stream in streams if stream in self._static} - self._seen

    def _take_static(self, stream: str, envelope: Envelope) -> None:
        """Takes the one message of a static stream, if it has one, and its end; both come again after a restart. An end
        whose number is 0 means that there is no message."""
        known = stream in self._seen
        ends = envelope.kind is Kind.END and (known or not envelope.seq)
        if envelope.kind is not Kind.MESSAGE and not ends:
            self.refuse(stream, _described(envelope))
            return
        self.received += 1
        self._seen.add(stream)
        if ends or not known:
            self._deliver(stream, envelope)

    def _take_in_order(self, stream: str, envelope: Envelope) -> None:
        order = self._orders.get(stream) or self._orders.setdefault(stream, StreamOrder(self._first))
        verdict = order.take(envelope)
        if verdict.damaged:
            self._losses.damaged(stream, verdict.damaged)
        if verdict.gap is not None:
            self._losses.lost(stream, *verdict.gap)
        if verdict.repeats:
            self.received += 1
        elif verdict.taken is None:
            self.refuse(stream, _described(envelope))
        else:
            self.received += 1
            self._deliver(stream, verdict.taken)


def _described(envelope: Envelope) -> str:
    return f"a {envelope.kind.name} (incarnation {envelope.incarnation}, number {envelope.seq})"
