"""A tool on another machine follows a run over stalls of its link, and ends when the run is over."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgpack
import pytest

from dataflow.client import attach
from dataflow.client.attach import MachineUnreachable, elsewhere, find_running, still_runs
from dataflow.machines.hub import router
from dataflow.machines.keys import GRAPH_KEY, OVER_KEY
from dataflow.transport import Bus

GRAPH = {"name": "two", "namespace": "test"}


@contextmanager
def answering(endpoint: str, started: float) -> Iterator[Bus]:
    """A link that answers which graph runs."""
    described = msgpack.packb({"graph": GRAPH, "started": started})
    with router((endpoint,), (), {}) as bus:
        bus.serve(GRAPH_KEY, lambda query: query.reply(GRAPH_KEY, described))
        yield bus


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"unixsock-stream/{tmp_path / 'meet'}"


def test_run_continues_while_machine_is_silent_until_lost(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with elsewhere(endpoint, None):
        with answering(endpoint, 1.0):
            found = find_running(None)
            assert still_runs(found)
        assert still_runs(found)
        monkeypatch.setattr(attach, "LOST_AFTER", 0.0)
        with pytest.raises(MachineUnreachable, match=r"/meet was not heard for .*: whether two goes on is not known"):
            still_runs(found)


@pytest.mark.parametrize("ends", ["another run", "its own end"])
def test_run_is_over_when_machine_ends_it_or_has_another(endpoint: str, ends: str) -> None:
    with elsewhere(endpoint, None), ExitStack() as stack:
        with answering(endpoint, 1.0):
            found = find_running(None)
        bus = stack.enter_context(answering(endpoint, 2.0 if ends == "another run" else 1.0))

        deadline = time.monotonic() + 10
        if ends == "its own end":
            while not attach._elsewhere.get()._over and time.monotonic() < deadline:
                assert still_runs(found)
                bus.session.put(OVER_KEY, msgpack.packb(1.0))
        while still_runs(found):
            assert time.monotonic() < deadline
