"""A call is answered soon or by a job; answers fit; what goes wrong is said, and no process stays."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from dataflow.tool_server import jobs as module
from dataflow.tool_server.jobs import MOST_BYTES, CallFailed, Jobs, cut

BOUND = 60.0


@pytest.fixture
def patient() -> Iterator[Jobs]:
    jobs = Jobs(soon=BOUND)
    yield jobs
    jobs.close()


@pytest.fixture
def hasty() -> Iterator[Jobs]:
    jobs = Jobs(soon=0.0)
    yield jobs
    jobs.close()


def test_output_of_operators_accompanies_the_answer(patient: Jobs, loud: tuple[str, str]) -> None:
    recording, folder = loud
    text = patient.call("goto", {"recording": recording, "operator": "loud", "call": "0", "path": [folder]})

    told, _, printed = text.partition("\nprinted: ")
    assert json.loads(told)["same"]
    assert "printed by Python" in printed
    assert "written by a library" in printed


def test_a_call_that_takes_longer_is_a_job_which_can_be_ended(hasty: Jobs, loud: tuple[str, str]) -> None:
    told = json.loads(hasty.call("verify", {"recording": loud[0], "path": [loud[1]]}))
    assert (told["job"], told["tool"], told["next"]) == ("1", "verify", 'job(id="1") gives the answer')

    hasty.job("1", cancel=True)
    hasty._soon = BOUND
    with pytest.raises(CallFailed, match="job 1 was cancelled"):
        hasty.job("1")
    with pytest.raises(CallFailed, match="no job '2'; there are: 1"):
        hasty.job("2")
    process = hasty._jobs["1"].process
    assert process is None or process.returncode is not None


def test_no_more_calls_wait_than_are_allowed(
    hasty: Jobs, loud: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST_WAITING", 1)
    hasty.call("verify", {"recording": loud[0]})

    with pytest.raises(CallFailed, match="1 jobs are not done: wait for one, or end one"):
        hasty.call("verify", {"recording": loud[0]})


def test_process_that_ends_without_answer_is_reported(patient: Jobs, tmp_path: Path) -> None:
    (tmp_path / "ends.py").write_text("import os\nprint('a last word', flush=True)\nos._exit(3)\n")
    graph = tmp_path / "ends.yaml"
    graph.write_text("graph: ends\noperators:\n  a: {use: 'ends:A'}\n")
    kept = Path(__file__).resolve().parent.parent / "recordings_of" / "run.mcap"

    with pytest.raises(CallFailed, match=r"the process of verify ended without an answer \(3\): a last word"):
        patient.call("verify", {"recording": str(kept), "graph": str(graph), "path": [str(tmp_path)]})


def test_a_long_answer_is_given_in_parts_that_fit() -> None:
    text = "".join(f"{k}: größer; " for k in range(3000))
    offset, parts = 0, []
    while True:
        part = cut(text, offset, "7")
        assert len(part.encode()) <= MOST_BYTES
        said, note, rest = part.rpartition("\n(bytes ")
        if not note:
            parts.append(part)
            break
        parts.append(said)
        offset = int(rest.partition("offset=")[2].partition(")")[0])
    assert "".join(parts) == text
    with pytest.raises(CallFailed, match="the answer of job 7 has"):
        cut(text, 10**6, "7")
