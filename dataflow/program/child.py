"""Talks with a program over its standard input and output: calls out, replies in, every wait with a bound.

The frames are specified in `docs/other-languages.md`.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import struct
import subprocess
import time
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import Final

_CALL: Final = struct.Struct("<BqI")  # kind, stamp, frames
_REPLY: Final = struct.Struct("<BI")  # outcome, frames
_SIZE: Final = struct.Struct("<I")
_MOST_FRAMES: Final = 65_536
_MOST_BYTES: Final = 1 << 30
_AT_ONCE: Final = 1 << 20
_PARTS_AT_ONCE: Final = 64
_LEAVING: Final = 5.0
"""Seconds in which a program ends, once its standard input has."""

Bytes = bytes | bytearray | memoryview


class CallKind(IntEnum):
    """Kinds of calls; the frames of each are in `docs/other-languages.md`."""

    SETUP = 0
    PROCESS = 1
    FINISH = 2
    RESET = 3
    PARAMETER = 4
    SNAPSHOT = 5
    RESTORE = 6


class Outcome(IntEnum):
    """Outcomes of calls: `NONE` where a program has no such thing, such as a state."""

    DONE = 0
    FAILED = 1
    NONE = 2


class ProgramError(RuntimeError):
    """A program failed, ended, answered nothing in its time or something that is no reply; names program and call."""

    tells_all = True


class Child:
    """A running program. Its standard error is the operator's log. A failed call ends it."""

    def __init__(self, command: Sequence[str], folder: Path, patience: float) -> None:
        """Starts it in `folder`. `patience`: seconds that one call may take. Raises `ProgramError`."""
        self._name, self._patience, self._ended = Path(command[0]).name, patience, False
        try:
            self._process = subprocess.Popen(
                list(command), cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
            )
        except OSError as error:
            raise ProgramError(f"{command[0]} cannot be started: {error.strerror}") from error
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._to, self._from = self._process.stdin.fileno(), self._process.stdout.fileno()
        for pipe in (self._to, self._from):
            os.set_blocking(pipe, False)
            with contextlib.suppress(OSError):  # a limit on pipes that is lower: then in smaller pieces
                fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _AT_ONCE)

    def call(self, kind: CallKind, stamp: int, frames: Sequence[Sequence[Bytes]]) -> list[bytearray] | None:
        """Makes a call, each frame in consecutive parts, and returns the frames of its reply; None for `NONE`.

        Raises `ProgramError`; the program has ended then.
        """
        what = f"{kind.name.lower()}() at {stamp}" if kind in (CallKind.PROCESS, CallKind.FINISH) else kind.name.lower()
        if self._ended:
            raise ProgramError(f"{self._name} has ended: {what} is not made")
        deadline = time.monotonic() + self._patience
        try:
            parts: list[Bytes] = [_CALL.pack(kind, stamp, len(frames))]
            for frame in frames:
                parts.append(_SIZE.pack(sum(len(part) for part in frame)))
                parts.extend(frame)
            self._refuse_unasked(what)
            self._write(parts, what, deadline)
            head = self._read(_REPLY.size, what, deadline)
            outcome, count = _REPLY.unpack(head)
            if outcome not in tuple(Outcome) or count > _MOST_FRAMES:
                printed = bytes(head) + self._at_once()
                raise ProgramError(
                    f"{self._name}: {what}: no reply on standard output, which is for replies alone: {printed[:60]!r}"
                )
            found = [self._frame(what, deadline) for _ in range(count)]
        except BaseException:
            self.end(0.0)
            raise
        if outcome == Outcome.FAILED:
            self.end(_LEAVING)
            text = b"".join(found).decode("utf-8", "replace") or "it gave no reason"
            raise ProgramError(f"{self._name}: {what} failed: {text}")
        return found if outcome == Outcome.DONE else None

    def end(self, seconds: float = _LEAVING) -> int:
        """Closes its input, kills it when it has not ended by then, and returns its exit code."""
        self._ended = True
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait(_LEAVING)

    def _refuse_unasked(self, what: str) -> None:
        """Raises `ProgramError` where something waits before a call is made: it would be taken for its reply."""
        if found := self._at_once():
            raise ProgramError(f"{self._name}: before {what} it wrote to its standard output unasked: {found[:60]!r}")

    def _at_once(self) -> bytes:
        try:
            return os.read(self._from, _AT_ONCE)
        except BlockingIOError:
            return b""

    def _write(self, parts: list[Bytes], what: str, deadline: float) -> None:
        left = [memoryview(part).cast("B") for part in parts if len(part)]
        left.reverse()
        while left:
            self._wait(self._to, select.POLLOUT, what, deadline)
            try:
                written = os.writev(self._to, left[: -_PARTS_AT_ONCE - 1 : -1])
            except BlockingIOError:
                continue
            except BrokenPipeError:
                raise self._gone(what) from None
            while written:
                part = left.pop()
                if written < len(part):
                    left.append(part[written:])
                    break
                written -= len(part)

    def _frame(self, what: str, deadline: float) -> bytearray:
        (size,) = _SIZE.unpack(self._read(_SIZE.size, what, deadline))
        if size > _MOST_BYTES:
            raise ProgramError(f"{self._name}: {what}: a frame of {size} bytes in the reply, at most {_MOST_BYTES}")
        return self._read(size, what, deadline)

    def _read(self, size: int, what: str, deadline: float) -> bytearray:
        """Reads as many bytes; memory is taken as they come."""
        data = bytearray()
        while len(data) < size:
            self._wait(self._from, select.POLLIN, what, deadline)
            try:
                more = os.read(self._from, min(size - len(data), _AT_ONCE))
            except BlockingIOError:
                continue
            if not more:
                raise self._gone(what)
            data += more
        return data

    def _wait(self, descriptor: int, event: int, what: str, deadline: float) -> None:
        poll = select.poll()
        poll.register(descriptor, event)
        if not poll.poll(max(0.0, deadline - time.monotonic()) * 1000):
            raise ProgramError(f"{self._name}: {what}: no answer in {self._patience:g} s")

    def _gone(self, what: str) -> ProgramError:
        code = self.end(1.0)
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return ProgramError(f"{self._name} {how} in {what}; what it printed is in the log")
