"""Layout of a recording: topics, channel kinds, metadata names. `docs/recordings.md` describes it for others."""

from __future__ import annotations

import functools
import json
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, version
from typing import Final

FORMAT: Final = "1"
PROGRAM: Final = "robot-dataflow/"
"""Begins the name of the library in the header of our files."""
RECORDING: Final = "recording"
DIGESTS: Final = "digests"
GRAPH: Final = "dataflow:graph"
RUN: Final = "dataflow:run"
ENDS: Final = "dataflow:ends"
OUTCOME: Final = "dataflow:outcome"
COMPLETED: Final = "dataflow:completed"
BAG: Final = "dataflow:bag"
"""Of a replay of another system's bag: its file, clock, topics and repairs."""
CUT: Final = "dataflow:cut"
"""Of a part of a recording: what it was cut from, and the span (`dataflow.recording.streams.cutting`)."""
RECOVERED: Final = "dataflow:recovered"
"""Of a file that was saved from a broken one: its name, and what was damaged."""
FLIGHT: Final = "dataflow:flight"
"""Of what a flight recorder kept: its triggers."""
TOLD: Final = "dataflow:told"
"""Contents that the events of a run always cover, as `events`: names, by spaces."""
PARAMETERS: Final = "parameter"
"""The event of a parameter that was changed."""
RESERVED_METADATA: Final = frozenset({RECORDING, DIGESTS})
FIELDS: Final = "fields"
"""Key of a stream's channel metadata: the declaration of a type that is not of `dataflow.messages`, as JSON."""
COMPANION_SUFFIX: Final = "/@companion"
SEQUENCE_SPAN: Final = 2**32


class Kind(StrEnum):
    """Kinds of channels, in their metadata under `kind`."""

    STREAM = "stream"
    COMPANION = "companion"
    FIRINGS = "firings"
    EVENTS = "events"
    FRAMES = "frames"
    LOGS = "logs"


EVENT_SCHEMA: Final = json.dumps(
    {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Event",
        "description": "something that happened to the run: a gap in a stream, a new incarnation, a fault",
        "type": "object",
        "properties": {
            "timestamp": {
                "type": "object",
                "title": "time",
                "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
            },
            "event": {"type": "string", "description": "kind of event"},
            "stamp": {"type": "string", "description": "event time, nanoseconds since the epoch"},
            "data": {"type": "object", "properties": {}, "description": "what is particular to the kind"},
        },
        "required": ["timestamp", "event", "stamp", "data"],
    },
    indent=1,
).encode()


@functools.cache
def library() -> str:
    """Returns the name of this program in the header of its files."""
    try:
        return f"{PROGRAM}{version('robot-dataflow')}"
    except PackageNotFoundError:
        return f"{PROGRAM}unknown"


def firings_topic(namespace: str, operator: str) -> str:
    return _internal(namespace, f"firings/{operator}")


def events_topic(namespace: str) -> str:
    return _internal(namespace, "events")


def frames_topic(namespace: str) -> str:
    return _internal(namespace, "frames")


def logs_topic(namespace: str) -> str:
    return _internal(namespace, "logs")


def _internal(namespace: str, rest: str) -> str:
    return f"{namespace}/@/{rest}" if namespace else f"@/{rest}"
