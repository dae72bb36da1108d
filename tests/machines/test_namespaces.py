"""Two machines as the kernel shows them: network namespaces with a cable between them that is pulled."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from joined_agents import HERE, end, once_it_runs, taken
from needed_programs import need

from dataflow.graph import load_text
from dataflow.machines.keys import issue, new_authority
from dataflow.supervision.plan import Rendezvous
from dataflow.supervision.run import run
from dataflow.verification.verify import verify

pytestmark = pytest.mark.long

SPACE, HERE_SIDE, THERE_SIDE = "dataflow-robot", "dataflow0", "dataflow1"
ADDRESS, PORT = "10.213.77.1", 17447
GRAPH = """\
graph: two
namespace: test
operators:
  sensor: {use: "machine_operators:Sensor", params: {steps: STEPS, period: 0.02}, machine: robot}
  there: {use: "machine_operators:Scale", inputs: {x: sensor/count}, machine: robot, process: own}
  here: {use: "machine_operators:Scale", inputs: {x: sensor/count}, live: {queue: block}}
"""


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True, timeout=20)


@pytest.fixture
def cable() -> Iterator[None]:
    """A namespace with a cable to it; skips, with the reason, where this machine makes none."""
    try:
        ip("netns", "add", SPACE)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"this machine makes no network namespaces: {getattr(error, 'stderr', '') or error}")
    try:
        try:
            ip("link", "add", HERE_SIDE, "type", "veth", "peer", "name", THERE_SIDE, "netns", SPACE)
        except subprocess.CalledProcessError as error:
            pytest.skip(f"this machine makes no veth pairs: {error.stderr}")
        ip("addr", "add", f"{ADDRESS}/24", "dev", HERE_SIDE)
        ip("link", "set", HERE_SIDE, "up")
        ip("-n", SPACE, "addr", "add", "10.213.77.2/24", "dev", THERE_SIDE)
        ip("-n", SPACE, "link", "set", THERE_SIDE, "up")
        ip("-n", SPACE, "link", "set", "lo", "up")
        yield
    finally:
        ip("netns", "del", SPACE)


@pytest.mark.parametrize("seconds", [2.0, 10.0])
def test_a_cable_that_is_pulled_loses_nothing_and_only_the_asked_port_listens(
    cable: None, tmp_path: Path, seconds: float
) -> None:
    """For more than a link may be silent, and for more than Zenoh keeps it (`hub.LEASE`)."""
    need("openssl")
    steps = 200 + round(seconds * 50)
    new_authority(tmp_path / "authority")
    issue(tmp_path / "authority", tmp_path / "laptop", "laptop", serves=[ADDRESS])
    issue(tmp_path / "authority", tmp_path / "robot", "robot")
    endpoint = f"tls/{ADDRESS}:{PORT}"
    command = [sys.executable, "-m", "dataflow.cli.main", "join", "robot", "--connect", endpoint]
    command += ["--keys", str(tmp_path / "robot"), "--folder", str(tmp_path / "files")]
    robot = subprocess.Popen(
        ["ip", "netns", "exec", SPACE, "env", f"PYTHONPATH={HERE}", *command], stdout=subprocess.PIPE, text=True
    )
    listening: dict[str, str] = {}

    def pull() -> None:
        there = ["ip", "netns", "exec", SPACE, "ss", "-Hltn"]
        listening["there"] = subprocess.run(there, capture_output=True, text=True, timeout=20, check=True).stdout
        here = ["ss", "-Hltn", f"src {ADDRESS}/24"]
        listening["here"] = subprocess.run(here, capture_output=True, text=True, timeout=20, check=True).stdout
        ip("link", "set", HERE_SIDE, "down")
        time.sleep(seconds)
        ip("link", "set", HERE_SIDE, "up")

    report = run(
        load_text(GRAPH.replace("STEPS", str(steps))),
        machines=Rendezvous(endpoint, tmp_path / "laptop"),
        live=True,
        record=tmp_path / "cable.mcap",
        watch=once_it_runs(pull),
    )

    said = end(robot)
    assert listening["there"] == ""
    assert [line.split()[3] for line in listening["here"].splitlines()] == [f"{ADDRESS}:{PORT}"]
    assert taken(report) == dict.fromkeys(("here", "there"), steps), said
    assert "sensor" not in report.drops
    assert any("the link to machine 'robot' is back" in note for note in report.notes)
    assert verify(tmp_path / "cable.mcap", jobs=1).identical
