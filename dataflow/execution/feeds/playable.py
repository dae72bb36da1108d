"""Recorded streams that stand in for sources, whatever they were recorded with."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from dataflow.recording.streams.cutting import cut_of
from dataflow.recording.streams.entries import Recorded
from dataflow.recording.streams.streams import StreamInfo


class PlayableStreams(Protocol):
    """Streams of messages by name, read in the order of stamps: a recording, or a bag of another system. `metadata`:
    the file's description of the run that made it, as recordings have it; empty where there was none."""

    path: Path
    streams: Mapping[str, StreamInfo]
    metadata: Mapping[str, Mapping[str, str]]

    @property
    def torn(self) -> bool:
        """Returns whether the file has no proper end."""

    def messages(
        self, streams: Sequence[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[Recorded]:
        """Messages with start ≤ stamp ≤ end (ns), merged by (stamp, stream); static streams first and whole."""

    def stamps(self, stream: str, start: int | None = None, end: int | None = None) -> Iterator[int]:
        """The stamps of what `messages()` gives of one stream, in that order."""

    def opening(self) -> Mapping[str, Any] | None:
        """Plain values by which another process opens the same streams; None where the path alone suffices."""

    def close(self) -> None:
        """Closes the file. Idempotent."""


def span_of(recording: PlayableStreams, streams: Iterable[str]) -> tuple[int, int] | None:
    """The first and the last stamp (ns) of those streams that are not static; None when they hold no message. Of a part
    of a recording, what lies outside of its span is left out."""
    infos = [recording.streams[s] for s in streams if not recording.streams[s].static]
    firsts = [info.first for info in infos if info.first is not None]
    lasts = [info.last for info in infos if info.last is not None]
    if not firsts or not lasts:
        return None
    part = cut_of(recording.metadata)
    start, end = (None, None) if part is None else (part.start, part.end)
    return min(firsts) if start is None else start, max(lasts) if end is None else min(max(lasts), end)
