"""Scores a scene graph against the true one: its nodes by overlap in space, its relations by pairs of nodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, SceneGraph
from dataflow.messages.geometry import yaw_of
from operators.labels import LabelSpace
from operators.scene.bodies import upright_iou
from operators.scene.relations import FLOOR

Array = NDArray[np.float64]
Box = tuple[Array, Array, float]
Triple = tuple[int, str, int]

PREDICATES = ("on", "in", "sitting_on", "holding", "near", "left_of", "in_front_of")
"""Relations that are scored: those that the simulator's truth has too."""


class VisibleImages:
    """Counts in how many images each true object was plainly seen: so much of it, with so many pixels."""

    def __init__(self, visible: float = 0.6, pixels: int = 200, images: int = 5) -> None:
        self._visible, self._pixels, self._images = visible, pixels, images
        self._plain: Counter[int] = Counter()
        self.last: dict[int, int] = {}

    def add(self, objects: Detections2D) -> None:
        """Takes the true objects of one image. Raises ValueError where they have no ids, or not how much is visible."""
        if objects.ids is None or objects.visible is None or objects.pixel_counts is None:
            raise ValueError("the true objects need ids, what share of them is visible, and their pixels")
        self.last |= dict.fromkeys(objects.ids.tolist(), objects.stamp)
        plain = (objects.visible >= self._visible) & (objects.pixel_counts >= self._pixels)
        self._plain.update(objects.ids[plain].tolist())

    def countable(self) -> set[int]:
        """Returns the ids of objects that were seen so often by now."""
        return {i for i, n in self._plain.items() if n >= self._images}

    def must(self, truth: SceneGraph, labels: LabelSpace, recent: float = 2.0) -> set[int]:
        """Returns the ids of objects that a map must have at the time of the true graph.

        Those that were seen so often by then; agents only where they were in view in the last `recent` seconds.
        """
        names = dict(zip(truth.ids.tolist(), (truth.class_names[c] for c in truth.class_ids), strict=True))
        since = truth.stamp - round(recent * 1e9)
        known = (i for i in self.countable() if i in names)
        return {i for i in known if "agent" not in labels.roles(names[i]) or self.last[i] >= since}


@dataclass(frozen=True)
class NodeScore:
    """A map's nodes against the truth. Lists name classes and ids; overlaps are IoUs.

    `match` gives the true id of each node that is an object of its class; `doubles` are nodes beside such a one of the
    same thing, `wrong` the other false ones with their greatest overlap and least distance (m), `ignored` the ids of
    those of things that do not count.
    """

    must: int
    found: int
    match: dict[int, int]
    ious: list[float]
    missed: list[tuple[str, int]]
    doubles: list[tuple[str, int]] = field(default_factory=list)
    wrong: list[tuple[str, int, float, float]] = field(default_factory=list)
    ignored: frozenset[int] = frozenset()

    @property
    def recall(self) -> float:
        return self.found / max(self.must, 1)

    @property
    def precision(self) -> float:
        return self.found / max(self.found + len(self.doubles) + len(self.wrong), 1)


def score_nodes(nodes: SceneGraph, truth: SceneGraph, must: Collection[int], iou: float = 0.25) -> NodeScore:
    """Matches nodes with true objects, class by class, best overlap first, and scores them.

    `must` are the ids of the true objects that count. Others are neither a miss nor, where the map has them, false.
    Both graphs are in one frame. Nodes that are not objects (floor, room, robot) are not scored.
    """
    mine, labels = boxes_of(nodes)
    true, names = boxes_of(truth)
    match = match_nodes(nodes, truth, iou)
    taken = set(match.values())
    doubles, wrong, ignored = [], [], set()
    for i, box in mine.items():
        if i in match or i <= FLOOR:
            continue
        same = [t for t in true if names[t] == labels[i] and t > FLOOR]
        best = max((upright_iou(true[t], box) for t in same), default=0.0)
        gap, nearest = min(((float(np.linalg.norm(true[t][0] - box[0])), t) for t in same), default=(9.0, 0))
        if gap < 0.5 * float(box[1].max()) + 0.2 and nearest > FLOOR and nearest not in must and nearest not in taken:
            ignored.add(i)
        elif gap < 0.5 and nearest in taken:
            doubles.append((labels[i], i))
        else:
            wrong.append((labels[i], i, round(best, 2), round(gap, 2)))
    return NodeScore(
        must=len(must),
        found=len(taken & set(must)),
        match=match,
        ious=[upright_iou(true[t], mine[i]) for i, t in match.items()],
        missed=[(names[t], t) for t in sorted(must) if t not in taken],
        doubles=doubles,
        wrong=wrong,
        ignored=frozenset(ignored),
    )


def match_nodes(nodes: SceneGraph, truth: SceneGraph, iou: float = 0.25) -> dict[int, int]:
    """Returns the true id of each node that is an object of its class, best overlap first."""
    mine, labels = boxes_of(nodes)
    true, names = boxes_of(truth)
    rows = sorted(
        (
            (upright_iou(true[t], mine[m]), t, m)
            for t in true
            for m in mine
            if t > FLOOR and m > FLOOR and names[t] == labels[m] and np.abs(true[t][0] - mine[m][0]).max() < 2
        ),
        reverse=True,
    )
    match: dict[int, int] = {}
    used: set[int] = set()
    for value, t, m in rows:
        if value >= iou and t not in used and m not in match:
            match[m] = t
            used.add(t)
    return match


def boxes_of(graph: SceneGraph) -> tuple[dict[int, Box], dict[int, str]]:
    """Returns the box and the class of each node, by id."""
    yaws = np.zeros(graph.count) if graph.orientations is None or not graph.count else yaw_of(graph.orientations)
    ids = graph.ids.tolist()
    boxes = {i: (graph.positions[k], graph.sizes[k], float(yaws[k])) for k, i in enumerate(ids)}
    return boxes, {i: graph.class_names[c] for i, c in zip(ids, graph.class_ids.tolist(), strict=True)}


class RelationScore:
    """Counts relations that are right, false and missed, by predicate, over several times.

    *mapped*: of pairs whose nodes are both matched; *all*: every relation of ours, and every true one between objects
    that must be mapped. Relations with a thing that does not count as a node do not count in *all* either, right or
    wrong: no true relation with it could be missed, so a false one would be held against what cannot be found. The
    floor counts as matched; other surfaces, which the truth does not have, are left out.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    def add(
        self,
        graph: SceneGraph,
        truth: SceneGraph,
        match: dict[int, int],
        must: Iterable[int],
        ignored: Collection[int] = frozenset(),
    ) -> None:
        """Takes the relations of one time; `match` is the true id of our nodes, `ignored` are those of things that do
        not count though no true one matches them.
        """
        of, wanted = match | {FLOOR: FLOOR}, {*must, FLOOR}
        known, ours = set(of.values()), triples(graph)
        true = {ordered(t) for t in triples(truth)}
        mine = {ordered((of[s], p, of[o])) for s, p, o in ours if s in of and o in of}
        for triple in mine | {t for t in true if t[0] in known and t[2] in known}:
            kind = "hit" if triple in mine and triple in true else "false" if triple in mine else "miss"
            self.counts[f"mapped {kind} {triple[1]}"] += 1
        counted = {t for t in mine if {t[0], t[2]} <= wanted}
        strange = [t for t in ours if not (t[0] in of and t[2] in of)]
        beside = {*ignored, *(node for node, thing in of.items() if thing not in wanted)}
        self.counts["all hit"] += len(counted & true)
        self.counts["all false"] += len([t for t in strange if not {t[0], t[2]} & beside]) + len(counted - true)
        self.counts["all miss"] += len([t for t in true - mine if {t[0], t[2]} <= wanted])

    def f1(self, scope: str, predicate: str = "") -> float:
        """Returns the F1 of `mapped` or `all` relations, of one predicate where one is given; NaN without any."""
        hit, false, miss = self._counted(scope, predicate)
        return 2 * hit / (2 * hit + false + miss) if hit + false + miss else float("nan")

    def precision(self, scope: str) -> float:
        """Returns the precision: correct of all predicted relations, NaN if none were predicted."""
        hit, false, _ = self._counted(scope)
        return hit / (hit + false) if hit + false else float("nan")

    def recall(self, scope: str) -> float:
        """Returns the share of the true relations that are said; NaN without any."""
        hit, _, miss = self._counted(scope)
        return hit / (hit + miss) if hit + miss else float("nan")

    def _counted(self, scope: str, predicate: str = "") -> tuple[int, int, int]:
        """Returns how many are right, false and missed."""
        hit, false, miss = (
            sum(n for k, n in self.counts.items() if k.startswith(f"{scope} {kind}") and k.endswith(predicate))
            for kind in ("hit", "false", "miss")
        )
        return hit, false, miss


def triples(graph: SceneGraph) -> set[Triple]:
    """Returns the relations that are scored, by ids of nodes: those between objects, and with the floor."""
    ids = graph.ids.tolist()
    rows = ((ids[s], p, ids[o]) for s, p, o in graph.relations() if p in PREDICATES)
    return {row for row in rows if min(row[0], row[2]) >= FLOOR}


def ordered(triple: Triple) -> Triple:
    """Returns a relation with the lower id first where it holds both ways."""
    s, p, o = triple
    return (min(s, o), p, max(s, o)) if p == "near" else triple
