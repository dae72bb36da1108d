"""Sections of a graph file that are about the whole graph: what is recorded, how it is viewed, where it listens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Record:
    """Choice of the streams that a recording holds. `thin`: not all of them; firing records are always written.

    `snapshots`: nanoseconds of event time between two snapshots of an operator's state; None for none.
    """

    streams: tuple[str, ...]
    thin: bool = False
    snapshots: int | None = None


PANELS = ("world", "cameras", "scene", "map", "plots", "status", "log")
"""Parts of the viewer's window that a graph may choose."""


@dataclass(frozen=True, slots=True)
class View:
    """Choices for the viewer: streams left out, panels (none: all), a layout saved from it (empty: derived)."""

    hide: tuple[str, ...] = ()
    panels: tuple[str, ...] = ()
    layout: str = ""


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
