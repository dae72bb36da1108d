"""Workers of a sweep begin while it is planned."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from dataflow.graph import Graph, load_graph
from dataflow.recording import RecordingWriter
from dataflow.sweep import run
from dataflow.sweep.run import on_ray
from dataflow.sweep.table import Store
from dataflow.sweep.work import Result

GRAPH = "graph: none\noperators: {}\n"


class Begun:
    """Stands for a worker: whether it was started and ended."""

    all: list[Begun]

    def __init__(self, commands: tuple[str, ...]) -> None:
        self.commands, self.started, self.ended = commands, False, False
        Begun.all.append(self)

    def start(self) -> None:
        self.started = True

    def close(self) -> None:
        self.ended = True


@pytest.fixture(autouse=True)
def workers(monkeypatch: pytest.MonkeyPatch) -> None:
    Begun.all = []
    monkeypatch.setattr(run, "Worker", Begun)


@pytest.fixture
def recordings(tmp_path: Path) -> list[str]:
    files = [tmp_path / f"{name}.mcap" for name in "ab"]
    for file in files:
        with RecordingWriter(file, metadata={"file": {"name": file.name}}):
            pass
    return [str(file) for file in files]


def sweep(recordings: list[str], folder: Path, **how: object) -> run.Sweep:
    return run.Sweep(recordings, "verify", folder=folder, **how)


def test_as_many_begin_as_there_is_work_before_any_graph_is_loaded(
    recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = list[int]()

    def loaded(*given: object, **how: object) -> Graph:
        seen.append(sum(worker.started for worker in Begun.all))
        return load_graph(*given, **how)

    monkeypatch.setattr(run, "load_graph", loaded)
    (tmp_path / "graph.yaml").write_text(GRAPH)
    with pytest.raises(Exception, match="operators"):
        run.Sweep(recordings, "replay", tmp_path / "graph.yaml", folder=tmp_path / "out", jobs=7)
    assert seen == [2]
    assert [(worker.commands, worker.ended) for worker in Begun.all] == [(("replay",), True)] * 2


def test_none_begins_where_results_are_known_and_nothing_may_be_left(recordings: list[str], tmp_path: Path) -> None:
    assert sweep(recordings, tmp_path / "out").left
    assert len(Begun.all) == 2

    Store(tmp_path / "out").keep(Result("key", "done", 0, "", ({},), 1.0))
    assert sweep(recordings, tmp_path / "out").left
    assert len(Begun.all) == 2
    assert sweep(recordings, tmp_path / "out", again=True).left
    assert len(Begun.all) == 4


def test_no_cluster_is_begun_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert list(on_ray([], "local", 1, 60.0, {})) == []
