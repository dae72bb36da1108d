"""Any recorded call can be gone to, in any order, and is then what it was."""

from __future__ import annotations

import json
import random
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tampering import Kept, as_it_is, tampered

import dataflow
from dataflow.api.local import LocalRun
from dataflow.capture.capture import capture
from dataflow.cli.support.debug_shell import Shell, WrongCommand
from dataflow.debugging.debugger import DebugError, Debugger, UnrepeatableCalls
from dataflow.debugging.fired import SPACING, Probe, Process, RepeatedCall
from dataflow.execution.failure import OperatorFailure
from dataflow.graph import Graph, load_graph, load_text
from dataflow.graph.sections import Record
from dataflow.messages.base import Message
from dataflow.recording import Recorded, Recording
from dataflow.records import reading
from dataflow.records.firing import CALLS, FiringRecord, Rows
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import graph_that_is_here
from dataflow.supervision.run import run
from dataflow.sync import Firing

KEPT = Path(__file__).resolve().parent.parent / "recordings_of"

ADDER = '''
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Source
{more_imports}

def vector(stamp, number):
    return FeatureVector(stamp=stamp, vectors=np.array([[number]], np.float32), model="made")


class Numbers(Source):
    x: Out[FeatureVector]

    def stream(self):
        for k in range(30):
            yield {{"x": vector(1_700_000_000_000_000_000 + k * 100_000_000, k)}}


@dataclass
class State:
    total: float = 0.0


class Adder(Operator):
    """Adds up."""

    x: In[FeatureVector]
    total: Out[FeatureVector]
    state: State

    def process(self, x):
        {line}
        return {{"total": vector(x.stamp, self.state.total)}}
'''


@pytest.fixture(params=["run.mcap", "live.mcap"])
def kept(request: pytest.FixtureRequest) -> Iterator[Recording]:
    with Recording(KEPT / request.param) as recording:
        yield recording


@pytest.mark.parametrize("operator", ["look", "smooth", "busy", "tally"])
def test_all_calls_are_as_recorded_forwards_and_in_any_order(kept: Recording, operator: str) -> None:
    debugger = Debugger(kept, operator)
    forwards = [debugger.goto(number) for number in range(len(debugger.calls))]

    assert all(fired.same for fired in forwards)
    order = random.Random(3).sample(range(len(debugger.calls)), 8)
    for number in order:
        assert shown(debugger.goto(number)) == shown(forwards[number])
    debugger.close()


def shown(fired: RepeatedCall) -> tuple[Any, ...]:
    return fired.call, fired.before, fired.after, [m.here.digest() for m in fired.made if m.here]


@pytest.mark.parametrize("operator", ["smooth", "tally"])
def test_state_after_a_call_is_that_before_the_next(kept: Recording, operator: str) -> None:
    debugger = Debugger(kept, operator)
    before = debugger.goto(0)
    for number in range(1, len(debugger.calls)):
        fired = debugger.goto(number)
        follows = fired.call.incarnation == before.call.incarnation and fired.call.record == before.call.record + 1
        assert not follows or fired.before == before.after
        before = fired


def test_modified_call_is_no_start_for_later_calls(kept: Recording) -> None:
    debugger = Debugger(kept, "smooth")
    debugger.goto(1)

    def otherwise(process: Process, firing: Firing) -> dict[str, Message]:
        process(firing)
        return process(firing)

    differs = [debugger.goto(2, otherwise), debugger.again(otherwise)]
    assert not any(fired.same for fired in differs)
    assert debugger.goto(3).same
    assert debugger.goto(2).same
    debugger.close()


def test_a_call_is_found_by_its_time(kept: Recording) -> None:
    debugger = Debugger(kept, "busy")
    for number in (0, 3, 70):
        stamp = debugger.calls[number].stamp
        found = debugger.calls[debugger.number_at(stamp)]
        assert found.stamp <= stamp
    with pytest.raises(DebugError, match=r"busy was not called by then: its first call is \d+\.\d{3} s later"):
        debugger.number_at(0)
    assert debugger.goto(-1).number == len(debugger.calls) - 1


def test_unknown_operators_and_calls_are_named(kept: Recording) -> None:
    with pytest.raises(DebugError, match="'none' are recorded; there are: busy, look, smooth, tally"):
        Debugger(kept, "none")
    with pytest.raises(DebugError, match="'robot' is a source"):
        Debugger(kept, "robot")
    debugger = Debugger(kept, "busy")
    with pytest.raises(DebugError, match=f"has calls 0 to {len(debugger.calls) - 1}, there is no 4000"):
        debugger.goto(4000)
    with pytest.raises(DebugError, match="goto one"):
        debugger.again()


def written(folder: Path, line: str, more_imports: str = "") -> Path:
    file = folder / "debugged_adder.py"
    file.write_text(ADDER.format(line=line, more_imports=more_imports))
    return file


RIGHT = "self.state.total += float(x.vectors[0, 0])"


@pytest.fixture
def added(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Recording]:
    """A recorded run of the adder; the parameter is a line more of its graph."""
    written(tmp_path, RIGHT)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "debugged_adder", raising=False)
    graph = load_text(
        f"graph: graph\n{getattr(request, 'param', '')}\noperators:\n  numbers: {{use: 'debugged_adder:Numbers'}}\n"
        "  adder: {use: 'debugged_adder:Adder', inputs: {x: numbers/x}}\n"
    )
    dataflow.run(graph, record=tmp_path / "run.mcap")
    with Recording(tmp_path / "run.mcap") as recording:
        yield recording
    monkeypatch.delitem(sys.modules, "debugged_adder", raising=False)


def test_going_back_begins_from_a_state_on_the_way(added: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dataflow.debugging.fired.SPACING", 0)
    monkeypatch.setattr("dataflow.debugging.ring.MOST_CALLS", 1)
    debugger = Debugger(added, "adder")
    debugger.goto(25)
    assert SPACING > 0

    debugger.goto(20)

    work = debugger._work
    assert work is not None
    assert work.results()["adder"].verified == 1
    assert debugger.at is not None
    assert debugger.at.states()[0] == {"total": sum(range(20))}
    assert debugger.at.changed() == ("total",)


def test_going_back_to_kept_calls_makes_none(added: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    debugger = Debugger(added, "adder")
    debugger.goto(25)
    made = list[int]()
    process = Probe.process

    def noting(self: Probe, firing: Firing) -> dict[str, Message]:
        made.append(firing.stamp)
        return process(self, firing)

    monkeypatch.setattr(Probe, "process", noting)
    back = [debugger.goto(number) for number in range(24, -1, -1)]

    assert made == []
    assert all(fired.same for fired in back)
    assert [fired.outputs["total"].vectors.item() for fired in back] == [sum(range(n + 1)) for n in range(24, -1, -1)]
    assert back[14].states() == ({"total": sum(range(10))}, {"total": sum(range(11))})
    assert len(made) == 11  # from the first state on
    assert debugger.again().same
    assert debugger.goto(26).states()[1] == {"total": sum(range(27))}


def test_until_looks_at_the_last_calls_too_once_gone_back(added: Recording) -> None:
    debugger = Debugger(added, "adder")
    debugger.goto(25)
    debugger.goto(3)
    numbers = list[int]()
    assert debugger.until(lambda fired: bool(numbers.append(fired.number))) is None
    assert numbers == [*range(4, len(debugger.calls))]


def test_the_kept_calls_are_bounded_by_their_bytes(added: Recording) -> None:
    debugger = Debugger(added, "adder")
    debugger.goto(0)
    held = debugger._ring.get(0)
    assert held is not None
    nbytes = sum(message.nbytes() for message in held.messages())
    for most, kept in ((5, [21, 22, 23, 24, 25]), (0, [25])):
        debugger = Debugger(added, "adder", most_bytes=most * nbytes)
        debugger.goto(25)
        assert [n for n in range(26) if debugger._ring.get(n)] == kept


def test_snapshots_by_cpu_time_are_used(added: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = replace(graph_that_is_here(added)[0], record=Record(tuple(added.streams), snapshots="cpu"))
    assert Graph.from_json(json.loads(json.dumps(graph.to_json()))).record == graph.record
    for spacing, expected in ((0, 30), (10**12, 0)):
        monkeypatch.setattr("dataflow.records.spacing.CPU_SPACING", spacing)
        path = tmp_path / f"{spacing}.mcap"
        LocalRun(graph).execute(record=path)
        with Recording(path) as recording:
            kinds = [record.kind for record in FiringLog.read(recording).records("adder")]
            assert kinds.count("snapshot") == expected
            debugger = Debugger(recording, "adder", graph)
            assert debugger.goto(17).same
            assert debugger._work is not None
            assert debugger._work.results()["adder"].verified == (1 if expected else 18)


LONG = """
graph: long
namespace: test
operators:
  left: {{use: runtime_operators:Counter, params: {{count: {count}, period: 100000000}}}}
  tuned: {{use: runtime_operators:Tuned, inputs: {{x: left/fast}}}}
record: {{snapshots: 2s}}
"""


@pytest.mark.long
def test_the_way_to_a_call_does_not_depend_on_the_length_of_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dataflow.records.window.FIRST_REACH", 3 * 10**9)
    monkeypatch.setattr("dataflow.debugging.debugger.AHEAD", 10**9)
    decode, decoded = reading.decode_rows, list[int]()

    def noting(batch: Rows) -> tuple[FiringRecord, ...]:
        decoded.append(len(batch.rows))
        return decode(batch)

    monkeypatch.setattr(reading, "decode_rows", noting)
    costs = []
    for count in (400, 1600):
        (tmp_path / "long.yaml").write_text(LONG.format(count=count))
        run(load_graph(tmp_path / "long.yaml"), placement="one_process", record=tmp_path / f"{count}.mcap")
        with Recording(tmp_path / f"{count}.mcap") as recording:
            debugger = Debugger(recording, "tuned")
            decoded.clear()
            there = debugger.goto(count // 2 + 7)
            assert there.same
            assert debugger._work is not None
            assert debugger._work.results()["tuned"].verified <= 21
            costs.append(sum(decoded))
            assert debugger.goto(count - 10).same
            assert debugger._work.results()["tuned"].verified <= 21
            assert debugger.goto(count - 10 - 40).same
            further = debugger.until(lambda fired: fired.inputs["x"].stamp % 10**9 == 0)
            assert further is not None
            assert further.same
            debugger.close()
    assert costs[1] < 1600 // 4  # of 1,600 records, whose batches end by the recorder's clock


def test_edited_source_is_taken_over_and_compared_from_the_same_state(added: Recording, tmp_path: Path) -> None:
    debugger = Debugger(added, "adder")
    debugger.goto(10)
    assert debugger.reload() == []
    written(tmp_path, RIGHT + "; self.state.total += 0.5 * (x.stamp % 200_000_000 == 0)")
    assert debugger.reload() == ["debugged_adder"]

    assert not debugger.again().same  # at 1.0 s
    (made,) = debugger.again().made
    assert [field.field for field in made.fields] == ["vectors"]
    assert made.recorded is not None
    assert made.recorded.vectors.item() == sum(range(11))
    assert made.here is not None
    assert made.here.vectors.item() == sum(range(11)) + 0.5
    first = debugger.first_difference()
    assert first is not None
    assert first.number == 0

    written(tmp_path, RIGHT)
    debugger.reload()
    assert debugger.goto(10).same
    assert debugger.first_difference() is None


COUNTS = RIGHT + "; self.state.calls += 1; self.state.total += (self.state.calls > 20)"


@pytest.mark.parametrize("added", ["record: {snapshots: 500ms}"], indirect=True)
def test_recorded_states_that_lack_a_field_of_the_class_are_not_used(added: Recording, tmp_path: Path) -> None:
    debugger = Debugger(added, "adder")
    assert debugger._recorded
    assert debugger.goto(25).same
    file = written(tmp_path, COUNTS)
    file.write_text(file.read_text().replace("total: float = 0.0\n", "total: float = 0.0\n    calls: int = 0\n"))
    debugger.reload()

    for fired in (debugger.again(), debugger.goto(25), debugger.until(lambda fired: True, first=25)):
        assert fired is not None
        assert not fired.same
        before, after = fired.states()
        assert before == {"total": sum(range(25)) + 5, "calls": 25}  # of the calls from the beginning
        assert after == {"total": sum(range(26)) + 6, "calls": 26}
    debugger.goto(3)
    assert debugger.goto(24).states()[1] == {"total": sum(range(25)) + 5, "calls": 25}
    found = debugger.first_difference()
    assert found is not None
    assert found.number == 20
    debugger.close()
    fresh = Debugger(added, "adder")  # of the class as it is now
    assert fresh.goto(25).states()[0] == {"total": sum(range(25)) + 5, "calls": 25}


TRACKED = "k = int(x.vectors[0, 0]) % 4; self.state.tracks[k] = self.state.total = float(k * 10)"


def test_expressions_see_the_dicts_of_a_state(
    added: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    debugger = Debugger(added, "adder")
    file = written(tmp_path, TRACKED)
    text = file.read_text().replace("import dataclass\n", "import dataclass, field\n")
    kept = "    total: float = 0.0\n    tracks: dict[int, float] = field(default_factory=dict)\n"
    file.write_text(text.replace("    total: float = 0.0\n", kept))
    debugger.reload()
    shell = Shell(debugger, 0)
    debugger.goto(7)

    shell.onecmd('print after["tracks"][3]')
    assert capsys.readouterr().out == "30\n"
    at = debugger.goto(2)
    shell.onecmd("state tracks")
    assert "after   {0: 0.0, 1: 10.0, 2: 20.0}" in capsys.readouterr().out
    assert ("tracks", {0: 0.0, 1: 10.0}, {0: 0.0, 1: 10.0, 2: 20.0}) in [*at.changes()]


def test_broken_source_leaves_the_old_one(added: Recording, tmp_path: Path) -> None:
    debugger = Debugger(added, "adder")
    debugger.goto(4)
    written(tmp_path, "self.state.total +=")
    with pytest.raises(DebugError, match="cannot be used, the old one is: SyntaxError"):
        debugger.reload()
    written(tmp_path, RIGHT, more_imports="import no_such_module")
    with pytest.raises(DebugError, match="no_such_module"):
        debugger.reload()
    assert debugger.again().same


def test_until_goes_to_the_call_that_meets_the_condition(added: Recording) -> None:
    debugger = Debugger(added, "adder")
    found = debugger.until(lambda fired: fired.outputs["total"].vectors.item() > 100)
    assert found is not None
    assert found.number == 14
    assert found.before is not None
    later = debugger.until(lambda fired: fired.number % 10 == 0)
    assert later is not None
    assert later.number == 20
    assert debugger.until(lambda fired: False) is None
    assert debugger.at is later
    assert debugger.goto(21).number == 21


@pytest.fixture
def torn(added: Recording, tmp_path: Path) -> Iterator[Recording]:
    """A recording of 31 calls whose last 11 lack what they were given."""

    def before_the_end(found: Recorded) -> Kept:
        return [] if found.stream.endswith("numbers/x") and found.seq >= 20 else as_it_is(found)

    with Recording(tampered(Path(added.path), tmp_path / "torn.mcap", messages=before_the_end)) as recording:
        yield recording


def test_calls_that_cannot_be_made_are_counted(torn: Recording) -> None:
    debugger = Debugger(torn, "adder")
    assert debugger.first_difference() is None
    lost = UnrepeatableCalls(len(debugger.calls) - 20, 20, "graph/numbers/x #20 is not recorded")
    assert debugger.unmade == lost
    assert str(lost) == "11 calls could not be made again (the first is call 20: graph/numbers/x #20 is not recorded)"

    assert debugger.until(lambda fired: False, first=3, last=25) is None
    assert debugger.unmade == replace(lost, count=6)
    assert debugger.until(lambda fired: fired.number == 7) is not None
    assert debugger.unmade is None
    assert debugger.until(lambda fired: True, first=20) is None
    assert debugger.unmade == lost
    with pytest.raises(DebugError, match="call 25 of adder cannot be made again: graph/numbers/x #20 is not recorded"):
        debugger.goto(25)


def test_capture_does_not_report_unmade_calls_as_recorded(torn: Recording) -> None:
    with pytest.raises(DebugError, match="adder: 20 calls as recorded, without an error; 11 calls could not be made"):
        capture(torn, Debugger(torn, "adder"))


def test_a_search_ends_at_its_last_call(added: Recording) -> None:
    debugger = Debugger(added, "adder")
    for _ in range(2):  # the second time out of what is kept
        assert [fired.number for fired in all_made(debugger, 4, 9)] == [*range(4, 10)]
        assert debugger.unmade is None


def test_calls_on_the_way_that_cannot_be_made_are_counted(added: Recording, tmp_path: Path) -> None:
    """Five records are missing, behind which a state is recorded."""
    graph = replace(graph_that_is_here(added)[0], record=Record(tuple(added.streams), snapshots="cpu"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dataflow.records.spacing.CPU_SPACING", 0)
        LocalRun(graph).execute(record=tmp_path / "states.mcap")
    with Recording(tmp_path / "states.mcap") as recording:
        calls = [r.index for r in FiringLog.read(recording).records("adder") if r.kind in CALLS]
    gone = range(calls[10], calls[12])
    path = tampered(
        tmp_path / "states.mcap",
        tmp_path / "gap.mcap",
        records=lambda record: record.operator != "adder" or record.index not in gone,
    )
    with Recording(path) as recording:
        debugger = Debugger(recording, "adder", graph)
        made = {fired.number for fired in all_made(debugger)}
        assert debugger.unmade is not None
        assert made | {*range(debugger.unmade.first, len(debugger.calls))} == {*range(len(debugger.calls))}
        assert len(made) + debugger.unmade.count == len(debugger.calls)
        assert "missing" in debugger.unmade.why


def all_made(debugger: Debugger, first: int = 0, last: int | None = None) -> list[RepeatedCall]:
    found = list[RepeatedCall]()

    def visit(fired: RepeatedCall) -> bool:
        found.append(fired)
        return False

    assert debugger.until(visit, first=first, last=last) is None
    return found


def test_prompt_fails_and_names_calls_that_could_not_be_made(
    torn: Recording, capsys: pytest.CaptureFixture[str]
) -> None:
    shell = Shell(Debugger(torn, "adder"), 0)
    lost = "11 calls could not be made again (the first is call 20: graph/numbers/x #20"
    for line, told in (
        ("diff", "20 calls as recorded"),
        ("until False", "no call after this one that can be made is so: False"),
    ):
        shell.onecmd(line)
        assert shell.failed
        assert f"error: {told}; {lost}" in capsys.readouterr().out


def test_search_reports_calls_that_it_could_not_make(
    torn: Recording, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    debugger = Debugger(torn, "adder")
    made = debugger.goto(3)

    def found(condition: Callable[[RepeatedCall], bool]) -> RepeatedCall:
        debugger.unmade = UnrepeatableCalls(2, 1, "records before it are missing")
        return made

    monkeypatch.setattr(debugger, "until", found)
    Shell(debugger, 0).onecmd("until True")
    assert "on the way to it 2 calls could not be made again (the first is call 1" in capsys.readouterr().out
    Shell(debugger, 0, json=True).onecmd("diff")
    assert json.loads(capsys.readouterr().out)["not_made"]["count"] == 2


def test_the_prompt_goes_to_a_call_as_the_command_line_names_it(added: Recording) -> None:
    debugger = Debugger(added, "adder")
    shell = Shell(debugger, debugger.calls[0].stamp)
    assert shell.number("adder@1.25") == shell.number("@1.25") == 12
    for word, why in (("numbers@1", "the operator here is adder"), ("@inf", "expected the number"), ("7x", "number")):
        with pytest.raises(WrongCommand, match=why):
            shell.number(word)


def test_missing_state_is_explained(added: Recording, tmp_path: Path) -> None:
    debugger = Debugger(added, "adder")
    assert "adder declares no state, so what it keeps in attributes is not seen" in debugger.no_state()
    debugger.node.operator.stateless = True
    try:
        assert debugger.no_state() == "adder has no state: it is declared stateless"
    finally:
        debugger.node.operator.stateless = False


def test_recording_of_sources_alone_is_refused(repository: Path) -> None:
    with (
        Recording(repository / "recordings" / "demo.mcap") as recording,
        pytest.raises(DebugError, match="nor of any other operator: the recording holds what sources gave"),
    ):
        Debugger(recording, "odometry")


def test_expression_is_false_of_calls_without_its_inputs(added: Recording, capsys: pytest.CaptureFixture[str]) -> None:
    shell = Shell(Debugger(added, "adder"), 0)

    shell.onecmd("until inp.x.stamp < 0")  # the last call is finish(), which is given nothing
    assert not shell.failed
    assert "no call after this one is so: inp.x.stamp < 0" in capsys.readouterr().out
    shell.onecmd("until inp.x.stampp < 0")
    assert shell.failed
    assert "inp.x.stampp < 0 at call 0: AttributeError" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "expression", "lacks"),
    [
        (None, "inp.x.stampp", True),  # it cannot be known that the name is wrong
        (None, "inp.x.stamp > 3", True),
        (None, "len(inp.x)", True),
        (None, "inp.y", False),
        (None, "inp.x is None and 1 / 0", False),
        ((), "inp.x[-1].stamp", True),
        ((), "max(m.stamp for m in inp.x)", True),
        ({}, "inp.x['src/x'].stamp", True),
        ((), "inp.x.stamp", False),
        (1, "inp.x.stampp", False),
        (1, "[][0]", False),
    ],
)
def test_error_of_expression_by_missing_input_is_recognised(
    given: Any, expression: str, lacks: bool, added: Recording
) -> None:
    fired = replace(Debugger(added, "adder").goto(2), inputs={"x": given})
    with pytest.raises(Exception) as caught:
        eval(expression, fired.names())

    assert fired.lacks_for(caught.value) == lacks


def test_expression_that_fits_no_call_is_an_error(
    added: Recording, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shell = Shell(debugger := Debugger(added, "adder"), 0, json=True)
    until = debugger.until
    monkeypatch.setattr(debugger, "until", lambda is_so: until(lambda fired: is_so(replace(fired, inputs={"x": None}))))

    shell.onecmd("until inp.x.stampp < 0")
    assert shell.failed
    assert "in no call after this one is there what it needs: inp.x.stampp < 0 at call 0" in capsys.readouterr().out
    shell.onecmd("until inp.x is not None and inp.x.stamp > 0 or number == 3 and out.total.vectors is None")
    told = capsys.readouterr()
    assert "no call after this one is so" in told.out
    shell.onecmd(f"until {(condition := 'number > 3 and inp.x.stamp < 0')}")
    assert not shell.failed
    assert f"not so where there is nothing, in 26 calls: {condition} at call 4" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "text", "found"),
    [
        ("until inp.x.sta", "inp.x.sta", ["inp.x.stamp"]),
        ('print before["to', "to", ["total"]),
        ("print after['to", "to", ["total"]),
        ('print before["la', "la", []),  # no name of the state, and no keyword of Python
        ('until out.total == "whi', "whi", []),
    ],
)
def test_names_are_completed_in_expressions(line: str, text: str, found: list[str], added: Recording) -> None:
    shell = Shell(debugger := Debugger(added, "adder"), 0)
    debugger.goto(2)

    assert shell.complete_until(text, line, len(line) - len(text), len(line)) == found


def test_operator_without_calls_is_refused(added: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    debugger = Debugger(added, "adder")
    monkeypatch.setattr(debugger, "calls", [])
    for find in (debugger.goto, debugger.number_at):
        with pytest.raises(DebugError, match=r"^adder was not called in this recording$"):
            find(0)


def test_an_error_is_shown_with_its_line(added: Recording, tmp_path: Path) -> None:
    debugger = Debugger(added, "adder")
    debugger.goto(2)
    written(tmp_path, "self.state.total /= x.vectors.size - 1")
    debugger.reload()

    fired = debugger.again()

    assert not fired.same
    assert "ZeroDivisionError" in (fired.error or "")
    assert "debugged_adder.py" in (fired.error or "")
    assert fired.recorded_error is None


def test_failed_setup_is_retried(added: Recording, tmp_path: Path) -> None:
    debugger = Debugger(added, "adder")
    debugger.goto(2)
    written(tmp_path, RIGHT, more_imports="def broken(self): raise OSError('no camera')")
    (tmp_path / "debugged_adder.py").open("a").write("\n    setup = broken\n")
    debugger.reload()
    for number in (2, 5, 5):
        with pytest.raises(OperatorFailure, match="no camera"):
            debugger.goto(number)
    written(tmp_path, RIGHT)
    debugger.reload()
    assert debugger.goto(5).same


def test_missing_other_operators_are_no_error() -> None:
    with Recording(KEPT / "perception.mcap") as recording:
        debugger = Debugger(recording, "motion_check")
        assert debugger.goto(1).same
