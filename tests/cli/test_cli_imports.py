"""Nothing is imported from where one stands, or because a recording names it, unless a command has to run it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

OWN = """\
from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Source


class Own(Source):
    \"\"\"A source of one's own.\"\"\"

    made: Out[FeatureVector] = Out(doc="numbers")

    def stream(self):
        for stamp in range(1, 4):
            yield {"made": FeatureVector(stamp=stamp, vectors=[[stamp]], model="m")}


class Same(Operator):
    \"\"\"Hands on what it is given.\"\"\"

    x: In[FeatureVector] = In(doc="numbers")
    y: Out[FeatureVector] = Out(doc="the same")

    def process(self, x):
        return x
"""


GRAPH = """\
graph: own
operators:
  a: {use: "own_operators:Own"}
  b: {use: "own_operators:Same", inputs: {x: a/made}}
"""


def run(folder: Path, *words: object, safe: Sequence[str] = ("-P",)) -> subprocess.CompletedProcess[str]:
    """The command as the console script runs it, in `folder`; `safe`: what keeps Python from looking there first."""
    package = Path(__file__).resolve().parents[2]
    environment = {**os.environ, "PYTHONPATH": str(package)}
    command = [sys.executable, *safe, "-m", "dataflow.cli.main", *map(str, words)]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=60)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A graph with a module of its own beside it, and a recording of it made from another folder."""
    folder = tmp_path_factory.mktemp("robot")
    (folder / "own_operators.py").write_text(OWN)
    graph = folder / "own.yaml"
    graph.write_text(GRAPH)
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    recording = elsewhere / "own.mcap"
    told = run(elsewhere, "run", graph, "--record", recording, "-q", "--json")
    assert told.returncode == 0, told.stderr
    assert json.loads(told.stdout)["streams"]["own/a/made"]["messages"] == 3
    return graph, recording


def hijacking(folder: Path) -> Path:
    """A folder with files that bear the names of modules which every command imports, at once and later."""
    for name in ("typer", "secrets"):
        (folder / f"{name}.py").write_text("print('hijacked')\nraise RuntimeError('hijacked')\n")
    return folder


@pytest.mark.long
@pytest.mark.parametrize("command", ["list", "info", "diff", "check", "show", "run"])
def test_a_file_where_one_stands_replaces_no_module(made: tuple[Path, Path], tmp_path: Path, command: str) -> None:
    graph, recording = made
    words: dict[str, list[Any]] = {
        "info": [recording],
        "diff": [recording, recording],
        "run": [graph, "-q"],
        "list": [],
    }
    told = run(hijacking(tmp_path), command, *words.get(command, [graph]))

    assert told.returncode == 0, told.stderr
    assert "hijacked" not in told.stdout + told.stderr


@pytest.mark.long
def test_nor_where_the_command_is_called_as_a_module(made: tuple[Path, Path], tmp_path: Path) -> None:
    """Python puts the current folder first on the path then."""
    told = run(hijacking(tmp_path), "info", made[1], safe=())

    assert told.returncode == 0, told.stderr
    assert "hijacked" not in told.stdout + told.stderr


@pytest.mark.long
def test_a_recording_is_replayed_with_modules_of_a_named_folder(made: tuple[Path, Path], tmp_path: Path) -> None:
    graph, recording = made
    lost = run(tmp_path, "verify", recording, "-q")
    assert lost.returncode == 2
    assert "no module 'own_operators'" in lost.stderr
    assert f"looked among the installed packages and in {tmp_path}; --path DIR names another folder" in lost.stderr

    assert run(tmp_path, "verify", recording, "--path", graph.parent, "-q").returncode == 0
    assert run(tmp_path, "replay", recording, "--path", graph.parent, "-q").returncode == 0
    assert "no such folder" in run(tmp_path, "replay", recording, "--path", "nowhere").stderr


@pytest.mark.long
def test_looking_at_a_recording_imports_none_of_its_modules(made: tuple[Path, Path], tmp_path: Path) -> None:
    _, recording = made
    (tmp_path / "own_operators.py").write_text("raise RuntimeError('imported')\n")
    saved = tmp_path / "own.rrd"

    for words in (
        ["info", recording],
        ["diff", recording, recording],
        ["latency", recording],
        ["lint", recording],
        ["convert", recording, tmp_path / "again.mcap", "--to", "mcap"],
        ["view", recording, "--to", saved],
    ):
        told = run(tmp_path, *words)
        assert told.returncode == 0, told.stderr
        assert "imported" not in told.stderr
    assert saved.is_file()


LOADED = """\
import contextlib, sys
from dataflow.cli.app import call
with contextlib.suppress(SystemExit):
    call()
print(*sys.modules, file=sys.stderr)
"""


@pytest.mark.long
@pytest.mark.parametrize("name", ["CloudBuilder", "EkfFusion", "operators.evaluation:ConsistencyMetrics", ""])
def test_describing_operators_loads_no_large_library(tmp_path: Path, name: str) -> None:
    package = Path(__file__).resolve().parents[2]
    told = subprocess.run(
        [sys.executable, "-P", "-c", LOADED, "operators", *name.split()],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(package)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    loaded = set(told.stderr.split())

    assert name.rpartition(":")[2] in told.stdout
    assert loaded & {"torch", "torchvision", "onnxruntime", "scipy.stats", "pandas", "open3d"} == set()
    if name == "CloudBuilder":
        assert "operators.cloud.cloud_builder" in loaded
        assert loaded & {"operators.cloud.clusterer", "operators.slam.lidar.slam", "scipy.spatial"} == set()
