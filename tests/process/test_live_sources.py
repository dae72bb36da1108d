"""Live sources: they are restarted when they raise, and closed when nobody reads them any more."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from typing import Any

import process_operators
import pytest
from process_doubles import RecordedChannel

from dataflow.execution.failure import OperatorFailure
from dataflow.execution.feeds.pace import Pace
from dataflow.execution.feeds.window import Window
from dataflow.execution.source import SourceRunner
from dataflow.graph import load_text
from dataflow.process import live_sources
from dataflow.process.live_sources import LiveSources
from dataflow.records.firing import FiringRecord
from dataflow.sync import Entry


@pytest.fixture(autouse=True)
def _first_lives() -> Iterator[None]:
    process_operators.Count.lives = 0
    process_operators.Count.closed.clear()
    process_operators.Blocks.ends.clear()
    process_operators.Blocks.waiting.clear()
    process_operators.Blocks.let_go.clear()
    yield
    process_operators.Blocks.let_go.set()


class Emitted:
    """Keeps what a source emits."""

    def __init__(self) -> None:
        self.messages: list[tuple[int, int, int]] = []  # incarnation, number, stamp
        self.ends: list[str] = []
        self.records: list[tuple[int, str]] = []

    def message(self, stream: str, entry: Entry) -> None:
        self.messages.append((entry.incarnation, entry.seq, entry.stamp))

    def frontier(self, stream: str, frontier: int) -> None:
        """Frontiers are of no interest here."""

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self.ends.append(reason)

    def record(self, record: FiringRecord) -> None:
        self.records.append((record.incarnation, record.kind))


class Sources:
    """Live sources of a graph with one of them, and a main thread for them."""

    def __init__(self, use: str, *, restarts: int = 0, **params: Any) -> None:
        self.inbox: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
        self.channel, self.emitted = RecordedChannel(), Emitted()
        window, backlog = Window(256, 1 << 20), Window(4096, 1 << 24)
        self.live = LiveSources(
            self.inbox,
            self.channel,
            Pace(None),
            window,
            backlog,
            resumed=False,
            in_its_place=self.in_its_place,
        )
        self.runner = SourceRunner(node_of(use, restarts, params), self.emitted, live=True)
        self.live.add(self.runner)
        self.runner.setup()
        self.live.start()

    def in_its_place(self, act: Any, step: Any) -> bool:
        return False

    def run(self) -> None:
        """Handles what the reader hands over until the source has ended."""
        while not self.runner.ended:
            due = self.live.next_due()
            self.live.restart_due()
            try:
                kind, *rest = self.inbox.get(timeout=10 if due is None else due)
            except queue.Empty:
                assert due is not None, "the source neither ends nor fails"
                continue
            (self.live.take if kind == "source" else self.live.failed)(*rest)


def node_of(use: str, restarts: int, params: dict[str, Any]) -> Any:

    live = f"live: {{restart: {{max: {restarts}, backoff: 1ms}}}}" if restarts else ""
    text = f"""\
graph: sources
namespace: test
operators:
  camera:
    use: process_operators:{use}
    params: {params}
    {live}
  twice: {{use: process_operators:Twice, inputs: {{x: camera/count}}}}
"""
    node = load_text(text).nodes["camera"]
    assert node.live.restart.max == restarts
    return node


def test_a_source_that_raises_is_restarted_and_its_streams_begin_a_new_incarnation() -> None:
    sources = Sources("Count", restarts=2, fails_at=4)

    with pytest.raises(OperatorFailure) as caught:
        sources.run()

    assert (caught.value.operator, caught.value.summary) == ("camera", "Unplugged: no such device")
    assert caught.value.when == "stream() after stamp 1203"
    told = sources.channel.of("restarting")
    assert [(t["operator"], t["when"]) for t in told] == [
        ("camera", "stream() after stamp 1003"),
        ("camera", "stream() after stamp 1103"),
    ]
    assert all(t["summary"] == "Unplugged: no such device" and t["pause"] > 0 for t in told)
    assert all(t["where"].startswith("process_operators.py:") for t in told)
    assert all("Unplugged: no such device" in t["traceback"].splitlines()[-1] for t in told)
    assert sources.emitted.messages == [(i, k, 1000 + 100 * i + k) for i in range(3) for k in range(4)]
    assert [i for i, kind in sources.emitted.records if kind == "setup"] == [0, 1, 2]
    assert len(process_operators.Count.closed) == 2
    assert sources.live.restarts_of("camera") == 2


def test_without_a_policy_a_source_that_raises_fails_the_run() -> None:
    with pytest.raises(OperatorFailure, match=r"'camera' failed in stream\(\) before its first message: "):
        Sources("Count", fails_at=0).run()


def test_a_step_that_breaks_the_contract_restarts_the_source_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread that reads it ends first."""
    monkeypatch.setattr(SourceRunner, "emit_live", _refuse_once(SourceRunner.emit_live))
    sources = Sources("Count", restarts=1, number=3)

    sources.run()

    assert sources.channel.of("restarting")[0]["summary"] == "ValueError: no such port"
    assert sources.emitted.messages[-1][0] == 1
    assert sources.emitted.ends == ["end of source"]


def _refuse_once(emit: Any) -> Any:
    refused: list[int] = []

    def emit_live(self: SourceRunner, step: Any) -> Any:
        if not refused:
            refused.append(1)
            raise OperatorFailure(self.node.name, "stream()", ValueError("no such port"))
        return emit(self, step)

    return emit_live


def test_any_exception_of_the_thread_ends_the_source_under_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(step: Any) -> tuple[int, int]:
        raise AssertionError("a fault of the runtime's own")

    monkeypatch.setattr(live_sources, "step_size", wrong)

    with pytest.raises(OperatorFailure, match=r"'camera' failed in the thread .*AssertionError: a fault of the"):
        Sources("Count").run()


def test_the_restart_that_is_pending_is_forgotten_when_the_run_is_stopped() -> None:
    sources = Sources("Count", restarts=1, fails_at=0)
    kind, *rest = sources.inbox.get(timeout=10)
    assert kind == "source_failed"
    sources.live.failed(*rest)
    sources.live.finish("interrupted")

    sources.run()
    sources.live.restart_due()

    assert sources.emitted.ends == ["interrupted"]
    assert process_operators.Count.lives == 1


class InPlace(Sources):
    """The thread that reads a source emits in the place of the main one, which waits."""

    def __init__(self, use: str, **params: Any) -> None:
        self.emitting: list[str] = []
        super().__init__(use, **params)

    def in_its_place(self, act: Any, step: Any) -> bool:
        self.emitting.append(threading.current_thread().name)
        act(step)
        return True


def test_a_reader_emits_itself_where_the_main_thread_waits() -> None:
    sources = InPlace("Count", number=3)

    sources.run()

    assert sources.emitting == ["source camera"] * 3
    assert sources.emitted.messages == [(0, k, 1000 + k) for k in range(3)]
    assert sources.emitted.ends == ["end of source"]


@pytest.mark.parametrize("restarts", [0, 1])
def test_a_step_that_a_reader_may_not_emit_fails_its_source(monkeypatch: pytest.MonkeyPatch, restarts: int) -> None:
    monkeypatch.setattr(SourceRunner, "emit_live", _refuse_once(SourceRunner.emit_live))
    sources = InPlace("Count", restarts=restarts, number=3)

    if restarts:
        sources.run()
        assert sources.emitted.messages[-1][0] == 1
    else:
        with pytest.raises(OperatorFailure, match="no such port"):
            sources.run()
