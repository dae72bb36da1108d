"""What a process has at its edges, for tests: envelopes, and a supervisor that only listens."""

from __future__ import annotations

import errno
import os
from typing import Any

import numpy as np
import pytest

from dataflow.messages import FeatureVector
from dataflow.transport import Envelope, Kind

STREAM = "test/left/fast"


def message(seq: int, stamp: int | None = None, incarnation: int = 0) -> Envelope:
    at = 1000 + 10 * seq if stamp is None else stamp
    data = FeatureVector(stamp=at, vectors=np.zeros((1, 1), np.float32), model="test")
    return Envelope(Kind.MESSAGE, STREAM, incarnation, seq, at, data)


def frontier(seq: int, stamp: int, incarnation: int = 0) -> Envelope:
    return Envelope(Kind.FRONTIER, STREAM, incarnation, seq, stamp)


def end(seq: int, stamp: int, incarnation: int = 0) -> Envelope:
    return Envelope(Kind.END, STREAM, incarnation, seq, stamp, reason="end")


class RecordedChannel:
    """Keeps what a process tells its supervisor."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, dict[str, Any]]] = []

    def send(self, kind: str, /, **fields: Any) -> None:
        self.sent.append((kind, fields))

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [fields for sent, fields in self.sent if sent == kind]


class Disk:
    """A disk that can be full."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.full = False
        write = os.write

        def refusing(descriptor: int, data: Any) -> int:
            if self.full:
                raise OSError(errno.ENOSPC, "No space left on device")
            return write(descriptor, data)

        monkeypatch.setattr("dataflow.recording.container.os.write", refusing)
        monkeypatch.setattr("dataflow.process.outage.FIRST_PAUSE", 0.0)
        monkeypatch.setattr("dataflow.process.outage.LONGEST_PAUSE", 0.0)
