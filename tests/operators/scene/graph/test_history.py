"""What happened to a node of a scene graph, from graphs made here."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from made_graphs import scene_graph
from typer.testing import CliRunner

from dataflow.messages import Activity, SceneGraph
from dataflow.recording import RecordingWriter
from operators.scene.commands import scene
from operators.scene.graph.history import history
from operators.scene.graph.query import QueryError

IDS = {"mug 2": 2, "table 1": 1, "person 4": 4, "floor": 0}
SECOND = 1_000_000_000


def graph(second: int, mug: Sequence[float] | None, *relations: tuple[str, str, str, float]) -> SceneGraph:
    """A table and a person, a mug where there is one, and relations between them by name."""
    here = [name for name in IDS if name != "mug 2" or mug is not None]
    things = [(IDS[n], n.split()[0], mug if n == "mug 2" and mug else (0.0, 0.0, 0.0), (1, 1, 1)) for n in here]
    rows = [(IDS[s], p, IDS[o], score) for s, p, o, score in relations]
    return scene_graph(things, rows, stamp=second * SECOND, labels=tuple(here))


def act(second: int, activity: str) -> Activity:
    return Activity(
        stamp=second * SECOND, class_names=("walking", "drinking"), subjects=np.array([4], np.int64),
        class_ids=np.array([("walking", "drinking").index(activity)], np.int32), scores=np.array([0.9], np.float32),
    )  # fmt: skip


GRAPHS = [
    graph(1, None, ("person 4", "heads_for", "table 1", 0.6)),
    graph(2, (0, 0, 0.8), ("mug 2", "on", "table 1", 0.9), ("mug 2", "near", "person 4", 0.9)),
    graph(3, (0.2, 0, 0.8), ("mug 2", "on", "table 1", 0.9), ("person 4", "heads_for", "mug 2", 0.7)),
    graph(4, (0.2, 0, 1.3), ("person 4", "holding", "mug 2", 0.8), ("person 4", "heads_for", "mug 2", 0.9)),
    graph(5, None),
]
ACTS = [act(1, "walking"), act(2, "walking"), act(4, "drinking")]


def told(node: str) -> list[tuple[int, str]]:
    return [(e.stamp // SECOND, e.text) for e in history(iter(GRAPHS), {a.stamp: a for a in ACTS}, node)]


def test_a_thing_comes_lies_is_taken_up_and_goes() -> None:
    assert told("mug 2") == [
        (2, "appears at (0.00, 0.00, 0.80) m"),
        (2, "on table 1 begins"),
        (4, "is at (0.20, 0.00, 1.30) m"),
        (4, "on table 1 ends"),
        (4, "person 4 holding it begins"),
        (5, "vanishes"),
    ]


def test_an_agent_has_acts_and_goals() -> None:
    assert told("person 4") == [
        (1, "appears at (0.00, 0.00, 0.00) m"),
        (1, "is walking"),
        (1, "heads for table 1"),
        (3, "heads for mug 2"),
        (4, "is drinking"),
        (4, "holding mug 2 begins"),
        (5, "holding mug 2 ends"),
    ]


def test_a_node_that_is_nowhere_is_named_with_the_nearest() -> None:
    with pytest.raises(QueryError, match="no node is called 'mug 3'; did you mean 'mug 2'"):
        told("mug 3")


def test_command_shows_history_up_to_a_time(tmp_path: Path) -> None:
    file = tmp_path / "room.mcap"
    with RecordingWriter(file, metadata={}) as writer:
        writer.add_stream("robot1/scene/graph", SceneGraph)
        writer.add_stream("robot1/scene/activities", Activity)
        for k, each in enumerate(GRAPHS):
            writer.write("robot1/scene/graph", each, seq=k)
        for k, acted in enumerate(ACTS):
            writer.write("robot1/scene/activities", acted, seq=k)
    done = CliRunner().invoke(scene, [str(file), "--history", "person 4", "--at", "2.5"])
    assert done.exit_code == 0
    assert [line.split("s  ")[1] for line in done.output.splitlines()[-2:]] == ["heads for table 1", "heads for mug 2"]
    done = CliRunner().invoke(scene, [str(file), "--history", "mug 2", "--json"])
    assert json.loads(done.output)[-1] == {"seconds": 4.0, "stamp": 5 * SECOND, "event": "vanishes"}
    done = CliRunner().invoke(scene, [str(file), "--history", "mugg"])
    assert (done.exit_code, "no node is called 'mugg'" in done.output) == (2, True)
