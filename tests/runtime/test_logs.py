"""What operators log and print has its level, operator and event time: on the terminal, in the recording, for tools."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from background_run import Background
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.client.attach import find_running
from dataflow.graph import Graph, load_text
from dataflow.recording import LogLine, Recording
from dataflow.recording.streams.diff import diff
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.run import replay
from dataflow.supervision.supervisor import Supervisor
from dataflow.transport.registry import registry_folder

EVERY = 20
FIRST = 1_000_000_000 + (EVERY - 1) * 10_000_000
"""The stamp of the firing at which the first word is said."""


def graph(**params: object) -> Graph:
    words = ", ".join(f"{key}: {value}" for key, value in ({"every": EVERY} | params).items())
    return load_text(
        "graph: talk\nnamespace: test\noperators:\n"
        "  left: {use: runtime_operators:Counter, params: {count: 40, ratio: 5}}\n"
        f"  talker: {{use: talking_operators:Talker, inputs: {{x: left/fast}}, params: {{{words}}}}}\n"
        "  other: {use: runtime_operators:Smooth, inputs: {x: left/fast}}\n"
    )


def call(*words: object, code: int = 0):
    outcome = CliRunner().invoke(app, [str(word) for word in words])
    assert outcome.exit_code == code, (outcome.stdout, outcome.stderr, outcome.exception)
    return outcome


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[tuple[str, str]]]:
    """A recording of a run in one process, and what the terminal was shown."""
    path = tmp_path_factory.mktemp("logs") / "talk.mcap"
    shown: list[tuple[str, str]] = []
    plan = RunPlan(graph(), record=path, placement="one_process")
    Supervisor(plan, on_output=lambda label, line: shown.append((label, line))).run()
    return path, shown


def lines_of(path: Path) -> list[LogLine]:
    with Recording(path) as opened:
        return [line for _, line in opened.logs()]


def test_log_lines_of_all_kinds_are_recorded_with_level_operator_and_event_time(recorded) -> None:
    said = [line for line in lines_of(recorded[0]) if line.stamp == FIRST]

    assert {(line.level, line.text, line.source) for line in said} >= {
        ("warning", "word 1", "talking_operators.Talker"),
        ("info", "printed", "stdout"),
        ("warning", "to stderr", "stderr"),
        ("error", "two\nlines", "some.library"),
    }
    assert any("old function" in line.text and line.source == "py.warnings" for line in said)
    assert {line.operator for line in said} == {"talker"}
    assert all(line.time > 1e18 for line in said)
    assert next(line for line in said if line.text == "word 1").file.endswith("talking_operators.py")


def test_log_lines_outside_of_firings_and_of_python_are_recorded(recorded) -> None:
    said = {line.text: line for line in lines_of(recorded[0])}

    assert (said["ready to talk"].operator, said["ready to talk"].stamp) == ("talker", None)
    assert said["from a library outside of Python"].level == "info"
    assert "good night" in said
    assert "not shown unless asked for" not in said


def test_the_lines_lie_at_event_time_as_messages_that_foxglove_shows(recorded) -> None:
    from mcap.reader import make_reader

    with recorded[0].open("rb") as file:
        found = [
            (schema.name, message.log_time, json.loads(message.data))
            for schema, _, message in make_reader(file).iter_messages(topics=["test/@/logs"])
        ]
    assert {name for name, _, _ in found} == {"foxglove.Log"}
    assert all(at >= 1_000_000_000 for _, at, _ in found)
    word = next((at, value) for _, at, value in found if value["message"] == "word 1")
    assert word[0] == FIRST
    assert (word[1]["level"], word[1]["name"]) == (3, "talker")


def test_the_terminal_is_shown_the_lines_with_levels_from_warnings_on(recorded) -> None:
    _, shown = recorded
    texts = [line for _, line in shown]

    assert "ready to talk" in texts
    assert "warning: word 1" in texts
    assert texts[texts.index("error: two") + 1] == "error: lines"
    assert not any("\x1e" in line or "{" in line for line in texts)


@pytest.mark.long
def test_a_replay_of_a_run_that_talks_is_the_same(recorded, tmp_path: Path) -> None:
    path, again = recorded[0], tmp_path / "again.mcap"
    replay(path, graph=graph(), record=again, placement="process_each")
    with Recording(path) as a, Recording(again) as b:
        assert diff(a, b).same
    assert {line.text for line in lines_of(again)} == {line.text for line in lines_of(path)}


def test_the_command_chooses_lines_of_a_recording(recorded) -> None:
    path = recorded[0]
    worse = [json.loads(line) for line in call("logs", path, "--level", "error", "--json").stdout.splitlines()]
    assert {line["text"] for line in worse} == {"two\nlines"}
    assert "warning  talker  word 2" in call("logs", path, "--operator", "talker", "--last", 12).stdout
    nobody = call("logs", path, "--operator", "talkr", "--operator", "talker", "--level", "fatal").stderr
    assert "nothing was logged" in nobody
    assert "no operator or process 'talkr' is in the recording: did you mean 'talker'?" in nobody
    assert "'talker' is in" not in nobody
    assert "expected one of debug" in call("logs", path, "--level", "loud", code=2).stderr
    assert "about a running graph" in call("logs", path, "--follow", code=2).stderr


@pytest.mark.long
def test_lines_of_a_recording_are_drawn_with_the_rest(recorded, tmp_path: Path) -> None:
    saved = tmp_path / "talk.rrd"
    assert "could not" not in call("view", recorded[0], "--to", saved).stdout
    assert b"ready to" in saved.read_bytes()  # the first time: later words are packed


@pytest.mark.long
def test_a_running_graph_shows_its_log_and_leaves_none_behind(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    background = Background(graph(every=1, wait=0.05), view_file=tmp_path / "talk.rrd")
    find_running("talk", wait=30)

    told = call("logs", "--follow", "--json", "--wait", 30).stdout

    background.end()
    assert {"ready to talk", "word 1", "word 40"} <= {json.loads(line)["text"] for line in told.splitlines()}
    assert b"ready to" in (tmp_path / "talk.rrd").read_bytes()  # the first time: later words are packed
    assert not [file.name for file in registry_folder().iterdir() if ".log" in file.name]


@pytest.mark.long
def test_the_least_level_is_chosen_with_the_run(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("DATAFLOW_LOG_LEVEL", "error")  # restored afterwards: the option sets it
    file, path = tmp_path / "talk.yaml", tmp_path / "talk.mcap"
    file.write_text(
        "graph: talk\noperators:\n  left: {use: runtime_operators:Counter, params: {count: 20, ratio: 5}}\n"
        "  talker: {use: talking_operators:Talker, inputs: {x: left/fast}}\n"
    )
    call("run", file, "--record", path, "--log-level", "debug", "-q")
    assert "not shown unless asked for" in {line.text for line in lines_of(path)}
    assert "expected one of debug" in call("run", file, "--log-level", "loud", code=2).stderr
