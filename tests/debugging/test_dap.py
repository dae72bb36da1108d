"""An editor that steps forwards and back sees what a run with prints shows."""

from __future__ import annotations

import importlib
import json
import select
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tampering import Kept, as_it_is, tampered

import dataflow
from dataflow.debugging.dap.session import Session, listen
from dataflow.debugging.debugger import DebugError, Debugger
from dataflow.debugging.fired import Abandoned, Probe
from dataflow.debugging.lines import homes_of, is_own, source_parts, stoppable_line
from dataflow.messages.base import Message
from dataflow.recording import Recorded, Recording
from dataflow.sync import Firing

Run = tuple[Recording, Path]
"""A recording, and the source file of its operator."""

SOURCE = '''
from dataclasses import dataclass

import numpy as np

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Source


class Numbers(Source):
    x: Out[FeatureVector]

    def stream(self):
        for k in range(12):
            vectors = np.array([[k, k * k]], np.float32)
            yield {"x": FeatureVector(stamp=1_700_000_000_000_000_000 + k * 100_000_000, vectors=vectors, model="made")}


@dataclass
class State:
    total: float = 0.0


def clipped(value, most):
    if value > most:
        value = most
    return value


class Adder(Operator):
    """Adds up."""

    x: In[FeatureVector]
    total: Out[FeatureVector]
    state: State

    def process(self, x):
        added = 0.0
        for value in x.vectors[0].tolist():
            added += clipped(value, 50.0)
        self.state.total += added
        return {"total": FeatureVector(stamp=x.stamp, vectors=np.array([[self.state.total]], np.float32), model="made")}
'''
LINES = {text.strip(): number for number, text in enumerate(SOURCE.splitlines(), 1)}
ADDED = LINES["added += clipped(value, 50.0)"]
CLIPS = LINES["value = most"]
FIRST = LINES["added = 0.0"]
TOTAL = LINES["self.state.total += added"]

WATCHED = {"added", "value", "most"}


class Client:
    """An editor: requests, and what comes of them."""

    def __init__(self, connection: socket.socket, file: Path) -> None:
        connection.settimeout(60)
        self._stream = connection.makefile("rwb")
        self._file, self._seq = file, 0
        self.told: list[str] = []

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        answer = self.request(command, **arguments)
        assert answer["success"], answer
        return dict(answer["body"])

    def request(self, command: str, **arguments: Any) -> dict[str, Any]:
        self._send(command, arguments)
        self._stream.flush()
        return self._answer()

    def at_once(self, *commands: str, **arguments: Any) -> tuple[str, int]:
        """The stop that comes of requests which are all there before the first one is answered, which has arguments."""
        for k, command in enumerate(commands):
            self._send(command, {} if k else arguments)
        self._stream.flush()
        self._seq -= len(commands)
        for _ in commands:
            self._seq += 1
            assert self._answer()["success"]
        return self.stopped()

    def _send(self, command: str, arguments: dict[str, Any]) -> None:
        self._seq += 1
        data = json.dumps({"seq": self._seq, "type": "request", "command": command, "arguments": arguments}).encode()
        self._stream.write(b"Content-Length: %d\r\n\r\n" % len(data) + data)

    def _answer(self) -> dict[str, Any]:
        while (message := self._read())["type"] != "response":
            self._note(message)
        assert message["request_seq"] == self._seq
        return message

    def stopped(self) -> tuple[str, int]:
        """The reason and the line of the next stop."""
        while (message := self._read())["event"] != "stopped":
            self._note(message)
        return message["body"]["reason"], self.line()

    def begin(self, *breakpoints: int, **more: str) -> tuple[str, int]:
        """Sets breakpoints, says that all is set, and waits for the first stop."""
        if breakpoints:
            self.breakpoints(*breakpoints, **more)
        return self.go("configurationDone")

    def go(self, command: str) -> tuple[str, int]:
        self.ask(command)
        return self.stopped()

    def line(self) -> int:
        return int(self.frames()[0]["line"])

    def frames(self) -> list[dict[str, Any]]:
        return list(self.ask("stackTrace", threadId=1)["stackFrames"])

    def call(self) -> int:
        return int(self.ask("threads")["threads"][0]["name"].split(" call ")[1].split()[0])

    def variables(self) -> dict[str, str]:
        frame = self.frames()[0]["id"]
        scope = self.ask("scopes", frameId=frame)["scopes"][0]["variablesReference"]
        return {each["name"]: each["value"] for each in self.parts(scope)}

    def parts(self, reference: int) -> list[dict[str, Any]]:
        return list(self.ask("variables", variablesReference=reference)["variables"])

    def value(self, expression: str, **more: Any) -> str:
        return str(self.ask("evaluate", expression=expression, frameId=1, **more)["result"])

    def seen(self) -> tuple[int, int, dict[str, str]]:
        """The call, the line and the watched variables, as `printed` has them."""
        return self.call(), self.line(), {n: v for n, v in self.variables().items() if n in WATCHED}

    def breakpoints(self, *lines: int, **more: str) -> list[dict[str, Any]]:
        wanted = [{"line": line, **more} for line in lines]
        told = self.ask("setBreakpoints", source={"path": str(self._file)}, breakpoints=wanted)
        return list(told["breakpoints"])

    def _read(self) -> dict[str, Any]:
        length = int(self._stream.readline().split(b":")[1])
        self._stream.readline()
        return dict(json.loads(self._stream.read(length)))

    def _note(self, message: dict[str, Any]) -> None:
        if message["event"] == "output":
            self.told.append(message["body"]["output"].strip())


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    folder = tmp_path_factory.mktemp("dap") / "site-packages"
    folder.mkdir()
    (folder / "stepped_adder.py").write_text(SOURCE)
    sys.path.insert(0, str(folder))
    module = importlib.import_module("stepped_adder")
    graph = dataflow.Graph().add("numbers", module.Numbers).add("adder", module.Adder)
    graph.connect("adder", x="numbers/x").run(record=folder / "run.mcap")
    with Recording(folder / "run.mcap") as recording:
        yield recording, folder / "stepped_adder.py"
    sys.path.remove(str(folder))
    del sys.modules["stepped_adder"]


@contextmanager
def editing(recorded: Run, first: int = 0, **arguments: Any) -> Iterator[Client]:
    """An editor that has said how it begins, and no breakpoints yet."""
    failures: list[BaseException] = []
    listening = listen(0)

    def serve() -> None:
        try:
            connection, _ = listening.accept()
            debugger = Debugger(recorded[0], "adder")
            with connection:
                Session(connection, debugger, first).serve()
            debugger.close()
        except BaseException as error:
            failures.append(error)

    server = threading.Thread(target=serve, daemon=True)
    server.start()
    with listening, socket.create_connection(listening.getsockname()) as connection:
        client = Client(connection, recorded[1])
        assert client.ask("initialize", adapterID="test")["supportsStepBack"]
        client.ask("launch", **arguments)
        yield client
        client.ask("disconnect")
    server.join(60)
    assert not server.is_alive()
    assert failures == []


def printed() -> list[tuple[int, int, dict[str, str]]]:
    """What prints at the beginning of each line of the source show, over all calls: call, line, variables.

    It is written by hand beside the source, and does what the source does.
    """
    told: list[tuple[int, int, dict[str, str]]] = []
    for call in range(12):
        known: dict[str, str] = {}

        def at(text: str, call: int = call, known: dict[str, str] = known) -> None:
            told.append((call, LINES[text], dict(known)))

        at("added = 0.0")
        added = 0.0
        known["added"] = repr(added)
        at("for value in x.vectors[0].tolist():")
        for value in (float(call), float(call * call)):
            known["value"] = repr(value)
            at("added += clipped(value, 50.0)")
            outside = dict(known)
            known.clear()
            known |= {"value": repr(value), "most": "50.0"}
            at("if value > most:")
            if value > 50.0:
                at("value = most")
                known["value"] = "50.0"
            at("return value")
            added += min(value, 50.0)
            known.clear()
            known |= outside | {"added": repr(added)}
            at("for value in x.vectors[0].tolist():")
        at("self.state.total += added")
        at(next(text for text in LINES if text.startswith('return {"total"')))
    return told


def test_breakpoints_and_variables_are_those_of_a_run_with_prints(recorded: Run) -> None:
    with editing(recorded, stopOnEntry=False) as client:
        assert [each["line"] for each in client.breakpoints(CLIPS, TOTAL)] == [CLIPS, TOTAL]
        client.ask("configurationDone")
        seen = []
        while (reason := client.stopped()[0]) == "breakpoint":
            seen.append(client.seen())
            client.ask("continue")
        assert reason == "end of the recording"
        assert seen == [each for each in printed() if each[1] in (CLIPS, TOTAL)]
        assert [line for line in client.told if "not as recorded" in line] == []
        assert client.told[0] == "call 0: as recorded, digest by digest"
        assert "this was the last call; at its last line again" in client.told


def test_steps_forwards_and_back_are_the_lines_of_a_run_with_prints(recorded: Run) -> None:
    expected = printed()
    first = next(n for n, each in enumerate(expected) if each[0] == 7)
    with editing(recorded, first=7) as client:
        assert client.begin()[0] == "entry"
        seen = [client.seen()]
        for _ in range(16):
            client.go("stepIn")
            seen.append(client.seen())
        assert seen == expected[first : first + 17]
        assert seen[-1][0] == 8  # into the next call
        for back in range(1, 6):
            assert client.go("stepBack")[0] == "step"
            assert client.seen() == expected[first + 16 - back]
        client.go("stepIn")
        assert client.seen() == expected[first + 12]


def test_a_breakpoint_is_hit_in_a_later_call_after_a_step_back(recorded: Run) -> None:
    with editing(recorded, stopOnEntry=False) as client:
        client.begin(TOTAL)
        client.go("stepBack")
        assert [client.go("continue") for _ in range(3)] == [("breakpoint", TOTAL)] * 3
        assert client.call() == 2


def test_reverse_continue_goes_to_earlier_hits(recorded: Run) -> None:
    hits = [each for each in printed() if each[1] in (CLIPS, ADDED)]
    with editing(recorded, first=9, stopOnEntry=False) as client:
        client.breakpoints(CLIPS, ADDED)
        client.ask("configurationDone")
        while client.stopped() and client.seen() != (9, CLIPS, {"value": "81.0", "most": "50.0"}):
            client.ask("continue")
        before = hits[: hits.index(client.seen())]
        for expected in reversed(before[-8:]):
            assert client.go("reverseContinue")[0] == "breakpoint"
            assert client.seen() == expected
        client.breakpoints()
        assert client.go("reverseContinue")[0] == "entry"
        assert client.seen() == printed()[0]


def test_a_condition_stops_where_it_is_true_forwards_and_back(recorded: Run) -> None:
    expected = [each for each in printed() if each[1] == ADDED and float(each[2]["value"]) > 60]
    with editing(recorded, stopOnEntry=False) as client:
        client.begin(ADDED, condition="value > 60")
        forwards = [client.seen()]
        for _ in range(2):
            client.go("continue")
            forwards.append(client.seen())
        assert forwards == expected[:3]
        client.go("reverseContinue")
        assert client.seen() == expected[1]


@pytest.mark.parametrize(("hits", "values"), [("2", [1.0, 4.0]), (">= 1", [0.0, 0.0, 1.0]), ("%2", [1.0, 4.0])])
def test_a_hit_count_counts_the_passes_of_a_call_forwards_and_back(
    recorded: Run, hits: str, values: list[float]
) -> None:
    with editing(recorded, 0 if hits == ">= 1" else 1) as client:
        client.begin(ADDED, condition="value >= 0", hitCondition=hits)

        stops = [client.go("continue") and float(client.value("value")) for _ in values]

        assert stops == values
        assert client.go("reverseContinue") == ("breakpoint", ADDED)
        assert float(client.value("value")) == values[-2]


def test_hit_counts_continue_when_breakpoints_are_set_again(recorded: Run) -> None:
    with editing(recorded, 1, stopOnEntry=False) as client:
        client.begin(ADDED, hitCondition="1")
        assert client.call() == 1

        client.breakpoints(ADDED, hitCondition="1")

        client.go("continue")
        assert client.call() == 2


def test_condition_that_raises_is_reported_once(recorded: Run) -> None:
    with editing(recorded, 1, stopOnEntry=False) as client:
        client.begin(ADDED, condition="nothing > 1", hitCondition="1")
        assert sum("raises NameError" in text for text in client.told) == 1


def test_a_log_point_prints_once_and_does_not_stop(recorded: Run) -> None:
    with editing(recorded, 2) as client:
        client.begin(ADDED, condition="value > 2", logMessage='adds {value:.2f} to "{added}"')
        assert client.go("stepOut") == ("entry", FIRST)  # of the next call
        assert client.go("stepBack")[0] == "step"
        assert [text for text in client.told if text.startswith("adds")] == ['adds 4.00 to "2.0"']
        client.go("reverseContinue")
        assert client.call() == 0


def test_steps_over_and_out_stay_in_the_frame_and_leave_it(recorded: Run) -> None:
    with editing(recorded, first=3) as client:
        client.begin()
        over = [client.go("next")[1] for _ in range(8)]
        loop = LINES["for value in x.vectors[0].tolist():"]
        assert over == [loop, ADDED, loop, ADDED, loop, TOTAL, TOTAL + 1, LINES["added = 0.0"]]
        assert client.call() == 4
        client.breakpoints(LINES["if value > most:"])
        client.go("continue")
        assert [frame["name"] for frame in client.frames()] == ["clipped", "process"]
        client.breakpoints()
        assert client.go("stepOut")[1] == loop
        assert client.seen()[2] == {"added": "4.0", "value": "4.0"}


def test_values_are_opened_and_expressions_evaluated(recorded: Run) -> None:
    with editing(recorded, first=5) as client:
        client.begin()
        assert client.value("float(x.vectors[0, 1])") == "25.0"
        assert client.value("self.state.total") == str(float(sum(k + k * k for k in range(5))))
        told = client.ask("evaluate", expression="self.state", frameId=1)
        assert [each["name"] for each in client.parts(told["variablesReference"])] == ["total"]
        vectors = client.ask("evaluate", expression="x", frameId=1)["variablesReference"]
        assert "vectors" in {each["name"] for each in client.parts(vectors)}
        failed = client.request("evaluate", expression="nothing_such", frameId=1)
        assert not failed["success"]
        assert "nothing_such" in failed["message"]
        assert not client.request("variables", variablesReference=9999)["success"]
        assert not client.request("dataBreakpointInfo")["success"]
        client.ask("evaluate", expression="goto 11", context="repl", frameId=1)
        assert client.stopped()[0] == "entry"
        assert client.seen() == next(each for each in printed() if each[0] == 11)


@pytest.mark.parametrize("text", ["foo bar", "left = nothing_such", "raise SystemExit", "raise OSError(2, 'no')"])
def test_console_error_leaves_the_call_where_it_is(recorded: Run, text: str) -> None:
    with editing(recorded, first=5) as client:
        client.begin()
        assert not client.request("evaluate", expression=text, context="repl", frameId=1)["success"]
        assert client.line() == LINES["added = 0.0"]
        assert client.go("next") == ("step", LINES["for value in x.vectors[0].tolist():"])


def test_assigned_variables_are_those_of_the_frame(recorded: Run) -> None:
    with editing(recorded, first=5, stopOnEntry=False) as client:
        client.begin(LINES["if value > most:"])
        client.value("value = 40.0", context="repl")
        client.ask("evaluate", expression="value = 7.0", context="repl", frameId=2)
        assert client.variables()["value"] == "40.0"
        assert client.value("value") == "40.0"
        client.breakpoints()
        client.go("stepOut")
        assert client.seen()[2] == {"added": "40.0", "value": "7.0"}


def test_breakpoint_that_cannot_be_set_has_a_reason(recorded: Run) -> None:
    with editing(recorded) as client:
        doc = LINES['"""Adds up."""']
        for before in (doc + 1, LINES["class Adder(Operator):"]):
            (told,) = client.breakpoints(before)
            assert (told["verified"], "runs before the first recorded call" in told["message"]) == (False, True)
        assert client.breakpoints(LINES["def clipped(value, most):"]) == [{"verified": True, "line": CLIPS - 1}]
        (beyond,) = client.breakpoints(4000)
        assert not beyond["verified"]
        told = client.ask("setBreakpoints", source={"path": np.__file__}, breakpoints=[{"line": 1}])
        assert "not for libraries" in told["breakpoints"][0]["message"]
        for more in ({"condition": "value >"}, {"hitCondition": "often"}, {"hitCondition": "0"}, {"logMessage": "{"}):
            (wrong,) = client.breakpoints(ADDED, **more)
            assert not wrong["verified"]
            assert next(iter(more.values())) in wrong["message"]
        client.begin()


BEGUN = """LIMIT = 3


class Robot:
    size: int = 4

    def setup(self):
        self.limit = LIMIT
        self.bound = lambda x: min(x, self.limit)

    @property
    def wide(
        self,
    ):
        class Inner:
            width = 3

        return [
            Inner.width,
        ]
"""


@pytest.mark.parametrize(
    ("wanted", "line"), [(1, 0), (4, 0), (5, 0), (7, 0), (8, 0), (9, 9), (11, 15), (12, 15), (16, 16), (19, 19)]
)
def test_breakpoints_are_for_lines_that_calls_run(tmp_path: Path, wanted: int, line: int) -> None:
    file = tmp_path / "begun.py"
    file.write_text(BEGUN)
    if line:
        assert stoppable_line(str(file), wanted, "Robot.setup") == line
        return
    with pytest.raises(LookupError, match=f"line {wanted} runs before the first recorded call"):
        stoppable_line(str(file), wanted, "Robot.setup")


def test_state_changed_by_hand_is_reported_and_does_not_reach_the_next_call(recorded: Run) -> None:
    with editing(recorded, first=2) as client:
        client.begin()
        client.value("setattr(self.state, 'total', 7.0)", context="repl")
        client.breakpoints(TOTAL)
        client.go("continue")
        client.go("continue")
        assert (client.call(), client.value("self.state.total")) == (3, str(float(sum(k + k * k for k in range(3)))))
        client.go("continue")
        assert client.told[-2:] == [
            "call 2: not as recorded, differs in total",
            "call 3: as recorded, digest by digest",
        ]


def test_pause_is_noticed_between_calls_forwards_and_back(recorded: Run) -> None:
    with editing(recorded, stopOnEntry=False) as client:
        assert client.at_once("configurationDone", "pause")[0] == "pause"
        assert client.call() == 0
    with editing(recorded, first=11) as client:
        client.begin()
        assert client.at_once("reverseContinue", "pause")[0] == "pause"


def test_a_pause_ends_a_way_to_a_call_far_away(recorded: Run) -> None:
    with editing(recorded) as client:
        client.begin()
        goto = {"expression": "goto 11", "context": "repl", "frameId": 1}
        assert client.at_once("evaluate", "pause", **goto)[0] == "pause"
        assert client.call() < 11


def test_pause_on_the_way_stops_there_even_if_few_calls_are_kept(
    recorded: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = Session._look_on_the_way

    def paused(session: Session) -> None:
        session._pauses = session._pauses or session._debugger.reached == 6
        look(session)

    monkeypatch.setattr("dataflow.debugging.ring.MOST_CALLS", 2)
    monkeypatch.setattr(Session, "_look_on_the_way", paused)
    with editing(recorded) as client:
        client.begin()
        client.value("goto 11", context="repl")
        assert client.stopped()[0] == "pause"
        assert client.call() == 7


def test_a_pause_behind_the_last_call_stops_too(recorded: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    with editing(recorded, first=11) as client:
        client.begin()

        def broken_off(session: Session, *_: object) -> None:
            monkeypatch.undo()
            session._debugger._made_on_the_way(3, None)
            session._pauses = True
            raise Abandoned

        monkeypatch.setattr(Session, "_last", broken_off)
        client.ask("continue")
        assert client.stopped()[0] == "pause"
        assert client.call() == 4


def test_calls_are_made_once_on_the_way_and_twice_back_to_the_beginning(
    recorded: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    process = Probe.process

    def counted(probe: Probe, firing: Firing) -> dict[str, Message]:
        made.append(firing.stamp)
        return process(probe, firing)

    monkeypatch.setattr(Probe, "process", counted)
    with editing(recorded, stopOnEntry=False) as client:
        client.breakpoints(LINES["added = 0.0"])
        client.ask("configurationDone")
        for _ in range(11):
            client.stopped()
            client.value("self.state.total")
            client.ask("continue")
        client.stopped()
        assert len(made) == 12
    made.clear()
    with editing(recorded, first=11) as client:
        client.begin()
        assert len(made) == 12
        client.breakpoints()
        assert client.go("reverseContinue") == ("entry", LINES["added = 0.0"])
        assert len(made) < 12 + 2 * 12 + 4


def test_source_of_installed_package_is_the_operators_own(recorded: Run) -> None:
    """The operator of this file lies among installed packages."""
    engine, installed = Path(dataflow.__file__).resolve().parent, recorded[1].resolve()
    assert homes_of("stepped_adder") == (installed,)
    assert homes_of("dataflow.debugging.lines") == (engine,)
    assert is_own(str(installed), (installed.parent,))
    assert not is_own(str(installed), (installed.parent / "other",))
    assert is_own(__file__, ())
    assert not is_own(str(engine / "operator.py"), (engine,))


def test_restart_takes_over_edited_source(recorded: Run) -> None:
    file = recorded[1]
    with editing(recorded, first=6) as client:
        client.begin()
        try:
            file.write_text(SOURCE.replace("added = 0.0", "added = 0.5"))
            assert client.go("restart")[0] == "entry"
            client.go("next")
            assert client.value("added") == "0.5"
            assert "taken over: stepped_adder" in client.told
        finally:
            file.write_text(SOURCE)
        client.go("restart")
        client.go("next")
        assert client.value("added") == "0.0"


@pytest.mark.parametrize("head", ["GET / HTTP/1.1\r\nHost: here", "POST /a:b HTTP/1.1\r\nContent-Length: %d"])
def test_other_protocols_end_the_session(recorded: Run, head: str) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        body = json.dumps({"seq": 1, "type": "request", "command": "configurationDone"})
        theirs.sendall(f"{head.replace('%d', str(len(body)))}\r\n\r\n{body}".encode())
        theirs.shutdown(socket.SHUT_WR)
        session = Session(ours, Debugger(recorded[0], "adder"), 0)
        session.serve()
        assert session._over
        assert not select.select([theirs], [], [], 0)[0]  # nothing was answered


def test_a_client_that_sends_nothing_ends_the_session(recorded: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dataflow.debugging.dap.session.GREETS", 0.01)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        session = Session(ours, Debugger(recorded[0], "adder"), 0)
        session.serve()
        assert session._over


def test_a_line_behind_the_end_of_the_file_names_the_last_one(recorded: Run) -> None:
    with editing(recorded) as client:
        (told,) = client.breakpoints(100_000)
        client.begin()
    assert not told["verified"]
    last = max(line for part in source_parts(str(recorded[1])) for line in part.lines)
    assert told["message"] == f"no code from line 100000 on: the last line with code is {last}"


@contextmanager
def serving(recording: Recording, file: Path, first: int) -> Iterator[tuple[Client, socket.socket, list[DebugError]]]:
    """A session that has begun, which the block has to bring to an end; its socket, and the errors that it raises."""
    ours, theirs = socket.socketpair()
    debugger, failures = Debugger(recording, "adder"), list[DebugError]()

    def serve() -> None:
        try:
            Session(ours, debugger, first).serve()
        except DebugError as error:
            failures.append(error)

    with ours, theirs:
        client = Client(theirs, file)
        server = threading.Thread(target=serve, daemon=True)
        server.start()
        for command in ("initialize", "launch", "configurationDone"):
            client.ask(command)
        yield client, theirs, failures
        while (message := client._read())["event"] != "terminated":
            client._note(message)
        server.join(60)
    debugger.close()
    assert not server.is_alive()


def test_malformed_message_ends_session_without_a_verdict_on_the_call(recorded: Run) -> None:
    with serving(*recorded, 3) as (client, theirs, _):
        client.stopped()
        theirs.sendall(b"Content-Length: 5\r\n\r\nhello")
    assert [text for text in client.told if "not as recorded" in text] == []
    assert "the session ends: no message of the Debug Adapter Protocol" in client.told[-1]


@pytest.fixture(scope="module")
def torn(recorded: Run, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Recording]:
    """The recording without what the calls from 9 on were given."""

    def before_the_end(found: Recorded) -> Kept:
        return [] if found.stream.endswith("numbers/x") and found.seq >= 9 else as_it_is(found)

    file = tmp_path_factory.mktemp("torn") / "torn.mcap"
    with Recording(tampered(Path(recorded[0].path), file, messages=before_the_end)) as recording:
        yield recording


def test_running_on_stops_before_a_call_that_cannot_be_made(recorded: Run, torn: Recording) -> None:
    with editing((torn, recorded[1]), 7, stopOnEntry=False) as client:
        assert client.begin()[0] == "end of the recording"
        assert client.call() == 8
        assert any("call 9 of adder cannot be made again: graph/numbers/x #9 is not recorded" in t for t in client.told)
        assert client.go("stepBack")[0] == "step"
        assert client.call() == 8


def test_first_call_that_cannot_be_made_ends_session_with_the_reason(recorded: Run, torn: Recording) -> None:
    with serving(torn, recorded[1], 10) as (client, _, failures):
        pass
    assert "call 10 of adder cannot be made again" in client.told[-1]
    assert len(failures) == 1


@pytest.fixture
def edited(recorded: Run) -> Iterator[Path]:
    """The file of the operator, which may be edited."""
    yield recorded[1]
    recorded[1].write_text(SOURCE)
    module = sys.modules["stepped_adder"]
    exec(compile(SOURCE, str(recorded[1]), "exec"), vars(module))


def test_call_that_raises_stops_once_at_the_raising_line(recorded: Run, edited: Path) -> None:
    with editing(recorded, 5) as client:
        assert client.ask("setExceptionBreakpoints", filters=["uncaught"]) == {}
        assert client.begin()[0] == "entry"
        raises = "value = most if most != value - 14 else [][7]"
        edited.write_text(SOURCE.replace("value = most\n", f"{raises}\n"))
        client.go("restart")

        reason, line = client.go("continue")
        assert (reason, line, client.call()) == ("exception", CLIPS, 8)
        assert client.variables() == {"value": "64.0", "most": "50.0"}
        assert client.go("stepBack") == ("step", CLIPS - 1)
        assert client.go("continue") == ("exception", CLIPS)  # it has come to the line anew
        client.ask("continue")
        assert client.stopped()[0] == "end of the recording"
        assert any("IndexError: list index out of range" in text for text in client.told)


def test_call_with_other_lines_each_time_stops_in_the_end(recorded: Run, edited: Path) -> None:
    with editing(recorded, 11) as client:
        client.begin()
        less = (
            "LEFT = [90]\n\n\ndef clipped(value, most):\n    LEFT[0] -= 1\n    for _ in range(LEFT[0]):\n        pass\n"
        )
        edited.write_text(SOURCE.replace("def clipped(value, most):\n", less))
        client.go("restart")

        assert client.go("continue")[0] == "entry"  # each time the call is made, it runs fewer lines

        assert client.call() == 11
        assert sum("it does not repeat (dataflow verify --why" in text for text in client.told) == 2
