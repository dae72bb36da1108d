"""Activities of the agents of a scene as an operator."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Activity, Boxes3D, Classification, Odometry, Pose, SceneGraph
from dataflow.operator import Counts, In, Operator, Out, Param, Remembered, Sampled
from operators.labels import LabelSpace, labels_file
from operators.recognition.activity.features import NAMES, AgentWindow, Surroundings
from operators.recognition.activity.samples import STEP
from operators.recognition.activity.scene_agents import mattering, seen_times
from operators.scene.bodies import Body
from operators.scene.graph.agents import UNKNOWN
from operators.weights import NetworkFileError, open_kind, shipped, trained_in_simulation

if TYPE_CHECKING:
    import onnxruntime

F32 = NDArray[np.float32]
KIND = "activity"

_SPAN = 0.5  # seconds
_DOUBT = 0.01  # what a look leaves to an activity at least


@dataclass(frozen=True, eq=False)
class ActivityModel:
    """An opened network. It runs on one CPU thread, so equal inputs give equal outputs."""

    classes: tuple[str, ...]
    layers: int
    width: int
    session: onnxruntime.InferenceSession

    @classmethod
    def open(cls, file: Path) -> ActivityModel:
        """Raises FileNotFoundError, or NetworkFileError where the file is no activity network for our features."""
        session, facts = open_kind(file, KIND, ("classes", "layers", "width"))
        if tuple(facts.get("features", ())) != NAMES:
            raise NetworkFileError(
                f"{file} was trained on other features than these {len(NAMES)}: train one by `dataflow train {KIND}`"
            )
        return cls(tuple(map(str, facts["classes"])), int(facts["layers"]), int(facts["width"]), session)

    def fresh(self) -> F32:
        """Returns the state (2, L, W) of an agent that was never seen: hidden, then cell."""
        return np.zeros((2, self.layers, self.width), np.float32)

    def step(self, features: F32, states: F32) -> tuple[F32, F32]:
        """Returns probabilities (N, C) and next states (N, 2, L, W) for features (N, F) and states (N, 2, L, W)."""
        hidden, cell = (np.ascontiguousarray(states[:, k].transpose(1, 0, 2)) for k in (0, 1))
        found = self.session.run(None, {"features": features, "hidden": hidden, "cell": cell})
        probabilities, hidden, cell = (np.asarray(each, np.float32) for each in found)
        return probabilities, np.stack([hidden.transpose(1, 0, 2), cell.transpose(1, 0, 2)], axis=1)


class PostureWindow(Remembered):
    """Looks at a posture in the last half second; each gives probabilities of activities."""

    _taken: deque[tuple[float, F32]]

    def __init__(self) -> None:
        self._taken = deque()

    def update(self, time: float, probabilities: F32 | None) -> None:
        """Takes the look (C,) of a time, seconds, if there is one, and forgets the old ones."""
        if probabilities is not None:
            self._taken.append((time, np.asarray(probabilities, np.float32)))
        while self._taken and self._taken[0][0] < time - _SPAN:
            self._taken.popleft()

    def evidence(self, weight: float) -> F32 | None:
        """Returns factors (C,) for the probabilities of the activities, 1 for the likeliest; None without a look.

        They are the geometric mean over the looks, which are too alike to count as independent ones, to the power
        `weight`. Method: Hinton, "Training products of experts by minimizing contrastive divergence", 2002.
        """
        if not self._taken:
            return None
        logs = np.log(np.maximum(np.stack([look for _, look in self._taken]), _DOUBT)).mean(axis=0)
        return np.asarray(np.exp(weight * (logs - logs.max())), np.float32)


@dataclass
class _Agent:
    """State of one agent: its recent past, the network's state (2, L, W), what it does, since when (ns), and the last
    looks at its posture.

    `stepped` is the time (ns) of the graph whose step is the last in the state, None where there is none.
    """

    window: AgentWindow
    state: NDArray[np.float32]
    stepped: int | None
    activity: str
    since: int
    looks: PostureWindow


@dataclass
class State(Counts):
    """Holds the agents by their ids, and what is around them."""

    agents: dict[int, _Agent] = field(default_factory=dict)
    around: Surroundings = field(default_factory=Surroundings)


class ActivityRecognizer(Operator):
    """Recognises what each person, robot and ball of a scene does, by a recurrent network over motion and surroundings.

    A vector of an agent's motion in the last 2.5 s, its extent and the seats, tables and drinks around it goes at each
    graph into two LSTM layers. Their state is kept for as long as the agent is in the scene, and goes on by steps of
    0.15 s at least, however often graphs come; the network answers for a quarter of a second ago. `unknown` stands for
    what is too unsure, or too long out of sight.

    If postures of people are given, the probabilities of the posture and of the motion network are multiplied, since
    the two see different evidence.

    Persons stand, walk, sit down, sit, stand up, reach or drink; balls roll or rest; robots drive or rest. Method:
    Hochreiter and Schmidhuber, "Long short-term memory", 1997; trained on simulated people (`dataflow train activity`).
    """

    nodes: In[SceneGraph] = In(doc="objects with agents among them, 2 to 10 times a second; relations are not used")
    robot: Sampled[Pose | Odometry] = Sampled(required=False, doc="the robot, in the frame of the nodes")
    objects: Sampled[Boxes3D] = Sampled(
        required=False,
        doc="the nodes as boxes with velocities: how fast those are that are new; of the nodes' own stamp",
    )
    postures: Sampled[Classification] = Sampled(
        required=False, doc="what the posture of each person looks like, by PostureRecognizer; of the nodes' own stamp"
    )
    activities: Out[Activity] = Out(doc="a row an agent: activity, probabilities, what it is done to, since when")

    weights: str | None = Param(None, doc="network file of `dataflow train activity`; none means the shipped one")
    labels: str = Param("coco", doc="label space: coco, simulator, or a YAML file; gives the roles of classes")
    least: float = Param(0.35, ge=0, lt=1, tunable=True, doc="probability below which an activity is unknown")
    posture: float = Param(1.0, ge=0, tunable=True, doc="how much postures count beside the network; 0 for not at all")
    memory: float = Param(1.5, ge=0, doc="time out of sight after which an activity is unknown", unit="s")
    state: State

    @classmethod
    def trained_in_simulation(cls, params: Mapping[str, Any]) -> bool:
        return trained_in_simulation(params["weights"] or shipped("activity.onnx"))

    def setup(self) -> None:
        """Opens the network. Raises FileNotFoundError or NetworkFileError."""
        file = self.use_file(str(shipped("activity.onnx")) if self.weights is None else self.weights)
        self._model = ActivityModel.open(file)
        self._labels = LabelSpace.read(self.use_file(labels_file(self.labels)))
        self._classes = (*self._model.classes, UNKNOWN)

    def process(
        self,
        nodes: SceneGraph,
        robot: Pose | Odometry | None = None,
        objects: Boxes3D | None = None,
        postures: Classification | None = None,
    ) -> Activity:
        """Raises ValueError where the robot is in another frame than the nodes."""
        if robot is not None and robot.frame != nodes.frame:
            raise ValueError(f"the robot is in {robot.frame!r}, the nodes in {nodes.frame!r}")
        same = objects is not None and (objects.stamp, objects.frame) == (nodes.stamp, nodes.frame)
        bodies, unusable = mattering(nodes, self._labels, objects if same else None)
        seen = seen_times(nodes)
        time = nodes.stamp * 1e-9
        self.state.around.update(time, bodies)
        agents = sorted((b for b in bodies if b.agent), key=lambda b: b.id)
        self.state.agents = {b.id: self.state.agents.get(b.id) or self._fresh(nodes.stamp) for b in agents}
        here = None if robot is None else robot.matrix()[:2, 3]
        looks = self._looks(postures) if postures is not None and postures.stamp == nodes.stamp else {}
        vectors = []
        for body in agents:
            window = self.state.agents[body.id].window
            window.add(time, body)
            self.state.agents[body.id].looks.update(time, looks.get(body.id))
            vectors.append(window.vector(body, (nodes.stamp - seen[body.id]) * 1e-9, self.state.around, here))
        self.state.counts.update({"graphs": 1, "agents": len(agents), "unusable nodes": unusable})
        return self._answer(nodes.stamp, agents, vectors, seen)

    def _fresh(self, stamp: int) -> _Agent:
        return _Agent(AgentWindow(), self._model.fresh(), None, "", stamp, PostureWindow())

    def _looks(self, postures: Classification) -> dict[int, NDArray[np.float32]]:
        """Returns what each posture speaks for, by ids: probabilities (C,) of our activities.

        Nothing speaks against those that the postures do not know.
        """
        if postures.ids is None or postures.probabilities is None:
            return {}
        own = list(self._model.classes)
        columns = [k for k, name in enumerate(postures.class_names) if name in own]
        rows = np.repeat(postures.probabilities.max(axis=1, initial=0.0, keepdims=True), len(own), axis=1)
        rows[:, [own.index(postures.class_names[k]) for k in columns]] = postures.probabilities[:, columns]
        return dict(zip(postures.ids.tolist(), rows, strict=True))

    def _answer(
        self, stamp: int, agents: list[Body], vectors: list[NDArray[np.float32]], seen: Mapping[int, int]
    ) -> Activity:
        probabilities = np.zeros((len(agents), len(self._classes)), np.float32)
        objects = np.full(len(agents), -1, np.int64)
        if agents:
            states = np.stack([self.state.agents[b.id].state for b in agents])
            probabilities[:, :-1], states = self._model.step(np.stack(vectors), states)
            for k, body in enumerate(agents):
                evidence = self.state.agents[body.id].looks.evidence(self.posture)
                if evidence is not None:
                    probabilities[k, :-1] *= evidence
            probabilities /= np.maximum(probabilities.sum(axis=1, keepdims=True), 1e-6)
        chosen = []
        for k, body in enumerate(agents):
            agent = self.state.agents[body.id]
            if agent.stepped is None or stamp - agent.stepped >= STEP * 1e9:
                agent.state, agent.stepped = states[k], stamp
            fresh = stamp - seen[body.id] <= self.memory * 1e9
            activity = self._likeliest(probabilities[k], fresh)
            self.state.counts["unknown"] += activity == UNKNOWN
            if activity != agent.activity:
                agent.activity, agent.since = activity, stamp
            chosen.append(self._classes.index(activity))
            objects[k] = self.state.around.object_of(activity, body)
        rows = np.arange(len(agents))
        probabilities = np.clip(probabilities, 0, 1)
        unsure = 1 - probabilities.max(axis=1, initial=0.0)
        known = np.array(chosen, np.int32) != len(self._classes) - 1
        return Activity(
            stamp=stamp,
            class_names=self._classes,
            subjects=np.array([b.id for b in agents], np.int64),
            class_ids=np.array(chosen, np.int32),
            scores=np.where(known, probabilities[rows, chosen], unsure).astype(np.float32),
            probabilities=probabilities,
            objects=objects,
            since=np.array([self.state.agents[b.id].since for b in agents], np.int64),
        )

    def _likeliest(self, probabilities: NDArray[np.float32], fresh: bool) -> str:
        best = int(probabilities.argmax())
        return self._classes[best] if fresh and probabilities[best] >= self.least else UNKNOWN
