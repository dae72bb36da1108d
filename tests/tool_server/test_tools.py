"""Each tool answers as the command of its name does, in JSON values; what does not fit is refused with what would."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tampering import Kept, as_it_is, tampered

import dataflow
from dataflow.graph import load_text
from dataflow.recording import Recorded, Recording
from dataflow.records.comparison import Verification
from dataflow.records.firing import CALLS
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import ReplayError, graph_that_is_here
from dataflow.text import json_text
from dataflow.tool_server.tools import ToolError, _alike, _text, _verified, answer
from dataflow.verification.report import VerifyReport

SKIPPED, DEGREES = 613, 640
"""The first calls of `sum` and `sine` that the bugs change."""


def ask(tool: str, recording: str, **arguments: Any) -> Any:
    """Returns the answer as an agent gets it."""
    return json.loads(json_text(answer(tool, {"recording": recording, **arguments}, lambda text: None)))


def test_verify_names_culprits_with_their_first_call(bugs: dict[str, str]) -> None:
    told = ask("verify", bugs["right"])

    assert not told["identical"]
    assert sorted(told["culprits"]) == ["sine", "sum"]
    assert {each["operator"] for each in told["operators"]} == {"sine", "sum"}
    assert all(each["first"]["stamp"] for each in told["operators"])
    assert {each["operator"]: each["first"]["call"] for each in told["operators"]} == {"sum": SKIPPED, "sine": DEGREES}


def test_a_recorded_state_is_of_the_call_behind_which_it_was_taken(bugs: dict[str, str]) -> None:
    with Recording(Path(bugs["right"])) as recording:
        log, node = FiringLog.read(recording), graph_that_is_here(recording)[0].nodes["sum"]
        records = list(log.ordered(node))
        state = [record.kind for record in records].index("snapshot", 100)
        before = sum(record.kind in CALLS for record in records[:state])

        assert [log.call_at(node, (0, n)) for n in (0, state, state + 1)] == [None, before - 1, before]


def test_a_call_is_shown_with_its_difference(bugs: dict[str, str]) -> None:
    found = ask("diff", bugs["right"], operator="sine")

    assert (found["number"], found["same"], found["of"]) == (DEGREES, False, 701)
    assert [each["field"] for each in found["outputs"]["out"]["fields"]] == ["vectors"]
    assert found == ask("goto", bugs["right"], operator="sine", call=str(DEGREES))
    assert ask("goto", bugs["right"], operator="sine", call="@6.4")["number"] == DEGREES
    for last in ("-1", -1, 700):
        assert ask("goto", bugs["right"], operator="sine", call=last)["number"] == 700


SCALED = """
from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out


class Scaled(Operator):
    stateless = True
    x: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, x):
        vectors = x.vectors * 2
        if x.vectors[0, 0] > 3:
            vectors = vectors + 1
        return {"y": FeatureVector(stamp=x.stamp, vectors=vectors, model="scaled")}
"""


def commit(folder: Path) -> None:
    """Commits all files of a folder."""
    git = ["git", "-C", str(folder), "-c", "user.name=robot", "-c", "user.email=robot@localhost"]
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "As it was"]):
        subprocess.run([*git, *words], check=True, timeout=60)


def committed(folder: Path, name: str, text: str, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, str]:
    """A committed module with an operator `Scaled`, and a recording by it; it is imported anew then."""
    file = folder / f"{name}.py"
    file.write_text(text)
    commit(folder)
    monkeypatch.syspath_prepend(str(folder))
    graph = load_text(
        "graph: scaled\noperators:\n  src: {use: 'zoo.bugs:Numbers', params: {steps: 8}}\n"
        f"  scaled: {{use: '{name}:Scaled', inputs: {{x: src/x}}}}\n"
    )
    dataflow.run(graph, record=folder / "right.mcap")
    monkeypatch.delitem(sys.modules, name)
    return file, str(folder / "right.mcap")


def test_the_changed_line_that_made_a_call_differ_is_named_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, recording = committed(tmp_path, "scaled_operators", SCALED, monkeypatch)
    file.write_text(SCALED.replace("x.vectors * 2", "2.0 * x.vectors").replace("vectors + 1", "vectors + 10"))
    wrong = SCALED[: SCALED.index("+ 1")].count("\n") + 1

    told = ask("lines", recording, operator="scaled")
    assert (told["call"], told["raised"]) == (4, None)
    assert told["recorded_code"]["scaled_operators"].startswith("commit ")
    assert [(each["first"], each["mends"], each["ran"]) for each in told["changes"]] == [
        (wrong, True, True),
        (wrong - 2, False, True),
    ]
    assert "vectors + 1\n" in told["changes"][0]["recorded"]
    assert told["alone"] == {str(file): [[wrong, wrong]]}

    two = SCALED.replace("x.vectors * 2", "x.vectors * 3").replace("vectors + 1", "vectors + 10")
    file.write_text(two.replace("class Scaled", "\nclass Scaled"))
    monkeypatch.delitem(sys.modules, "scaled_operators")
    told = ask("lines", recording, operator="scaled", call="4")
    changes = [(each["here"].strip(), each["mends"], each["together"]) for each in told["changes"]]
    assert [mends for _, mends, _ in changes] == [False] * 3
    assert [together for *_, together in changes] == [True, True, False]
    assert changes[2][0] == ""  # the new line

    file.write_text(SCALED.replace("x.vectors * 2", "2.0 * x.vectors").replace("vectors + 1", "vectors + 10"))
    monkeypatch.delitem(sys.modules, "scaled_operators")
    (tmp_path / ".git").rename(tmp_path / "hidden")
    told = ask("lines", recording, operator="scaled")
    assert (told["changes"], told["recorded_code"]) == ([], {"scaled_operators": "not found"})
    assert told["alone"] == {str(file): [[wrong, wrong]]}


@pytest.mark.long
def test_a_changed_default_of_a_parameter_is_a_change_that_is_undone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = SCALED.replace("x.vectors * 2", "x.vectors * self.gain").replace("Operator, Out", "Operator, Out, Param")
    right = right.replace("    x: In[", '    gain: float = Param(2.0, doc="gain")\n    x: In[')
    file, recording = committed(tmp_path, "gained_operators", right, monkeypatch)
    file.write_text(right.replace("2.0, doc", "3.0, doc").replace("vectors + 1", "1 + vectors"))

    told = ask("lines", recording, operator="scaled")

    assert [("gain: float" in each["here"], each["mends"]) for each in told["changes"]] == [
        (True, True),
        (False, False),
    ]


def test_the_state_before_and_after_a_call(bugs: dict[str, str]) -> None:
    told = ask("state", bugs["wrong"], operator="sum", call="5")

    assert told["changed"] == {"total": {"before": 10.0, "after": 15.0}}
    assert ask("state", bugs["wrong"], operator="sum", call=str(SKIPPED))["changed"] == {}
    with pytest.raises(ToolError, match="no part 'nothing' in the state; there are: "):
        ask("state", bugs["wrong"], operator="sum", call="5", part="nothing")
    with pytest.raises(ToolError, match="sine has no state"):
        ask("state", bugs["wrong"], operator="sine", call="5")


def test_history_of_a_field_lists_changes_only(bugs: dict[str, str]) -> None:
    told = ask("history", bugs["wrong"], operator="sum", field="out.out.vectors[0, 0]", first=SKIPPED - 2, last=-1)

    assert told["calls"] == [SKIPPED - 2, 700]
    assert [each["call"] for each in told["changes"][:3]] == [SKIPPED - 2, SKIPPED - 1, SKIPPED + 1]
    part = ask("history", bugs["wrong"], operator="sum", field="number")
    assert (part["calls"], part["next"]) == ([0, 199], "history with first=200 goes on")
    with pytest.raises(ToolError, match=r"out\.none at call 0: AttributeError.*; there are: inp\.x, out\.out"):
        ask("history", bugs["wrong"], operator="sum", field="out.none", last=3)
    ends = ask("history", bugs["wrong"], operator="sum", field="inp.x.stamp > 0 and number > 500", first=500)
    assert [each["call"] for each in ends["changes"]] == [500, 501, 700]
    assert ends["changes"][-1]["value"] == {"error": "AttributeError: 'NoneType' object has no attribute 'stamp'"}


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (np.float32(199990000), 199990000.0),
        (np.float32(0.1), 0.1),
        (np.float64(1 / 3), 1 / 3),
        (np.uint8(7), 7),
        (np.bool_(True), True),
        (2**60, 2**60),
        (np.array([0.1, 2.0]), "[0.1, 2. ]"),
        ({"k0": np.float32(9), "k1": {"x": "y"}}, {"k0": 9.0, "k1": {"x": "y"}}),
        ({0: 9}, "{0: 9}"),
    ],
)
def test_numbers_of_numpy_are_numbers_with_all_their_digits(value: Any, shown: Any) -> None:
    assert _text(value) == shown
    assert type(_text(value)) is type(shown)


def test_a_value_that_stays_not_a_number_does_not_change() -> None:
    nan, half = np.float32("nan"), np.array([0.5, np.nan])

    assert _alike(nan, float("nan"))
    assert _alike(half, half.copy())
    assert _alike((nan, [1, {"a": half}]), (float("nan"), [1, {"a": half.copy()}]))
    assert not _alike((nan, 1), (nan, 2))
    assert not _alike([nan], [nan, nan])
    assert not _alike({"a": nan}, {"b": nan})
    assert not _alike(half, half.astype(np.float32))
    assert not _alike(np.array([0.10000001]), np.array([0.1]))
    assert not _alike(half, 0.5)
    assert not _alike(nan, 1.0)


def test_history_of_a_constant_nan_is_one_change(bugs: dict[str, str]) -> None:
    told = ask(
        "history", bugs["wrong"], operator="sine", field="float('nan') if number < 5 else inp.x.stamp * 0", last=9
    )

    assert [each["call"] for each in told["changes"]] == [0, 5]


def test_that_nothing_differs_or_was_lost_is_an_answer(bugs: dict[str, str], tmp_path: Path) -> None:
    assert ask("diff", bugs["wrong"], operator="sum") == {"operator": "sum", "same": True, "of": 701}
    text = (
        "graph: held\noperators:\n  src: {use: 'zoo.bugs:Numbers', params: {steps: 5}}\n"
        "  score: {use: 'zoo.tuned:Counted', inputs: {x: src/x}}\n"
    )
    dataflow.run(load_text(text), record=tmp_path / "run.mcap")

    told = ask("drops", str(tmp_path / "run.mcap"), worse="calls > 3")

    assert (told["losses"], told["named"]) == (0, [])
    assert told["told"].startswith("nothing was lost")


def test_what_if_reruns_with_changed_code_or_parameter(bugs: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZOO_FIXED", "1")
    told = ask("what_if", bugs["wrong"], operator="sum", call=str(SKIPPED), show="after['total']")

    assert not told["same"]
    assert told["show"] == sum(range(SKIPPED + 1))
    with pytest.raises(ValueError, match="Skips has no parameter 'step'"):
        ask("what_if", bugs["wrong"], operator="sum", call="3", params={"step": 2})
    with pytest.raises(ToolError, match="no operator 'summ' in the graph; there are: sine, src, sum"):
        ask("what_if", bugs["wrong"], operator="summ", call="3", params={"step": 2})


OTHERS = (
    "other operators: {'sine': 'culprit: differs alike each time (nothing that the recording holds of it has changed)'}"
)


@pytest.mark.long
def test_fix_is_proven_if_only_the_expected_calls_change(bugs: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    right = "out.out.vectors[0, 0] == before['total'] + 613"
    common = {"operator": "sum", "call": str(SKIPPED)}
    told = ask("prove", bugs["wrong"], expect=right, **common)
    assert not told["proven"]
    assert told["reasons"] == ["call 613 still gives what was recorded", f"call 613: expect is false: {right}"]

    monkeypatch.setenv("ZOO_FIXED", "1")  # which mends sine, too: something else
    told = ask("prove", bugs["wrong"], expect=right, may_change="number < 620", **common)
    assert not told["proven"]
    assert told["changed_calls"]["count"] == 700 - SKIPPED
    assert told["reasons"][0].startswith("calls that may not change do: [620, 621")
    assert told["reasons"][1:] == [OTHERS]


def test_a_proven_fix(bugs: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zoo.bugs.Skips.work", lambda self, k, kind: _added(self.state, k))
    expect = {"expect": "out.out.vectors[0, 0] == 188_191", "may_change": f"number > {SKIPPED}"}

    only = ask("prove", bugs["wrong"], operator="sum", call=str(SKIPPED), **expect)

    assert only["reasons"] == []
    assert only["proven"]
    assert only["other_operators"] == {"identical": ["sine"]}


def test_a_fix_that_raises_in_later_calls_is_not_proven(bugs: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    def mended(operator: Any, k: float, kind: int) -> list[float]:
        return _added(operator.state, k) if k < 690 else [1 / 0]

    monkeypatch.setattr("zoo.bugs.Skips.work", mended)
    arguments = {"operator": "sum", "call": str(SKIPPED), "expect": "out.out.vectors[0, 0] == 188_191"}

    told = ask("prove", bugs["wrong"], **arguments)

    assert not told["proven"]
    [reason] = told["reasons"]
    assert reason.startswith("calls raise what is not recorded: {690: 'ZeroDivisionError: division by zero'")
    assert ask("prove", bugs["wrong"], **arguments, may_change="error is None or number > 600")["proven"]
    true_of_any = ["True", "number == 613", "error is None", "not same", "after is not None"]
    for already in [*true_of_any, "out.out is not None and inp.x.vectors[0, 0] >= 0"]:
        with pytest.raises(ToolError, match=r"expect=.* is true of what was recorded as well"):
            ask("prove", bugs["wrong"], **arguments | {"expect": already})


@pytest.mark.long
def test_a_fix_makes_all_that_is_recorded_of_right_code(bugs: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = {"operator": "sum", "call": str(SKIPPED), "expect": "True", "right": bugs["right"]}
    reasons = ask("prove", bugs["wrong"], **arguments)["reasons"]
    assert reasons == ["call 613 still gives what was recorded", f"sum in {bugs['right']}: culprit"]

    monkeypatch.setenv("ZOO_FIXED", "1")  # which mends sine, too
    assert ask("prove", bugs["wrong"], **arguments)["reasons"] == [OTHERS]


@pytest.fixture(scope="module")
def torn(bugs: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> str:
    """The recording by the code with bugs, without what the calls from 650 on were given."""

    def before_the_end(found: Recorded) -> Kept:
        return [] if found.stream.endswith("src/x") and found.seq >= 650 else as_it_is(found)

    file = tmp_path_factory.mktemp("torn") / "torn.mcap"
    return str(tampered(Path(bugs["wrong"]), file, messages=before_the_end))


LOST = "51 calls could not be made again (the first is call 650: bugs/src/x #650 is not recorded)"


def test_each_tool_reports_calls_that_could_not_be_made(torn: str) -> None:
    lost = {"count": 51, "first": 650, "why": "bugs/src/x #650 is not recorded"}
    with pytest.raises(ToolError, match=re.escape(f"sum: 650 calls give what was recorded; {LOST}")):
        ask("diff", torn, operator="sum")
    told = ask("history", torn, operator="sum", field="same")
    assert (told["calls"], len(told["changes"]), told["not_made"]) == ([0, 700], 1, lost)
    assert "not_made" not in ask("history", torn, operator="sum", field="same", last=649)
    with pytest.raises(ToolError, match=r"sum, calls 650 to 660: 11 calls could not be made again"):
        ask("history", torn, operator="sum", field="same", first=650, last=660)
    told = ask("verify", torn, only=["sum"])
    assert told["verdicts"] == {"unverifiable": ["sum"]}
    assert told["not_made"] == {"sum": "51 of 701 calls could not be made again (bugs/src/x #650 is not recorded)"}


def test_verdict_of_a_cut_recording_is_identical_up_to_the_cut() -> None:
    whole = Verification("whole", firings=3, verified=3)
    torn = Verification("torn", firings=5, verified=3, unverifiable=2, beyond=2, cut=True, missing="x #3")
    report = VerifyReport((whole, torn), (), (), 0, 0, 0.0, 0.0)

    told = _verified(report)

    assert torn.verdict == "identical"
    assert told["verdicts"] == {"identical": ["whole"], "identical up to the cut": ["torn"]}
    assert told["not_made"] == {"torn": "2 of 5 calls could not be made again (x #3 is not recorded)"}


def test_no_fix_is_proven_where_calls_could_not_be_made(torn: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zoo.bugs.Skips.work", lambda self, k, kind: _added(self.state, k))
    told = ask("prove", torn, operator="sum", call=SKIPPED, expect="out.out.vectors[0, 0] == 188_191")

    assert not told["proven"]
    own, others = told["reasons"]
    assert own == f"sum: {LOST}"
    assert "'sine': '51 of 701 calls could not be made again (bugs/src/x #650 is not recorded)'" in others
    assert told["changed_calls"]["not_made"]["count"] == 51


SHARED = """
import os

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out
from shared_factor import FACTOR


class Scaled(Operator):
    stateless = True
    x: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, x):
        return {"y": FeatureVector(stamp=x.stamp, vectors=x.vectors * FACTOR, model="scaled")}
"""
CHANCE = """
import os

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out
{imports}

class Chance(Operator):
    stateless = True
    x: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, x):
        noise = int.from_bytes(os.urandom(4), "big")
        return {{"y": FeatureVector(stamp=x.stamp, vectors=x.vectors + noise, model="chance")}}


class Onwards(Chance):
    def process(self, x):
        return {{"y": x}}
"""


@pytest.mark.parametrize("shares", [False, pytest.param(True, marks=pytest.mark.long)])
def test_unrepeatable_operator_is_named_and_judged_only_if_its_code_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shares: bool
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("shared_factor", "fixed_scale", "by_chance"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    factor = tmp_path / "shared_factor.py"
    factor.write_text("FACTOR = 3\n")
    (tmp_path / "fixed_scale.py").write_text(SHARED)
    imports = "from shared_factor import FACTOR" if shares else ""
    (tmp_path / "by_chance.py").write_text(CHANCE.format(imports=imports))
    commit(tmp_path)
    graph = load_text(
        "graph: shared\noperators:\n  src: {use: 'zoo.bugs:Numbers', params: {steps: 8}}\n"
        "  scaled: {use: 'fixed_scale:Scaled', inputs: {x: src/x}}\n"
        "  chance: {use: 'by_chance:Chance', inputs: {x: src/x}}\n"
        "  onwards: {use: 'by_chance:Onwards', inputs: {x: chance/y}}\n"
    )
    recording = str(tmp_path / "wrong.mcap")
    dataflow.run(graph, record=recording)
    factor.write_text("FACTOR = 2  # of another size: bytecode of the same second would be taken for it\n")
    for name in ("shared_factor", "fixed_scale", "by_chance"):
        monkeypatch.delitem(sys.modules, name)

    told = ask("prove", recording, operator="scaled", call=4, expect="out.y.vectors[0, 0] == 8")

    if not shares:
        assert told["reasons"] == []
        assert told["do_not_repeat"] == {"chance": "differs each time with the code that was recorded"}
        return
    assert not told["proven"]
    assert told["reasons"] == [
        "other operators: {'chance': 'culprit: differs each time (code changed: shared_factor); "
        "with the recorded code too'}"
    ]


def _added(state: Any, k: float) -> list[float]:
    state.total += k
    return [state.total]


def test_a_wrong_call_becomes_a_test(bugs: dict[str, str], tmp_path: Path) -> None:
    file = tmp_path / "test_sine.py"
    told = ask("capture", bugs["right"], operator="sine", to=str(file))

    assert (told["call"], told["kept"]) == (DEGREES, 1)
    assert "dataflow capture right.mcap --op sine --firing 640" in file.read_text()
    done = subprocess.run([sys.executable, "-m", "py_compile", str(file)], check=False, timeout=60)
    assert done.returncode == 0
    with pytest.raises(ToolError, match=r"expected a new file that ends in \.py"):
        ask("capture", bugs["right"], operator="sine", to=str(file))


def test_blame_leads_to_the_source_and_reports_progress(bugs: dict[str, str]) -> None:
    said: list[str] = []
    arguments = {"recording": bugs["wrong"], "field": "sine/out.vectors[0,0]@1"}
    told = json.loads(json_text(answer("blame", arguments, said.append)))

    assert told["whole"]
    assert [place[0] for place in told["sensed"]] == ["bugs/src/x"]
    assert "links found" in said[-1]


def test_drops_refuses_with_the_figures_that_there_are(bugs: dict[str, str]) -> None:
    with pytest.raises(ReplayError):
        ask("drops", bugs["wrong"], worse="ate > 1")
    with pytest.raises(ToolError, match="worse='ate >': no Python expression"):
        ask("drops", bugs["wrong"], worse="ate >")


@pytest.mark.long
def test_why_finds_that_code_repeats_and_differs_from_the_recorded(bugs: dict[str, str]) -> None:
    said: list[str] = []
    told = answer("why", {"recording": bugs["right"], "operator": "sine"}, said.append)

    assert said[0] == "re-run 1 of at most 8"
    assert 1 <= len(said) <= 8
    assert told["repeats"]
    assert told["operator"] == "sine"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"call": "first"}, 'expected a number such as 7 or -1, "@SECONDS" or "diff"'),
        ({"call": "701"}, "sine has calls 0 to 700, there is no 701"),
        ({"call": 701}, "sine has calls 0 to 700, there is no 701"),
        ({"call": "@nan"}, "call='@nan': expected a number such as 7"),
        ({"call": "0", "operator": "cosine"}, "there are: sine, sum"),
        ({"call": "0", "path": ["nowhere"]}, "path: no such folder: nowhere"),
    ],
)
def test_wrong_arguments_are_refused(bugs: dict[str, str], arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        ask("goto", bugs["right"], **{"operator": "sine", **arguments})


def test_an_expression_that_cannot_be_compiled_is_none(bugs: dict[str, str]) -> None:
    for field in ("1 +", "+".join("1" * 50_000), "a\0b"):
        with pytest.raises(ToolError, match="no Python expression"):
            ask("history", bugs["right"], operator="sine", field=field)


def test_a_missing_recording_is_named_with_those_beside_it(bugs: dict[str, str]) -> None:
    with pytest.raises(ToolError, match=r"no recording .*rigth\.mcap; beside it: .*right\.mcap, .*wrong\.mcap"):
        ask("verify", bugs["right"].replace("right", "rigth"))
