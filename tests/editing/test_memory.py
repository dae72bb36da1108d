"""Records of a long run are read one at a time: memory hardly grows with the run."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from dataflow.analysis.latency import latencies
from dataflow.editing.joins import Joined
from dataflow.editing.spans import RunRecords
from dataflow.editing.spool import Spool
from dataflow.graph import load_graph
from dataflow.graph.model import Graph
from dataflow.records.firing import Emission, FiringRecord
from dataflow.records.order import Place
from dataflow.sync import MessageRef

FEW, MANY = 2_000, 6_000
GRAPH = """
graph: long
namespace: test
operators:
  left: {use: runtime_operators:Counter}
  first: {use: runtime_operators:Tuned, inputs: {x: left/fast}}
"""


@dataclass(frozen=True)
class Made:
    """So many records of a source, or of an operator that takes its messages, made while they are read."""

    operator: str
    number: int

    def since(self, begin: Place) -> Iterator[FiringRecord]:
        source = self.operator == "left"
        for k in range(max(0, begin[1]), self.number):
            inputs = {} if source else {"x": MessageRef("test/left/fast", 0, k)}
            sent = (Emission(k, k + 1, k.to_bytes(16, "little")),)
            yield FiringRecord(self.operator, 0, k, "fire", k + 1, inputs=inputs, outputs=sent, wall_start=k)

    def __iter__(self) -> Iterator[FiringRecord]:
        return self.since((-1, -1))


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Graph:
    path = tmp_path_factory.mktemp("memory") / "long.yaml"
    path.write_text(GRAPH)
    return load_graph(path)


def cut(number: int, folder: Path, _: Graph) -> int:
    logs = {name: Made(name, number).since for name in ("left", "first")}
    run = RunRecords(logs, {"left": ("test/left/fast",), "first": ("test/first/y",)})
    start, end = number // 4, number // 2
    found = run.of_span({"test/left/fast", "test/first/y"}, start, end, lambda _: (start, end))
    with Spool(folder, found.records) as spool:
        return spool.calls


def joined(number: int, folder: Path, _: Graph) -> int:
    parts = [Made("left", number // 2), Made("left", number)]
    with Spool(folder, {"left": Joined(parts, ("test/left/fast",))}) as spool:
        return spool.calls


def latency(number: int, _: Path, graph: Graph) -> int:
    (path,) = latencies(graph, {name: Made(name, number) for name in graph.nodes})
    return path.count


@pytest.mark.parametrize(("work", "share"), [(cut, 4), (joined, 1), (latency, 1)], ids=["cut", "merge", "latency"])
def test_memory_hardly_grows_with_the_length_of_a_run(
    work: Callable[[int, Path, Graph], int], share: int, tmp_path: Path, graph: Graph, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dataflow.analysis.latency.KEPT", 256)
    work(100, tmp_path, graph)  # what is loaded on the way
    peaks = []
    for number in (FEW, MANY):
        tracemalloc.start()
        try:
            done = work(number, tmp_path, graph)
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
        assert done >= number // share

    assert (peaks[1] - peaks[0]) / (MANY - FEW) < 60  # bytes a step; the records of one take about a kilobyte


def test_each_part_of_a_run_reads_little_more_than_its_own_records() -> None:
    read = [0]

    def counted(begin: Place) -> Iterator[FiringRecord]:
        for record in Made("left", 8192).since(begin):
            read[0] += 1
            yield record

    run = RunRecords({"left": counted}, {"left": ("test/left/fast",)})
    counts = []
    for parts in (2, 8):
        read[0], each = 0, 8192 // parts
        for k in range(parts):
            start, end = k * each + 1, (k + 1) * each
            found = run.of_span({"test/left/fast"}, start, end, lambda _, span=(start, end): span)
            assert sum(record.kind == "fire" for record in found.records["left"]) == each
        counts.append(read[0])
    assert counts[1] < 2 * counts[0]
