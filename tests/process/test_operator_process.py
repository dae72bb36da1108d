"""The main loop of an operator process: when it reports, how much it takes in at a time, and what ends it."""

from __future__ import annotations

import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import process_operators
import pytest
from process_doubles import RecordedChannel
from process_operators import value

from dataflow.execution.failure import OperatorFailure
from dataflow.graph import load_text
from dataflow.names import firings_key
from dataflow.process import live_sources, operator_process
from dataflow.process.config import ProcessConfig
from dataflow.process.operator_process import OperatorProcess
from dataflow.records.black_box import make_black_box, read_black_box
from dataflow.records.firing import decode_batch
from dataflow.sync import FOREVER
from dataflow.transport import Envelope, Kind, encode

STREAM = "test/camera/count"
GRAPH = """\
graph: one
namespace: test
operators:
  camera: {use: "process_operators:SOURCE"}
  last: {use: "process_operators:OPERATOR", inputs: {x: camera/count}}
"""


class OneProcess:
    """The process of one operator, without a network: what arrives is put into its inbox."""

    def __init__(
        self,
        operator: str = "Twice",
        *,
        runs: str = "last",
        source: str = "Count",
        live: bool = False,
        box: int | None = None,
    ) -> None:
        graph = load_text(GRAPH.replace("OPERATOR", operator).replace("SOURCE", source))
        self.inbox: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
        self.channel = RecordedChannel()
        takes = [STREAM] if runs == "last" else []
        config = ProcessConfig(runs, graph.to_json(), [runs], {}, takes, [], live=live, firings=True)
        self.process = OperatorProcess(config, self.channel, self.inbox, box=box)
        self.process.make()
        for runner in self.process.driver.all:
            runner.setup()
        self.process.orders.released = True

    def arrives(self, *stamps: int, first: int = 0) -> None:
        for seq, stamp in enumerate(stamps, first):
            envelope = Envelope(Kind.MESSAGE, STREAM, 0, seq, stamp, value(stamp, seq))
            self.inbox.put(("envelope", STREAM, encode(envelope)))

    def says(self, kind: Kind, seq: int, stamp: int, incarnation: int = 0) -> None:
        self.inbox.put(("envelope", STREAM, encode(Envelope(kind, STREAM, incarnation, seq, stamp))))

    def leaves_when(self, sent: Callable[[str, dict[str, Any]], bool]) -> None:
        """The supervisor lets it go when it has said something."""
        send = self.channel.send

        def answer(kind: str, /, **fields: Any) -> None:
            send(kind, **fields)
            if sent(kind, fields):
                self.inbox.put(("control", "leave", {}))

        self.process.progress._channel = SimpleNamespace(send=answer)


def test_progress_is_reported_before_waiting_for_input(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not when the process has waited for more: the sources may be waiting for this report."""
    monkeypatch.setattr(operator_process, "IDLE_WAIT", 60.0)
    one = OneProcess()
    one.arrives(1000, 1010, 1020)
    one.leaves_when(lambda kind, fields: kind == "progress" and fields["done"].get("last", 0) >= 1020)

    thread = threading.Thread(target=one.process.run, daemon=True)
    thread.start()
    thread.join(20)

    assert not thread.is_alive()
    assert one.channel.of("progress")[-1]["counts"]["last"][0] == 3


def test_decided_firing_does_not_wait_for_the_whole_inbox(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operator_process, "TAKE_WITHIN", 0.0)
    one = OneProcess()
    one.arrives(*range(1000, 1100))

    one.process._take(0.0)
    one.process._work()

    assert one.process.driver.operators[0].firings == 1
    assert one.inbox.qsize() == 99


def test_a_live_run_takes_all_that_has_arrived_to_know_the_newest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operator_process, "TAKE_WITHIN", 0.0)
    one = OneProcess(live=True)
    one.arrives(*range(1000, 1100))

    one.process._take(0.0)

    assert one.inbox.empty()


@pytest.mark.parametrize("live", [True, False])
def test_envelopes_that_contradict_their_stream_end_no_process(live: bool, capsys: pytest.CaptureFixture[str]) -> None:
    one = OneProcess(live=live)
    one.arrives(1000, 1010)
    one.says(Kind.FRONTIER, 0, FOREVER)
    one.says(Kind.FRONTIER, 0, FOREVER - 1)
    one.says(Kind.END, 0, 5)
    one.arrives(1020, first=2)

    while not one.inbox.empty():
        one.process._take(0.0)
        one.process._work()

    assert one.process.driver.operators[0].firings == 3
    assert (one.process.inlet.received, one.process.inlet.misplaced) == (3, 3)
    assert capsys.readouterr().err.count(STREAM) == 1


def test_an_exception_that_is_no_exception_is_named_and_cut() -> None:
    """Operator, firing and stamp; not 50 MB of it."""
    one = OneProcess("Weird")
    one.arrives(1000)
    one.process._take(0.0)

    with pytest.raises(OperatorFailure, match=r"operator 'last' failed in fire at stamp 1000: Unplugged: x") as caught:
        one.process._work()

    assert len(caught.value.summary) < 3000
    assert "characters left out" in caught.value.summary
    assert len(caught.value.traceback) < 30_000


def test_libraries_that_setup_imports_are_limited_to_the_threads_of_the_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[int] = []
    one = OneProcess()
    monkeypatch.setitem(sys.modules, "cv2", None)
    runner = one.process.driver.operators[0]

    def setup() -> None:
        monkeypatch.setitem(sys.modules, "cv2", SimpleNamespace(setNumThreads=limits.append))

    monkeypatch.setattr(runner.operator, "setup", setup)

    one.process.set_up()

    assert limits == [1]


def test_an_operator_that_cannot_be_made_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: process_operators.Twice, **params: Any) -> None:
        raise ImportError("no such library")

    monkeypatch.setattr(process_operators.Twice, "__init__", refuse)

    with pytest.raises(OperatorFailure, match="'last' failed in construction: ImportError: no such library"):
        OneProcess()


def test_records_that_were_lost_on_their_way_are_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = make_black_box()
    one = OneProcess(live=True, box=memory)
    sent: list[Any] = []
    key = firings_key("test", "last")
    monkeypatch.setattr(one.process.outlet, "_send_bytes", lambda at, data: sent.append(data) if at == key else None)
    one.arrives(10, 20)
    one.process._take(0.0)
    one.process._work()
    one.process.outlet.flush_all()
    first = [r for data in sent for r in decode_batch(data).records]
    assert [r.index for r in first] == [0, 1, 2]  # setup() and two firings
    sent.clear()

    one.process.orders.obey("lacks", {"operator": "last"})

    assert [r for data in sent for r in decode_batch(data).records] == first
    assert read_black_box(memory, {"last": ("y",)}).reached["last"].last
    os.close(memory)


@pytest.fixture
def blocked() -> Iterator[OneProcess]:
    """The process of a live source that waits for its device."""
    blocks = process_operators.Blocks
    blocks.ends.clear()
    blocks.waiting.clear()
    blocks.let_go.clear()
    one = OneProcess(source="Blocks", runs="camera", live=True)
    one.process.live.in_its_place = lambda act, step: False
    for part in ("taps", "outside", "bus"):
        setattr(one.process, part, SimpleNamespace(close=lambda: None))
    one.process.live.start()
    assert blocks.waiting.wait(10)
    yield one
    blocks.let_go.set()


def test_a_source_is_not_closed_while_its_stream_is_read(blocked: OneProcess) -> None:
    process_operators.Blocks.let_go.set()

    blocked.process.close()

    assert process_operators.Blocks.ends == [("stream", "source camera"), ("close", "MainThread")]


def test_a_source_whose_stream_does_not_return_is_not_closed_at_all(
    blocked: OneProcess, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(live_sources, "RETURN_WITHIN", 0.05)

    blocked.process.close()

    assert process_operators.Blocks.ends == []
    assert "source 'camera' did not return within 0.05 s: close() is not called" in capsys.readouterr().err
