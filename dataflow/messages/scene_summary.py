"""Scene graphs for people: of hundreds of relations the few that matter, as data and in words.

The kind of a node follows from ids, relations and activities, not from names of classes: ids up to 0 are places (room,
floor, walls, table tops) and the robot itself, as SceneGraphBuilder numbers them; agents are the nodes that act.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from dataflow.messages.detection import labels_of
from dataflow.messages.scene import Activity, SceneGraph

ACTING = frozenset(("sitting_on", "holding", "facing", "approaching", "reaching_for", "heads_for"))
"""Predicates whose subject acts."""

CARRYING = ("part_of", "sitting_on", "in", "on", "held_by")
"""Predicates that say what carries a node; of equal scores, the first counts."""

HEADS_FOR = "heads_for"
"""The predicate of an intention: its score is the probability of the goal."""

MOVED = frozenset(("rolling", "driving", "resting"))
"""Activities of what is no living being: a ball, a vehicle, a robot."""

SURROUNDINGS = frozenset(("near", "left_of", "right_of", "in_front_of", "behind"))
"""Predicates that hold between so many nodes that they say little."""

FLOOR = 0
"""The id of the floor; places and the robot itself have lower ones."""

ROOMS = -1_000_000
"""Ids below this are rooms."""

LEAST = 0.5
"""Score from which a relation is shown; of an intention any."""


@dataclass(frozen=True, slots=True)
class SummaryRelation:
    """A relation between two nodes, by index. `score` is 1 where the graph has none."""

    subject: int
    predicate: str
    object: int
    score: float


@dataclass(frozen=True, slots=True)
class SceneSummary:
    """The relations of a graph that are worth showing.

    - `carriers`: by node, what it stands on, lies in or sits on: one relation at most, without loops.
    - `children`: by node, the nodes that it carries.
    - `telling`: the others, those of agents first, then by score.
    - `intentions`: where agents may be going, likeliest first.
    - `agents`: the nodes that have an activity or are the subject of an `ACTING` predicate.
    - `places`: the nodes that others are in, or that only part them: room, floor, walls; not a top that carries things.
    - `tops`: surfaces that are part of a thing, which is shown in their place.
    - `rooms`: by node of a room where there are several, the nodes that are in it.
    """

    carriers: Mapping[int, SummaryRelation]
    children: Mapping[int, Sequence[int]]
    telling: tuple[SummaryRelation, ...]
    intentions: tuple[SummaryRelation, ...]
    agents: frozenset[int] = frozenset()
    places: frozenset[int] = frozenset()
    tops: frozenset[int] = frozenset()
    rooms: Mapping[int, Sequence[int]] = field(default_factory=dict)

    def carried(self, node: int) -> tuple[int, ...]:
        """The nodes that `node` carries, by index."""
        return tuple(self.children.get(node, ()))


def class_names(graph: SceneGraph) -> tuple[str, ...]:
    """The class name of each node; its number where classes have no names."""
    return labels_of(graph.class_ids, graph.class_names)


def summarize(graph: SceneGraph, activities: Activity | None = None, most: int = 24) -> SceneSummary:
    """Chooses what to show of a graph: what carries what, intentions, and at most `most` other relations.

    `SURROUNDINGS` are left out, then the commonest predicates until few enough are left; an agent has its strongest
    relation of each kind (it faces one thing, not five).
    """
    ids, doers = graph.ids.tolist(), doing(activities)
    agents = frozenset(k for k, i in enumerate(ids) if i in doers) | {
        s for s, p, _ in graph.relations() if p in ACTING and ids[s] > 0
    }
    tops = frozenset(s for s, p, o in graph.relations() if p == "part_of" and ids[s] <= 0 < ids[o])
    scores = [1.0] * len(graph.subjects) if graph.relation_scores is None else graph.relation_scores.tolist()
    every = [
        SummaryRelation(s, p, o, score)
        for (s, p, o), score in zip(graph.relations(), scores, strict=True)
        if s != o and p not in SURROUNDINGS and ids[o] >= ROOMS
    ]
    rooms: dict[int, list[int]] = {k: [] for k, i in enumerate(ids) if i < ROOMS}
    for s, p, o in graph.relations():
        if p == "in" and o in rooms:
            rooms[o].append(s)
    carrying = [r for r in every if r.predicate in CARRYING and r.score >= LEAST]
    carriers = _carriers(carrying, tops)
    intentions = sorted((r for r in every if r.predicate == HEADS_FOR), key=lambda r: (r.subject, -r.score))
    rest = [r for r in every if r.predicate not in CARRYING and r.predicate != HEADS_FOR and r.score >= LEAST]
    counts = Counter(r.predicate for r in rest)
    while len(rest) > most and len(counts) > 1:
        commonest = counts.most_common(1)[0][0]
        del counts[commonest]
        rest = [r for r in rest if r.predicate != commonest]
    rest.sort(key=lambda r: (r.subject not in agents, -r.score, r.subject, r.object))
    told: list[SummaryRelation] = []
    for r in rest:
        before = any((r.subject, r.predicate) == (other.subject, other.predicate) for other in told)
        if not (before and r.subject in agents):
            told.append(r)
    children: dict[int, list[int]] = {}
    for child, relation in carriers.items():
        children.setdefault(relation.object, []).append(child)
    bearing = {o for o, carried in children.items() if ids[o] < FLOOR and any(ids[c] > 0 for c in carried)}
    places = frozenset(k for k, i in enumerate(ids) if i <= FLOOR) - tops - bearing
    return SceneSummary(carriers, children, tuple(told[:most]), tuple(intentions), agents, places, tops, rooms)


def _carriers(relations: Sequence[SummaryRelation], tops: Collection[int]) -> dict[int, SummaryRelation]:
    """The strongest carrier of each node, a thing before its top; a relation that would close a loop is left out."""
    carriers: dict[int, SummaryRelation] = {}
    for relation in sorted(
        relations, key=lambda r: (r.object in tops, -r.score, CARRYING.index(r.predicate), r.subject, r.object)
    ):
        if relation.subject in carriers:
            continue
        node: int | None = relation.object
        while node is not None and node != relation.subject:
            node = carriers[node].object if node in carriers else None
        if node is None:
            carriers[relation.subject] = relation
    return dict(sorted(carriers.items()))


def doing(activities: Activity | None) -> dict[int, tuple[str, float]]:
    """The activity and its score by the id of who does it."""
    if activities is None:
        return {}
    names = activities.class_names
    rows = zip(activities.subjects.tolist(), activities.class_ids.tolist(), activities.scores.tolist(), strict=True)
    return {subject: (names[c] if names else str(c), score) for subject, c, score in rows}


@dataclass(frozen=True, slots=True)
class Row:
    """A line about a node: its name, and what there is to say of it."""

    name: str
    text: str


def agents_in_words(graph: SceneGraph, summary: SceneSummary, activities: Activity | None = None) -> list[Row]:
    """A row for each person or animal that acts: its activity, what it is on, holds or heads for."""
    acts = doing(activities)
    return _agents(graph, summary, acts, summary.agents - _moved(graph, summary, acts))


def movers_in_words(graph: SceneGraph, summary: SceneSummary, activities: Activity | None = None) -> list[Row]:
    """The same for each thing that moves, by itself or by others, as its activity shows: one of `MOVED`."""
    acts = doing(activities)
    return _agents(graph, summary, acts, _moved(graph, summary, acts))


def _moved(graph: SceneGraph, summary: SceneSummary, acts: Mapping[int, tuple[str, float]]) -> frozenset[int]:
    return frozenset(n for n in summary.agents if acts.get(int(graph.ids[n]), ("", 0.0))[0] in MOVED)


def _agents(
    graph: SceneGraph, summary: SceneSummary, acts: Mapping[int, tuple[str, float]], nodes: Collection[int]
) -> list[Row]:
    names, rows = graph.names(), []
    going = {r.subject for r in summary.intentions}
    for node in sorted(nodes, key=lambda n: (n not in going, n)):
        identity, words = int(graph.ids[node]), []
        if identity in acts:
            words.append(f"{spaced(acts[identity][0])} {percent(acts[identity][1])}")
        related = [r for r in summary.telling if r.subject == node]
        if node in summary.carriers and summary.carriers[node].object not in summary.places:
            related.insert(0, summary.carriers[node])
        words += [f"{spaced(r.predicate)} {names[r.object]}" for r in related]
        goals = [f"{names[r.object]} ({percent(r.score)})" for r in summary.intentions if r.subject == node]
        words += ["heads for " + " or ".join(goals)] if goals else []
        rows.append(Row(names[node], ", ".join(words)))
    return sorted(rows, key=lambda row: not row.text)


def carriers_in_words(graph: SceneGraph, summary: SceneSummary) -> list[Row]:
    """A row for each thing that others are in or on: "12 books, mug 3"; places last, with what stands there alone."""
    names, classes = graph.names(), class_names(graph)
    rows, bare = [], []
    for node in range(graph.count):
        children = [c for c in summary.carried(node) if c not in summary.agents | summary.places | summary.tops]
        if node in summary.places:
            alone = [c for c in children if not summary.carried(c)]
            bare += [Row(names[node], grouped([names[c] for c in alone], [classes[c] for c in alone]))] if alone else []
            continue
        if children:
            ways = dict.fromkeys(summary.carriers[child].predicate for child in children)
            words = []
            for way in ways:
                part = [c for c in children if summary.carriers[c].predicate == way]
                words.append(f"{spaced(way)} it {grouped([names[c] for c in part], [classes[c] for c in part])}")
            rows.append(Row(names[node], "; ".join(words)))
    return rows + bare


def rooms_in_words(graph: SceneGraph, summary: SceneSummary) -> list[Row]:
    """A row for each room where there are several: its area, the rooms behind its doors, and what is in it."""
    names, classes, ids = graph.names(), class_names(graph), graph.ids.tolist()
    doors = [(s, o) for s, p, o in graph.relations() if p == "connected_to"]
    rows = []
    for room in sorted(summary.rooms, key=lambda k: -ids[k]):
        words = [] if graph.areas is None else [f"{graph.areas[room]:.1f} m²"]
        beyond = sorted({o if s == room else s for s, o in doors if room in (s, o)}, key=lambda k: -ids[k])
        words += [f"connected to {', '.join(names[k] for k in beyond)}"] if beyond else []
        inside = summary.rooms[room]
        words += [f"in it {grouped([names[k] for k in inside], [classes[k] for k in inside])}"] if inside else []
        rows.append(Row(names[room], "; ".join(words)))
    return rows


def grouped(names: Sequence[str], classes: Sequence[str]) -> str:
    """Names of things, several of a class by their number: "12 books, mug 3"."""
    kinds: dict[str, list[str]] = {}
    for name, kind in zip(names, classes, strict=True):
        kinds.setdefault(kind, []).append(name)
    parts = [(len(several), several[0] if len(several) == 1 else f"{len(several)} {plural(kind)}")
             for kind, several in kinds.items()]  # fmt: skip
    return ", ".join(text for _, text in sorted(parts, key=lambda part: -part[0]))


def plural(word: str) -> str:
    """The plural of the name of a class, as English forms it most often."""
    if word.endswith("lf"):
        return word[:-1] + "ves"
    return word + ("es" if word.endswith(("s", "x", "ch", "sh")) else "s")


def spaced(word: str) -> str:
    """A predicate or an activity as words: "heads_for" is "heads for"."""
    return word.replace("_", " ")


def percent(score: float) -> str:
    return f"{round(100 * score)} %"
