"""`list`, `echo`, `hz` and `view` on a graph that runs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from attached_run import AttachedRun

from dataflow.cli.commands.following.live import _Rate
from dataflow.graph import load_graph
from dataflow.supervision.plan import RunPlan


@pytest.fixture(scope="module")
def running(small: Path) -> Iterator[AttachedRun]:
    """A graph that runs as long as the tests of this file need."""
    graph = load_graph(small, settings=["count=1000000", "sleep=0.02"])
    background = AttachedRun(RunPlan(graph, placement="one_process", window=(8, 1 << 20)))
    yield background
    if background.thread.is_alive():
        background.end()


@pytest.mark.usefixtures("running")
def test_list_shows_the_running_graph_and_its_consumers(dataflow) -> None:
    told = dataflow("list").stdout
    assert f"namespace test, process {os.getpid()}" in told
    assert "smooth.x, gripper.x" in told
    (listed,) = json.loads(dataflow("list", "--json").stdout)
    assert listed["operators"] == ["left", "smooth", "gripper", "sum"]


@pytest.mark.usefixtures("running")
def test_echo_prints_whole_messages_as_lines_of_json(dataflow) -> None:
    lines = dataflow("echo", "left/fast", "-n", 3, "--json").stdout.splitlines()

    messages = [json.loads(line) for line in lines]
    assert [m["stream"] for m in messages] == ["test/left/fast"] * 3
    assert messages[0]["stamp"] < messages[1]["stamp"] < messages[2]["stamp"]
    assert messages[0]["vectors"][0][0] == (messages[0]["stamp"] - 10**9) / 10**7  # the counter's number


@pytest.mark.usefixtures("running")
@pytest.mark.parametrize(
    "words", [["echo", "-n", "1"], ["hz", "--seconds", "0.2"], ["top", "--once"], ["record", "--seconds", "0.2", "-o"]]
)
def test_commands_name_the_followed_graph(dataflow, tmp_path: Path, words: list[str]) -> None:
    told = dataflow(*words, *([tmp_path / "attached.mcap"] if words[0] == "record" else []))

    assert f"following small (process {os.getpid()})" in told.stderr
    assert "following" not in told.stdout


@pytest.mark.usefixtures("running")
def test_the_graph_that_is_meant_may_stand_in_the_environment(dataflow, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATAFLOW_GRAPH", "kitchen")
    assert "no graph 'kitchen' runs on this machine" in dataflow("echo", code=2).stderr
    assert "left/fast" in dataflow("echo", "left/fast", "--graph", "small", "-n", 1).stdout
    assert "total" in dataflow("hz", "--graph", "small", "--seconds", 0.2).stdout


@pytest.mark.usefixtures("running")
def test_echo_prints_fields_for_people(dataflow) -> None:
    told = dataflow("echo", "left/*", "-n", 4).stdout

    assert "test/left/constant  0.000000000s  FeatureVector" in told
    assert "  vectors  [[42.]]" in told


@pytest.mark.usefixtures("running")
def test_echo_prints_one_message_and_the_fields_that_are_asked_for(dataflow) -> None:
    told = dataflow("echo", "left/fast", "--once", "--field", "vectors").stdout.splitlines()
    assert told[0].startswith("test/left/fast  ")
    assert [line.split()[0] for line in told[1:]] == ["vectors"]

    line = json.loads(dataflow("echo", "left/fast", "--once", "-f", "vectors", "-f", "labels", "--json").stdout)
    assert list(line) == ["stream", "type", "stamp", "labels", "vectors"]


@pytest.mark.usefixtures("running")
def test_echo_of_a_field_that_there_is_not_names_the_nearest(dataflow) -> None:
    told = dataflow("echo", "left/fast", "--field", "vectrs", code=2).stderr
    assert "FeatureVector, which has no field 'vectrs': did you mean 'vectors'?" in " ".join(told.split())
    assert "--once is --count 1" in dataflow("echo", "--once", "-n", 3, code=2).stderr


@pytest.mark.usefixtures("running")
def test_echo_into_a_closed_pipe_is_quiet() -> None:
    echo = subprocess.Popen(
        [sys.executable, "-m", "dataflow.cli.main", "echo", "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert echo.stdout is not None
    assert echo.stderr is not None
    assert echo.stdout.readline().startswith(b"{")
    echo.stdout.close()
    told = echo.stderr.read()
    echo.wait(20)

    assert b"Traceback" not in told
    assert b"error" not in told


@pytest.mark.usefixtures("running")
def test_a_stream_that_the_graph_does_not_have_is_refused_at_once(dataflow) -> None:
    for command in (["echo"], ["hz"], ["view", "--to", "x.rrd", "--stream"]):
        assert "did you mean 'left/fast'?" in dataflow(*command, "left/fats", code=2).stderr


@pytest.mark.usefixtures("running")
def test_hz_prints_the_rate_by_stamp(dataflow) -> None:
    rows = json.loads(dataflow("hz", "left/fast", "--seconds", 0.5, "--json").stdout)
    (row,) = rows
    assert row["stream"] == "test/left/fast"
    assert row["hz_event"] == pytest.approx(100.0)
    assert row["hz_clock"] > 0
    (row,) = json.loads(dataflow("hz", "left/fast", "--seconds", 0.5, "--window", 0.2, "--json").stdout)
    assert row["hz_event"] == pytest.approx(100.0)
    assert "--window 0" in dataflow("hz", "--window", 0, code=2).stderr
    told = dataflow("hz", "left/*", "--seconds", 0.3).stdout
    assert "Hz by stamp" in told
    assert "left/fast" in told


def test_rates_over_a_window_ignore_earlier_messages() -> None:
    rate = _Rate()
    for second in range(10):  # ten a second stamped, one a second by the clock, until the last two
        rate.seen.append((float(second), second * 10**8, second, 100))
    rate.seen.append((9.5, 10**9, 10, 100))

    assert rate.row("s")["hz_clock"] == pytest.approx(10 / 9.5)
    rate.forget_before(9.0)
    assert rate.row("s")["hz_clock"] == pytest.approx(2.0)
    assert rate.row("s")["messages"] == 11
    rate.forget_before(100.0)
    assert rate.row("s")["hz_clock"] is None


def test_a_graph_that_does_not_run_is_answered_with_those_that_do(dataflow, running: AttachedRun) -> None:
    told = dataflow("echo", "--graph", "kitchen", code=2).stderr
    assert "no graph 'kitchen' runs on this machine (running: small)" in told
    assert "0 or more" in dataflow("hz", "--wait", "-1", code=2).stderr
    assert running.thread.is_alive()


@pytest.mark.usefixtures("running")
def test_running_graph_is_recorded_by_pattern_without_firing_records(dataflow, tmp_path: Path) -> None:
    told = dataflow("record", "left/*", "-o", tmp_path / "a.mcap", "--seconds", 1)

    assert "without firing records" in told.stderr
    found = json.loads(dataflow("info", tmp_path / "a.mcap", "--json").stdout)
    assert {s["name"] for s in found["streams"] if s["count"]} == {
        f"test/left/{p}" for p in ("constant", "fast", "slow")
    }
    assert "left no firing records" in dataflow("verify", tmp_path / "a.mcap", code=2).stderr


@pytest.mark.usefixtures("running")
def test_trigger_without_flight_recorder_and_invalid_playback_words_are_refused(dataflow) -> None:
    assert "has no flight recorder" in dataflow("trigger", code=2).stderr
    assert "expected pause, resume, step, speed or status" in dataflow("playback", "rewind", code=2).stderr
    assert "expected a factor of real time, or max" in dataflow("playback", "speed", code=2).stderr
    assert "expected a number from 0.001 to 1,000" in dataflow("playback", "speed", 0, code=2).stderr
    assert "expected a whole number" in dataflow("playback", "step", 0, code=2).stderr
    assert "pause takes no '3'" in dataflow("playback", "pause", 3, code=2).stderr


@pytest.mark.usefixtures("running")
def test_run_is_paused_stepped_and_resumed(dataflow) -> None:
    assert dataflow("playback", "pause").stdout.startswith("paused at ")
    before = json.loads(dataflow("playback", "status", "--json").stdout)
    assert before["paused"]
    assert not before["replay"]
    dataflow("playback", "step", 2)
    dataflow("playback", "speed", 1000)
    after = json.loads(dataflow("playback", "resume", "--json").stdout)
    assert (after["paused"], after["speed"]) == (False, 1000.0)
    assert "playing" in (told := dataflow("playback", "speed", "max").stdout)
    assert "as fast as it goes" in told


def test_view_follows_the_graph_to_its_end_and_saves_it(dataflow, running: AttachedRun, tmp_path: Path) -> None:
    """The last test of the file: it ends the graph."""
    saved = tmp_path / "live.rrd"
    threading.Timer(1.0, running.supervisor.stop).start()

    told = dataflow("view", "--graph", "small", "--to", saved, "--stream", "left/*")

    assert f"following small (process {os.getpid()})" in told.stderr
    assert f"wrote {saved} (" in told.stdout
    running.end()
    assert "no graph runs" in dataflow("list").stderr
    assert json.loads(dataflow("list", "--json").stdout) == []
