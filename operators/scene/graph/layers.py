"""The scene graph over time: layers, relations with hysteresis, activities, goals, and what changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.scene.bodies import Body, BoxPairs
from operators.scene.graph.agents import GoalInference, Motion, activity_of
from operators.scene.graph.rooms import RoomPlan
from operators.scene.relations import FLOOR, ROBOT, ROOM, Hysteresis, Relation, RelationRules, relations_of

Array = NDArray[np.float64]
_LEAST_GOAL = 0.1  # probability of a goal that is named
BUILDING = "building"
"""Class of the node around everything where there are several rooms."""


@dataclass(frozen=True)
class GraphSettings:
    """Scores in [0, 1]; times in seconds. `begin` and `end` are the hysteresis of relations."""

    begin: float = 0.5
    end: float = 0.25
    smoothing: float = 0.4
    rules: RelationRules = field(default_factory=RelationRules)


@dataclass(frozen=True)
class Act:
    """The activity of an agent: its score, its object (-1 for none), since when (ns), and the goals it may have."""

    agent: int
    activity: str
    score: float
    object: int
    since: int
    goals: Mapping[int, float]

    @property
    def goal(self) -> int:
        """The likeliest goal, -1 for none."""
        return max(self.goals, key=lambda i: (self.goals[i], i), default=-1)


@dataclass(frozen=True)
class Snapshot:
    """The graph at one time, with the relations and the nodes that have just changed."""

    bodies: tuple[Body, ...]
    relations: Mapping[Relation, float]
    acts: tuple[Act, ...]
    began: tuple[Relation, ...]
    ended: tuple[Relation, ...]
    appeared: tuple[int, ...]
    vanished: tuple[int, ...]


class LayeredGraph(Remembered):
    """Builds the graph of a room: room, surfaces, objects, agents, the robot.

    Relations follow from the boxes of the moment and begin and end with hysteresis. Agents have motions, from which
    activities and goals are inferred; `heads_for` is a relation of an agent to each likely goal, with its probability.
    """

    _hysteresis: Hysteresis
    _motions: dict[int, Motion]
    _goals: dict[int, GoalInference]
    _acts: dict[int, tuple[str, int]]
    _known: set[int]

    def __init__(self, settings: GraphSettings) -> None:
        self._settings, self._pairs = settings, BoxPairs()
        self._hysteresis = Hysteresis(settings.begin, settings.end, settings.smoothing)
        self._motions, self._goals, self._acts, self._known = {}, {}, {}, set()

    def update(
        self,
        stamp: int,
        things: Sequence[Body],
        T_world_robot: Array | None,
        postures: Mapping[int, tuple[str, float]] | None = None,
        rooms: RoomPlan | None = None,
    ) -> Snapshot:
        """Takes the objects of one time, which may have surfaces among them, and the robot's pose.

        `postures` has, by id, what the joints of people show, with its probability. With `rooms` the room around
        everything is the building.
        """
        s, time = self._settings, stamp * 1e-9
        bodies = list(things)
        for k, body in enumerate(bodies):
            if body.agent:
                motion = self._motions.setdefault(body.id, Motion())
                motion.add(time, body)
                bodies[k] = replace(body, velocity=np.zeros(3) if body.moving < 0.5 else motion.velocity())
        bodies = _with_room(bodies, T_world_robot, rooms)
        ids = {b.id for b in bodies}
        vanished = self._known - ids
        self._forget(vanished)
        now = relations_of(bodies, T_world_robot, s.rules, self._pairs)
        now |= {} if rooms is None else rooms.relations(bodies)
        people = [b for b in bodies if b.person]
        wanted = [b for b in bodies if "goal" in b.roles]
        goals = {b.id: self._goals_of(time, b, wanted, now) for b in people}
        held, began, ended = self._hysteresis.update(stamp, now)
        for agent, likely in goals.items():
            sure = {i: p for i, p in likely.items() if i >= 0 and p >= _LEAST_GOAL}
            held |= {(agent, "heads_for", i): p for i, p in sure.items()}
        shown = postures or {}
        acts = tuple(self._act(stamp, b, held, goals.get(b.id, {}), shown.get(b.id)) for b in bodies if b.agent)
        appeared = tuple(sorted(ids - self._known))
        self._known = ids
        return Snapshot(tuple(bodies), held, acts, tuple(began), tuple(ended), appeared, tuple(sorted(vanished)))

    def _goals_of(
        self, time: float, agent: Body, wanted: Sequence[Body], now: Mapping[Relation, float]
    ) -> dict[int, float]:
        free = [b for b in wanted if (agent.id, "sitting_on", b.id) not in now]
        return self._goals.setdefault(agent.id, GoalInference()).update(time, agent, free)

    def _act(
        self,
        stamp: int,
        agent: Body,
        held: Mapping[Relation, float],
        goals: Mapping[int, float],
        posture: tuple[str, float] | None,
    ) -> Act:
        activity, score, object = activity_of(agent, self._motions[agent.id], held, posture)
        before, since = self._acts.get(agent.id, ("", stamp))
        if before != activity:
            since = stamp
        self._acts[agent.id] = (activity, since)
        return Act(agent.id, activity, score, object, since, goals)

    def _forget(self, ids: set[int]) -> None:
        if ids:
            self._hysteresis.forget(ids)
        for i in ids:
            for table in (self._motions, self._goals, self._acts):
                table.pop(i, None)


def _ground(bodies: Sequence[Body]) -> float:
    """The height of the floor, which is 0 unless a quarter of the bodies reach below: one box that is too large does
    not lower it, or nothing else would stand on it."""
    return min(0.0, float(np.quantile([b.bottom for b in bodies], 0.25)))


def _with_room(bodies: Sequence[Body], T_world_robot: Array | None, rooms: RoomPlan | None) -> list[Body]:
    """Adds the floor where there is none, the room around everything, those in it, and the robot; by rising id."""
    made = list(bodies)
    still = np.zeros(3)
    if made:
        floors = [b for b in made if b.id == FLOOR]
        corners = np.concatenate([b.corners() for b in made])
        low, high = corners.min(axis=0), corners.max(axis=0)
        height = max(b.top for b in made)
        ground = floors[0].top if floors else _ground(made)
        middle = (low + high) / 2
        if not floors:
            made.append(Body(FLOOR, "floor", np.array([*middle, ground]), np.array([*(high - low), 0.0]), 0.0, still))
        center = np.array([*middle, (ground + height) / 2])
        made += [] if rooms is None else rooms.bodies(ground, height)
        label = "room" if rooms is None else BUILDING
        made.append(Body(ROOM, label, center, np.array([*(high - low), height - ground]), 0.0, still))
    if T_world_robot is not None:
        yaw = float(np.arctan2(T_world_robot[1, 0], T_world_robot[0, 0]))
        made.append(Body(ROBOT, "self", T_world_robot[:3, 3].copy(), np.zeros(3), yaw, still))
    return sorted(made, key=lambda b: b.id)
