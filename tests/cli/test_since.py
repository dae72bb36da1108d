"""What a report says of an operator that differs alike: what changed since the recording, or that nothing did."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from dataflow.causes.why import Cause, CauseReport
from dataflow.cli.commands.verification import _reasons
from dataflow.cli.support.causes import _lines
from dataflow.cli.support.verdicts import explain
from dataflow.records.comparison import Difference, Verification
from dataflow.verification.gate import Checked, judge
from dataflow.verification.report import VerifyReport

FIRST = Difference(0, "fire", 1, "out", "a", "b", call=0)


def said(more: dict[str, Any], **of: Any) -> str:
    """The sentence about the second run of an operator. `of`: its verification; `more`: of the report."""
    found = Verification("x", firings=1, verified=1, differing=1, first=FIRST, own_fault=True, **of)
    report = VerifyReport((found,), (), more.pop("facts", ()), 1, 1, 1.0, 1.0, repeated={"x": True}, **more)
    [judged] = judge(report, {})
    checked = Checked(Path("run.mcap"), "run", report, (judged,))
    [line] = [line for line in explain(checked, judged) if "second time" in line]
    return line


@pytest.mark.parametrize(
    ("of", "more", "sentence"),
    [
        ({"code_known": True, "code_changed": ["rig"]}, {}, "changed since the recording: its code"),
        (
            {"code_known": True},
            {"changes": {"x": ("parameter gain 1 → 2",)}},
            "changed since the recording: parameter gain 1 → 2",
        ),
        (
            {"code_known": True},
            {"facts": (("python", "3.11", "3.12"),)},
            "changed since the recording: libraries or the machine",
        ),
        (
            {"files_changed": ["a.npy"]},
            {},
            "changed since the recording: a file that it read; perhaps its code, of which the recording has no digests",
        ),
        (
            {},
            {"facts": (("python", "3.11", "3.12"),)},
            "changed since the recording: libraries or the machine; perhaps its code, of which the recording has no",
        ),
        ({"code_known": True}, {}, "its code, parameters, libraries and machine are as recorded"),
        ({}, {}, "its code, of which the recording has no digests"),
    ],
)
def test_report_names_changes_or_none(of: dict[str, Any], more: dict[str, Any], sentence: str) -> None:
    assert sentence in (told := said(more, **of))
    assert ("no digests" in told) is not of.get("code_known", False)


def test_unchanged_operator_is_reported_as_recorded() -> None:
    [line] = _lines(CauseReport("x", repeats=True, code_known=True, reruns=4))

    assert (
        "code, parameters, libraries and machine are as recorded: what it reads from outside may have changed" in line
    )
    assert "files that C libraries read" in line


def test_files_that_have_an_effect_and_are_older_than_the_recording_are_named() -> None:
    lines = list(_lines(CauseReport("x", repeats=True, code_known=True, also=(Cause("file:/etc/gain"),), reruns=4)))

    assert lines[1] == "x: its results also depend on file /etc/gain, older than the recording"


def test_without_culprit_no_causes_are_looked_for(capsys: pytest.CaptureFixture[str]) -> None:
    report = VerifyReport((Verification("x", firings=1, verified=1),), (), (), 1, 1, 1.0, 1.0)

    assert _reasons(Checked(Path("run.mcap"), "run", report), None, None) == []
    assert "no causes to look for: there is no culprit" in capsys.readouterr().err
