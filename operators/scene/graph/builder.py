"""The scene graph as an operator."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Activity, Classification, Diagnostics, Odometry, Pose, Rooms, SceneGraph, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import quaternion_from_yaw, yaw_of
from dataflow.messages.scene_summary import ROOMS
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry.extrinsics import transform_between
from operators.labels import LabelSpace, labels_file
from operators.labels.label_space import warn_of_unknown
from operators.scene.bodies import Body, BodyMemory
from operators.scene.graph.agents import ACTIVITIES, UNKNOWN
from operators.scene.graph.layers import BUILDING, Act, GraphSettings, LayeredGraph, Snapshot
from operators.scene.graph.rooms import RoomPlan
from operators.scene.map.map_surface import SURFACES
from operators.scene.relations import FLOOR, ROBOT, ROOM, SURFACE, RelationRules
from operators.status import Row, status_of_rows

EXTRA = {FLOOR: "floor", ROBOT: "self", ROOM: "room"}
"""Classes of the nodes that are not objects, by id."""

_IN_SIGHT = 1_500_000_000  # nanoseconds since an agent was seen, up to which no answer is an answer


@dataclass(kw_only=True)
class State(Counts):
    """Holds the graph and the names of its nodes, by id."""

    graph: LayeredGraph
    names: dict[int, str] = field(default_factory=dict)


class SceneGraphBuilder(Operator):
    """Relates the objects of a map: what is on, in, under, near, left of what, who does what, and where they are going.

    Nodes are the room (id -2), the robot (-1), surfaces (the floor is 0, walls and table tops count from -11 down),
    objects and agents. Heights are over the map's floor; without one it is estimated from the objects. Relations are
    worked out from upright boxes, scored, and begin and end with hysteresis: on, in, under, above, near, left_of and
    in_front_of (of things near each other, as the robot sees them at that moment), part_of, sitting_on, holding,
    facing, approaching, and heads_for, whose score is the probability that the agent is going there. supports, right_of
    and behind are inverses and asked for as such. Activities come from a recogniser or, if it is absent or gives no
    answer, from motion and contact. With `rooms` each room is a node (ids below -1,000,000, named from `room 1` on)
    with the area of its floor; things, agents and the robot are in the room they stand in, rooms with a door between
    them are connected_to each other, and the room of id -2 is the building.

    Method: layers after Armeni et al., "3D scene graph", 2019, and Hughes et al., "Hydra", 2022; goals after Ramirez
    and Geffner, "Probabilistic plan recognition using off-the-shelf classical planners", 2010.
    """

    nodes: In[SceneGraph] = In(doc="the objects of a map, as SemanticMap gives them; relations in it are not used")
    robot: Sampled[Pose | Odometry] = Sampled(required=False, doc="the robot in the frame of the map")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between `robot_frame` and the frame that `robot` poses"
    )
    recognized: Sampled[Activity] = Sampled(
        required=False,
        doc="activities of agents by ActivityRecognizer; fresh ones replace our own, `unknown` of those in sight, too",
    )
    postures: Sampled[Classification] = Sampled(
        required=False,
        doc="whether people stand or sit, by SkeletonPosture, by ids of nodes; with it, what one in sight does who "
        "does neither by it, nor anything else, is unknown; without ids they are of none",
    )
    rooms: Sampled[Rooms] = Sampled(
        required=False, doc="rooms of the floor and the doors between them, by RoomSegmenter, in the map's frame"
    )
    graph: Out[SceneGraph] = Out(doc="all nodes and the relations that hold, with their scores")
    activities: Out[Activity] = Out(doc="what agents do, to what, since when, and their likeliest goal")
    changes: Out[Diagnostics] = Out(
        doc="nodes and relations that appeared (ok) or vanished (warn); where there are any"
    )

    robot_frame: str | None = Param(None, doc="frame of the robot, x ahead; none means the one that `robot` poses")
    begin: float = Param(0.5, gt=0, lt=1, doc="mean score at which a relation begins")
    end: float = Param(0.25, gt=0, lt=1, doc="and at which it ends")
    smoothing: float = Param(
        0.4, gt=0, doc="time constant of that mean; left_of and in_front_of go by the score of the moment", unit="s"
    )
    near: float = Param(0.5, gt=0, doc="gap up to which things are near each other", unit="m")
    side: float = Param(0.15, gt=0, doc="least difference for left_of and in_front_of", unit="m")
    labels: str = Param("coco", doc="label space: coco, simulator, or a YAML file; gives the roles of classes")
    fresh: float = Param(0.5, ge=0, doc="age up to which a recognised activity counts", unit="s")

    state: State
    _plan: RoomPlan | None = None

    def setup(self) -> None:
        """Raises ValueError for an end that is not below the beginning, or a bad label space; FileNotFoundError."""
        if self.end >= self.begin:
            raise ValueError(f"end {self.end} must be below begin {self.begin}")
        self._labels = LabelSpace.read(self.use_file(labels_file(self.labels)))
        self._bodies = BodyMemory(self._labels)

    def initial_state(self) -> State:
        rules = RelationRules(near=self.near, side=self.side)
        settings = GraphSettings(begin=self.begin, end=self.end, smoothing=self.smoothing, rules=rules)
        return State(graph=LayeredGraph(settings))

    def on_reset(self, input: str) -> None:
        """Starts the graph again: the clock of an input was reset."""
        super().on_reset(input)
        self._bodies, self._plan = BodyMemory(self._labels), None

    def process(
        self,
        nodes: SceneGraph,
        robot: Pose | Odometry | None = None,
        extrinsics: Transforms | None = None,
        recognized: Activity | None = None,
        postures: Classification | None = None,
        rooms: Rooms | None = None,
    ) -> dict[str, Any]:
        """Raises ValueError where robot or rooms are in another frame than the map, or no transform relates frames."""
        T = None
        if robot is not None:
            if robot.frame != nodes.frame:
                raise ValueError(f"the robot is in {robot.frame!r}, the map in {nodes.frame!r}")
            T = robot.matrix()
            if self.robot_frame is not None:
                T = T @ transform_between(extrinsics, self.robot_frame, robot.child_frame)
        if "unknown classes" not in self.state.counts:
            things = [name for name in nodes.class_names if name not in SURFACES]
            self.state.counts["unknown classes"] = warn_of_unknown(self, self._labels, things)
        if nodes.moving is not None:  # who drove may have stopped since; who stood still stands, as far as is known
            moving = np.where(_in_sight(nodes), nodes.moving, np.minimum(nodes.moving, np.float32(0.5)))
            nodes = nodes.replace(moving=moving)
        usable = _usable(nodes)
        bodies, unusable = self._bodies_of(nodes, usable), nodes.count - len(usable)
        fresh = postures is not None and nodes.stamp - postures.stamp <= self.fresh * 1e9
        shown = _postures_of(nodes, postures) if postures is not None and fresh else {}
        now = self.state.graph.update(nodes.stamp, bodies, T, shown, self._plan_of(rooms, nodes.frame))
        self.state.names |= {b.id: _name(b) for b in now.bodies}
        self.state.counts.update({"graphs": 1, "unusable nodes": unusable, "relations begun": len(now.began)})
        self.state.counts["nodes"], self.state.counts["relations"] = len(now.bodies), len(now.relations)
        out: dict[str, Any] = {
            "graph": self._message(nodes, now),
            "activities": self._activities(nodes, now, recognized),
        }
        if now.began or now.ended or now.appeared or now.vanished:
            out["changes"] = self._changes(nodes.stamp, now)
        return out

    def _plan_of(self, rooms: Rooms | None, frame: str) -> RoomPlan | None:
        if rooms is None:
            return None
        if rooms.frame != frame:
            raise ValueError(f"the rooms are in {rooms.frame!r}, the map in {frame!r}")
        if self._plan is None or self._plan.stamp != rooms.stamp:
            self._plan = RoomPlan(rooms)
        return self._plan

    def _bodies_of(self, nodes: SceneGraph, rows: NDArray[np.intp]) -> list[Body]:
        """Returns the nodes in some rows as upright bodies."""
        names, class_ids = nodes.class_names, nodes.class_ids[rows].tolist()
        labels = [names[c] if names else str(c) for c in class_ids]
        yaws = np.zeros(nodes.count) if nodes.orientations is None else yaw_of(nodes.orientations)
        bodies = self._bodies.update(
            nodes.ids[rows].tolist(), labels, nodes.positions[rows], nodes.sizes[rows], yaws[rows]
        )
        if nodes.moving is None:
            return bodies
        moving = nodes.moving[rows].tolist()
        return [replace(b, moving=p) if p == p else b for b, p in zip(bodies, moving, strict=True)]

    def _message(self, nodes: SceneGraph, now: Snapshot) -> SceneGraph:
        areas = {} if self._plan is None else self._plan.areas
        more = (*EXTRA.values(), *([BUILDING] if self._plan is not None else []))
        classes = (*nodes.class_names, *(n for n in more if n not in nodes.class_names))
        row = {i: k for k, i in enumerate(nodes.ids.tolist())}
        at = {b.id: k for k, b in enumerate(now.bodies)}
        place = {name: k for k, name in reversed([*enumerate(classes)])}

        def given(values: NDArray[Any] | None, otherwise: float) -> list[Any]:
            known = () if values is None else values.tolist()
            return [otherwise if values is None or b.id not in row else known[row[b.id]] for b in now.bodies]

        held = list(now.relations.items())
        tracks = [(t, k) for k, b in enumerate(now.bodies) if b.id in row for t in nodes.tracks_of(row[b.id])]
        return SceneGraph(
            stamp=nodes.stamp,
            frame=nodes.frame,
            class_names=classes,
            labels=tuple(self.state.names[b.id] for b in now.bodies),
            predicates=tuple(p for (_, p, _), _ in held),
            ids=np.array([b.id for b in now.bodies], np.int64),
            class_ids=np.array([place[b.label] for b in now.bodies], np.int32),
            positions=np.array([b.center for b in now.bodies]).reshape(-1, 3),
            sizes=np.array([b.size for b in now.bodies]).reshape(-1, 3),
            orientations=quaternion_from_yaw(np.array([b.yaw for b in now.bodies])).reshape(-1, 4),
            scores=np.array(given(nodes.scores, 1.0), np.float32),
            last_seen=np.array(given(nodes.last_seen, nodes.stamp), np.int64),
            subjects=np.array([at[s] for (s, _, _), _ in held], np.int32),
            objects=np.array([at[o] for (_, _, o), _ in held], np.int32),
            relation_scores=np.array([min(score, 1.0) for _, score in held], np.float32),
            moving=None if nodes.moving is None else np.array(given(nodes.moving, np.nan), np.float32),
            areas=np.array([areas.get(b.id, np.nan) for b in now.bodies], np.float32) if areas else None,
            tracks=None if nodes.tracks is None else np.array([track for track, _ in tracks], np.int64),
            track_nodes=None if nodes.tracks is None else np.array([node for _, node in tracks], np.int32),
        )

    def _activities(self, nodes: SceneGraph, now: Snapshot, recognized: Activity | None) -> Activity:
        acts = list(now.acts)
        if recognized is not None and nodes.stamp - recognized.stamp <= self.fresh * 1e9:
            shown = set(nodes.ids[_in_sight(nodes)].tolist())
            acts = [_recognized(act, recognized, in_sight=act.agent in shown) for act in acts]
        names = tuple(dict.fromkeys([*ACTIVITIES, *(a.activity for a in acts)]))
        return Activity(
            stamp=nodes.stamp,
            class_names=names,
            goals=tuple(self._goal(a) for a in acts),
            subjects=np.array([a.agent for a in acts], np.int64),
            class_ids=np.array([names.index(a.activity) for a in acts], np.int32),
            scores=np.array([min(max(a.score, 0.0), 1.0) for a in acts], np.float32),
            objects=np.array([a.object for a in acts], np.int64),
            since=np.array([a.since for a in acts], np.int64),
        )

    def _goal(self, act: Act) -> str:
        return "" if act.goal < 0 else f"{self.state.names[act.goal]} ({act.goals[act.goal]:.2f})"

    def _changes(self, stamp: int, now: Snapshot) -> Diagnostics:
        names = self.state.names
        rows: list[Row] = [(names[i], "appeared", Level.OK, {}) for i in now.appeared]
        rows += [(names[i], "vanished", Level.WARN, {}) for i in now.vanished]
        for relations, level, word in ((now.began, Level.OK, "begins"), (now.ended, Level.WARN, "ends")):
            rows += [(names[s], f"{p} {names[o]} {word}", level, {}) for s, p, o in relations]
        return status_of_rows(stamp, rows)


def _in_sight(nodes: SceneGraph) -> NDArray[np.bool_]:
    """Returns which nodes (N,) were seen just now."""
    seen = np.full(nodes.count, nodes.stamp) if nodes.last_seen is None else nodes.last_seen
    return np.asarray(nodes.stamp - seen <= _IN_SIGHT)


def _postures_of(nodes: SceneGraph, postures: Classification) -> dict[int, tuple[str, float]]:
    """Returns what the joints of people show, and `unknown` for the nodes in sight of which none do."""
    shown = dict.fromkeys(nodes.ids[_in_sight(nodes)].tolist(), (UNKNOWN, 0.3))
    if postures.ids is None:
        return shown
    told = zip(postures.labels(), postures.scores.tolist(), strict=True)
    return shown | dict(zip(postures.ids.tolist(), told, strict=True))


def _recognized(act: Act, recognized: Activity, *, in_sight: bool) -> Act:
    """Returns an act with the recogniser's activity of its agent in place of the rule-based one.

    `unknown` is kept, too, while the agent is in sight: the rules would more often be wrong than right. Out of sight
    there is no evidence, and the rule-based activity is the agent's last one.
    """
    rows = np.flatnonzero(recognized.subjects == act.agent)
    if not len(rows):
        return act
    k = int(rows[0])
    name = recognized.class_names[recognized.class_ids[k]] if recognized.class_names else str(recognized.class_ids[k])
    if name == UNKNOWN and not in_sight:
        return act
    object = act.object if recognized.objects is None else int(recognized.objects[k])
    since = act.since if recognized.since is None else int(recognized.since[k])
    return Act(act.agent, name, float(recognized.scores[k]), object, since, act.goals)


def _name(body: Body) -> str:
    if body.id == ROOM:
        return body.label
    first = ROOMS if body.id < ROOMS else SURFACE
    return EXTRA.get(body.id, f"{body.label} {first - body.id if body.id < first else body.id}")


def _usable(nodes: SceneGraph) -> NDArray[np.intp]:
    """Returns the rows of the nodes that are finite and of a kind that the graph supports."""
    usable = np.isfinite(nodes.positions).all(axis=1) & np.isfinite(nodes.sizes).all(axis=1)
    usable &= (nodes.sizes >= 0).all(axis=1) & ((nodes.ids >= FLOOR) | (nodes.ids < SURFACE))
    return np.flatnonzero(usable)
