"""Configuration of an operator process, as plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class ResumeState:
    """Holds where an operator had got to when its process died: the next incarnation (0: none had died), the last stamp
    of each port, the parameters that were changed, the place (incarnation, number) of the message that each port would
    have made next, and how often it has been restarted."""

    incarnation: int = 0
    last: Mapping[str, int] = field(default_factory=dict)
    changed: Mapping[str, Any] = field(default_factory=dict)
    places: Mapping[str, Sequence[int]] = field(default_factory=dict)
    restarts: int = 0


@dataclass(frozen=True, slots=True)
class ProcessConfig:
    """Configuration of an operator process, from its supervisor. Travels as plain values.

    `publish` maps the local streams that other processes take (firing records included) to how many take them;
    `subscribe` are the remote ones taken here. `listen` are the endpoints at which programs from outside reach it.
    `replay` names a recording and the streams that stand in for sources. `window` is (messages, bytes); so is `ahead`,
    by which its sources may be ahead of the graph; None: a window. `paused`: they wait until they are let go on.
    `firings`: whether a recorder takes the firing records. `live`: sources do
    not wait for the graph, and operators not for their inputs. `resume` is given to a process that takes the place of
    one that died: for each operator, where it had got to (`ResumeState`, as plain values). `warm`: the recording and
    stamp from which on it is replayed, with the operators' states of that moment. `links_out` and `links_in`: for each
    link to and from another process the keys of its channels, after whether messages may be dropped for a consumer that
    takes nothing; their descriptors were handed down in this order. `life`: how many processes have had its place, with
    this one.
    """

    label: str
    graph: dict[str, Any]
    nodes: list[str]
    publish: dict[str, int]
    subscribe: list[str]
    listen: list[str]
    replay: dict[str, Any] | None = None
    window: tuple[int, int] = (256, 64 << 20)
    ahead: tuple[int, int] | None = None
    rate: float | None = None
    paused: bool = False
    paranoid: bool = False
    firings: bool = False
    live: bool = False
    resume: dict[str, Any] | None = None
    warm: dict[str, Any] | None = None
    links_out: Sequence[tuple[bool, Sequence[str]]] = ()
    links_in: Sequence[Sequence[str]] = ()
    life: int = 1

    def resumed(self, operator: str) -> ResumeState:
        """Returns where an operator had got to in the process before this one."""
        return ResumeState(**(self.resume or {}).get(operator, {}))
