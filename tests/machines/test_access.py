"""What certificates let their holders do at the supervisor's machine: each flow of each kind is tried."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest
import zenoh
from needed_programs import need

from dataflow.machines.hub import machine_key, router
from dataflow.machines.keys import GRAPH_KEY, TOOLS, access, issue, new_authority, own_name, settings, tool_settings
from dataflow.transport import Bus, NetworkConfig
from dataflow.transport.keys import local_key, runtime_key
from dataflow.transport.publisher import undeclare

SPACE = "test"
WITHIN = 5.0
HOLDERS = ("tools", "robot", "elsewhere", "laptop")


@pytest.fixture(scope="module")
def buses(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Bus]]:
    """By who holds it, a connection to one supervisor's machine; "here" is one of its own processes."""
    need("openssl")
    folder = tmp_path_factory.mktemp("access")
    new_authority(folder / "authority")
    issue(folder / "authority", folder / "laptop", "laptop", serves=["127.0.0.1"])
    for name in HOLDERS[:-1]:
        issue(folder / "authority", folder / name, TOOLS if name == "tools" else name)
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tls/127.0.0.1:{server.getsockname()[1]}"
    inside = f"unixsock-stream/{folder / 'inside'}"
    with ExitStack() as stack:
        more = settings(folder / "laptop", endpoint) | access(["robot"], SPACE, own_name(folder / "laptop"))
        found = {"here": stack.enter_context(Bus(NetworkConfig(listen=(inside,))))}
        stack.enter_context(closing(router((endpoint,), (inside,), more)))
        for name in HOLDERS:
            if name in ("tools", "laptop"):
                held = Bus(NetworkConfig(connect=(endpoint,), zenoh=tool_settings(folder / name, endpoint)))
            else:
                own = f"unixsock-stream/{folder / name}.sock"
                held = router((own,), (endpoint,), settings(folder / name, endpoint))
            found[name] = stack.enter_context(held)
        for bus in found.values():
            until(bus.peers)
        yield found


def until(condition: Any) -> bool:
    """Returns whether a condition holds within a while."""
    deadline = time.monotonic() + WITHIN
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


def puts_reach(sender: Bus, taker: Bus, key: str, *, closed: str = "") -> bool:
    """Returns whether what one puts comes to another: sent until it does, or, where it is to be refused, until what
    is put to `closed`, an open key, does."""
    came: list[str] = []
    took: Any = zenoh.handlers.Callback(lambda sample: came.append(str(sample.key_expr)), indirect=False)
    declared = [taker.session.declare_subscriber(each, took) for each in filter(None, (key, closed))]

    def sent() -> bool:
        for each in filter(None, (key, closed)):
            sender.session.put(each, b"x")
        return bool(came)

    assert until(sent)
    time.sleep(0.05)
    for each in declared:
        undeclare(each)
    return key in came


def is_answered(asker: Bus, holder: Bus, key: str, *, waits: bool = True) -> bool:
    """Returns whether a request of one is answered by another; `waits`: it is asked again until it is."""
    answering = holder.serve(key, lambda query: query.reply(key, b"answer"))
    try:
        if waits:
            return until(lambda: asker.ask(key, timeout=0.5))
        time.sleep(0.3)  # the declaration would have arrived
        return bool(asker.ask(key, timeout=0.5))
    finally:
        answering.close()


STREAM = f"{SPACE}/camera/image"
PARAM = runtime_key(SPACE, "param", "camera")
RELOAD = local_key(SPACE, "reload", "camera")
TAPS, TAP, ACK = (runtime_key(SPACE, kind, "1") for kind in ("taps", "tap", "ack"))


def test_a_tool_follows_and_asks_and_no_more(buses: dict[str, Bus]) -> None:
    here, tools = buses["here"], buses["tools"]

    assert puts_reach(here, tools, STREAM)
    assert puts_reach(here, tools, TAP)
    assert puts_reach(tools, here, ACK)
    assert is_answered(tools, here, PARAM)
    assert is_answered(tools, here, GRAPH_KEY)
    assert is_answered(here, tools, TAPS)

    for key in (STREAM, TAP, machine_key("robot", "start"), GRAPH_KEY):
        assert not puts_reach(tools, here, key, closed=ACK), key
    assert not is_answered(tools, here, RELOAD, waits=False)
    assert not is_answered(here, tools, PARAM, waits=False)
    assert not is_answered(here, tools, GRAPH_KEY, waits=False)
    assert is_answered(here, here, RELOAD)


def test_machine_publishes_under_its_name_and_serves_its_operators(buses: dict[str, Bus]) -> None:
    here, robot = buses["here"], buses["robot"]

    assert puts_reach(robot, here, machine_key("robot", "run", "up"))
    assert puts_reach(here, robot, machine_key("robot", "run", "down"))
    assert puts_reach(robot, here, STREAM)
    assert is_answered(here, robot, PARAM)
    assert is_answered(here, robot, RELOAD)

    assert not puts_reach(robot, here, machine_key("arm", "hello"), closed=STREAM)
    assert not is_answered(robot, here, RELOAD, waits=False)


def test_a_machine_that_is_not_in_the_graph_gets_and_gives_nothing(buses: dict[str, Bus]) -> None:
    here, elsewhere = buses["here"], buses["elsewhere"]

    assert not is_answered(elsewhere, here, GRAPH_KEY, waits=False)
    assert not is_answered(elsewhere, here, PARAM, waits=False)
    assert not is_answered(here, elsewhere, PARAM, waits=False)


def test_tools_with_the_keys_of_the_machine_that_runs_the_graph_load_code_again(buses: dict[str, Bus]) -> None:
    here, laptop = buses["here"], buses["laptop"]

    assert is_answered(laptop, here, RELOAD)
    assert is_answered(laptop, here, PARAM)
    assert not puts_reach(laptop, here, STREAM, closed=ACK)
    assert not is_answered(here, laptop, RELOAD, waits=False)
