"""Sections of a graph file that are about the whole graph: what is recorded, how it is viewed, where it listens."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import NoneType
from typing import Any, Literal


@dataclass(frozen=True, slots=True)
class Trigger:
    """A condition on which a flight recorder keeps what was.

    `kind`: "raise" (an operator fails), "drops" (more than `above` messages a second are dropped, by `operator` or by
    any), "field" (a field of a stream's messages, or one of its elements, is `above`, `below` or `equals` something).
    """

    kind: Literal["raise", "drops", "field"]
    operator: str = ""
    stream: str = ""
    field: str = ""
    above: float | None = None
    below: float | None = None
    equals: str | float | bool | None = None


@dataclass(frozen=True, slots=True)
class Flight:
    """A flight recorder: event time to keep before a trigger and after it (ns), where, and how many files at most.

    `disk`: size limit of the ring buffer, bytes; None: as much as `keep` needs. A lower limit shortens the history.
    """

    keep: int
    after: int
    when: tuple[Trigger, ...] = ()
    folder: str = "flight"
    files: int = 20
    disk: int | None = None


Snapshots = int | Literal["cpu"]


@dataclass(frozen=True, slots=True)
class Record:
    """Choice of the streams that a recording holds. `thin`: not all of them; firing records are always written.

    `snapshots`: nanoseconds of event time between two snapshots of an operator's state; "cpu": one per 0.25 s of CPU
    time that repeating it takes; None for none. `flight`: the
    flight recorder of runs that are not recorded whole; None for none. `on_failure`: whether a run goes on without a
    recorder that fails ("go_on") or ends ("end"); None: a live run goes on, any other ends.
    """

    streams: tuple[str, ...]
    thin: bool = False
    snapshots: Snapshots | None = None
    flight: Flight | None = None
    on_failure: Literal["go_on", "end"] | None = None


ON_FAILURE: Mapping[str, Literal["go_on", "end"]] = {"go_on": "go_on", "end": "end"}

PANELS = ("world", "cameras", "scene", "map", "text", "scores", "plots", "status", "log")
"""Parts of the viewer's window that a graph may choose."""

PLACE_FRAMES = ("Transforms", "Odometry", "Pose")
"""Message types that say where frames lie: the viewer takes such streams even where they are hidden, for that alone."""


@dataclass(frozen=True, slots=True)
class View:
    """Choices for the viewer: streams left out, panels (none: all), a layout saved from it (empty: derived), clouds
    whose points stay where they were seen, and the event time (ns) between two images of a stream in a viewer file
    (None: the viewer's own choice)."""

    hide: tuple[str, ...] = ()
    panels: tuple[str, ...] = ()
    layout: str = ""
    keep: tuple[str, ...] = ()
    every: int | None = None


@dataclass(frozen=True, slots=True)
class Network:
    """Addresses by which processes listen and connect beyond loopback. The default opens nothing.

    `listen` and `connect` are Zenoh endpoints (`"tcp/192.168.1.2:7447"`); `tls` and `access_control` are handed to
    Zenoh's own configuration (`transport/link/tls`, `access_control`) as they are.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    shared_memory: bool = True
    scouting: bool = False
    tls: Mapping[str, Any] = field(default_factory=dict)
    access_control: Mapping[str, Any] = field(default_factory=dict)

    @property
    def loopback_only(self) -> bool:
        return not (self.listen or self.connect or self.scouting)


def as_values(thing: Any) -> Any:
    """Returns what `dataclasses.asdict` does of dataclasses, mappings, sequences and plain values, several times as
    quickly: plain values are not copied."""
    kind = type(thing)
    if kind in _PLAIN:
        return thing
    if kind is dict:
        return {key: as_values(value) for key, value in thing.items()}
    if kind is tuple or kind is list:
        return kind([as_values(value) for value in thing])
    if (fields := getattr(kind, "__dataclass_fields__", None)) is not None:
        return {name: as_values(getattr(thing, name)) for name in fields}
    return copy.deepcopy(thing)


_PLAIN = frozenset((str, int, float, bool, NoneType))


def record_to_json(record: Record) -> dict[str, Any]:
    """Leaves out what the graph does not say and older recordings did not hold."""
    later = ("flight", "on_failure")
    return {name: value for name, value in as_values(record).items() if name not in later or value is not None}


def record_from_json(data: Mapping[str, Any]) -> Record:
    flight = data.get("flight")
    if flight is not None:
        flight = Flight(**{**flight, "when": tuple(Trigger(**trigger) for trigger in flight["when"])})
    return Record(**{**data, "streams": tuple(data["streams"]), "flight": flight})


def view_to_json(view: View) -> dict[str, Any]:
    """Leaves out `every` where the graph does not say it, so that recorded graphs stay as they were."""
    return {name: value for name, value in as_values(view).items() if name != "every" or value is not None}


def view_from_json(data: Mapping[str, Any]) -> View:
    """Sections that older recordings lack are as they were: every panel, no saved layout, no points that stay."""
    hide, panels, keep = (tuple(data.get(name, ())) for name in ("hide", "panels", "keep"))
    return View(hide, panels, data.get("layout", ""), keep, data.get("every"))
