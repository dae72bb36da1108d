"""Sinks of visualised messages: a window, a running viewer, a browser or a file.

`ViewerSink.log` never waits for a viewer unless it is asked to. Rerun's own `log` does: when a viewer stalls, its
channels fill and the calling thread stands still. So a thread of the sink's own talks to Rerun, behind a queue that is
bounded in messages and bytes and that drops its oldest.
"""

from __future__ import annotations

import logging
import subprocess
import threading
import traceback
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self
from urllib.parse import urlsplit

import rerun as rr

from dataflow.graph.model import Graph
from dataflow.messages import Message
from dataflow.view import process
from dataflow.view.backlog import Backlog, Bounds
from dataflow.view.blueprint import blueprint
from dataflow.view.drawing import parts_of, visualize
from dataflow.view.layout import layout
from dataflow.view.pacing import Pace
from dataflow.view.process import LOOPBACK, ViewerError
from dataflow.view.scene import SCENE, VIEWER_LOG, SceneState, ViewOptions, entity_of
from dataflow.view.scores import SCORES, Summaries, document, scores_of
from dataflow.view.targets import GRPC_PORT, Connect, Save, Serve, Spawn, Target
from dataflow.view.viewpoint import ViewerPose

SETTLE = 1_000_000_000
"""Event time (ns) after which the viewer decides where to look from."""

FILE_OPTIONS = ViewOptions(
    jpeg_quality=75,
    depth_step=0.04,
    depth_block=2,
    max_points=2_000,
    point_step=2.0**-6,
    point_shades=16,
    pose_step=45_000_000,
    image_step=200_000_000,
)
"""Contents of a file unless more is asked for: for looking, not for measuring."""

_FILE_BATCHES = rr.ChunkBatcherConfig(flush_tick=10.0, flush_num_bytes=8 << 20)
"""Rows of an entity go into a file together: one at a time, each has a header larger than most rows."""


@dataclass(frozen=True, slots=True)
class SinkStatistics:
    """Counts of messages: drawn, dropped because the viewer was too slow, failed to draw, left out by `image_step`."""

    drawn: int
    dropped: int
    failed: int
    passed: int = 0


class ViewerSink:
    """Draws messages of streams in a viewer. `open`, `log` any number of times, `close`; or a `with` block.

    `report` gets one line for people about everything that goes wrong, once per stream and cause.
    """

    def __init__(
        self,
        target: Target,
        *,
        options: ViewOptions | None = None,
        bounds: Bounds | None = None,
        report: Callable[[str], None] | None = None,
        application: str = "dataflow",
    ) -> None:
        self.target = target
        self._options = options
        self._report = report or logging.getLogger(__name__).warning
        self._application = application
        self._recording: rr.RecordingStream | None = None
        self._scene = SceneState()
        self._thread: threading.Thread | None = None
        self._server: subprocess.Popen[bytes] | None = None
        self._pace = Pace()
        self._backlog = Backlog(bounds or Bounds())
        self._counts: Counter[str] = Counter()
        self._reported: set[tuple[str, str]] = set()
        self._started_at: int | None = None
        self._graph: Graph | None = None
        self._outlook: ViewerPose | None = None
        self._seen: set[str] = set()
        self._scores: Summaries = {}
        self._laid_out = False

    def open(
        self,
        streams: Mapping[str, type[Message]],
        graph: Graph | None = None,
        static: Iterable[str] = (),
        hidden: Iterable[str] = (),
    ) -> None:
        """Starts or reaches the viewer and lays out its views. Raises `ViewerError`.

        `streams`: name → message type. `static`: streams whose one message holds for all time, besides those that the
        graph names. `hidden`: streams that are not shown, besides those that the graph hides; where they place frames,
        these are placed all the same.
        """
        if self._recording is not None:
            raise ViewerError("this sink is open already")
        self._graph = graph
        options = self._options or _options(self.target, graph)
        self._scene = SceneState(layout(streams, graph, static, hidden), options)
        self._pace = self._scene.layout.pace(options.image_step)
        name = graph.name if graph is not None else self._application
        batches = _FILE_BATCHES if isinstance(self.target, Save) else None
        recording = rr.RecordingStream(name, recording_id=uuid.uuid4(), batcher_config=batches)
        try:
            self._reach(recording)
        except ViewerError:
            self._stop_server()
            raise
        recording.send_recording_name(name)
        recording.log(SCENE, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._saved_layout(recording, graph)
        if not isinstance(self.target, Save) and not self._laid_out:
            recording.send_blueprint(blueprint(self._scene.layout, following=True))
        self._recording = recording
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def log(self, stream: str, message: Message, *, wait: float = 0.0) -> bool:
        """Hands a message over for drawing; returns whether it was taken.

        Where the queue is full, waits up to `wait` seconds for room, then drops the oldest. Messages of streams that
        are not shown are passed over.
        """
        if self._recording is None:
            raise ViewerError("this sink is not open: call open() first")
        layout = self._scene.layout
        if stream not in layout.streams and stream not in layout.placing:
            return False
        if stream in layout.static:
            return self._backlog.put_static(stream, message)
        dropped = self._backlog.put(stream, message, wait)
        if dropped is None:
            return False
        self._counts["dropped"] += dropped
        if dropped:
            self._tell("", "slow", "the viewer is too slow: some messages are not shown (the oldest are dropped)")
        return True

    def scores(self, summaries: Summaries) -> None:
        """Shows findings, and what operators without outputs have summed up at the end of a run, with a graph."""
        self._backlog.put_scores(scores_of(summaries, self._graph))

    def statistics(self) -> SinkStatistics:
        """Returns what became of the messages so far."""
        return SinkStatistics(*(self._counts[what] for what in ("drawn", "dropped", "failed", "passed")))

    def backlog(self) -> int:
        """Returns how many messages wait to be drawn."""
        return len(self._backlog)

    def close(self, timeout: float = 10.0) -> bool:
        """Draws what waits, flushes and lets go of the viewer; returns whether all arrived within `timeout` seconds."""
        if self._recording is None or self._thread is None:
            return True
        self._backlog.close()
        self._thread.join(timeout)
        finished = not self._thread.is_alive()
        if not finished:
            _abandoned.append(self._recording)  # its destructor would wait for the stalled viewer
            self._tell("", "close", f"the viewer did not take everything within {timeout:g} s; the rest is not shown")
        self._recording = None
        self._stop_server()
        return finished

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _reach(self, recording: rr.RecordingStream) -> None:
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        match self.target:
            case Save(path):
                if not path.parent.is_dir():
                    raise ViewerError(f"cannot save {path}: there is no folder {path.parent}")
                try:
                    recording.save(path)
                except Exception as error:
                    raise ViewerError(f"cannot save {path}: {error}") from error
            case Connect(url):
                _check_reachable(url)
                recording.connect_grpc(url)
            case Spawn(port, memory):
                if (problem := process.display_problem()) is not None:
                    raise ViewerError(f"cannot open a viewer window: {problem}. Use serve (a browser) or a .rrd file")
                arguments = ["--port", str(port), "--memory-limit", memory, "--expect-data-soon"]
                process.start(arguments, [port], outlive=True)
                recording.connect_grpc(f"rerun+http://{LOOPBACK}:{port}/proxy")
            case Serve(web, grpc, memory):
                arguments = ["--serve-web", "--port", str(grpc), "--web-viewer-port", str(web)]
                self._server = process.start([*arguments, "--server-memory-limit", memory], [grpc, web], outlive=False)
                recording.connect_grpc(f"rerun+http://{LOOPBACK}:{grpc}/proxy")

    def _stop_server(self) -> None:
        if self._server is not None:
            process.stop(self._server)
            self._server = None

    def _run(self) -> None:
        """The drawing thread: everything that may wait for the viewer happens here."""
        recording = self._recording
        assert recording is not None
        while (entry := self._backlog.take()) is not None:
            if isinstance(entry, tuple):
                if self._pace.takes(*entry):
                    self._draw(recording, *entry)
                else:
                    self._counts["passed"] += 1
            else:
                self._scores = entry
                self._guarded("", lambda: self._score(recording))
        for stream, message in self._pace.rest():
            self._draw(recording, stream, message)
            self._counts["passed"] -= 1
        self._guarded("", lambda: self._settle(recording))
        if isinstance(self.target, Save):
            self._guarded("", lambda: self._look_again(recording))
        self._guarded("", lambda: recording.flush(timeout_sec=3600.0))  # close() bounds the wait
        recording.disconnect()

    def _draw(self, recording: rr.RecordingStream, stream: str, message: Message) -> None:
        static = stream in self._scene.layout.static
        if self._guarded(stream, lambda: visualize(recording, entity_of(stream), message, self._scene, stream)):
            self._counts["drawn"] += 1
        else:
            self._counts["failed"] += 1
        new = stream not in self._seen or self._scene.new_parts
        self._seen.add(stream)
        if new and self._outlook is not None:
            self._guarded("", lambda: self._lay_out(recording))
        if static:
            return
        if self._started_at is None:
            self._started_at = message.stamp
        if self._outlook is None and message.stamp - self._started_at >= SETTLE:
            self._guarded("", lambda: self._settle(recording))
        for doubt in self._scene.doubts(message.stamp):
            recording.log(VIEWER_LOG, rr.TextLog(doubt, level="INFO"))

    def _score(self, recording: rr.RecordingStream) -> None:
        recording.log(SCORES, document(self._scores), static=True)
        if self._outlook is not None:
            self._lay_out(recording)

    def _settle(self, recording: rr.RecordingStream) -> None:
        """Decides, once, which way is up and where to look from."""
        if self._outlook is not None:
            return
        self._outlook = self._scene.viewpoint.outlook(self._scene.tree)
        if self._outlook.up[1] < 0:
            recording.log(SCENE, rr.ViewCoordinates.RDF, static=True)
        self._lay_out(recording)

    def _look_again(self, recording: rr.RecordingStream) -> None:
        """Chooses the viewpoint once more, from which all that there is in a file is in view."""
        if self._scene.viewpoint.knows_more:
            self._outlook = self._scene.viewpoint.outlook(self._scene.tree, whole=True)
            self._lay_out(recording)

    def _saved_layout(self, recording: rr.RecordingStream, graph: Graph | None) -> None:
        """Takes the layout that the graph names, as saved from the viewer, in place of a derived one."""
        if graph is None or not graph.view.layout:
            return
        file = Path(graph.view.layout)
        if file.is_file():
            recording.log_file_from_path(file)
            self._laid_out = True
        else:
            self._tell("", "layout", f"there is no layout {file} (`view: layout` in the graph); the views are derived")

    def _lay_out(self, recording: rr.RecordingStream) -> None:
        """Views for the streams that have had a message, and for what these drew: a sensor that is off leaves none."""
        self._scene.new_parts = False
        if self._laid_out:
            return
        full = self._scene.layout
        shown = layout({name: type_ for name, type_ in full.streams.items() if name in self._seen}, self._graph)
        parts = [(name, part) for name, type_ in shown.streams.items() for part in parts_of(type_)]
        shown = replace(shown, empty=frozenset(each for each in parts if not self._scene.has_drawn(*each)))
        following = not isinstance(self.target, Save) or self.target.at_end
        views = blueprint(shown, outlook=self._outlook, following=following, scores=bool(self._scores))
        recording.send_blueprint(views)

    def _guarded(self, stream: str, action: Callable[[], object]) -> bool:
        """Runs an action whose failure must not end the viewer; returns whether it worked."""
        try:
            action()
        except Exception as error:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            cause = f"{type(error).__name__} at {frame.name}:{frame.lineno}"
            self._tell(stream, cause, f"cannot draw {stream or 'the views'}: {type(error).__name__}: {error}")
            return False
        return True

    def _tell(self, stream: str, cause: str, text: str) -> None:
        if (stream, cause) not in self._reported:
            self._reported.add((stream, cause))
            self._report(text)


def _options(target: Target, graph: Graph | None) -> ViewOptions:
    """Returns what a file holds, by the graph's wish too; anything else shows all."""
    if not isinstance(target, Save):
        return ViewOptions()
    every = graph.view.every if graph is not None else None
    return FILE_OPTIONS if every is None else replace(FILE_OPTIONS, image_step=every)


_abandoned: list[rr.RecordingStream] = []
"""Recordings whose viewer stalled: kept, because letting go of one would wait for it."""


def _check_reachable(url: str) -> None:
    """Rerun's `connect_grpc` returns at once and tries for ever; this raises at once where no server listens."""
    parts = urlsplit(url)
    if parts.path != "/proxy" or parts.hostname is None:
        raise ViewerError(f"viewer address {url!r}: expected rerun+http://HOST:PORT/proxy")
    port = parts.port or GRPC_PORT
    if not process.listening(port, parts.hostname, timeout=3.0):
        raise ViewerError(f"no viewer listens on {parts.hostname}:{port}; start one with `rerun --bind {LOOPBACK}`")
