"""Opens recordings for analysis: streams by short name or pattern, parts of them by time, joins by timestamp."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from dataflow.api.asof import Direction, asof
from dataflow.api.html import recording_html
from dataflow.api.join import Joined
from dataflow.api.names import StreamNameError, stream_named, streams_named
from dataflow.api.stream import RecordedStream, facts_of
from dataflow.arguments import checked
from dataflow.graph.model import Graph
from dataflow.recording import Event, Recorded, Recording
from dataflow.recording.layout import RECORDING
from dataflow.recording.notices import warning
from dataflow.recording.streams.cutting import cut_of
from dataflow.recording.streams.part_folder import parts_in
from dataflow.reexecution.recorded_run import resolved_graph


@checked
def open(path: str | Path) -> RecordedStreams:
    """Opens a recording: one of this project's, or any MCAP file, also one whose writer was killed.

    Only its index is read. Close it with `close()` or a `with` block. Raises `FileNotFoundError`, and `RecordingError`
    for a file that is no MCAP.
    """
    file = Path(path).expanduser()
    if not file.is_file() and not (file.is_dir() and parts_in(file)):
        raise FileNotFoundError(f"no recording {file}" + (": that is a folder" if file.is_dir() else ""))
    with warning():
        recording = Recording(file)
    infos = [info for info in recording.streams.values() if not info.static and "/@/" not in f"/{info.name}"]
    part = cut_of(recording.metadata)
    origin = min((info.first for info in infos if info.first is not None), default=0)
    if part is not None and part.start is not None:
        origin = part.start
    return RecordedStreams(recording, tuple(recording.streams), origin)


class RecordedStreams(Mapping[str, RecordedStream]):
    """The streams of a recording, or some of them, whole or from one moment to another.

    `recording["imu"]` is a stream by its name, full or short (`imu` for `robot1/robot/imu`); iteration gives the full
    names. `start` and `end` are timestamps, `duration` seconds, all from the index.
    """

    def __init__(
        self,
        recording: Recording,
        names: tuple[str, ...],
        origin: int,
        first: int | None = None,
        last: int | None = None,
    ) -> None:
        self._recording, self._names, self._origin = recording, names, origin
        self._first, self._last = first, last
        self._streams: dict[str, RecordedStream] = {}

    @property
    def path(self) -> Path:
        """The file."""
        return self._recording.path

    @property
    def namespace(self) -> str:
        """The namespace of the graph that made the recording; empty for other programs' files."""
        return str(self.metadata.get(RECORDING, {}).get("namespace", ""))

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The metadata of the recording by name: the graph, the machine, package versions, the outcome."""
        return self._recording.metadata

    @property
    def graph(self) -> Graph | None:
        """The graph that made the recording, to look at; no operator is imported. None where the file holds none."""
        return resolved_graph(self._recording)

    @property
    def start(self) -> int:
        """The timestamp of the first message (ns since the epoch), static streams and the runtime's own aside.

        A part begins where it was cut.
        """
        return self._origin if self._first is None else max(self._origin, self._first)

    @property
    def end(self) -> int:
        """The timestamp of the last message (ns since the epoch), static streams aside."""
        infos = (self._recording.streams[name] for name in self._names)
        last = max((i.last for i in infos if i.last is not None and not i.static), default=self.start)
        return last if self._last is None else min(last, self._last)

    @property
    def duration(self) -> float:
        """Seconds from `start` to `end`."""
        return max(0, self.end - self.start) * 1e-9

    # ------------------------------------------------------------------------------------------------- streams

    @checked
    def __getitem__(self, name: str) -> RecordedStream:
        found = stream_named(name, self._names, self.namespace)
        if found not in self._streams:
            stream = RecordedStream(self._recording, found, self._origin)
            whole = self._first is None and self._last is None
            self._streams[found] = stream if whole else stream.within(self._first, self._last)
        return self._streams[found]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __contains__(self, name: object) -> bool:
        try:
            return isinstance(name, str) and bool(stream_named(name, self._names, self.namespace))
        except StreamNameError:
            return False

    @checked
    def select(self, *names: str) -> RecordedStreams:
        """Some of the streams, by names or patterns: `*` stands for one part of a name, `**` for any number.

        Raises `StreamNameError` for a word that means none.
        """
        found = {name for word in names for name in streams_named(word, self._names, self.namespace)}
        chosen = tuple(name for name in self._names if name in found)
        return RecordedStreams(self._recording, chosen, self._origin, self._first, self._last)

    @checked
    def between(self, start: float | None = None, end: float | None = None) -> RecordedStreams:
        """The recording from `start` to `end`, both included, in seconds from its own start."""
        first = None if start is None else self._origin + round(start * 1e9)
        last = None if end is None else self._origin + round(end * 1e9)
        return self.within(first, last)

    @checked
    def within(self, first: int | None = None, last: int | None = None) -> RecordedStreams:
        """The recording with first ≤ stamp ≤ last (nanoseconds since the epoch). Static streams stay whole."""
        firsts = [stamp for stamp in (self._first, first) if stamp is not None]
        lasts = [stamp for stamp in (self._last, last) if stamp is not None]
        return RecordedStreams(
            self._recording, self._names, self._origin, max(firsts, default=None), min(lasts, default=None)
        )

    # ------------------------------------------------------------------------------------------------- messages

    def messages(self) -> Iterator[Recorded]:
        """The messages of all its streams that have a message type, by timestamp, with stream, number and incarnation.

        Static streams come first.
        """
        readable = [name for name in self._names if self._recording.streams[name].message_type is not None]
        return self._recording.messages(readable, self._first, self._last)

    def events(self) -> Iterator[Event]:
        """Reads the events of the run: restarts, gaps, planned faults."""
        return self._recording.events()

    @checked
    def join(
        self, anchor: str, *others: str, direction: Direction = "backward", tolerance: float | None = None
    ) -> Joined:
        """Puts to each message of `anchor` the matching one of each other stream, by timestamp.

        `direction`: the newest at or before (`backward`, as a `Sampled` input has it), the oldest at or after
        (`forward`), or the `nearest`. `tolerance`: seconds that a match may be away; a message without one stays, with
        None in its place. Raises `StreamNameError`.
        """
        streams = tuple(self[name] for name in (anchor, *others))
        limit = None if tolerance is None else round(tolerance * 1e9)
        places = [asof(streams[0].stamps, other.stamps, direction, limit) for other in streams[1:]]
        return Joined(streams, places)

    # ------------------------------------------------------------------------------------------------- life, display

    def close(self) -> None:
        """Closes the file, for every part of the recording. Idempotent."""
        self._recording.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __eq__(self, other: object) -> bool:
        return self is other

    def __hash__(self) -> int:
        return id(self)

    def __repr__(self) -> str:
        return f"<recording {self.path}: {len(self)} streams, {self.duration:.3f} s>"

    def _repr_html_(self) -> str:
        streams = [facts_of(self[name]) for name in self]
        return recording_html(self.path, self.start, self.duration, f"{self.namespace}/", streams)

    def _ipython_key_completions_(self) -> list[Any]:
        prefix = f"{self.namespace}/"
        return [name.removeprefix(prefix) for name in self._names]
