"""A message type of one's own goes everywhere that the page says, with the page's own code, in real processes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dataflow.graph import Graph, load_graph
from dataflow.messages import base as registry
from dataflow.messages.declaration import Declaration
from dataflow.recording import Recording
from dataflow.recording.layout import DIGESTS
from dataflow.recording.streams.diff import diff
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.supervision.replay import plan_replay
from dataflow.supervision.run import replay, run
from dataflow.verification.verify import verify

BRIGHTNESS = "daylight/photometer/brightness"


@pytest.fixture(scope="module")
def page() -> dict[str, list[str]]:
    """The page's code blocks by language."""
    text = (Path(__file__).parents[2] / "docs" / "own-messages.md").read_text(encoding="utf-8")
    found: dict[str, list[str]] = {}
    for language, code in re.findall(r"```(\w+)\n(.*?)```", text, re.DOTALL):
        found.setdefault(language, []).append(code)
    return found


@pytest.fixture(scope="module")
def folder(page: dict[str, list[str]], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder where the page's files are, importable as long as the tests run."""
    where = tmp_path_factory.mktemp("own")
    (where / "brightness.py").write_text(page["python"][0], encoding="utf-8")
    (where / "daylight.yaml").write_text(page["yaml"][0], encoding="utf-8")
    (where / "out").mkdir()
    (where / "elsewhere").mkdir()
    known = dict(registry._registry)
    sys.path.insert(0, str(where))
    yield where
    sys.path.remove(str(where))
    sys.modules.pop("brightness", None)
    registry._registry.clear()
    registry._registry.update(known)


@pytest.fixture(scope="module")
def graph(folder: Path) -> Graph:
    return load_graph(folder / "daylight.yaml")


@pytest.fixture(scope="module")
def recorded(folder: Path, graph: Graph) -> Path:
    """The page's run, with a viewer file."""
    report = run(graph, record=folder / "out" / "day.mcap", view_file=folder / "out" / "day.rrd")
    assert not report.interrupted
    return folder / "out" / "day.mcap"


def without_the_module(folder: Path, *words: str, **more: Any) -> subprocess.CompletedProcess[str]:
    """Python in another folder, where `brightness` cannot be imported."""
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, *words], cwd=folder / "elsewhere", env=env, capture_output=True, text=True, timeout=60, **more
    )


def test_the_commands_are_those_that_are_tested(page: dict[str, list[str]]) -> None:
    assert [line.split()[1] for line in page["sh"][0].splitlines()] == ["run", "replay", "diff", "verify"]


def test_it_is_recorded_and_drawn(recorded: Path) -> None:
    with Recording(recorded) as recording:
        info = recording.streams[BRIGHTNESS]
        assert (info.count, info.generic, info.message_type.__name__) == (30, False, "Brightness")
        assert dict(recording.digests()) == recording.metadata[DIGESTS]
    assert recorded.with_suffix(".rrd").stat().st_size > 0


def test_it_is_replayed_compared_and_verified(recorded: Path, graph: Graph) -> None:
    again = recorded.with_name("again.mcap")
    replay(recorded, placement="one_process", record=again)
    with Recording(recorded) as a, Recording(again) as b:
        assert diff(a, b).same
    assert verify(recorded).identical


def test_a_recording_opens_where_the_module_is_not(recorded: Path, page: dict[str, list[str]], folder: Path) -> None:
    script = page["python"][1].replace("out/day.mcap", str(recorded))
    done = without_the_module(folder, "-c", script)
    lines = done.stdout.splitlines()
    assert lines[0] == "True", done.stderr
    assert len(lines) == 31
    with Recording(recorded) as recording:
        first = next(recording.messages([BRIGHTNESS]))
    assert lines[1] == f"{first.stamp} {first.message.mean}"


@pytest.mark.long
def test_tools_look_at_it_where_the_module_is_not(recorded: Path, folder: Path) -> None:
    script = (
        "import sys; from dataflow.cli.main import main\n"
        "for words in (['info', *sys.argv[1:]], ['view', *sys.argv[1:], '--to', 'day.rrd'],"
        " ['diff', *sys.argv[1:], *sys.argv[1:]]):\n"
        "    sys.argv[1:], kept = words, sys.argv[1:]\n"
        "    try: main()\n"
        "    except SystemExit as end: assert not end.code, end.code\n"
        "    sys.argv[1:] = kept\n"
        "assert 'operators.sources' not in sys.modules\n"
    )
    done = without_the_module(folder, "-c", script, str(recorded))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "type read from the recording" in done.stdout
    assert "without its module: Brightness" in done.stdout + done.stderr
    assert (folder / "elsewhere" / "day.rrd").stat().st_size > 0


def test_a_changed_type_is_named_with_field_and_forms(recorded: Path, graph: Graph) -> None:
    values = graph.types["Brightness"].to_json()
    values["fields"][2]["dtypes"] = ["int32"]
    changed = replace(graph, types={"Brightness": Declaration.from_json(values)})
    with Recording(recorded) as recording:
        plan_replay(recording, graph, replaced=["camera", "photometer"])
        with pytest.raises(ReplayError, match=r"field 'histogram' is int64 \(8,\) in the recording and int32 \(8,\)"):
            plan_replay(recording, changed, replaced=["camera", "photometer"])


@pytest.mark.long
def test_a_running_graph_is_echoed_where_the_module_is_not(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    words = ["-m", "dataflow.cli.main", "run", "daylight.yaml", "--live", "--set", "camera.frames=100000"]
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "COLUMNS": "200"}
    running = subprocess.Popen([sys.executable, *words], cwd=folder, env=env, stderr=subprocess.PIPE)
    try:
        echo = ("echo", "photometer/brightness", "--wait", "30", "-n", "1", "--json")
        done = without_the_module(folder, "-m", "dataflow.cli.main", *echo)
    finally:
        running.terminate()
        _, errors = running.communicate(timeout=30)
    assert '"type": "Brightness"' in done.stdout, done.stderr + errors.decode()
    assert '"histogram": [' in done.stdout
