"""The history of one node of a scene graph: when it came, where it went, what it did, what it related to."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Activity, SceneGraph
from dataflow.messages.scene_summary import HEADS_FOR, SURROUNDINGS
from operators.scene.graph.query import QueryError

Array = NDArray[np.float64]

_MOVED = 0.3  # metres from where it was last told to be, from which on a node has moved
_FLEETING = SURROUNDINGS | {"facing", "approaching"}


@dataclass(frozen=True, slots=True)
class Event:
    """An occurrence in the life of a node, and when it was (ns)."""

    stamp: int
    text: str


def history(graphs: Iterable[SceneGraph], activities: Mapping[int, Activity], node: str) -> list[Event]:
    """Returns what happened to a node, named as in the graph (`mug 12`), over graphs of rising stamps.

    That is: it appears, is elsewhere by more than 0.3 m, does something else, heads for something else, begins
    and ends relations (but those that say only what is around it), vanishes. `activities` are by stamp. Raises
    QueryError for a node that no graph has.
    """
    events: list[Event] = []
    known: set[str] = set()
    place: Array | None = None
    held: dict[str, None] = {}
    act = goal = ""
    for graph in graphs:
        names = graph.names()
        known.update(names)
        if node not in names:
            if place is not None:
                events.append(Event(graph.stamp, "vanishes"))
            place, held, act, goal = None, {}, "", ""
            continue
        k = names.index(node)
        here = graph.positions[k]
        if place is None:
            events.append(Event(graph.stamp, f"appears at {_place(here)}"))
            place = here
        elif float(np.linalg.norm(here - place)) > _MOVED:
            events.append(Event(graph.stamp, f"is at {_place(here)}"))
            place = here
        doing = _activity(activities.get(graph.stamp), int(graph.ids[k]))
        if doing and doing != act:
            events.append(Event(graph.stamp, f"is {doing.replace('_', ' ')}"))
            act = doing
        aim = _goal(graph, k, names)
        if aim and aim != goal:
            events.append(Event(graph.stamp, f"heads for {aim}"))
        goal = aim or goal
        now = _relations(graph, k, names)
        events += [Event(graph.stamp, f"{text} ends") for text in held if text not in now]
        events += [Event(graph.stamp, f"{text} begins") for text in now if text not in held]
        held = now
    if node not in known:
        near = difflib.get_close_matches(node, known, 1)
        hint = f"did you mean {near[0]!r}?" if near else "--nodes lists those at a time"
        raise QueryError(f"no node is called {node!r}; {hint}")
    return events


def _place(position: Array) -> str:
    return f"({', '.join(f'{v:.2f}' for v in position)}) m"


def _activity(message: Activity | None, id: int) -> str:
    if message is None or id not in message.subjects.tolist():
        return ""
    return str(message.class_names[message.class_ids[message.subjects.tolist().index(id)]])


def _goal(graph: SceneGraph, node: int, names: tuple[str, ...]) -> str:
    """The likeliest goal of a node, by name; empty for none."""
    scores = [1.0] * len(graph.subjects) if graph.relation_scores is None else graph.relation_scores.tolist()
    rows = [(scores[r], names[o]) for r, (s, p, o) in enumerate(graph.relations()) if s == node and p == HEADS_FOR]
    return str(max(rows)[1]) if rows else ""


def _relations(graph: SceneGraph, node: int, names: tuple[str, ...]) -> dict[str, None]:
    """The relations of a node that last, in words, in the order of the graph."""
    return {
        f"{p.replace('_', ' ')} {names[o]}" if s == node else f"{names[s]} {p.replace('_', ' ')} it": None
        for s, p, o in graph.relations()
        if node in (s, o) and p not in _FLEETING and p != HEADS_FOR
    }
