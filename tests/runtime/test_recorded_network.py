"""Somebody's recording opens no port and calls nobody, unless its user asks for that."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import typer.testing

from dataflow.cli.main import app
from dataflow.graph import load_text
from dataflow.recording import Recording
from dataflow.reexecution.recorded_run import graph_as_recorded, recorded_graph
from dataflow.supervision import supervisor
from dataflow.supervision.run import replay, run
from dataflow.transport.registry import Reservation

GRAPH = """
graph: chain
namespace: test
network: {{listen: ["{listen}"], connect: ["{connect}"], scouting: true}}
operators:
  left: {{use: runtime_operators:Counter, params: {{count: 20, ratio: 5}}}}
  sum: {{use: runtime_operators:Sum, inputs: {{x: left/fast}}}}
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A recording whose graph listens and connects where nothing harmful is: on sockets of this test."""
    path = tmp_path_factory.mktemp("network") / "run.mcap"
    with Reservation(2) as reserved:
        listen, connect = reserved.endpoints
        run(load_text(GRAPH.format(listen=listen, connect=connect)), record=path, placement="one_process")
        yield path, listen, connect


@pytest.fixture
def spawned(monkeypatch: pytest.MonkeyPatch) -> list[Mapping[str, Any]]:
    """What every process of the runs of a test was told."""
    told: list[Mapping[str, Any]] = []
    make = supervisor.configurations

    def noted(*arguments: Any) -> Mapping[str, tuple[str, dict[str, Any]]]:
        made = make(*arguments)
        told.extend(config for _, config in made.values())
        return made

    monkeypatch.setattr(supervisor, "configurations", noted)
    return told


def obeyed(configs: list[Mapping[str, Any]], *endpoints: str) -> set[str]:
    """Those of `endpoints`, and scouting, that any of these processes was told to use."""
    used: set[str] = set()
    for config in configs:
        network = config["graph"]["network"]
        used |= {*config.get("listen", ()), *network["listen"], *network["connect"]}
        used |= {"scouting"} if network["scouting"] else set()
    return used & {*endpoints, "scouting"}


@pytest.mark.long
def test_a_replay_leaves_the_recorded_network_alone(
    recorded: tuple[Path, str, str], spawned: list[Mapping[str, Any]]
) -> None:
    path, listen, connect = recorded
    replay(path, placement="one_process")
    assert spawned
    assert obeyed(spawned, listen, connect) == set()
    with Recording(path) as recording:
        assert recorded_graph(recording).network.loopback_only
        assert not graph_as_recorded(recording).network.loopback_only


@pytest.mark.long
def test_it_is_obeyed_when_asked_for_and_else_reported(
    recorded: tuple[Path, str, str], spawned: list[Mapping[str, Any]]
) -> None:
    path, listen, connect = recorded
    told = typer.testing.CliRunner().invoke(app, ["replay", str(path), "--one-process", "--quiet"])
    assert told.exit_code == 0, told.output
    assert "not obeyed" in told.output
    assert obeyed(spawned, listen, connect) == set()
    told = typer.testing.CliRunner().invoke(app, ["replay", str(path), "--one-process", "--quiet", "--network"])
    assert told.exit_code == 0, told.output
    assert "not obeyed" not in told.output
    assert obeyed(spawned, listen, connect) == {listen, connect, "scouting"}
