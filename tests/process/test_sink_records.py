"""Firing records on their way into a recording: none is passed over, and none of somebody else is stored."""

from __future__ import annotations

import queue
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from process_doubles import RecordedChannel

from dataflow.graph import load_text
from dataflow.names import firings_key
from dataflow.recording import Recording
from dataflow.records.firing import FiringRecord, decode_batch, encode_batch
from dataflow.records.reading import recorded_firings
from dataflow.sinks.recorder import RecorderSink
from dataflow.sinks.sink import SinkConfig, SinkProcess
from dataflow.sync import NEVER
from dataflow.transport import Envelope, Kind

GRAPH = """\
graph: one
namespace: test
operators:
  camera: {use: "process_operators:Count"}
  last: {use: "process_operators:Twice", inputs: {x: camera/count}}
"""
KEY, CAMERA = firings_key("test", "last"), firings_key("test", "camera")
STREAM = "test/camera/count"


class Stored:
    """A sink that keeps the places of the records it is given."""

    def __init__(self) -> None:
        self.places: list[tuple[int, int]] = []

    def firings(self, operator: str, records: Sequence[FiringRecord], payload: bytes) -> None:
        assert list(decode_batch(payload).records) == list(records)
        self.places += [(r.incarnation, r.index) for r in records]


class Arrived(queue.SimpleQueue[tuple[Any, ...]]):
    """An inbox to which nothing comes through rings."""

    def counters(self) -> dict[str, int]:
        return {}


class Recorder:
    """A recorder without a network."""

    def __init__(self) -> None:
        graph = load_text(GRAPH)
        self.channel, self.stored = RecordedChannel(), Stored()
        config = SinkConfig("@recorder", "record", graph.to_json(), [], ["camera", "last"], {}, live=True)
        self.process = SinkProcess(config, self.channel, Arrived(), lambda *_: self.stored)
        self.process.sink = self.stored

    def arrives(self, *places: tuple[int, int], operator: str = "last", key: str = KEY) -> None:
        self.process._receive(key, batch(*places, operator=operator))


def batch(*places: tuple[int, int], operator: str = "last") -> bytes:
    return encode_batch([FiringRecord(operator, incarnation, index, "fire", index) for incarnation, index in places])


@pytest.mark.parametrize(
    ("before", "after", "lacking"),
    [
        ([(0, 0), (0, 1)], [(0, 4)], [(0, 2), (0, 3)]),  # in the same incarnation
        ([(0, 0), (0, 1)], [(1, 2)], [(1, 0), (1, 1)]),  # at the beginning of the next one
        ([], [(0, 1)], [(0, 0)]),  # at the very beginning
    ],
)
def test_records_that_did_not_come_are_asked_for(
    before: list[tuple[int, int]], after: list[tuple[int, int]], lacking: list[tuple[int, int]]
) -> None:
    recorder = Recorder()
    if before:
        recorder.arrives(*before)
    recorder.arrives(*after)

    assert recorder.channel.of("lacks") == [{"operator": "last"}]
    everything = [batch(place) for place in (*before, *lacking, *after)]
    recorder.process._control("records", {"batches": everything})
    assert sorted(recorder.stored.places) == sorted([*before, *lacking, *after])


def test_records_that_come_again_after_the_last_ones_are_taken() -> None:
    recorder = Recorder()
    recorder.process._receive(KEY, batch((0, 0)))
    finish = encode_batch([FiringRecord("last", 0, 2, "finish", 2)], last=True)
    recorder.process._receive(KEY, finish)
    for again in (batch((0, 0), (0, 1)), finish):
        recorder.process._receive(KEY, again)

    assert sorted(recorder.stored.places) == [(0, 0), (0, 1), (0, 2)]
    assert recorder.process.inlet.malformed == 0


def test_ended_recorder_waits_for_the_end_of_restarted_operators() -> None:
    recorder = Recorder()

    def ends(incarnation: int) -> list[dict[str, Any]]:
        for name in ("camera", "last"):
            records = encode_batch([FiringRecord(name, incarnation, 0, "finish", 2)], last=True)
            recorder.process._receive(firings_key("test", name), records)
            recorder.process._report(0.0)
        return [fields["report"] for fields in recorder.channel.of("ended")]

    assert [report["expected"] for report in ends(0)] == [0]
    recorder.process._control("expect", {"streams": [KEY], "times": 1, "begins": {"last": 1}})
    recorder.process._report(0.0)
    assert len(recorder.channel.of("ended")) == 1
    assert [report["expected"] for report in ends(1)] == [0, 1]


def test_delayed_end_of_a_predecessor_is_not_that_of_the_successor() -> None:
    """The recorder was slow: what the killed process had said, up to its end, comes after the word of its successor."""
    recorder = Recorder()
    recorder.process._open.add(STREAM)
    recorder.process.frontiers[STREAM] = 0
    recorder.stored.end = lambda *_: None
    begins = {"camera": 1, "last": 1}
    recorder.process._control("expect", {"streams": [STREAM, KEY, CAMERA], "times": 1, "begins": begins})
    for incarnation in (0, 1):
        assert recorder.channel.of("ended") == []
        recorder.process._deliver(STREAM, Envelope(Kind.END, STREAM, incarnation, 0, 7))
        for name, key in (("camera", CAMERA), ("last", KEY)):
            records = [FiringRecord(name, incarnation, 0, "finish", 2)]
            recorder.process._receive(key, encode_batch(records, last=True))
        recorder.process._report(0.0)
    assert [fields["report"]["expected"] for fields in recorder.channel.of("ended")] == [1]


def test_garbage_and_records_of_another_operator_are_dropped_and_counted(capsys: pytest.CaptureFixture[str]) -> None:
    recorder = Recorder()

    recorder.process._receive(KEY, b"\xc1garbage")
    recorder.arrives((0, 0), operator="camera")
    recorder.arrives((0, 0))

    assert recorder.stored.places == [(0, 0)]
    assert (recorder.process.inlet.malformed, recorder.process.inlet.misplaced) == (1, 1)
    assert capsys.readouterr().err.count(KEY) == 2


def test_polled_recorder_sends_ended_before_its_state() -> None:
    """A supervisor that heard of the state alone would take the run for stuck: all are idle, and one has not ended."""
    recorder = Recorder()
    for operator in ("camera", "last"):
        record = FiringRecord(operator, 0, 0, "finish", 0)
        recorder.process._receive(firings_key("test", operator), encode_batch([record], last=True))
    recorder.process._control("poll", {"round": 7})

    kinds = [kind for kind, _ in recorder.channel.sent]
    assert kinds.index("ended") < kinds.index("state")
    recorder.process._control("poll", {"round": 8})
    assert len(recorder.channel.of("ended")) == 1


def test_recorder_progresses_while_one_stream_lags() -> None:
    """On a slow disk: the run is not stuck."""
    recorder = Recorder()
    recorder.process.frontiers[STREAM] = 0

    for second in range(3):
        recorder.process._report(second)
        recorder.process._report(second + 0.5)
        recorder.arrives((0, second))
    recorder.process._report(9.0)
    recorder.process._report(11.0)

    assert [fields["done"] for fields in recorder.channel.of("progress")] == [{"@recorder": 0}] * 4


def test_records_of_an_operator_are_stored_in_the_order_of_its_calls_though_no_message_comes(tmp_path: Path) -> None:
    graph = load_text(GRAPH)
    options = {"metadata": {}, "compression": "zstd", "overwrite": False}
    sink = RecorderSink(tmp_path / "run.mcap", graph, [], options)
    for index, (kind, stamp) in enumerate([("setup", NEVER), ("finish", 0), ("param", 7)]):
        detail = {"name": "gain", "value": 1.0} if kind == "param" else {}
        record = FiringRecord("last", 0, index, kind, stamp, detail=detail)
        sink.firings("last", stamp, encode_batch([record]))
    sink.close("complete")

    with Recording(tmp_path / "run.mcap") as recording:
        assert [record.index for record in recorded_firings(recording, "last")] == [0, 1, 2]
