"""The files of a flight recorder's ring: deleted when they are old, joined into what is kept, on their own thread."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from dataflow.editing.part import Part
from dataflow.editing.rolling import keep_span
from dataflow.editing.spans import folded
from dataflow.graph.model import Graph
from dataflow.recording import Recording, RecordingError
from dataflow.recording.layout import FLIGHT
from dataflow.records.cuts import OrphanedMessage
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import FiringLog

MOST_WAITING = 8
"""Files that wait to be deleted, and spans that wait to be joined: then the recorder waits, so that the disk is
bounded."""


@dataclass(slots=True)
class Segment:
    """One file of the ring. `begin`: the stamp at which it was begun (None: before the first message); `held`: the
    messages of files before it that stand in front, by operator."""

    path: Path
    begin: int | None
    held: Mapping[str, list[OrphanedMessage]]


class FlightFiles:
    """Deletes files and joins others, on a separate thread, one after the other.

    The records of operators in deleted files are folded into a few each.
    """

    def __init__(self, graph: Graph, mode: int) -> None:
        self._graph, self._mode = graph, mode
        self._prologue: dict[str, list[FiringRecord]] = {}
        self._asked: queue.Queue[Callable[[], None] | None] = queue.Queue(MOST_WAITING)
        self._thread = threading.Thread(target=self._run, name="flight recorder", daemon=True)
        self._thread.start()

    def forget(self, segment: Segment) -> None:
        """Deletes a file, when what was asked for before is done; waits where much is asked for already."""
        self._asked.put(partial(self._forget, segment))

    def join(self, segments: list[Segment], part: Part, out: Path, one: dict[str, Any]) -> None:
        """Cuts a span out of some files into a recording; `one` is given its size, or what went wrong."""
        self._asked.put(partial(self._join, segments, part, out, one))

    def finish(self) -> None:
        """Returns when everything is done."""
        self._asked.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (act := self._asked.get()) is not None:
            act()

    def _forget(self, segment: Segment) -> None:
        try:
            with Recording(segment.path) as recording:
                log = FiringLog.read(recording)
                for operator in log.operators:
                    self._prologue[operator] = folded([*self._prologue.get(operator, ()), *log.of(operator)])
        except RecordingError as error:  # what follows is then unknown, as verification reports
            print(f"flight recorder: {error}", flush=True)
        finally:
            segment.path.unlink(missing_ok=True)

    def _join(self, segments: list[Segment], part: Part, out: Path, one: dict[str, Any]) -> None:
        try:
            records = _records(segments, self._prologue)
            about = {FLIGHT: {"triggers": json.dumps(one["reasons"])}}
            files = [segment.path for segment in segments]
            made = keep_span(files, records, self._graph, part, out, metadata=about, mode=self._mode)
            one["bytes"], one["messages"] = made.bytes, sum(made.streams.values())
            print(f"flight recorder: kept {out}: {one['reasons'][0]['what']}", flush=True)
        except Exception as error:  # the run goes on; the failure is said, and stands in its report
            one["error"] = f"{type(error).__name__}: {error}"
            print(f"flight recorder: could not keep {out}: {one['error']}", flush=True)


def _records(segments: list[Segment], prologue: dict[str, list[FiringRecord]]) -> dict[str, list[FiringRecord]]:
    """The firing records of files, behind what stands in for those that were deleted."""
    records = {operator: list(known) for operator, known in prologue.items()}
    for segment in segments:
        with Recording(segment.path) as recording:
            log = FiringLog.read(recording)
            for operator in log.operators:
                records.setdefault(operator, []).extend(log.of(operator))
    for operator, held in segments[0].held.items():
        listed = records.get(operator, [])
        at = next((k for k, record in enumerate(listed) if record.kind == "cut"), None)
        if at is not None:
            detail = {**listed[at].detail, "held": [list(message) for message in held]}
            listed[at] = replace(listed[at], detail=detail)
    return records
