"""Proposes which topic of a bag stands in for which stream of a graph, from message types and names. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+|\d+")
_SAME = {
    "colour": "color",
    "rgb": "color",
    "cam": "camera",
    "odom": "odometry",
    "gt": "truth",
    "groundtruth": "truth",
    "ground": "truth",
    "calibration": "info",
    "pointcloud": "points",
    "cloud": "points",
    "velodyne": "lidar",
    "gps": "fix",
    "navsat": "fix",
    "infra1": "left",
    "infra2": "right",
    "tf": "transforms",
    "mag": "magnetic",
    "extrinsics": "static",
}
_PLAIN = {"raw", "data", "msg", "robot", "sensor"}
"""Words without information."""


@dataclass(frozen=True, slots=True)
class SourceStream:
    """A stream that a topic may stand in for. `name`: without namespace; `needed`: something takes it that must."""

    stream: str
    name: str
    types: tuple[str, ...]
    static: bool
    needed: bool


@dataclass(frozen=True, slots=True)
class AvailableTopic:
    """A topic, the message types that it can be played as (best first), and how many messages it has."""

    topic: str
    types: tuple[str, ...]
    count: int


@dataclass(frozen=True, slots=True)
class Match:
    """A topic that stands in for a stream, as one of the stream's types."""

    wanted: SourceStream
    topic: str
    type: str


@dataclass(frozen=True, slots=True)
class Proposal:
    """A mapping as far as there is one.

    - `certain`: matches that are given or follow from types alone; `guessed`: those that names decided.
    - `missing`: needed streams that no topic fits.
    """

    certain: tuple[Match, ...]
    guessed: tuple[Match, ...]
    missing: tuple[SourceStream, ...]

    @property
    def settled(self) -> bool:
        """Returns whether it can be played as it is."""
        return not self.guessed and not self.missing

    @property
    def matches(self) -> tuple[Match, ...]:
        return (*self.certain, *self.guessed)


class MappingError(ValueError):
    """Raised when a mapping is invalid; the message names the word, and what would be right."""


def propose(streams: Sequence[SourceStream], topics: Sequence[AvailableTopic], given: Mapping[str, str]) -> Proposal:
    """Returns what stands in for each needed stream: as `given` (stream → topic), or what fits by type and name.

    Certain is a topic that is the only one to fit a stream, and fits no other needed stream. Streams that nothing needs
    are filled only where they are given. Raises `MappingError` for a given one whose types do not fit.
    """
    offered = {o.topic: o for o in topics}
    certain = [_given(wanted, offered[given[wanted.stream]]) for wanted in streams if wanted.stream in given]
    taken = set(given.values())
    left = [w for w in streams if w.needed and w.stream not in given]
    fits = {w.stream: [o for o in topics if o.topic not in taken and _type(w, o)] for w in left}
    missing = [w for w in left if not fits[w.stream]]
    open_: list[SourceStream] = []
    for wanted in left:
        found = fits[wanted.stream]
        rivals = [w for w in left if w is not wanted and found and found[0] in fits[w.stream]]
        if len(found) == 1 and not rivals:
            certain.append(_match(wanted, found[0]))
        elif found:
            open_.append(wanted)
    scored = sorted(
        ((_likeness(w.name, o.topic), -i, w, o) for w in open_ for i, o in enumerate(fits[w.stream])),
        key=lambda row: (-row[0], -row[1], row[2].stream),
    )
    guessed: dict[str, Match] = {}
    used: set[str] = set()
    for fresh in (True, False):  # a topic stands in twice only where there is no other
        for _, _, wanted, topic in scored:
            if wanted.stream not in guessed and not (fresh and topic.topic in used):
                guessed[wanted.stream] = _match(wanted, topic)
                used.add(topic.topic)
    return Proposal(tuple(certain), tuple(guessed[w.stream] for w in open_), tuple(missing))


def _given(wanted: SourceStream, topic: AvailableTopic) -> Match:
    if _type(wanted, topic) is None:
        raise MappingError(
            f"{topic.topic} is read as {' or '.join(topic.types) or 'nothing'}, and {wanted.name} takes "
            f"{' or '.join(wanted.types)}"
        )
    return _match(wanted, topic)


def _match(wanted: SourceStream, topic: AvailableTopic) -> Match:
    found = _type(wanted, topic)
    assert found is not None
    return Match(wanted, topic.topic, found)


def _type(wanted: SourceStream, topic: AvailableTopic) -> str | None:
    return next((t for t in topic.types if t in wanted.types), None)


def _words(name: str) -> set[str]:
    words = (word.lower() for part in name.split("/") for word in _WORD.findall(part))
    return {_SAME.get(word, word) for word in words} - _PLAIN


def _likeness(stream: str, topic: str) -> float:
    """Shared words over all words, 0 to 1; the last part of a name counts twice."""
    a, b = _words(stream), _words(topic)
    last = _words(stream.rpartition("/")[2]) & _words(topic)
    return (len(a & b) + len(last)) / max(1, len(a | b) + len(last))


def parse_map(words: Iterable[str], streams: Sequence[SourceStream], topics: Sequence[str]) -> dict[str, str]:
    """Returns stream → topic of words such as `/camera/color/image_raw=camera/image`.

    Streams are named with or without the namespace. Raises `MappingError`.
    """
    known = {w.name: w.stream for w in streams} | {w.stream: w.stream for w in streams}
    found: dict[str, str] = {}
    for word in words:
        topic, separator, stream = word.partition("=")
        if not separator:
            raise MappingError(f"--map {word!r}: expected TOPIC=STREAM, such as /camera/image_raw=camera/image")
        named = topic if topic in topics else f"/{topic}" if f"/{topic}" in topics else topic.removeprefix("/")
        if named not in topics:
            raise MappingError(f"--map {word!r}: the bag has no topic {topic!r}; it has {', '.join(topics) or 'none'}")
        if stream not in known:
            names = ", ".join(w.name for w in streams)
            raise MappingError(f"--map {word!r}: the graph's sources have no stream {stream!r}; they have {names}")
        if known[stream] in found:
            raise MappingError(f"--map {word!r}: {stream} is given twice")
        found[known[stream]] = named
    return found
