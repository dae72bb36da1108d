"""An ordered pipe between two machines that loses nothing while both ends live, over links that stall and reset.

Frames are numbered. Zenoh keeps their order on one link, and a link that resets loses what was on it: the receiver
sees the next number (or the sender's mark) ahead of what it expects, and asks for everything from there on, as a new
*round*. Frames of earlier rounds that are still on their way are ignored, so nothing is resent because a link is slow.
Beats go both ways besides, of a higher priority: what was taken, the round that is wanted, and the time, by which the
offset of the other machine's clock is measured (as NTP does, from the exchange with the shortest delay). A word that
is soon out of date may go with a beat: it overtakes the frames, and is lost with a link.

What the kernel and the network have taken can no longer be overtaken, and a kernel takes megabytes, which a slow link
needs a minute for. So no more is on its way than the link delivers in about `LATE` (`SendWindow`), long frames go in
pieces, and what waits, waits here.
"""

from __future__ import annotations

import math
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import zenoh

from dataflow.transport import Bus
from dataflow.transport.publisher import undeclare

BEAT_EVERY = 0.2
AWAY_AFTER = 1.5
"""Seconds without a sign of the other end after which its link counts as down."""
IN_FLIGHT, IN_FLIGHT_BYTES = 4096, 8 << 20
"""Pieces, and bytes of them, that are sent before the first of them is acknowledged, at most."""
PIECE = 30_000
"""Bytes of a frame that are sent at once; a batch of Zenoh's holds 65,535."""
LATE = 0.5
"""Seconds for which what was sent may wait on its way, beyond what the link takes at best."""
ACKNOWLEDGE_AFTER = 256
MOST_WAITING = 256 << 20
"""Bytes that wait for a link, at most, before messages that may be missed are dropped."""
EXCHANGES = 64
"""Exchanges of beats among which the one with the shortest delay measures the clocks' offset."""

_FRAME = struct.Struct("!IQB")  # round, number, kind
_END, _MARK, _PART = range(3)
"""Kinds: the last piece of a frame, or all of it; no piece, but the number of the next one; a piece before the last."""
_BEAT = struct.Struct("!IQqqq")  # round wanted, frames taken, sent at; of the other's last beat: sent at, taken at (ns)


class Clocks:
    """The other machine's clock against this one's."""

    def __init__(self) -> None:
        self._exchanges: deque[tuple[int, int]] = deque(maxlen=EXCHANGES)

    def exchanged(self, asked: int, taken: int, answered: int, heard: int) -> None:
        """Takes one exchange (ns): asked here, taken and answered there by that clock, heard here.

        Those before are forgotten where their delays cannot explain the difference: a clock was set, or has drifted.
        """
        delay, offset = (heard - asked) - (answered - taken), ((taken - asked) + (answered - heard)) // 2
        if delay < 0:  # a clock was set in its midst
            return
        if (best := self.best) is not None and abs(offset - best[1]) > (delay + best[0]) // 2 + 1:
            self._exchanges = deque(maxlen=EXCHANGES)
        self._exchanges.append((delay, offset))

    @property
    def best(self) -> tuple[int, int] | None:
        """Returns (delay, offset) in nanoseconds: by how much the other clock is ahead, at most half the delay wrong.
        None before the first exchange."""
        return min(tuple(self._exchanges), default=None)


class SendWindow:
    """The bytes that may be on their way at once. Pure: times (s) are given."""

    def __init__(self) -> None:
        self.bytes = min(2 * PIECE, IN_FLIGHT_BYTES)
        self._least = math.inf
        self._cut = -math.inf  # when there was too much: the times of what was sent before no longer count

    def taken(self, sent: float, now: float, nbytes: int, *, filled: bool) -> None:
        """Takes that the other end has so many more bytes, the last of which was sent at `sent`; `filled`: there was no
        room for more."""
        if sent < self._cut:
            return
        self._least = min(self._least, now - sent)
        waited = now - sent - self._least
        if waited > LATE:  # so many of them are delivered in that time
            self.bytes, self._cut = max(PIECE, int(self.bytes * LATE / waited)), now
        elif filled and waited < LATE / 2:
            self.bytes = min(IN_FLIGHT_BYTES, self.bytes + nbytes)


class UnacknowledgedFrame(NamedTuple):
    """A piece that is not acknowledged."""

    kind: int
    data: bytes


class Pipe:
    """One end. `take` gets the frames in order, on a thread of Zenoh's, and must not wait."""

    def __init__(self, bus: Bus, out: str, into: str, take: Callable[[bytes], None], *, bounded: bool) -> None:
        """`out`, `into`: the keys below which frames go and come. `bounded`: what may be dropped is, beyond
        `MOST_WAITING` bytes."""
        self.clocks = Clocks()
        self.dropped = 0
        self.bounded = bounded
        self._take = take
        self._changed = threading.Condition()
        self._waiting: deque[tuple[bytes, bool]] = deque()
        self._waiting_bytes = 0
        self._look_beyond = 0  # bytes that wait before what waits is looked at again: much of it may not be dropped
        self._sent: deque[UnacknowledgedFrame] = deque()
        self._base, self._next = 0, 0  # numbers: of the first piece in `_sent`, and of the next one to go out (again)
        self._room = SendWindow()
        self._flying: deque[float] = deque()  # when each piece from `_base` to `_next` was sent
        self._flying_bytes = 0
        self._round = 0
        self._wanted, self._expected, self._unsaid, self._unsaid_bytes = 0, 0, 0, 0
        self._parts: list[bytes] = []
        """The pieces of a frame that is not complete."""
        self._heard: tuple[int, int] = (0, 0)  # the other's last beat: sent at, by its clock; taken at, by this one's
        self._heard_at = -AWAY_AFTER
        self._closed = False
        session = bus.session
        self._frames = session.declare_publisher(
            f"{out}/frames", congestion_control=zenoh.CongestionControl.BLOCK, express=True
        )
        self._beats = session.declare_publisher(
            f"{out}/beats",
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            express=True,
        )
        self._subscribers = [
            session.declare_subscriber(f"{into}/frames", zenoh.handlers.Callback(self._on_frame, indirect=False)),
            session.declare_subscriber(f"{into}/beats", zenoh.handlers.Callback(self._on_beat, indirect=False)),
        ]
        for act in (self._send_frames, self._send_beats):
            threading.Thread(target=act, name="pipe", daemon=True).start()

    def send(self, frame: bytes, *, droppable: bool = False) -> None:
        """Queues a frame; on any thread. One that is `droppable` may be dropped while it waits, the oldest first."""
        with self._changed:
            self._waiting.append((frame, droppable))
            self._waiting_bytes += len(frame)
            if self.bounded and self._waiting_bytes > max(MOST_WAITING, self._look_beyond):
                self._drop_oldest()
            self._changed.notify_all()

    def send_with_beat(self, word: bytes) -> None:
        """Sends a frame ahead of all that waits; it may be lost. On any thread."""
        self._beat(word)

    @property
    def heard(self) -> bool:
        """Returns whether the other end was ever heard."""
        return self._heard_at >= 0

    @property
    def silence(self) -> float:
        """Seconds since the other end last sent anything."""
        return time.monotonic() - self._heard_at

    @property
    def idle(self) -> bool:
        """Returns whether the other end has taken everything."""
        with self._changed:
            return not (self._waiting or self._sent)

    def close(self, within: float = 0.0) -> None:
        """Ends it, after waiting (bounded) until the other end has taken everything."""
        deadline = time.monotonic() + within
        with self._changed:
            self._changed.wait_for(lambda: not (self._waiting or self._sent), max(0.0, deadline - time.monotonic()))
            self._beat()  # what was taken last
            self._closed = True
            self._changed.notify_all()
        for each in self._subscribers:
            undeclare(each)

    # Out

    def _drop_oldest(self) -> None:
        """Drops down to nine tenths of the bound, so that the next frames need no look at all that waits."""
        room = MOST_WAITING // 10
        kept: deque[tuple[bytes, bool]] = deque()
        for frame, droppable in self._waiting:
            if droppable and self._waiting_bytes > MOST_WAITING - room:
                self._waiting_bytes -= len(frame)
                self.dropped += 1
            else:
                kept.append((frame, droppable))
        self._waiting = kept
        self._look_beyond = self._waiting_bytes + room

    def _send_frames(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._due(), BEAT_EVERY)
                if self._closed:
                    return
                said = self._next_frame()
            if said is not None:
                try:
                    self._frames.put(said)
                except zenoh.ZError:  # the session is being closed
                    return

    def _due(self) -> bool:
        room = len(self._flying) < IN_FLIGHT and self._flying_bytes < self._room.bytes
        return room and (self._next < self._base + len(self._sent) or bool(self._waiting))

    def _next_frame(self) -> bytes | None:
        """Returns what goes out next: a piece again, a new one, or, while some are unacknowledged, the mark."""
        if not self._due():
            return _FRAME.pack(self._round, self._next, _MARK) if self._sent else None
        if self._next == self._base + len(self._sent):
            frame, _ = self._waiting.popleft()
            self._waiting_bytes -= len(frame)
            self._look_beyond = min(self._look_beyond, self._waiting_bytes + MOST_WAITING // 10)
            last = max(0, len(frame) - 1) // PIECE * PIECE
            self._sent.extend(UnacknowledgedFrame(_PART, frame[at : at + PIECE]) for at in range(0, last, PIECE))
            self._sent.append(UnacknowledgedFrame(_END, frame[last:]))
        number, self._next = self._next, self._next + 1
        kind, data = self._sent[number - self._base]
        self._flying.append(time.monotonic())
        self._flying_bytes += len(data) + _FRAME.size
        return _FRAME.pack(self._round, number, kind) + data

    def _taken(self, number: int, wanted: int) -> None:
        """The other end has taken all pieces before `number`, and wants them from there on as the round `wanted`."""
        with self._changed:
            filled, sent, before = self._flying_bytes >= self._room.bytes - PIECE, None, self._flying_bytes
            while self._base < number and self._sent:
                _, data = self._sent.popleft()
                self._base += 1
                if self._flying:
                    sent = self._flying.popleft()
                    self._flying_bytes -= len(data) + _FRAME.size
            if sent is not None:
                self._room.taken(sent, time.monotonic(), before - self._flying_bytes, filled=filled)
            self._next = max(self._next, self._base)
            if wanted > self._round:
                self._round, self._next = wanted, self._base
                self._flying.clear()
                self._flying_bytes = 0
            self._changed.notify_all()

    # In

    def _on_frame(self, sample: Any) -> None:
        data = sample.payload.to_bytes()
        if len(data) < _FRAME.size or self._closed:
            return
        self._heard_at = time.monotonic()
        round_, number, kind = _FRAME.unpack_from(data)
        if round_ != self._wanted:
            return
        if number > self._expected:
            self._wanted += 1
            self._beat()
        elif number == self._expected and kind != _MARK:
            self._expected += 1
            self._unsaid += 1
            self._unsaid_bytes += len(data)
            self._parts.append(data[_FRAME.size :])
            if kind == _END:
                frame, self._parts = self._parts[0] if len(self._parts) == 1 else b"".join(self._parts), []
                self._take(frame)
            if self._unsaid >= ACKNOWLEDGE_AFTER or self._unsaid_bytes > PIECE // 2:
                self._beat()

    def _on_beat(self, sample: Any) -> None:
        data, now = sample.payload.to_bytes(), time.time_ns()
        if len(data) < _BEAT.size or self._closed:
            return
        wanted, taken, sent_at, ours, taken_at = _BEAT.unpack_from(data)
        self._heard_at = time.monotonic()
        self._heard = (sent_at, now)
        if ours:
            self.clocks.exchanged(ours, taken_at, sent_at, now)
        self._taken(taken, wanted)
        if word := data[_BEAT.size :]:
            self._take(word)

    def _beat(self, word: bytes = b"") -> None:
        self._unsaid = self._unsaid_bytes = 0
        try:
            self._beats.put(_BEAT.pack(self._wanted, self._expected, time.time_ns(), *self._heard) + word)
        except zenoh.ZError:  # the session is being closed
            self._closed = True

    def _send_beats(self) -> None:
        while not self._closed:
            self._beat()
            time.sleep(BEAT_EVERY)
