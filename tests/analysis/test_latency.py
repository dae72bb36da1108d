"""Path latencies are what the wall times of the records say, along the critical path."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from diamond_records import DIAMOND, MS, message, one_round, record
from typer.testing import CliRunner

from dataflow.analysis.latency import batch_latencies, latencies
from dataflow.cli.main import app
from dataflow.graph import load_text
from dataflow.graph.model import Graph
from dataflow.records.firing import WITHHELD, encode_batch
from dataflow.sync import RunRef

TIMER = """
graph: timer
operators:
  camera: {use: latency_operators:Device}
  gather: {use: latency_operators:Gather, inputs: {recent: camera/value}}
"""


@pytest.fixture
def diamond() -> Graph:
    return load_text(DIAMOND)


def test_a_latency_ends_with_the_sink_and_is_shared_along_the_critical_path(diamond: Graph) -> None:
    (path,) = latencies(diamond, one_round(diamond, 0, 100, slow=10))
    assert (path.source, path.sink, path.count) == ("camera", "join", 1)
    assert path.p50 == path.largest == 16 * MS
    assert [(s.operator, s.work / MS, s.wait / MS) for s in path.shares] == [
        ("camera", 0.5, 0),
        ("slow", 10, 0.5),
        ("join", 2, 3),
    ]
    assert path.costliest == "slow"


def test_percentiles_are_over_all_firings(diamond: Graph) -> None:
    rounds = [one_round(diamond, k, 100.0 * k, slow=10 + k) for k in range(101)]
    (path,) = latencies(diamond, {name: [r for each in rounds for r in each[name]] for name in rounds[0]})
    assert (path.count, path.p50, path.p99, path.largest) == (101, 66 * MS, 115 * MS, 116 * MS)


def test_sampled_inputs_are_no_cause_while_there_is_a_trigger(diamond: Graph) -> None:
    given = one_round(diamond, 0, 100, slow=10)
    join = given["join"][0]
    given["lidar"] = [record("lidar", 0, 1, 0.5, stamp=-5)]
    given["join"] = [record("join", 0, 114, 2, {**join.inputs, "hint": message(diamond, "lidar", 0)})]
    assert [path.source for path in latencies(diamond, given)] == ["camera"]


def test_a_message_that_is_given_twice_is_sampled(diamond: Graph) -> None:
    """Even where it once had the stamp of the firing."""
    rounds = [one_round(diamond, k, 100.0 + 50 * k, slow=10) for k in range(2)]
    given = {name: [r for each in rounds for r in each[name]] for name in rounds[0]}
    hint = message(diamond, "lidar", 0)
    given["lidar"] = [record("lidar", 0, 1, 0.5)]
    given["join"] = [replace(r, inputs={**r.inputs, "hint": hint}) for r in given["join"]]
    assert [path.source for path in latencies(diamond, given)] == ["camera"]


def test_partners_within_the_tolerance_trigger(diamond: Graph) -> None:
    join = replace(diamond.nodes["join"], tolerance=5)
    graph = replace(diamond, nodes={**diamond.nodes, "join": join})
    given = one_round(graph, 0, 100, slow=10)
    given["lidar"] = [record("lidar", 0, 120, 0.5, stamp=-5)]
    (fired,) = given["join"]
    given["join"] = [replace(fired, inputs={**fired.inputs, "hint": message(graph, "lidar", 0)})]
    assert [path.source for path in latencies(graph, given)] == ["camera", "lidar"]


def test_no_operator_is_imported(diamond: Graph) -> None:
    elsewhere = Graph.from_json(json.loads(json.dumps(diamond.to_json())))
    nodes = {name: replace(node, use=f"there_is_none:{name}") for name, node in elsewhere.nodes.items()}
    given = one_round(diamond, 0, 100, slow=10)
    assert latencies(replace(elsewhere, nodes=nodes), given) == latencies(diamond, given)


def test_batches_of_a_running_graph_give_the_same_latencies(diamond: Graph) -> None:
    given = one_round(diamond, 0, 100, slow=10)
    batches = [encode_batch(records) for records in given.values()]
    assert batch_latencies(diamond, batches) == latencies(diamond, given)


def test_a_timer_is_caused_by_the_newest_message_of_its_batch() -> None:
    graph = load_text(TIMER)
    stream = next(iter(graph.nodes["camera"].outputs.values()))
    camera = [record("camera", k, 10.0 * k, 0.5) for k in range(5)]
    gather = [record("gather", 0, 50, 1, {"recent": (RunRef(stream, 0, 0, 4),)})]
    (path,) = latencies(graph, {"camera": camera, "gather": gather})
    assert path.p50 == 11 * MS


def test_firings_whose_causes_are_not_recorded_are_left_out(diamond: Graph) -> None:
    given = one_round(diamond, 0, 100, slow=10)
    given["camera"] = []
    assert latencies(diamond, given) == []


def test_a_message_that_was_not_sent_causes_nothing(diamond: Graph) -> None:
    given = one_round(diamond, 0, 100, slow=10)
    camera = message(diamond, "camera", 0)
    given["slow"] = [record("slow", 0, 101, 10, {"x": camera}, seq=WITHHELD)]
    (path,) = latencies(diamond, given)
    assert [s.operator for s in path.shares] == ["camera", "fast", "join"]


@pytest.mark.long
def test_the_command_prints_every_path_of_a_recording(tmp_path: Path, repository: Path) -> None:
    recording = tmp_path / "run.mcap"
    graph = repository / "graphs" / "synthetic_rgbd.yaml"
    runner = CliRunner()
    arguments = ["run", str(graph), "--one-process", "--quiet", "--set", "camera.frames=5", "--record", str(recording)]
    assert runner.invoke(app, arguments).exit_code == 0
    result = runner.invoke(app, ["latency", str(recording), "--json"])
    assert result.exit_code == 0, result.output
    paths = json.loads(result.output)
    assert paths
    for path in paths:
        assert 0 < path["p50_ms"] <= path["p99_ms"] <= path["max_ms"]
        assert path["count"] <= 5
        assert path["shares"][0]["operator"] == path["source"]
        assert path["shares"][-1]["operator"] == path["sink"]
    printed = runner.invoke(app, ["latency", str(recording)])
    assert paths[0]["sink"] in printed.output
