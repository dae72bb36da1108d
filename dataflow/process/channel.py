"""The control channel between the supervisor and one process: small msgpack messages over a socket pair.

It is a pipe rather than a Zenoh key because its end is the news: when either process dies, however it dies, the other
one reads end-of-file at once. The two ends differ in one thing: a process waits until its message is taken
(`Channel`), the supervisor never waits (`QueuedChannel`).
"""

from __future__ import annotations

import socket
import struct
import threading
from collections import deque
from collections.abc import Iterator
from typing import Any

import msgpack

LONGEST = 1 << 30
"""Bytes of one message, at most."""
READ_AT_ONCE = 1 << 18
"""Bytes that are read from a channel at once, so that one process that sends much does not keep the others waiting."""
MOST_QUEUED = 64 << 20
"""Bytes that may wait for a process that does not read."""

_LENGTH = struct.Struct("!I")


class ChannelClosed(ConnectionError):
    """The process at the other end is gone, or has closed its end."""


def _packed(kind: str, fields: dict[str, Any]) -> bytes:
    data: bytes = msgpack.packb([kind, fields], use_bin_type=True)
    return _LENGTH.pack(len(data)) + data


def _unpacked(data: bytes | memoryview) -> tuple[str, dict[str, Any]]:
    try:
        kind, fields = msgpack.unpackb(data, raw=False, strict_map_key=False)
    except ValueError as error:
        raise ChannelClosed(f"not a control message: {error}") from error
    return kind, fields


class Channel:
    """The end of a process. Sending is thread-safe and waits for the supervisor; one thread receives."""

    def __init__(self, descriptor: int) -> None:
        self._socket = socket.socket(fileno=descriptor)
        self._socket.setblocking(True)
        self._sending = threading.Lock()

    @staticmethod
    def pair() -> tuple[Channel, int]:
        """Returns a channel for this process, and the descriptor of the other end, to be inherited by a child."""
        ours, theirs = _pair()
        return Channel(ours.detach()), theirs

    def send(self, kind: str, /, **fields: Any) -> None:
        """Raises `ChannelClosed` when the supervisor is gone."""
        data = _packed(kind, fields)
        try:
            with self._sending:
                self._socket.sendall(data)
        except OSError as error:
            raise ChannelClosed(str(error)) from error

    def receive(self) -> tuple[str, dict[str, Any]]:
        """Waits for the next message and returns it. Raises `ChannelClosed` at the end."""
        (length,) = _LENGTH.unpack(self._read(_LENGTH.size))
        return _unpacked(self._read(length))

    def _read(self, length: int) -> bytes:
        data = bytearray()
        while len(data) < length:
            try:
                part = self._socket.recv(min(length - len(data), READ_AT_ONCE))
            except OSError as error:
                raise ChannelClosed(str(error)) from error
            if not part:
                raise ChannelClosed("the supervisor is gone")
            data += part
        return bytes(data)

    def close(self) -> None:
        self._socket.close()

    def fileno(self) -> int:
        return self._socket.fileno()


def _pair() -> tuple[socket.socket, int]:
    """Returns one end, and the descriptor of the other, which a child process inherits."""
    ours, theirs = socket.socketpair()
    theirs.set_inheritable(True)
    return ours, theirs.detach()


class QueuedChannel:
    """The supervisor's end. Nothing here waits: what the process does not take is queued, up to `most` bytes.

    A message that `replaces` takes the place of the last one of its kind that is still queued, so that a process that
    is stopped for a while finds the latest news and not their history. `overflowed`: a message did not fit any more
    and is lost, so the process can no longer be relied on.
    """

    def __init__(self, most: int = MOST_QUEUED) -> None:
        ours, self.theirs = _pair()
        """The descriptor of the other end, to be inherited by the process and closed here."""
        ours.setblocking(False)
        self._socket = ours
        self._most = most
        self._queue: deque[list[Any]] = deque()  # [kind, bytes]; the first may have gone in part
        self._replaceable: dict[str, list[Any]] = {}
        self._begun = 0
        self._unread = bytearray()
        self.queued = 0
        self.overflowed = False

    def send(self, kind: str, fields: dict[str, Any], *, replaces: bool = False) -> None:
        """Queues a message; `flush` sends it."""
        data = _packed(kind, fields)
        waiting = self._replaceable.get(kind) if replaces else None
        if waiting is not None:
            self.queued += len(data) - len(waiting[1])
            waiting[1] = data
            return
        if self._queue and self.queued + len(data) > self._most:
            self.overflowed = True
            return
        entry = [kind, data]
        self._queue.append(entry)
        self.queued += len(data)
        if replaces:
            self._replaceable[kind] = entry

    def flush(self) -> bool:
        """Sends what the process takes at the moment; True when it took anything or nothing was queued. Raises
        `ChannelClosed` when the process is gone."""
        took = not self._queue
        while self._queue:
            entry = self._queue[0]
            kind, data = entry
            try:
                sent = self._socket.send(memoryview(data)[self._begun :])
            except BlockingIOError:
                break
            except OSError as error:
                raise ChannelClosed(str(error)) from error
            if self._replaceable.get(kind) is entry:  # on its way: what comes later follows it
                del self._replaceable[kind]
            took = True
            self._begun += sent
            if self._begun < len(data):
                break
            self._queue.popleft()
            self.queued -= len(data)
            self._begun = 0
        return took

    @property
    def waiting(self) -> int:
        """Returns how many messages the process has not taken."""
        return len(self._queue)

    def receive(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yields the messages that are there. Raises `ChannelClosed` at the end, when all are taken."""
        try:
            data = self._socket.recv(READ_AT_ONCE)
        except BlockingIOError:
            return
        except OSError as error:
            raise ChannelClosed(str(error)) from error
        self._unread += data
        yield from self._complete()
        if not data:
            raise ChannelClosed("end of file")

    def _complete(self) -> list[tuple[str, dict[str, Any]]]:
        """Takes the whole messages out of what was read."""
        found, at = [], 0
        while len(self._unread) - at >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._unread, at)
            if length > LONGEST:
                raise ChannelClosed(f"a message of {length} bytes")
            end = at + _LENGTH.size + length
            if end > len(self._unread):
                break
            found.append(_unpacked(bytes(memoryview(self._unread)[at + _LENGTH.size : end])))
            at = end
        del self._unread[:at]
        return found

    def close(self) -> None:
        self._socket.close()

    def fileno(self) -> int:
        return self._socket.fileno()
