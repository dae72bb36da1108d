"""The recorder: whole streams and firing records into one MCAP file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgpack

from dataflow.graph.model import Graph
from dataflow.messages import Diagnostics
from dataflow.messages.base import Message
from dataflow.names import diagnostics_key
from dataflow.recording import LogLine, RecordingWriter
from dataflow.recording.layout import ENDS, OUTCOME, PARAMETERS, TOLD, firings_topic
from dataflow.recording.parts import OWNER_ONLY
from dataflow.records.firing import MAX_STATE_BYTES, decode_batch, encode_batch

GOES_ON = "goes on"
"""The outcome that a file names which is not the last one of its run."""
PARAMETER_MARK = msgpack.packb("value")
"""Stands in every batch with a parameter that was changed, as a key of its detail, and in few others."""


class RecorderSink:
    """Writes everything it is given; how streams ended and how the run ended go into metadata when it closes."""

    def __init__(self, path: Path, graph: Graph, streams: list[str], options: Mapping[str, Any]) -> None:
        self.path = path
        self.graph = graph
        self.writer = RecordingWriter(
            path,
            metadata=options["metadata"],
            namespace=graph.namespace,
            compression=options["compression"],
            overwrite=options["overwrite"],
            mode=options.get("mode", OWNER_ONLY),
        )
        self.writer.add_metadata(TOLD, {"events": PARAMETERS})
        self._added: set[str] = set()
        self._ends: dict[str, dict[str, Any]] = {}
        self.messages = 0
        self.diagnosed = 0
        """Messages of diagnostics so far."""
        self._unflushed: dict[str, list[int]] = {}
        self._flushed: dict[str, int] = {}
        self._calls = 0
        self._clock = 0
        self._early: list[tuple[str, bytes]] = []
        self._early_logs: list[LogLine] = []
        try:
            for stream in streams:
                types = graph.message_types(stream)
                if len(types) == 1 and types[0] is not Message:
                    self._add(stream, types[0])
            self.writer.flush()  # a disk that refuses is noticed at the beginning
        except BaseException:
            self.writer.close()
            raise

    def _add(self, stream: str, message_type: type[Message]) -> None:
        made = self.graph.streams[stream]
        extra = {"operator": made.node, "port": made.port}
        self.writer.add_stream(stream, message_type, static=made.static, extra=extra)
        self._added.add(stream)

    def message(self, stream: str, message: Message, seq: int, incarnation: int) -> None:
        if message.stamp > 0:
            self._clock = message.stamp
            self._write_early()
        if stream not in self._added:
            self._add(stream, type(message))
        self.messages += 1
        self.writer.write(stream, message, seq=seq, incarnation=incarnation)

    def firings(self, operator: str, stamp: int, payload: bytes, calls: int = 0) -> None:
        """Stores a batch of firing records, which holds `calls` calls.

        `setup()` has no stamp; its record is stored at the stamp of the first message, so that viewers of the file
        show no long nothing before it."""
        self._unflushed.setdefault(operator, []).append(calls)
        self._calls += calls
        if stamp > 0:
            self._clock = self._clock or stamp
            self._write_early()  # in the order of the calls
            self._write_firings(operator, stamp, payload)
        elif self._clock > 0:
            self._write_firings(operator, self._clock, payload)
        else:
            self._early.append((operator, payload))

    def _write_firings(self, operator: str, stamp: int, payload: bytes) -> None:
        """Writes a batch; one whose states make it too large is written record by record."""
        if len(payload) <= MAX_STATE_BYTES and PARAMETER_MARK not in payload:
            self.writer.write_firings(operator, stamp, payload)
            return
        batch = decode_batch(payload)
        for record in batch.records:
            if record.kind == "param":
                self.writer.write_event(PARAMETERS, record.stamp, {"operator": operator, "name": record.detail["name"]})
        if len(payload) <= MAX_STATE_BYTES:
            self.writer.write_firings(operator, stamp, payload)
            return
        self._unflushed.setdefault(operator, []).extend([0] * (len(batch.records) - 1))  # an entry for each message
        for record in batch.records:
            data = encode_batch([record], last=batch.last and record is batch.records[-1])
            self.writer.write_firings(operator, stamp, data)

    def _write_early(self) -> None:
        early, self._early = self._early, []
        for operator, payload in early:
            self._write_firings(operator, max(self._clock, 0), payload)
        logs, self._early_logs = self._early_logs, []
        for line in logs:
            self.writer.write_log(self._clock, line)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self._ends[stream] = {"final": final_stamp, "reason": reason}

    def event(self, name: str, stamp: int, data: Mapping[str, Any]) -> None:
        self.writer.write_event(name, stamp, data)

    def diagnostics(self, message: Diagnostics) -> None:
        stream = diagnostics_key(self.graph.namespace)
        if stream not in self._added:
            self.writer.add_stream(stream, Diagnostics, static=False, extra={})
            self._added.add(stream)
        self.writer.write(stream, message, seq=self.diagnosed, incarnation=0)
        self.diagnosed += 1

    def log(self, line: LogLine) -> None:
        """A line that is said before the first message is stored at its stamp, as the first firing records are."""
        if self._clock > 0 or line.stamp is not None:
            self.writer.write_log(line.stamp or self._clock, line)
        else:
            self._early_logs.append(line)

    def flush(self) -> None:
        self.writer.flush()
        self._flushed = {operator: self._saved_batches(operator) for operator in self._unflushed}
        self._unflushed = {operator: [] for operator in self._unflushed}

    @property
    def unsaved_calls(self) -> int:
        """Calls whose records are not in the file."""
        fresh = ((self._saved_batches(o) - self._flushed.get(o, 0), calls) for o, calls in self._unflushed.items())
        return sum(sum(calls[saved:]) for saved, calls in fresh)

    @property
    def saved_calls(self) -> int:
        """Calls whose records are in the file."""
        return self._calls - self.unsaved_calls

    def _saved_batches(self, operator: str) -> int:
        return self.writer.saved(firings_topic(self.graph.namespace, operator))

    def close(self, outcome: str) -> Mapping[str, Any]:
        self._write_early()
        self.flush()  # an outcome is said of what is there already
        self.writer.add_metadata(ENDS, {stream: json.dumps(end) for stream, end in sorted(self._ends.items())})
        self.writer.add_metadata(OUTCOME, {"outcome": outcome})
        self.writer.close()
        return {"path": str(self.path), "messages": self.messages, "bytes": self.path.stat().st_size}
