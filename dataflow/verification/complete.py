"""Completes a thin recording: what was not recorded is computed again, by the recorded firings, and stored.

The result holds what a full recording of the same run would: its drops, timeouts and late messages are repeated, since
the firing records say which messages each call was given.
"""

from __future__ import annotations

import errno
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.recording.layout import COMPLETED, ENDS, OUTCOME, RESERVED_METADATA, logs_topic
from dataflow.recording.streams.copying import Origin
from dataflow.records.comparison import Verification
from dataflow.records.firing import decode_batch
from dataflow.records.reading import FiringLog
from dataflow.reexecution.engine import Feeding, Recomputation
from dataflow.reexecution.recorded_run import ReplayError, recorded_graph
from dataflow.sinks.recorder import RecorderSink
from dataflow.supervision.core.report import Watch
from dataflow.supervision.replay import plan_replay
from dataflow.sync import Entry
from dataflow.verification.choice import require_records
from dataflow.verification.ledger import read_ledger
from dataflow.verification.record_totals import GraphRecordTotals, MessageSet
from dataflow.verification.workers.board import Board
from dataflow.verification.workers.processes import Call, call_workers


@dataclass(frozen=True, slots=True)
class Completion:
    """The result of completing a recording.

    `added`: streams that the thin recording did not hold. `messages` of all streams; `kept` of them were recorded, but
    no firing could be made again that made them, so they were taken over. Nothing is left at `path` when an operator
    made anything other than recorded; where firings could not be made again, what was not recorded is missing.
    """

    path: Path
    operators: tuple[Verification, ...]
    added: tuple[str, ...]
    messages: int
    kept: int
    nbytes: int
    wall: float

    @property
    def stored(self) -> bool:
        """Returns whether there is a file: everything that was made again is as recorded."""
        return not any(v.first for v in self.operators)

    @property
    def whole(self) -> bool:
        """Every firing of the run was made again, and made what it had made."""
        return not self.kept and all(v.verdict == "identical" and not v.cut for v in self.operators)

    def as_json(self) -> dict[str, Any]:
        return {
            "path": str(self.path) if self.stored else None,
            "stored": self.stored,
            "whole": self.whole,
            "added": list(self.added),
            "messages": self.messages,
            "kept": self.kept,
            "bytes": self.nbytes,
            "wall_s": self.wall,
            "operators": [v.to_wire() | {"verdict": v.verdict} for v in self.operators],
        }


def complete(
    path: Path, out: Path, *, graph: Graph | None = None, overwrite: bool = False, watch: Watch | None = None
) -> Completion:
    """Writes the complete recording of the run that the thin recording `path` is of.

    The new file holds the recorded streams and firing records as they are, and every other stream as the operators make
    it again. It appears under its name only when it is done and every message has the recorded digest.
    Raises `ReplayError` when `path` lacks what is needed (a sensor stream, firing records), `RunFailed` when an
    operator cannot run, `RecordingError` when the file cannot be written.
    """
    with Recording(path) as recording:
        played = graph or recorded_graph(recording)
        feeding = _plan(recording, played)  # refuses here what would fail there
    part = out.with_name(f"{out.name}.part")
    request = {"path": str(path), "part": str(part), "graph": played.to_json()}
    envs = dict.fromkeys(played.nodes[name].env for name in feeding.operators)
    if len(envs) > 1:
        raise ReplayError(
            f"{path}: its operators run in several environments ({', '.join(env or 'no env' for env in envs)}), and a "
            "recording is completed in one process: record all streams (`record: all`)"
        )
    call = Call(f"{__name__}:{complete_part.__name__}", request, feeding.operators, env=next(iter(envs), None))
    try:
        [found] = call_workers([call], threads=played.threads, watch=watch)
        made = Completion(
            path=out,
            operators=tuple(Verification.from_wire(v) for v in found["operators"]),
            added=tuple(found["added"]),
            messages=found["messages"],
            kept=found["kept"],
            nbytes=part.stat().st_size,
            wall=found["wall"],
        )
        if made.stored:
            if out.exists() and not overwrite:
                raise FileExistsError(errno.EEXIST, "the file exists", str(out))
            part.replace(out)
        return made
    finally:
        part.unlink(missing_ok=True)


def _plan(recording: Recording, graph: Graph) -> Feeding:
    again = [name for name, node in graph.nodes.items() if not node.source and not node.external]
    require_records(recording, FiringLog.read(recording).operators, again)
    resting = set(graph.nodes) - set(again)
    given = set(recording.streams).union(*(graph.nodes[name].taken for name in again))
    replaced = {name for name in resting if given & set(graph.nodes[name].outputs.values())}
    return Feeding(tuple(again), plan_replay(recording, graph, replaced=replaced, resting=resting).streams)


def complete_part(request: Mapping[str, Any], board: Board) -> dict[str, Any]:
    """Writes the new recording. Runs in a worker."""
    graph = Graph.from_json(request["graph"])
    part = Path(request["part"])
    started = time.monotonic()
    with Recording(request["path"], watch=board.goes_on) as recording:
        log = FiringLog.read(recording)
        feeding = _plan(recording, graph)
        store = _Store(recording, graph, feeding, part)
        work = Recomputation(
            recording, graph, feeding, log, made=store.take, read=store.take, ended=store.sink.end, watcher=board
        )
        results = work.run(until=lambda: any(runner.result.first for runner in work.runners.values()))
        ledger = read_ledger(recording, graph, GraphRecordTotals(log, graph), feeding.operators)
        for result in results.values():
            ledger.enter(result)
        kept = store.keep(recording)
        messages = store.close()
        added = sorted(s for s in store.streams if s not in recording.streams)
    return {
        "operators": [results[name].to_wire() for name in feeding.operators],
        "added": added,
        "messages": messages,
        "kept": kept,
        "wall": time.monotonic() - started,
    }


class _Store:
    """The new recording: metadata, events and firing records as they were, then every stream."""

    def __init__(self, recording: Recording, graph: Graph, feeding: Feeding, part: Path) -> None:
        made = {s for name in feeding.operators for s in graph.nodes[name].outputs.values()}
        self.streams = sorted(made | set(feeding.streams))
        self._outcome = recording.metadata.get(OUTCOME, {}).get("outcome", "unknown: the recording is torn")
        metadata = {
            name: dict(values)
            for name, values in recording.metadata.items()
            if name not in RESERVED_METADATA and name not in (ENDS, OUTCOME)
        }
        metadata[COMPLETED] = {"from": recording.path.name, "by": f"robot-dataflow {version('robot-dataflow')}"}
        options = {"metadata": metadata, "compression": "zstd", "overwrite": True}
        self.sink = RecorderSink(part, graph, self.streams, options)
        for stream, end in recording.metadata.get(ENDS, {}).items():
            known = json.loads(end)
            self.sink.end(stream, known["final"], known["reason"])
        for event in recording.events():
            self.sink.writer.write_event(event.name, event.stamp, event.data)
        first = min((info.first for info in recording.streams.values() if info.first), default=0)
        for operator, payload in recording.firings():  # those of setup() have no stamp, and keep their place
            stamp = decode_batch(payload).records[-1].stamp
            self.sink.firings(operator, stamp if stamp > 0 else first, payload)
        with Origin(recording.path) as origin:
            for place in origin.file.attachments:
                self.sink.writer.add_attachment(origin.file.attachment(place))
        self._copied = 0
        self._taken = {stream: MessageSet() for stream in self.streams}
        for said, line in recording.logs():
            self.sink.writer.write_log(said, line)
        for stream in sorted(recording.streams.keys() - {*graph.streams, logs_topic(graph.namespace)}):
            self._copy(recording, stream)

    def _copy(self, recording: Recording, stream: str) -> None:
        """A stream that no operator makes: the runtime's own, such as its diagnostics."""
        info = recording.streams[stream]
        if info.message_type is None:
            raise ReplayError(f"{recording.path}: stream {stream!r} holds {info.schema}, which is not known here")
        extra = {name: info.metadata[name] for name in ("operator", "port") if name in info.metadata}
        self.sink.writer.add_stream(stream, info.message_type, static=info.static, extra=extra)
        for found in recording.messages([stream]):
            self.sink.writer.write(stream, found.message, seq=found.seq, incarnation=found.incarnation)
            self._copied += 1

    def take(self, stream: str, entry: Entry) -> None:
        self._taken[stream].add(entry.incarnation, entry.seq)
        self.sink.message(stream, entry.value, entry.seq, entry.incarnation)

    def keep(self, recording: Recording) -> int:
        """Takes over the recorded messages that were not made again; how many."""
        kept = 0
        for stream, taken in self._taken.items():
            if sum(recording.counts(stream).values()) <= sum(taken.counts().values()):
                continue
            for found in recording.messages([stream]):
                if (found.incarnation, found.seq) not in taken:
                    self.sink.message(stream, found.message, found.seq, found.incarnation)
                    kept += 1
        return kept

    def close(self) -> int:
        self.sink.close(self._outcome)
        return self.sink.messages + self._copied
