"""A link that delays, stalls and resets loses nothing and restarts nothing; keys decide who may connect."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from joined_agents import HERE, end, join, once_it_runs, taken, wait_until
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
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.plan import Rendezvous
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

    def trouble() -> None:
        assert listening(port) == [f"127.0.0.1:{port}"]
        relay.stalled = True
        time.sleep(seconds)
        relay.stalled = False
        time.sleep(0.5)
        relay.reset()

    report = run(
        load_text(GRAPH),
        machines=Rendezvous(f"tls/127.0.0.1:{port}", keys / "laptop"),
        live=True,
        record=tmp_path / "link.mcap",
        watch=once_it_runs(trouble),
    )

    said = end(robot)
    assert taken(report) == dict.fromkeys(("here", "there"), 400), said
    assert "sensor" not in report.drops
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
        machines=Rendezvous(f"tls/127.0.0.1:{port}", keys / "laptop"),
        live=True,
    )

    said = end(robot)
    dropped = sum(number for _, _, number in report.drops.get("sensor", ()))
    assert taken(report) == dict.fromkeys(("here", "there"), 400 - dropped), said
    assert not report.restarts
    assert not any("no longer waited for" in note for note in report.notes)


@pytest.mark.long
def test_an_agent_that_gave_the_run_up_ends_it(keys: Path, link: tuple[int, Relay], tmp_path: Path) -> None:
    port, relay = link
    at = f"tls/127.0.0.1:{relay.port}"
    robot = join("robot", at, tmp_path / "files", "--keys", str(keys / "robot"), "--timeout", "2")

    def stall() -> None:
        relay.stalled = True
        time.sleep(4.0)  # more than the agent is patient for
        relay.stalled = False

    with pytest.raises(RunFailed, match=r"machine 'robot' has left the run: .*; its operators are gone"):
        run(
            load_text(GRAPH.replace("steps: 400", "steps: 1000000")),
            machines=Rendezvous(f"tls/127.0.0.1:{port}", keys / "laptop"),
            live=True,
            watch=once_it_runs(stall),
        )

    assert "the supervisor was not heard for 2 s" in end(robot)


@pytest.mark.parametrize("who", ["stranger", pytest.param("tools", marks=pytest.mark.long)])
def test_a_certificate_of_another_authority_or_of_a_tool_joins_nothing(keys: Path, tmp_path: Path, who: str) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    if who == "tools":  # as keys of before this was noted
        keys = Path(shutil.copytree(keys, tmp_path / "keys", ignore=shutil.ignore_patterns("machine")))
    stranger = join("robot", endpoint, tmp_path / "files", "--keys", str(keys / who))
    with pytest.raises(RunFailed, match=r"machine 'robot' did not join"):
        run(load_text(GRAPH), machines=Rendezvous(endpoint, keys / "laptop"), start_timeout=4.0)
    end(stranger)


ADDRESSED = r"expected tls/<address>:<port>"


@pytest.mark.parametrize(
    ("held", "endpoint", "reason"),
    [
        (None, "tcp/127.0.0.1:7447", r"'tcp/127\.0\.0\.1:7447' needs keys: make them with `dataflow keys new"),
        ("authority", "tls/127.0.0.1:7447", r"no certificate\.pem, key\.pem"),
        ("laptop", "tcp/0.0.0.0:7447", ADDRESSED),
        *(("tools", at, ADDRESSED) for at in ("tls/10.0.0.2", "tls/:7447", "tls/10.0.0.2:port", "tcp/10.0.0.2:7447")),
    ],
)
def test_endpoint_without_keys_or_port_is_refused(keys: Path, held: str | None, endpoint: str, reason: str) -> None:
    with pytest.raises(NetworkError, match=reason):
        settings(held and keys / held, endpoint)
    assert settings(None, "unixsock-stream//run/meet") == {}


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


ASKED = {
    "echo": ("tools", "echo there/y -n 3 --json"),
    "echo here": ("tools", "echo here/y -n 3 --json"),
    "top": ("tools", "top --json"),
    "hz": ("tools", "hz there/y --seconds 1 --json"),
    "health": ("tools", "health --over 0.3 --json"),
    "reload": ("laptop", "reload there --json"),
    "refused": ("tools", "reload there --timeout 1"),
    "playback": ("tools", "playback pause"),
    "trigger": ("tools", "trigger"),
    "pub": ("tools", """pub given '{"linear": [1, 0, 0], "angular": [0, 0, 0], "frame": "base"}'"""),
    "set": ("tools", "param set there.gain 7"),
    "record": ("tools", "record there/y -o part.mcap --seconds 0.5"),
    "stranger": ("stranger", "echo there/y -n 1"),
}
"""Commands of tools on another machine: whose keys they have, and what is typed."""


@pytest.mark.long
def test_tools_with_keys_follow_a_graph_of_another_machine_and_others_do_not(keys: Path, tmp_path: Path) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    robot = join("robot", endpoint, tmp_path / "files", "--keys", str(keys / "robot"))
    done: dict[str, int] = {}
    out: dict[str, str] = {}
    err: dict[str, str] = {}
    views: list[subprocess.Popen[str]] = []

    def begun(words: str, held: str = "tools") -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "dataflow.cli.main", *shlex.split(words)]
        command += ["--connect", endpoint, "--keys", str(keys / held)]
        env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "PYTHONPATH": str(HERE)}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, text=True, env=env, cwd=tmp_path, **pipes)

    def follow(supervisor: Supervisor) -> None:
        try:
            wait_until(lambda: supervisor.status.phase != "starting")
            views.append(begun("view --to view.rrd"))
            foxglove = begun("foxglove --port 0")
            for name, (held, words) in ASKED.items():
                tool = begun(words, held)
                out[name], err[name] = tool.communicate(timeout=60)
                done[name] = tool.returncode
            out["foxglove"] = foxglove.stderr.readline()
            foxglove.send_signal(signal.SIGINT)
            foxglove.communicate(timeout=60)
            wait_until(lambda: (tmp_path / "view.rrd").exists() and (tmp_path / "view.rrd").stat().st_size > 0)
        finally:
            supervisor.stop()

    @contextlib.contextmanager
    def controls(supervisor: Supervisor) -> Iterator[None]:
        following = threading.Thread(target=follow, args=(supervisor,))
        following.start()
        yield
        following.join()

    graph = GRAPH.replace("steps: 400", "steps: 1000000") + '  given: {use: "dataflow.remote:Twist"}\n'
    run(load_text(graph), machines=Rendezvous(endpoint, keys / "laptop"), live=True, controls=controls)

    end(robot)
    for view in views:
        _, err["view"] = view.communicate(timeout=60)
        done["view"] = view.returncode
    refused = {"refused", "playback", "trigger", "stranger"}
    assert {name for name, code in done.items() if code} == refused, err
    assert "ws://" in out["foxglove"]
    assert len(out["echo"].splitlines()) == len(out["echo here"].splitlines()) == 3
    top = json.loads(out["top"])
    assert {row["operator"]: row["state"] for row in top["operators"]}["there"] == "running"
    assert top["machines"]["robot"]["up"]
    assert abs(top["machines"]["robot"]["offset"]) <= top["machines"]["robot"]["delay"] / 2  # it is this one's clock
    assert json.loads(out["hz"])
    assert json.loads(out["health"])["reasons"] == []
    assert json.loads(out["reload"])["operator"] == "there"
    for name, reason in (("playback", "live"), ("trigger", "flight recorder"), ("refused", "these are keys of tools")):
        assert reason in err[name]
    assert "these keys are not let in" in err["stranger"]
