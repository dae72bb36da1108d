"""A link that delays, stalls and resets loses nothing and restarts nothing; keys decide who may connect."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from joined_agents import HERE, end, join
from link_relay import Relay
from needed_programs import need

from dataflow.graph import load_text
from dataflow.machines.keys import (
    TOOLS,
    KeysError,
    issue,
    new_authority,
    require_address,
    require_machine,
    require_serving,
    settings,
)
from dataflow.supervision.core.report import RunFailed, Status
from dataflow.supervision.plan import Meeting
from dataflow.supervision.run import run
from dataflow.supervision.supervisor import Supervisor
from dataflow.transport import NetworkError
from dataflow.verification.verify import verify

GRAPH = """\
graph: two
namespace: test
operators:
  sensor: {use: "machine_operators:Sensor", params: {steps: 400, size: 2000}, machine: robot}
  here: {use: "machine_operators:Scale", inputs: {x: sensor/count},
    live: {queue: block, restart: {max: 1, backoff: 10ms}}}
  there: {use: "machine_operators:Scale", inputs: {x: sensor/count}, machine: robot, process: own,
    live: {restart: {max: 1, backoff: 10ms}}}
"""


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys of two machines and of another authority's robot."""
    need("openssl")
    folder = tmp_path_factory.mktemp("keys")
    for authority in ("authority", "other"):
        new_authority(folder / authority)
    issue(folder / "authority", folder / "laptop", "laptop", serves=["127.0.0.1", "localhost"])
    issue(folder / "authority", folder / "robot", "robot")
    issue(folder / "authority", folder / "tools", TOOLS)
    issue(folder / "other", folder / "stranger", "robot")
    return folder


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def listening(port: int) -> list[str]:
    """Returns the addresses at which anything listens on a port, by `ss`."""
    shown = subprocess.run(["ss", "-Hltn", f"sport = :{port}"], capture_output=True, text=True, check=True, timeout=20)
    return [line.split()[3] for line in shown.stdout.splitlines()]


@pytest.fixture
def link() -> Iterator[tuple[int, Relay]]:
    """The port at which runs listen, and a relay to it with a delay of 20 ms."""
    port = free_port()
    relay = Relay(("127.0.0.1", port))
    relay.delay = 0.02
    yield port, relay
    relay.close()


@pytest.mark.parametrize("seconds", [2.0, pytest.param(8.0, marks=pytest.mark.long)])
def test_a_link_that_stalls_and_resets_loses_nothing_and_nothing_is_started_again(
    keys: Path, link: tuple[int, Relay], tmp_path: Path, seconds: float
) -> None:
    """For more than a link may be silent, and for more than Zenoh keeps it (`hub.LEASE`)."""
    port, relay = link
    robot = join("robot", f"tls/127.0.0.1:{relay.port}", tmp_path / "files", "--keys", str(keys / "robot"))
    stalled = threading.Event()

    def spoil(status: Status) -> None:
        counts = status.operators["sensor"]
        if status.phase == "running" and counts.firings > 50 and not stalled.is_set():
            stalled.set()
            threading.Thread(target=trouble, daemon=True).start()

    def trouble() -> None:
        assert listening(port) == [f"127.0.0.1:{port}"]
        relay.stalled = True
        time.sleep(seconds)
        relay.stalled = False
        time.sleep(0.5)
        relay.reset()

    report = run(
        load_text(GRAPH),
        machines=Meeting(f"tls/127.0.0.1:{port}", keys / "laptop"),
        live=True,
        record=tmp_path / "link.mcap",
        watch=spoil,
    )

    said = end(robot)
    assert stalled.is_set()
    took = {name: summary["taken"] for name, summary in report.summaries.items()}
    dropped = sum(number for _, _, number in report.drops.get("sensor", ()))
    assert took == dict.fromkeys(("here", "there"), 400 - dropped), said
    assert not dropped
    assert not report.restarts
    assert any("the link to machine 'robot' is down" in note for note in report.notes)
    assert any("the link to machine 'robot' is back" in note for note in report.notes)
    assert verify(tmp_path / "link.mcap", jobs=1).identical


@pytest.mark.long
def test_a_slow_link_delays_messages_and_gets_no_process_killed(
    keys: Path, link: tuple[int, Relay], tmp_path: Path
) -> None:
    port, relay = link
    relay.rate = 4e6  # less than half of what the sensor makes: seconds of it wait
    robot = join("robot", f"tls/127.0.0.1:{relay.port}", tmp_path / "files", "--keys", str(keys / "robot"))

    report = run(
        load_text(GRAPH.replace("size: 2000}", "size: 25000}, live: {restart: {max: 1, backoff: 10ms}}")),
        machines=Meeting(f"tls/127.0.0.1:{port}", keys / "laptop"),
        live=True,
    )

    said = end(robot)
    took = {name: summary["taken"] for name, summary in report.summaries.items()}
    dropped = sum(number for _, _, number in report.drops.get("sensor", ()))
    assert took == dict.fromkeys(("here", "there"), 400 - dropped), said
    assert not report.restarts
    assert not any("no longer waited for" in note for note in report.notes)


@pytest.mark.long
def test_an_agent_that_gave_the_run_up_ends_it(keys: Path, link: tuple[int, Relay], tmp_path: Path) -> None:
    port, relay = link
    at = f"tls/127.0.0.1:{relay.port}"
    robot = join("robot", at, tmp_path / "files", "--keys", str(keys / "robot"), "--timeout", "2")
    stalled = threading.Event()

    def stall() -> None:
        relay.stalled = True
        time.sleep(4.0)  # more than the agent is patient for
        relay.stalled = False

    def spoil(status: Status) -> None:
        if status.phase == "running" and status.operators["sensor"].firings > 50 and not stalled.is_set():
            stalled.set()
            threading.Thread(target=stall, daemon=True).start()

    with pytest.raises(RunFailed, match=r"machine 'robot' has left the run: .*; its operators are gone"):
        run(
            load_text(GRAPH.replace("steps: 400", "steps: 1000000")),
            machines=Meeting(f"tls/127.0.0.1:{port}", keys / "laptop"),
            live=True,
            watch=spoil,
        )

    assert "the supervisor was not heard for 2 s" in end(robot)


@pytest.mark.parametrize("who", ["stranger", pytest.param("tools", marks=pytest.mark.long)])
def test_a_certificate_of_another_authority_or_of_a_tool_joins_nothing(keys: Path, tmp_path: Path, who: str) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    if who == "tools":  # as keys of before this was noted
        keys = Path(shutil.copytree(keys, tmp_path / "keys", ignore=shutil.ignore_patterns("machine")))
    stranger = join("robot", endpoint, tmp_path / "files", "--keys", str(keys / who))
    with pytest.raises(RunFailed, match=r"machine 'robot' did not join"):
        run(load_text(GRAPH), machines=Meeting(endpoint, keys / "laptop"), start_timeout=4.0)
    end(stranger)


def test_an_endpoint_without_keys_is_refused_beyond_a_socket_of_this_user(keys: Path) -> None:
    with pytest.raises(NetworkError, match=r"'tcp/127\.0\.0\.1:7447' needs keys: make them with `dataflow keys new"):
        settings(None, "tcp/127.0.0.1:7447")
    with pytest.raises(NetworkError, match=r"expected tls/<address>:<port>"):
        settings(keys / "laptop", "tcp/0.0.0.0:7447")
    with pytest.raises(NetworkError, match=r"no certificate\.pem, key\.pem"):
        settings(keys / "authority", "tls/127.0.0.1:7447")
    assert settings(None, "unixsock-stream//run/meet") == {}


@pytest.mark.parametrize("endpoint", ["tls/10.0.0.2", "tls/:7447", "tls/10.0.0.2:port", "tcp/10.0.0.2:7447"])
def test_an_endpoint_without_a_port_is_refused_where_it_is_connected_to(keys: Path, endpoint: str) -> None:
    with pytest.raises(NetworkError, match=r"expected tls/<address>:<port>"):
        settings(keys / "tools", endpoint)


def test_keys_are_their_owners_alone_and_are_never_replaced(keys: Path) -> None:
    assert {path.stat().st_mode & 0o077 for path in keys.rglob("*key*") if path.is_file()} == {0}
    with pytest.raises(KeysError, match="has keys already"):
        issue(keys / "authority", keys / "robot", "robot")
    with pytest.raises(KeysError, match="has an authority already"):
        new_authority(keys / "authority")


def test_keys_are_taken_by_whom_they_were_made_for_alone(keys: Path, tmp_path: Path) -> None:
    require_machine(keys / "robot", "robot")
    require_serving(keys / "laptop")
    with pytest.raises(KeysError, match=r"holds the keys of machine 'robot', not those of 'arm'"):
        require_machine(keys / "robot", "arm")
    with pytest.raises(KeysError, match=r"holds the keys of tools, which join no run"):
        require_machine(keys / "tools", "robot")
    with pytest.raises(KeysError, match=r"cannot serve: .* --serves ADDRESS"):
        require_serving(keys / "robot")


@pytest.mark.parametrize("address", ["10.88.0.2:7447", "not,a:host", "", "-x"])
def test_an_address_with_a_port_is_refused(keys: Path, tmp_path: Path, address: str) -> None:
    with pytest.raises(KeysError, match=r"expected an address or host name, without a port"):
        issue(keys / "authority", tmp_path / "arm", "arm", serves=["192.168.1.3", address])


def test_an_endpoint_at_which_this_machine_cannot_listen_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = f"tls/127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(KeysError, match=r"port \d+ is taken: does another run listen there\?"):
            require_address(taken)
    require_address(taken)
    with pytest.raises(KeysError, match=r"192\.0\.2\.7 is no address of this machine"):
        require_address("tls/192.0.2.7:7447")
    for wrong in ("tls/127.0.0.1", "tls/:7447", "tls/127.0.0.1:port", "tls/127.0.0.1:70000"):
        with pytest.raises(KeysError, match=f"{wrong}: expected tls/<address>:<port>"):
            require_address(wrong)


def test_keys_that_could_not_be_made_leave_nothing_in_the_way(keys: Path, tmp_path: Path) -> None:
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "authority.key").write_text("no key")
    with pytest.raises(KeysError, match="openssl x509"):
        issue(tmp_path / "broken", tmp_path / "arm", "arm", serves=["192.168.1.3"])
    assert [path.name for path in tmp_path.iterdir()] == ["broken"]

    issue(keys / "authority", tmp_path / "arm", "arm", serves=["192.168.1.3"])

    assert {path.name for path in (tmp_path / "arm").iterdir()} == {
        "authority.pem",
        "certificate.pem",
        "key.pem",
        "machine",
        "name",
    }


@pytest.mark.long
def test_tools_with_keys_follow_a_graph_of_another_machine_and_others_do_not(keys: Path, tmp_path: Path) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    robot = join("robot", endpoint, tmp_path / "files", "--keys", str(keys / "robot"))
    found: dict[str, Any] = {}

    def tool(*words: str, held: str = "tools") -> subprocess.CompletedProcess[str]:
        started = started_tool(*words, held=held)
        said, complaint = started.communicate(timeout=60)
        return subprocess.CompletedProcess(words, started.returncode, said, complaint)

    def started_tool(*words: str, held: str = "tools") -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "dataflow.cli.main", *words, "--connect", endpoint, "--keys", str(keys / held)]
        env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "PYTHONPATH": str(HERE)}
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)

    def follow(supervisor: Supervisor) -> None:
        try:
            while supervisor.status.phase == "starting":
                time.sleep(0.05)
            viewer = tmp_path / "view.rrd"
            found["view"] = started_tool("view", "--to", str(viewer))
            foxglove = started_tool("foxglove", "--port", "0")
            found["echo"] = tool("echo", "there/y", "-n", "3", "--json")
            found["echo here"] = tool("echo", "here/y", "-n", "3", "--json")
            found["top"] = tool("top", "--json")
            found["hz"] = tool("hz", "there/y", "--seconds", "1", "--json")
            found["health"] = tool("health", "--over", "0.3", "--json")
            found["reload"] = tool("reload", "there", "--json", held="laptop")
            found["refused"] = tool("reload", "there", "--timeout", "1")
            for word in ("playback", "trigger"):
                found[word] = tool(*((word, "pause") if word == "playback" else (word,)))
            found["pub"] = tool("pub", "given", '{"linear": [1, 0, 0], "angular": [0, 0, 0], "frame": "base"}')
            assert foxglove.stderr is not None
            found["foxglove"] = foxglove.stderr.readline()
            foxglove.send_signal(signal.SIGINT)
            foxglove.communicate(timeout=60)
            found["set"] = tool("param", "set", "there.gain", "7")
            found["record"] = tool("record", "there/y", "-o", str(tmp_path / "part.mcap"), "--seconds", "0.5")
            found["stranger"] = tool("echo", "there/y", "-n", "1", held="stranger")
            while not viewer.exists() or not viewer.stat().st_size:
                time.sleep(0.05)
        finally:
            supervisor.stop()

    @contextlib.contextmanager
    def controls(supervisor: Supervisor) -> Iterator[None]:
        following = threading.Thread(target=follow, args=(supervisor,))
        following.start()
        yield
        following.join()

    meeting = Meeting(endpoint, keys / "laptop")
    graph = GRAPH.replace("steps: 400", "steps: 1000000") + '  given: {use: "dataflow.remote:Twist"}\n'
    run(load_text(graph), machines=meeting, live=True, controls=controls)

    end(robot)
    assert found["view"].communicate(timeout=60) is not None
    assert found["view"].returncode == 0
    assert "ws://" in found["foxglove"]
    assert len(found["echo"].stdout.splitlines()) == 3, found["echo"]
    assert len(found["echo here"].stdout.splitlines()) == 3, found["echo here"]
    top = json.loads(found["top"].stdout)
    assert {row["operator"]: row["state"] for row in top["operators"]}["there"] == "running"
    robot_state = top["machines"]["robot"]
    assert robot_state["up"]
    assert abs(robot_state["offset"]) <= robot_state["delay"] / 2  # it is this machine's clock
    assert json.loads(found["hz"].stdout), found["hz"]
    assert "live" in found["playback"].stderr
    assert "flight recorder" in found["trigger"].stderr
    assert found["pub"].returncode == 0, found["pub"]
    assert json.loads(found["health"].stdout)["reasons"] == [], found["health"]
    assert json.loads(found["reload"].stdout)["operator"] == "there", found["reload"]
    assert "there is not reloaded: these are keys of tools" in found["refused"].stderr
    assert found["set"].returncode == 0, found["set"]
    assert found["record"].returncode == 0, found["record"]
    assert found["stranger"].returncode != 0
    assert "these keys are not let in" in found["stranger"].stderr
