"""`dataflow sweep`: recordings by settings, each run once, kept, and found again in one table."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import pyarrow.parquet as parquet
import pytest

from dataflow.sweep.plan import Digests, sources_in
from dataflow.sweep.table import TIMES
from dataflow.sweep.work import replayed

MODULE = '''
import os
import signal
import time
from pathlib import Path

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Param, Source
import numpy as np
import psutil


def victim():
    """The process of a cluster that does the task, else this one."""
    found = [parent.pid for parent in psutil.Process().parents() if parent.cmdline()[:1] == ["ray::_there"]]
    return (found or [os.getpid()])[0]


class Numbers(Source):
    out: Out[FeatureVector]

    def stream(self):
        for step in range(12):
            vectors = np.full((1, 1), step, np.float32)
            yield {"out": FeatureVector(stamp=step * 10_000_000, vectors=vectors, model="m")}


class Scaled(Operator):
    x: In[FeatureVector]
    out: Out[FeatureVector]
    by: float = Param(2.0, doc="factor")
    kill: str = Param("", doc="a file: it is deleted and the process killed")
    wait: str = Param("", doc="a folder: it waits while a file named wait is there")
    fail_at: float = Param(1e9, doc="the scaled value at which it fails")

    def setup(self):
        self.sum = 0.0

    def process(self, x):
        if self.kill and Path(self.kill).exists():
            Path(self.kill).unlink()
            os.kill(victim(), signal.SIGKILL)
        while self.wait and Path(self.wait, "wait").exists():
            time.sleep(0.05)
        value = float(x.vectors[0, 0]) * self.by
        if value > self.fail_at:
            raise ValueError(f"{value} is too much")
        self.sum += value
        return FeatureVector(stamp=x.stamp, vectors=x.vectors * np.float32(self.by), model="m")

    def summary(self):
        return {"total error": self.sum, "words": "none"}
'''
GRAPH = """
graph: swept
namespace: test
operators:
  numbers: {use: "swept_operators:Numbers"}
  scaled: {use: "swept_operators:Scaled", inputs: {x: numbers/out}}
"""
OWN = """
from pathlib import Path

from beside import BY
from swept_operators import Scaled


class Own(Scaled):
    file: str = Param("", doc="factor")

    def setup(self):
        super().setup()
        self.by = float(self.use_file(self.file).read_text()) * BY
""".replace("from beside", "from dataflow.operator import Param\nfrom beside")
Sweep = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def folder(dataflow, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A graph with its operators, and two recordings of it, one deeper down."""
    path = tmp_path_factory.mktemp("sweep")
    (path / "swept_operators.py").write_text(MODULE)
    (path / "graph.yaml").write_text(GRAPH)
    (path / "runs" / "deep").mkdir(parents=True)
    dataflow("run", path / "graph.yaml", "--record", path / "runs" / "first.mcap", "--one-process", "-q")
    shutil.copy(path / "runs" / "first.mcap", path / "runs" / "deep" / "second.mcap")
    return path


@pytest.fixture
def sweep(dataflow, folder: Path, tmp_path: Path) -> Sweep:
    def run(*words: object, code: int = 0, graph: bool = True, recordings: str = "runs") -> dict[str, Any]:
        first = (folder / "graph.yaml",) if graph else ()
        given = ("--recordings", folder / recordings, "--path", folder, "--out", tmp_path, "-q", "--json")
        return json.loads(dataflow("sweep", *first, *given, *words, code=code).stdout)

    return run


def rows(tmp_path: Path) -> list[dict[str, Any]]:
    return parquet.read_table(tmp_path / "sweep.parquet").to_pylist()


def without_times(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{name: value for name, value in row.items() if name not in TIMES} for row in found]


@pytest.mark.parametrize("values", [(3,), pytest.param((1, 3), marks=pytest.mark.long)])
def test_every_recording_by_every_value_has_a_row_for_each_operator(
    sweep: Sweep, tmp_path: Path, values: tuple[int, ...]
) -> None:
    told = sweep("--set", f"scaled.by={','.join(map(str, values))}", "--jobs", "2")
    found = rows(tmp_path)

    assert told["ran"] == 2 * len(values)
    assert told["known"] == 0
    scaled = [row for row in found if row["operator"] == "scaled"]
    every = list(product(values, ("deep/second.mcap", "first.mcap")))
    assert [(row["set scaled.by"], row["recording"]) for row in scaled] == [(str(by), file) for by, file in every]
    assert [dict(row["figures"]) for row in scaled] == [{"total error": 66.0 * by} for by, _ in every]
    assert all(row["firings"] == row["emitted"] == 12 and row["outcome"] == "done" for row in scaled)
    assert len({row["digest"] for row in scaled}) == len(values)
    means = [choice["figures"]["scaled: total error"] for choice in told["settings"]]
    assert means == [{"mean": 66.0 * by, "std": 0.0, "recordings": 2} for by in values]


@pytest.mark.long
def test_a_second_sweep_runs_nothing_until_something_is_changed(sweep: Sweep, folder: Path, tmp_path: Path) -> None:
    assert sweep()["ran"] == 2
    first = rows(tmp_path)

    again = sweep()
    assert (again["ran"], again["known"]) == (0, 2)
    assert rows(tmp_path) == first

    module = folder / "swept_operators.py"
    module.write_text(MODULE + "\n# another version\n")
    assert sweep()["ran"] == 2
    module.write_text(MODULE)
    assert sweep("--again")["ran"] == 2
    assert without_times(rows(tmp_path)) == without_times(first)


@pytest.mark.long
def test_a_verdict_is_of_the_code_and_the_files_that_it_was_made_with(
    dataflow, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "beside.py").write_text("BY = 2\n")
    (tmp_path / "own_scaled.py").write_text(OWN)
    (tmp_path / "weights.txt").write_text("2")
    (tmp_path / "own.yaml").write_text(
        GRAPH.replace("swept_operators:Scaled", "own_scaled:Own").replace(
            "numbers/out}", "numbers/out}, params: {file: ~/weights.txt}"
        )
    )
    run = tmp_path / "own.mcap"
    dataflow("run", tmp_path / "own.yaml", "--record", run, "--path", folder, "--one-process", "-q")

    def verified(code: int) -> tuple[int, dict[str, int]]:
        given = ("--recordings", run, "--path", folder, "--out", tmp_path / "out", "--what", "verify", "-q", "--json")
        told = json.loads(dataflow("sweep", *given, "--path", tmp_path, code=code).stdout)
        return told["ran"], told["settings"][0]["verdicts"]

    assert verified(0) == (1, {"identical": 2})
    assert verified(0) == (0, {"identical": 2})
    (tmp_path / "weights.txt").write_text("5")
    assert verified(1) == (1, {"culprit": 1, "identical": 1})
    (tmp_path / "weights.txt").write_text("2")
    (tmp_path / "beside.py").write_text("BY = 3\n")
    assert verified(1) == (1, {"culprit": 1, "identical": 1})


def test_streams_are_those_of_the_operator_that_makes_them() -> None:
    def report(digest: str) -> dict[str, Any]:
        counts = {"firings": 1, "emitted": 1, "dropped": 0, "cpu_ms": 1.0, "wall_ms": 1.0}
        streams = {"ns/detector/boxes": {"digest": "a"}, "ns/front/detector/boxes": {"digest": digest}}
        operators = {"detector": counts, "front/detector": counts}
        summaries = {"detector": {"error": "NaN"}}
        run = {"operators": operators, "streams": streams, "restarts": {}, "summaries": summaries}
        return run | {"namespace": "ns"}

    one, other = replayed(report("b")), replayed(report("c"))
    assert one[0]["digest"] == other[0]["digest"]
    assert one[1]["digest"] != other[1]["digest"]
    assert math.isnan(one[0]["figures"]["error"])


def test_streams_are_distinct_where_namespace_and_operator_share_a_name() -> None:
    counts = {"firings": 1, "emitted": 1, "dropped": 0, "cpu_ms": 1.0, "wall_ms": 1.0}
    run = {"operators": {"x": counts, "ns/x": counts}, "restarts": {}, "summaries": {}}

    rows = replayed({**run, "namespace": "ns/ns", "streams": {"ns/ns/x/o": {"digest": "a"}}})

    assert [row["digest"] is None for row in rows] == [False, True]


def test_each_recording_counts_once_whatever_its_name_and_its_parts(folder: Path, tmp_path: Path) -> None:
    run = folder / "runs" / "first.mcap"
    (tmp_path / "parted").mkdir()
    for name in ("parted/drive_000.mcap", "parted/drive_001.mcap", "alone.mcap"):
        shutil.copy(run, tmp_path / name)
    shutil.copy(run, os.fsencode(tmp_path) + b"/caf\xe9.mcap")
    (tmp_path / "gap").mkdir()
    for name in ("gap/drive_000.mcap", "gap/drive_002.mcap"):  # one is missing: an error of that recording alone
        shutil.copy(run, tmp_path / name)
    found = sources_in([str(tmp_path), str(tmp_path / "." / "alone.mcap")], Digests(tmp_path / "digests.json"))
    assert sorted(source.name for source in found) == ["alone.mcap", "caf\\udce9.mcap", "gap", "parted"]


def test_failed_run_keeps_its_error_and_the_others_continue(sweep: Sweep, tmp_path: Path) -> None:
    words = ("--set", "scaled.fail_at=5,1e9")
    told = sweep(*words, recordings="runs/first.mcap", code=1)

    assert [choice["outcomes"] for choice in told["settings"]] == [{"failed": 1}, {"done": 1}]
    failed = [row for row in rows(tmp_path) if row["outcome"] == "failed"]
    assert len(failed) == 1
    assert all("6.0 is too much" in row["error"] for row in failed)
    assert all("ValueError: 6.0 is too much" in Path(row["log"]).read_text() for row in failed)
    assert sweep(*words, recordings="runs/first.mcap", code=1)["ran"] == 0


@pytest.mark.long
@pytest.mark.parametrize("words", ["", "--ray local", "--what verify"], ids=["process", "of a cluster", "of a worker"])
def test_killed_process_is_started_again_and_loses_nothing(sweep: Sweep, tmp_path: Path, words: str) -> None:
    if "ray" in words:
        pytest.importorskip("ray", reason="Ray is not installed: pip install 'robot-dataflow[ray]'")
    marker = tmp_path / "kill"
    marker.write_text("")
    told = sweep("--set", f"scaled.kill={marker}", "--jobs", "1", *words.split())

    assert not marker.exists()
    assert told["settings"][0]["outcomes"] == {"done": 2}
    if "verify" not in words:
        assert [row["firings"] for row in rows(tmp_path) if row["operator"] == "scaled"] == [12, 12]


@pytest.mark.long
def test_timed_out_runs_are_retried_by_the_next_sweep(sweep: Sweep, tmp_path: Path) -> None:
    marker = tmp_path / "wait"
    marker.write_text("")
    words = ("--set", f"scaled.wait={tmp_path}", "--jobs", "2")
    assert sweep(*words, "--timeout", "1", code=1)["settings"][0]["outcomes"] == {"timed out": 2}
    assert all(row["error"] == "not over within 1 s" for row in rows(tmp_path))

    marker.unlink()
    assert sweep(*words)["settings"][0]["outcomes"] == {"done": 2}


@pytest.mark.long
def test_verification_names_the_culprits(sweep: Sweep, folder: Path, tmp_path: Path) -> None:
    assert sweep("--what", "verify", graph=False)["settings"][0]["verdicts"] == {"identical": 4}
    told = sweep("--what", "verify", "--set", "scaled.by=2,3", code=1)

    assert [choice["verdicts"].get("culprit", 0) for choice in told["settings"]] == [0, 2]
    assert told["settings"][1]["culprits"] == {"scaled": 2}


@pytest.mark.long
def test_an_evaluation_has_the_operators_with_figures(sweep: Sweep, tmp_path: Path) -> None:
    sweep("--what", "evaluate")
    assert {row["operator"] for row in rows(tmp_path)} == {"scaled"}


@pytest.mark.long
def test_recordings_of_a_store_are_fetched(dataflow, folder: Path, tmp_path: Path) -> None:
    given = ("--recordings", f"file://{folder / 'runs'}", "--path", folder, "--out", tmp_path, "-q", "--json")
    assert json.loads(dataflow("sweep", folder / "graph.yaml", *given).stdout)["settings"][0]["outcomes"] == {"done": 2}
    assert {row["recording"] for row in rows(tmp_path)} == {"first.mcap", "deep/second.mcap"}


@pytest.mark.long
def test_two_settings_are_compared_pair_by_pair(dataflow, folder: Path, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    (runs / "deep").mkdir(parents=True)
    shutil.copy(folder / "runs" / "first.mcap", runs)
    another = runs / "deep" / "second.mcap"  # with times of its own: a copy counts once
    dataflow("run", folder / "graph.yaml", "--record", another, "--path", folder, "--one-process", "-q")
    shutil.copy(another, runs / "third.mcap")
    given = ("--recordings", runs, "--path", folder, "--out", tmp_path / "out", "-q", "--json")
    told = json.loads(dataflow("compare", folder / "graph.yaml", *given, "--set", "b:scaled.by=3").stdout)

    (figure,) = told["figures"]
    assert told["copies"] == {"third.mcap": "deep/second.mcap"}
    assert (figure["figure"], figure["a"], figure["b"]) == ("scaled: total error", 132.0, 198.0)
    assert dict(figure["recordings"]) == {"first.mcap": 66.0, "deep/second.mcap": 66.0}
    assert told["operators"] == [{"operator": "scaled", "recordings": 2, "first": 2}]

    words = ("--set", "b:scaled.by=3", "--explain", "total error")  # the operator that judges is the one that changed
    refused = dataflow("compare", folder / "graph.yaml", *given, *words, "--rerun", tmp_path / "b.rrd", code=2)
    assert "scaled: total error: no operator in front of scaled has other outputs" in refused.stderr

    words = ("--set", "b:scaled.by=3", "--set", "a:scaled.fail_at=5")
    failed = json.loads(dataflow("compare", folder / "graph.yaml", *given, *words, code=1).stdout)
    assert [(one["side"], one["recording"], one["outcome"]) for one in failed["failed"]] == [
        ("a", "deep/second.mcap", "failed"),
        ("a", "first.mcap", "failed"),
        ("a", "third.mcap", "failed"),
    ]
    assert all("operator 'scaled'" in one["error"] for one in failed["failed"])


@pytest.mark.long
def test_a_cluster_makes_the_same_table(sweep: Sweep, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'robot-dataflow[ray]'")
    sweep("--set", "scaled.by=1,3")
    here = rows(tmp_path)
    assert sweep("--set", "scaled.by=1,3", "--again", "--ray", "local", "--jobs", "2")["ran"] == 4
    assert without_times(rows(tmp_path)) == without_times(here)
