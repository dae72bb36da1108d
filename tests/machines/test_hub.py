"""The link: which agent is a machine, by what hellos call for, and what agents are given before it leaves."""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

from dataflow.machines.gate import Routes
from dataflow.machines.hub import Claims, Hub, HubConfig, machine_key, router
from dataflow.machines.pipe import AWAY_AFTER, Pipe
from dataflow.process.streams.inbox import Inbox

LONG = AWAY_AFTER + 1


def test_idle_agent_is_offered_the_run_and_its_namesake_is_not() -> None:
    claims = Claims("run")
    assert claims.answer("robot", b"1", "", None, 0.0) == "offer"
    assert claims.answer("robot", b"2", "", None, 0.1) == "another"
    assert claims.answer("robot", b"1", "run", 0.1, 0.2) == ""
    assert claims.answer("robot", b"2", "", 0.1, LONG) == "another"
    assert claims.answer("arm", b"3", "former", None, 0.0) == "busy"


def test_agent_that_left_the_run_or_restarted_is_detected() -> None:
    claims = Claims("run")
    claims.answer("robot", b"1", "", None, 0.0)
    assert claims.answer("robot", b"1", "run", LONG, 40.0) == ""  # a long stall: it goes on
    assert claims.answer("robot", b"1", "", 0.1, 41.0) == "offer"  # said before it began
    assert claims.answer("robot", b"1", "", LONG, 42.0) == "anew"
    assert claims.answer("robot", b"1", "next", LONG, 43.0) == "anew"
    assert claims.answer("robot", b"2", "", LONG, 44.0) == "anew"


def test_claim_of_an_agent_that_never_joined_expires() -> None:
    claims = Claims("run")
    claims.answer("robot", b"1", "", None, 0.0)
    assert claims.answer("robot", b"2", "", None, LONG) == "offer"
    assert claims.answer("robot", b"1", "", None, LONG + 0.1) == "another"


def test_agents_get_pending_messages_before_the_link_closes(tmp_path: Path) -> None:
    endpoint, listen = (f"unixsock-stream/{tmp_path / name}" for name in ("meet", "tools"))
    routes = Routes([], {}, {}, frozenset(), frozenset()).to_json()
    config = HubConfig("@link", endpoint, None, listen, (), "run", ("robot",), "test", routes, {}, True)
    inbox, taken = Inbox(), list[bytes]()
    hub = Hub(config, SimpleNamespace(send=lambda kind, **fields: None), inbox, ())
    hub.open()
    with closing(router((), (endpoint,), {})) as bus:
        up, down = (machine_key("robot", "run", way) for way in ("up", "down"))
        pipe = Pipe(bus, up, down, taken.append, bounded=False)
        deadline = time.monotonic() + 20
        while not pipe.heard and time.monotonic() < deadline:
            time.sleep(0.01)

        inbox.put(("control", "to", {"machine": "robot", "label": "", "kind": "over", "fields": {}}))
        inbox.put(("control", "leave", {}))
        hub.run()
        hub.close()

        assert len(taken) == 1
        assert b"over" in taken[0]
        pipe.close()
