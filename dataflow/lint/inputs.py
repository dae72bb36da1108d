"""Inputs of the checks, anything that has streams with timestamps and messages, and the findings there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from dataflow.messages import Message
from dataflow.recording import Recording
from dataflow.recording.layout import RECORDING, Kind
from dataflow.recording.mcap.index import NO_END

Stamps = npt.NDArray[np.int64]
Severity = Literal["note", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Finding:
    """`check` names what was looked for; `values` holds its figures by name, units in the names."""

    check: str
    stream: str
    severity: Severity
    text: str
    at: int | None = None
    """The first stamp (ns) at which it shows."""
    values: Mapping[str, float | int | str] | None = None

    def to_json(self) -> dict[str, Any]:
        return {key: value for key, value in asdict(self).items() if value is not None}


@dataclass(frozen=True, slots=True)
class StreamFacts:
    """`type` is the message type's name, or the file's own where no message type is known for it (`readable`)."""

    type: str
    static: bool
    count: int
    readable: bool


class LintInput(Protocol):
    """A recording of any kind. Streams are given by name, in the order they are to be reported in."""

    @property
    def namespace(self) -> str: ...

    @property
    def streams(self) -> Mapping[str, StreamFacts]: ...

    def file_findings(self, *, whole: bool) -> Iterator[Finding]:
        """Damage of the file, and what of its messages cannot be read; `whole`: all of them are looked at."""
        ...

    def stamps(self, stream: str) -> Stamps:
        """The timestamps (ns) of a stream in the order in which it was written."""
        ...

    def messages(self, stream: str) -> Iterator[Message]:
        """The messages of a readable stream, in that order."""
        ...


class RecordingInput:
    """An open recording; the runtime's own streams are left out."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.namespace = recording.metadata.get(RECORDING, {}).get("namespace", "")
        self.streams: Mapping[str, StreamFacts] = {
            name: StreamFacts(
                info.schema if info.message_type is None else info.message_type.SCHEMA,
                info.static,
                info.count,
                info.message_type is not None,
            )
            for name, info in recording.streams.items()
            if "/@/" not in f"/{name}"
        }

    def file_findings(self, *, whole: bool) -> Iterator[Finding]:
        """Damage."""
        if self._recording.torn:
            yield Finding("file", "", "warning", NO_END)
        for note in self._recording.damage:
            yield Finding("file", "", "warning", note)

    def stamps(self, stream: str) -> Stamps:
        """Our own recordings: from the index. Others: of the messages, else the log times."""
        info = self._recording.streams[stream]
        if info.metadata.get("kind") == Kind.STREAM:
            return np.fromiter(self._recording.stamps(stream), np.int64)
        if info.message_type is not None:
            return np.array([message.stamp for message in self.messages(stream)], np.int64)
        return np.array([record.log_time for record in self._recording.raw([stream])], np.int64)

    def messages(self, stream: str) -> Iterator[Message]:
        return (recorded.message for recorded in self._recording.messages([stream]))
