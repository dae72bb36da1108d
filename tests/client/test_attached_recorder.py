"""A recorder from outside: what it writes, counts and splits; and one that is attached to a graph that runs."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from dataflow.client.attach import find_running, graph_of
from dataflow.client.recorder import AttachedRecorder, Subscription, record, subscribed
from dataflow.graph import Graph, load_graph
from dataflow.messages import FeatureVector
from dataflow.recording import Recording
from dataflow.recording.parts import Splitting
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.supervisor import Supervisor
from dataflow.transport import Envelope, Kind
from dataflow.transport.codec import encode

RUNTIME = Path(__file__).resolve().parent.parent / "runtime"
GRAPH = """
graph: small
namespace: test
params: {count: 40}
operators:
  left: {use: "runtime_operators:Counter", params: {count: "${count}"}}
  smooth: {use: "runtime_operators:Smooth", inputs: {x: left/fast}, params: {sleep: 0.01}}
"""
MS = 1_000_000


@pytest.fixture
def graph(tmp_path: Path) -> Graph:
    (tmp_path / "small.yaml").write_text(GRAPH)
    return load_graph(tmp_path / "small.yaml", settings=["count=1000000"])


def said(seq: int, stream: str = "test/smooth/mean", incarnation: int = 0, stamp: int | None = None) -> bytes:
    at = (seq + 1) * 10 * MS if stamp is None else stamp
    message = FeatureVector(stamp=at, vectors=[[float(seq)] * 50], model="m")
    return encode(Envelope(Kind.MESSAGE, stream, incarnation, seq, at, message))


def numbers(path: str) -> list[tuple[int, int]]:
    with Recording(path) as recording:
        return [(m.incarnation, m.seq) for m in recording.messages(["test/smooth/mean"])]


def test_missed_messages_are_counted_by_sequence_number(graph: Graph, tmp_path: Path) -> None:
    with AttachedRecorder(tmp_path / "a.mcap", graph, ["test/smooth/mean"], metadata={}) as recorder:
        for seq in (5, 6, 9, 10):
            recorder.take(said(seq))
        recorder.take(said(2, incarnation=1, stamp=10**9))

    assert recorder.tally.missed == {"test/smooth/mean": 2 + 2}
    assert numbers(recorder.tally.files[0]) == [(0, 5), (0, 6), (0, 9), (0, 10), (1, 2)]


def test_invalid_messages_are_left_out_and_counted(graph: Graph, tmp_path: Path) -> None:
    with AttachedRecorder(tmp_path / "a.mcap", graph, ["test/smooth/mean"], metadata={}) as recorder:
        recorder.take(said(5))
        recorder.take(said(5))  # twice
        recorder.take(said(6, stamp=1))  # a stamp that goes back
        recorder.take(b"no envelope")
        recorder.take(said(7, stream="test/left/fast"))  # not asked for

    assert recorder.tally.refused == 3
    assert numbers(recorder.tally.files[0]) == [(0, 5)]


@pytest.mark.parametrize("splitting", [Splitting(every=30 * MS), Splitting(size=2_000)], ids=["time", "size"])
def test_split_files_hold_everything_once_and_static_messages_each(
    graph: Graph, tmp_path: Path, splitting: Splitting
) -> None:
    streams = ["test/smooth/mean", "test/left/constant"]
    constant = FeatureVector(stamp=0, vectors=[[7.0]], model="m")
    with AttachedRecorder(tmp_path / "a.mcap", graph, streams, metadata={}, splitting=splitting) as recorder:
        recorder.take(encode(Envelope(Kind.MESSAGE, "test/left/constant", 0, 0, 0, constant)))
        for seq in range(40):
            recorder.take(said(seq))
            recorder.flush()

    files = recorder.tally.files
    assert len(files) > 2
    assert [Path(f).name for f in files[:2]] == ["a_000.mcap", "a_001.mcap"]
    assert [place for file in files for place in numbers(file)] == [(0, seq) for seq in range(40)]
    for file in files:
        with Recording(file) as recording:
            assert recording.counts("test/left/constant") == {0: 1}


def test_static_message_above_the_size_limit_does_not_split_at_every_message(graph: Graph, tmp_path: Path) -> None:
    streams = ["test/smooth/mean", "test/left/constant"]
    large = FeatureVector(stamp=0, vectors=np.random.default_rng(1).random((1, 2_000), np.float32), model="m")
    split = Splitting(size=2_000)
    with AttachedRecorder(tmp_path / "a.mcap", graph, streams, metadata={}, splitting=split) as recorder:
        recorder.take(encode(Envelope(Kind.MESSAGE, "test/left/constant", 0, 0, 0, large)))
        for seq in range(100):
            recorder.take(said(seq))
            recorder.flush()

    assert 2 <= len(recorder.tally.files) <= 10
    assert [place for file in recorder.tally.files for place in numbers(file)] == [(0, seq) for seq in range(100)]


def test_every_file_is_compressed_as_is_asked_for(graph: Graph, tmp_path: Path) -> None:
    split = Splitting(every=30 * MS)
    with AttachedRecorder(
        tmp_path / "a.mcap", graph, ["test/smooth/mean"], metadata={}, splitting=split, compression="lz4"
    ) as recorder:
        for seq in range(6):
            recorder.take(said(seq))

    assert len(recorder.tally.files) == 2
    for file in recorder.tally.files:
        with Path(file).open("rb") as opened:
            summary = make_reader(opened).get_summary()
        assert summary is not None
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"lz4"}


def test_the_oldest_that_wait_are_let_go_when_there_is_no_room() -> None:
    subscription = Subscription(most=250)
    for number in range(5):
        subscription.put(bytes([number]) * 100)

    assert [p[0] for p in iter(lambda: subscription.take(0.0), None)] == [3, 4]


def test_a_graph_that_runs_is_recorded_from_outside(tmp_path: Path) -> None:
    (tmp_path / "small.yaml").write_text(GRAPH)
    graph = load_graph(tmp_path / "small.yaml", settings=["count=100000"])
    supervisor = Supervisor(RunPlan(graph, placement="one_process", window=(8, 1 << 20)))
    thread = threading.Thread(target=supervisor.run)
    thread.start()
    found = find_running("small", wait=30)
    running = graph_of(found)
    streams = ["test/left/constant", "test/left/fast", "test/smooth/mean"]
    with (
        subscribed(found, streams) as subscription,
        AttachedRecorder(tmp_path / "a.mcap", running, streams, metadata={}) as recorder,
    ):

        def until_enough():
            while recorder.tally.messages.get("test/smooth/mean", 0) < 20:
                yield True

        record(subscription, recorder, goes_on=until_enough())
    supervisor.stop()
    thread.join(60)
    assert not thread.is_alive()

    with Recording(tmp_path / "a.mcap") as recording:
        fast = [m.seq for m in recording.messages(["test/left/fast"])]
        assert recording.counts("test/left/constant") == {0: 1}
        assert not recording.firing_batches()
    assert fast == list(range(fast[0], fast[0] + len(fast)))
    assert not recorder.tally.missed  # a run that is not live waits for its subscribers
