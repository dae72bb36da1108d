"""The gate lets pass what is as recorded or as accepted, and names what is new and whose fault it is."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from dataflow.records.comparison import Difference, Verification
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.supervision.core.report import RunFailed
from dataflow.verification.compare import OutputComparison
from dataflow.verification.gate import Baseline, BaselineError, Checked, Judged, check, judge, recordings_in
from dataflow.verification.report import VerifyReport
from dataflow.verification.stored import StoredStream

Outcomes = dict[str, str | None]
"""Operator → what came out otherwise (any word), None for nothing."""


def report(outcomes: Outcomes, producers: Mapping[str, set[str]], *, culprits: set[str] | None = None) -> VerifyReport:
    """What verification gives for operators that each have one stream `<operator>/out`."""
    made = []
    for name, got in outcomes.items():
        v = Verification(name, firings=9, verified=9, outputs=9)
        if got is not None:
            v.differing = 3
            v.first = Difference(4, "fire", 400, "out", "recorded", got)
            fault = culprits is None or name in culprits
            v.tainted = None if fault else 1
            v.own_fault = fault
        made.append(v)
    return VerifyReport(
        operators=tuple(made),
        stood_in=(),
        facts=(),
        messages=9,
        streams=1,
        wall=1.0,
        span=2.0,
        digests={f"{name}/out": (9, got or "recorded") for name, got in outcomes.items()},
        outputs={name: (f"{name}/out",) for name in outcomes},
        producers={name: frozenset(producers.get(name, ())) for name in outcomes},
    )


CHAIN = {"b": {"a"}, "c": {"b"}}


def accepted(outcomes: Outcomes, producers: Mapping[str, set[str]] = CHAIN) -> dict[str, object]:
    return {j.operator: j.outcome for j in judge(report(outcomes, producers), {}) if j.outcome is not None}


def verdicts(judged: tuple[Judged, ...]) -> dict[str, str]:
    return {j.operator: j.verdict for j in judged}


def test_without_a_baseline_the_verdicts_are_those_of_verification() -> None:
    found = judge(report({"a": None, "b": "x", "c": "y"}, CHAIN, culprits={"b"}), {})

    assert verdicts(found) == {"a": "identical", "b": "culprit", "c": "downstream"}


@pytest.mark.parametrize("why", ["unknown", "unverifiable"])
def test_a_part_whose_calls_cannot_be_repeated_is_not_one_without_calls(why: str) -> None:
    made = Verification("a", firings=9, cut=True)
    found = replace(report({"a": None}, {}), operators=(made,))
    assert found.empty
    setattr(made, why, 9)
    assert not found.empty


def table() -> list[tuple[str, str, str, str]]:
    """The rows of the truth table in the docstring of `judge`: what is here, what is accepted, what else, verdict."""
    rows = [line.strip().strip("|").split("|") for line in (judge.__doc__ or "").splitlines() if "|" in line]
    return [(here.strip(), known.strip(), also.strip(), verdict.strip()) for here, known, also, verdict in rows[2:]]


Case = dict[str, str | bool]


def applies(row: tuple[str, str, str, str], case: Case) -> bool:
    """Whether a row of the table applies to a case, by its words."""
    here, known, also, _ = row
    recorded, made = case["here"] == "as recorded", case["here"]
    heres = {
        "as recorded": recorded,
        "as recorded, or within tolerance": recorded or made == "within tolerance",
        "otherwise": made in ("own", "led"),
        "otherwise, given what was recorded": made == "own",
        "otherwise, given something else": made == "led",
    }
    accepts = {
        "": True,
        "anything": True,
        "another outcome": case["accepted"] == "another",
        "that outcome": case["accepted"] == "that",
        "another, or none": case["accepted"] in ("another", "nothing"),
        "something, for any operator": case["accepted"] != "nothing",
    }
    others = {
        "": True,
        "whole": bool(case["whole"]),
        "not whole": not case["whole"],
        "a stored message differs from its record": bool(case["changed"]),
        "not led astray": not case["astray"],
    }
    return heres[here] and accepts[known] and others[also]


def test_the_verdict_is_that_of_the_first_row_of_the_table_that_applies() -> None:
    met = set()
    for made, known, whole, changed, astray in itertools.product(
        ("as recorded", "within tolerance", "own", "led"),
        ("nothing", "another", "that"),
        (True, False),
        (True, False),
        (True, False),
    ):
        if known == "that" and made not in ("own", "led"):
            continue
        case: Case = {"here": made, "accepted": known, "whole": whole, "changed": changed, "astray": astray}
        differs = made != "as recorded"
        outcome = report(
            {"a": "new" if astray else None, "b": "x" if differs else None},
            {"b": {"a"}},
            culprits={"a", "b"} if made == "own" else {"a"},
        )
        b = outcome.operators[1]
        b.unverifiable = 0 if whole else 1
        if made == "within tolerance":
            outcome = replace(outcome, tolerance=1.0, comparisons={"b": OutputComparison("b", within=3)})
        elif changed:
            outcome = replace(outcome, stored=(StoredStream("b/out", "b", changed=1, first_changed=(0, 4)),))
        baseline = accepted({"b": "x" if known == "that" else "y"}, {}) if known != "nothing" else {}

        [row, *_] = [row for row in table() if applies(row, case)]
        expected = made if row[3] == "identical, within tolerance" else row[3]
        expected = "identical" if expected == "as recorded" else expected
        found = next(j.verdict for j in judge(outcome, baseline) if j.operator == "b")

        assert found == expected, (case, row)
        met.add(row)
    assert met == set(table())


def test_only_accepted_changes_pass() -> None:
    known = accepted({"a": None, "b": "x", "c": "y"})
    same = report({"a": None, "b": "x", "c": "y"}, CHAIN, culprits={"b"})

    assert verdicts(judge(same, known)) == {"a": "identical", "b": "accepted", "c": "accepted"}
    other = report({"a": None, "b": "z", "c": "y"}, CHAIN, culprits={"b"})
    assert verdicts(judge(other, known))["b"] == "culprit"


def test_new_change_downstream_of_an_accepted_one_is_a_culprit() -> None:
    known = accepted({"a": None, "b": "x", "c": "y"})

    found = judge(report({"a": None, "b": "x", "c": "new"}, CHAIN, culprits={"b"}), known)

    assert verdicts(found) == {"a": "identical", "b": "accepted", "c": "culprit"}


def test_consequences_of_a_new_change_are_downstream() -> None:
    known = accepted({"a": "x", "b": "x", "c": "x"})

    found = judge(report({"a": "x", "b": "new", "c": "new"}, CHAIN, culprits={"a"}), known)

    assert verdicts(found) == {"a": "accepted", "b": "culprit", "c": "downstream"}


def test_operators_that_feed_each_other_are_both_named_rather_than_neither() -> None:
    circle = {"a": {"b"}, "b": {"a"}, "c": {"b"}}
    known = accepted({"a": "x", "b": "x", "c": "x"}, circle)

    found = judge(report({"a": "n", "b": "n", "c": "n"}, circle, culprits=set()), known)

    assert verdicts(found) == {"a": "culprit", "b": "culprit", "c": "downstream"}


def test_an_accepted_change_that_is_gone_does_not_pass_unseen() -> None:
    found = judge(report({"a": None, "b": None, "c": None}, CHAIN), accepted({"a": None, "b": "x", "c": None}))

    assert verdicts(found)["b"] == "not as accepted"
    assert not Checked(Path("x"), "x", report({}, {}), found).passed


def test_unverifiable_operator_neither_passes_nor_is_accepted(tmp_path: Path) -> None:
    made = report({"a": None}, {})
    made.operators[0].unverifiable = 2
    one = Checked(tmp_path / "r.mcap", "r", made, judge(made, {}))
    baseline = Baseline(tmp_path / "b.json")

    assert one.verdict == "not wholly verified"
    assert baseline.accept(one) == ([], ["a"])
    assert baseline.of(one.path) == {}


@pytest.mark.parametrize("part", ["unverifiable", "lost_records"])
def test_partly_unverifiable_difference_is_not_accepted(tmp_path: Path, part: str) -> None:
    made = report({"a": "x", "b": "y"}, CHAIN, culprits={"a"})
    setattr(made.operators[0], part, 2)
    one = Checked(tmp_path / "r.mcap", "r", made, judge(made, {}))
    baseline = Baseline(tmp_path / "b.json")

    assert verdicts(one.judged) == {"a": "culprit", "b": "downstream"}
    assert baseline.accept(one) == (["b"], ["a"])
    assert set(baseline.of(one.path)) == {"b"}


@pytest.mark.parametrize("part", ["unverifiable", "lost_records"])
def test_an_accepted_outcome_does_not_pass_where_it_could_not_be_repeated_in_part(part: str) -> None:
    known = accepted({"a": "x"}, {})
    made = report({"a": "x"}, {})
    setattr(made.operators[0], part, 2)

    found = judge(made, known)

    assert verdicts(found) == {"a": "unverifiable"}
    assert not found[0].passed


def test_consequences_of_an_unrepeatable_operator_are_not_accepted(tmp_path: Path) -> None:
    made = report({"a": "x", "b": "y", "c": None}, CHAIN, culprits={"a"})
    made = replace(made, repeated={"a": False})
    one = Checked(tmp_path / "r.mcap", "r", made, judge(made, {}))

    assert Baseline(tmp_path / "b.json").accept(one) == ([], ["a", "b"])


def test_unrepeatable_operator_is_not_accepted(tmp_path: Path) -> None:
    made = report({"a": "x"}, {})
    made = replace(made, repeated={"a": False})
    one = Checked(tmp_path / "r.mcap", "r", made, judge(made, {}))

    assert Baseline(tmp_path / "b.json").accept(one) == ([], ["a"])


def test_a_baseline_survives_its_file_and_goes_by_places_beside_it(tmp_path: Path) -> None:
    made = report({"a": "x", "b": None}, {})
    one = Checked(tmp_path / "day" / "r.mcap", "r", made, judge(made, {}))
    baseline = Baseline(tmp_path / "accepted.json")
    assert baseline.accept(one) == (["a"], [])
    baseline.save()

    again = Baseline.load(tmp_path / "accepted.json")

    assert set(again.accepted) == {"day/r.mcap"}
    assert verdicts(judge(made, again.of(one.path))) == {"a": "accepted", "b": "identical"}
    assert again.accept(one) == ([], [])
    assert again.unused([]) == ["day/r.mcap"]
    back = report({"a": None, "b": None}, {})
    assert again.accept(Checked(one.path, "r", back, judge(back, again.of(one.path)))) == (["a"], [])
    assert again.accepted == {}
    assert Baseline.load(tmp_path / "absent.json").accepted == {}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": 7, "accepted": {}}', '{"format": 1, "accepted": [1]}'])
def test_a_file_that_is_no_baseline_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "b.json").write_text(text)

    with pytest.raises(BaselineError, match="baseline"):
        Baseline.load(tmp_path / "b.json")


def test_a_folder_stands_for_all_its_recordings_each_once(tmp_path: Path) -> None:
    for name in ("b.mcap", "a.mcap", "sub/a.mcap", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()

    found = recordings_in([tmp_path, tmp_path / "a.mcap"])

    assert [name for _, name in found] == ["a.mcap", "b.mcap", "sub/a.mcap"]
    assert [name for _, name in recordings_in([tmp_path / "a.mcap", tmp_path / "sub" / "a.mcap"])] == [
        str(tmp_path / "a.mcap"),
        str(tmp_path / "sub" / "a.mcap"),
    ]
    (tmp_path / "empty").mkdir()
    with pytest.raises(ReplayError, match="holds no recording"):
        recordings_in([tmp_path / "empty"])
    with pytest.raises(ReplayError, match="no file or folder"):
        recordings_in([tmp_path / "absent"])


@pytest.mark.parametrize(
    "error", [ReplayError("no sensors"), RunFailed("process died", "its last words"), KeyError("a fault of ours")]
)
def test_error_of_one_recording_is_its_result(error: Exception) -> None:
    def broken(path: Path) -> VerifyReport:
        raise error

    one = check(Path("x.mcap"), "x", broken)

    assert one.verdict == "could not run"
    assert str(error.args[0]) in one.error
    assert not one.passed


def test_operator_traceback_is_distinguished_from_that_of_the_runtime() -> None:
    def failing(operator: str | None) -> Checked:
        def verify(path: Path) -> VerifyReport:
            raise RunFailed("it failed", "Traceback (most recent call last)", operator)

        return check(Path("x.mcap"), "x", verify)

    assert failing(None).internal
    assert not failing("smooth").internal


def test_an_interruption_ends_the_gate() -> None:
    def interrupted(path: Path) -> VerifyReport:
        raise RunFailed("stopped", interrupted=True)

    with pytest.raises(RunFailed, match="stopped"):
        check(Path("x.mcap"), "x", interrupted)
