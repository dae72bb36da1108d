"""A live graph takes messages from outside through a source that is made for it, and through nothing else."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.client.attach import find_running
from dataflow.graph import GraphError, load_text
from dataflow.messages import Number, Text
from dataflow.operator import Out
from dataflow.recording import Recording
from dataflow.remote import MOST, Remote
from dataflow.supervision.core.report import RunFailed, RunReport
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.run import run
from dataflow.supervision.supervisor import Supervisor
from dataflow.verification.verify import verify

GRAPH = """\
graph: taking
namespace: test
operators:
  left: {use: "runtime_operators:Counter", params: {count: 100000, ratio: 5}}
  desk: {use: "dataflow.remote:Number"}
  other: {use: "dataflow.remote:Text", process: desk}
  smooth: {use: "runtime_operators:Smooth", inputs: {x: left/fast}}
"""


class Live:
    """A live run on a thread of its own, until it is told to stop."""

    def __init__(self, text: str, record: Path | None = None) -> None:
        self.supervisor = Supervisor(RunPlan(load_text(text), live=True, record=record, metadata={}))
        self.report: RunReport | None = None
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        self.report = self.supervisor.run()

    def end(self) -> RunReport:
        self.supervisor.stop()
        self.thread.join(60)
        assert self.report is not None
        return self.report


def call(*words: object, code: int = 0, input: str | None = None):
    outcome = CliRunner().invoke(app, [str(word) for word in words], input=input)
    assert outcome.exit_code == code, (outcome.stdout, outcome.stderr, outcome.exception)
    return outcome


@pytest.fixture
def _registry_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.mark.long
@pytest.mark.usefixtures("_registry_of_its_own")
def test_messages_from_outside_are_taken_recorded_and_verified(tmp_path: Path) -> None:
    path = tmp_path / "taken.mcap"
    background = Live(GRAPH, path)
    find_running("taking", wait=30)

    first = json.loads(call("pub", "desk", "{value: 21.5, unit: m}", "--json").stdout)
    lines = '{"stream": "a/b", "type": "Number", "stamp": 3, "value": 1}\n\n{"value": 2}\n'
    more = [json.loads(line) for line in call("pub", "desk", "-", "--json", input=lines).stdout.splitlines()]
    call("pub", "other", "{text: hello}", "-n", 3, "--rate", 200)

    stamps = [first["stamp"], *(each["stamp"] for each in more)]
    assert stamps == sorted(set(stamps))
    late = call("pub", "desk", "{value: 3}", "--stamp", stamps[0], code=1)
    assert f"is not above {stamps[-1]}" in late.stderr
    for words, told in (
        (("desk", "{vlue: 3}"), "did you mean 'value'?"),
        (("desk", "[3]"), "expected a mapping"),
        (("desk", "{value: far}"), "value"),
        (("dsk", "{value: 3}"), "did you mean 'desk'?"),
        (("smooth", "{value: 3}"), "takes no messages from outside"),
        (("desk", "{value: 3}", "--stamp", -1), "above 0"),
        (("desk", "{value: 3}", "--stamp", 5, "--rate", 5), "leave --rate"),
    ):
        assert told in call("pub", *words, code=2).stderr
    assert background.end().restarts == {}

    with Recording(path) as opened:
        numbers = [(r.stamp, r.message.value) for r in opened.messages(["test/desk/message"])]
        texts = [r.message.text for r in opened.messages(["test/other/message"])]
    assert numbers == list(zip(stamps, [21.5, 1.0, 2.0], strict=True))
    assert texts == ["hello"] * 3
    assert verify(path, graph=load_text(GRAPH)).identical


@pytest.mark.long
@pytest.mark.usefixtures("_registry_of_its_own")
def test_a_run_that_is_not_live_has_no_clock_for_them() -> None:
    with pytest.raises(RunFailed, match="run it with --live"):
        run(load_text(GRAPH))


@pytest.mark.long
@pytest.mark.usefixtures("_registry_of_its_own")
def test_a_graph_without_such_a_source_takes_nothing() -> None:
    text = "\n".join(line for line in GRAPH.splitlines() if "remote" not in line)
    background = Live(text)
    find_running("taking", wait=30)
    assert "takes no messages from outside" in call("pub", "left", "{x: 1}", "--timeout", 1, code=2).stderr
    background.end()


def test_there_is_a_source_for_each_message_type_and_for_no_other_name() -> None:
    load_text("graph: g\noperators:\n  a: {use: 'dataflow.remote:Twist'}\n  b: {use: 'dataflow.remote:Alarm'}\n")
    with pytest.raises(GraphError, match="no operator 'Level'"):
        load_text("graph: g\noperators:\n  a: {use: 'dataflow.remote:Level'}\n")


class Notes(Remote):
    """Two ports are one too many."""

    one: Out[Text] = Out(doc="one")
    two: Out[Text] = Out(doc="two")


class Gauge(Remote):
    """A port of one's own name."""

    reading: Out[Number] = Out(doc="what somebody has read")


def test_a_source_of_ones_own_names_its_port_and_bounds_what_waits() -> None:
    with pytest.raises(TypeError, match="has 2 ports"):
        _ = Notes().port
    gauge = Gauge()
    taken = [gauge.put(Number(stamp=k + 1, value=k)) for k in range(MOST + 1)]
    assert taken == [True] * MOST + [False]
    steps = gauge.stream()
    assert next(steps)["reading"].stamp == 1
    gauge.stop_reading()
    assert sum(1 for _ in steps) <= MOST
