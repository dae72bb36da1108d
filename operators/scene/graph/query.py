"""Questions to a scene graph, and the graph as JSON."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dataflow.messages import Activity, SceneGraph
from dataflow.messages.scene_summary import ROOMS, summarize
from operators.labels import LabelSpace
from operators.scene.map.map_surface import SURFACES
from operators.scene.relations import FLOOR, INVERSES, PREDICATES, ROBOT, ROOM, SYMMETRIC, TABLETOP

_ANY = ("anything", "something", "thing", "*")
_PHRASES = {p.replace("_", " "): p for p in (*PREDICATES, *INVERSES)}
_MEANT = {
    "inside": "in",
    "within": "in",
    "on top of": "on",
    "upon": "on",
    "over": "above",
    "below": "under",
    "beneath": "under",
    "underneath": "under",
    "beside": "near",
    "next to": "near",
    "close to": "near",
    "by": "near",
    "before": "in front of",
    "in back of": "behind",
    "after": "behind",
    "carrying": "holding",
    "seated on": "sitting on",
    "looking at": "facing",
    "going to": "heads for",
}
"""Relations as people call them, with the one that is nearest in meaning: what an error proposes."""
_NO_LABELS = LabelSpace("none")
_LAYERS = {ROOM: "room", FLOOR: "surface", ROBOT: "robot"}


class QueryError(ValueError):
    """Explains what in a question is not understood, and what would be."""


@dataclass(frozen=True)
class Clause:
    """One condition: a relation to some node of a class, or to none (`wanted` is False)."""

    predicate: str
    object: str
    wanted: bool = True


@dataclass(frozen=True)
class Match:
    """A node that fits, by index, with the relations that make it fit and the least of their scores and its own."""

    node: int
    score: float
    because: tuple[tuple[int, str, int], ...]


def parse(text: str, classes: Sequence[str]) -> tuple[str, list[Clause]]:
    """Returns the class that is asked for and the conditions on it, by names of `classes`: `mug on table near person`
    asks for a mug that is on a table and near a person.

    A class may be `anything`, or name a node with its number, as `table 3`; `not on table` asks for none. Relations are
    written with blanks or `_`. Raises QueryError, which proposes the relation nearest in meaning or spelling.
    """
    words = re.findall(r"[\w*-]+", text.lower().replace("_", " "))
    if not words:
        raise QueryError("the question is empty; ask for something like: mug on table near person")
    subject, k = _noun(words, 0, classes)
    clauses = []
    while k < len(words):
        if words[k] in ("and", "that", "is", "a", "an", "the"):
            k += 1
            continue
        wanted = words[k] != "not"
        k += not wanted
        phrase = _relation(words[k:])
        k += len(phrase.split())
        while k < len(words) and words[k] in ("a", "an", "the", "of"):
            k += 1
        object, k = _noun(words, k, classes)
        clauses.append(Clause(_PHRASES[phrase], object, wanted))
    return subject, clauses


def _relation(words: Sequence[str]) -> str:
    """Returns the relation that the words begin with, the longest that does. Raises QueryError."""
    begun = [p for p in (*_PHRASES, *_MEANT) if list(words[: len(p.split())]) == p.split()]
    longest = max(begun, key=len, default="")
    if longest in _PHRASES:
        return longest
    known = f"there are {', '.join(sorted(_PHRASES))}"
    if not words:
        raise QueryError(f"the question ends where a relation should be named; {known}")
    heard = longest or words[0]
    near = difflib.get_close_matches(heard, (*_PHRASES, *_MEANT), 1)
    hint = f"did you mean {_MEANT.get(near[0], near[0])!r}? " if near else ""
    raise QueryError(f"{heard!r} is no relation; {hint}{known}")


def _noun(words: Sequence[str], k: int, classes: Sequence[str]) -> tuple[str, int]:
    if k >= len(words):
        raise QueryError("the question ends where a thing should be named")
    if k + 1 < len(words) and words[k] in ("a", "an", "the"):
        k += 1
    if words[k] in _ANY:
        return "*", k + 1
    known = {c.replace("_", " "): c for c in classes}
    for length in (3, 2, 1):
        name = " ".join(words[k : k + length])
        if name in known:
            k += length
            if k < len(words) and words[k].isdigit():
                return f"{known[name]} {words[k]}", k + 1
            return known[name], k
    near = difflib.get_close_matches(words[k], known, 1)
    hint = f"; did you mean {near[0]!r}?" if near else f"; there are {', '.join(sorted(known))}"
    raise QueryError(f"{words[k]!r} is no class of this graph{hint}")


def ask(graph: SceneGraph, text: str, labels: LabelSpace = _NO_LABELS) -> list[Match]:
    """Returns the nodes that a question asks for, likeliest first. Raises QueryError.

    Classes have their own names and those that the label space gives them. `on` a class whose role is `support`
    includes on a table top, since the thing below it may be unseen.
    """
    subject, clauses = parse(text, list(dict.fromkeys([*graph.class_names, *labels.names(graph.class_names)])))
    asked = _meant(subject, graph, labels)
    conditions = [(clause, _meant(clause.object, graph, labels, on=clause.predicate == "on")) for clause in clauses]
    scores = graph.relation_scores if graph.relation_scores is not None else [1.0] * len(graph.predicates)
    held = [(*triple, float(score)) for triple, score in zip(graph.relations(), scores, strict=True)]
    matches = []
    for node in sorted(asked):
        score = 1.0 if graph.scores is None else float(graph.scores[node])
        because: list[tuple[int, str, int]] = []
        fits = True
        for clause, others in conditions:
            found = [row for row in held if _fits(row, node, clause.predicate, others)]
            fits = fits and bool(found) == clause.wanted
            if found and clause.wanted:
                best = max(found, key=lambda row: row[3])
                score = min(score, best[3])
                because.append(best[:3])
        if fits:
            matches.append(Match(node, score, tuple(because)))
    return sorted(matches, key=lambda m: (-m.score, int(graph.ids[m.node])))


def _fits(row: tuple[int, str, int, float], node: int, predicate: str, others: set[int]) -> bool:
    """Returns whether a relation is one of a node, by a predicate or its inverse, to one of the others."""
    s, p, o, _ = row
    if p != INVERSES.get(predicate, predicate):
        return False
    turned = predicate in INVERSES
    forth, back = s == node and o in others, o == node and s in others
    return (back if turned else forth) or (back and p in SYMMETRIC)


def _meant(name: str, graph: SceneGraph, labels: LabelSpace, *, on: bool = False) -> set[int]:
    """Returns the nodes, by index, of a class or, with a number behind its name, the one; `on`: those to stand on."""
    if name == "*":
        return {k for k, id in enumerate(graph.ids.tolist()) if id not in (ROOM, ROBOT)}
    called, number = labels.called(name, graph.class_names), ""
    if not called:
        name, _, number = name.rpartition(" ")
        called = labels.called(name, graph.class_names)
    elif on and "support" in labels.roles(name):
        called.append(TABLETOP)
    wanted = {f"{each} {number}".rstrip() for each in called}
    named = zip(graph.class_ids.tolist(), graph.ids.tolist(), graph.names(), strict=True)
    classes = graph.class_names
    return {k for k, (c, id, own) in enumerate(named) if wanted & {classes[c], f"{classes[c]} {id}", own}}


def as_json(graph: SceneGraph, activities: Activity | None = None) -> dict[str, Any]:
    """Returns the graph as plain data: nodes by layer with box and score, relations with theirs; metres, ns.

    Nodes that have one of the `activities`, or act in a relation, are agents.
    """
    names, scores, agents = graph.names(), graph.relation_scores, summarize(graph, activities).agents
    nodes = []
    for k in range(graph.count):
        id, label = int(graph.ids[k]), graph.class_names[graph.class_ids[k]] if graph.class_names else ""
        layer = "building" if label == "building" else "room" if id < ROOMS else _LAYERS.get(id)
        layer = layer or ("surface" if label in SURFACES else "agent" if k in agents else "object")
        nodes.append(
            {
                "id": id,
                "name": names[k],
                "class": label,
                "layer": layer,
                "position": graph.positions[k].tolist(),
                "size": graph.sizes[k].tolist(),
                "orientation": None if graph.orientations is None else graph.orientations[k].tolist(),
                "score": None if graph.scores is None else round(float(graph.scores[k]), 4),
                "last_seen": None if graph.last_seen is None else int(graph.last_seen[k]),
                "tracks": list(graph.tracks_of(k)),
            }
            | ({} if graph.areas is None or np.isnan(graph.areas[k]) else {"area": round(float(graph.areas[k]), 2)})
        )
    relations = [
        {
            "subject": int(graph.ids[s]),
            "predicate": p,
            "object": int(graph.ids[o]),
            "score": None if scores is None else round(float(scores[k]), 4),
        }
        for k, (s, p, o) in enumerate(graph.relations())
    ]
    return {"stamp": graph.stamp, "frame": graph.frame, "nodes": nodes, "relations": relations}
