"""The calls of an operator without state are divided among workers, and the verdict is that on all of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tampering import tampered

from dataflow.graph import Graph
from dataflow.records.firing import FiringRecord
from dataflow.supervision.core.report import Status
from dataflow.verification.verify import verify
from dataflow.verification.workers import slices
from dataflow.verification.workers.slices import LEAST_NS, cut, shares

PER_CALL = 50_000
WithClass = Callable[[str, str], Graph]


def told(report: Any) -> dict[str, Any]:
    """The report but for the times in it."""
    found = report.as_json()
    for name in ("wall_s", "real_time_factor", "reading_cpu_ms"):
        del found[name]
    for operator in found["operators"]:
        assert operator.pop("cpu_ms") > 0
    return found


@pytest.fixture
def divided(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Divides operators however little they do; the slices that were made, by operator."""
    monkeypatch.setattr(slices, "LEAST_NS", 1)
    seen: list[dict[str, Any]] = []
    answer = slices.answer

    def noted(books: Any, answers: Any) -> Any:
        seen.extend(each["slices"] for each in answers)
        return answer(books, answers)

    monkeypatch.setattr(slices, "answer", noted)
    return seen


@given(
    st.lists(st.integers(0, 10**10), min_size=1, max_size=6),
    st.lists(st.tuples(st.integers(1, 10**10), st.integers(0, 10**9)), max_size=4),
)
def test_all_work_is_given_out_and_no_slice_is_small(loads: list[int], divisible: list[tuple[int, int]]) -> None:
    work = {f"operator {k}": ns for k, (ns, _) in enumerate(divisible)}
    makers = {f"operator {k}": ns for k, (_, ns) in enumerate(divisible)}

    poured = shares(loads, makers, work)

    assert {name: sum(ns for _, ns in of) for name, of in poured.items()} == work
    assert all(ns >= min(LEAST_NS, work[name]) for name, of in poured.items() for _, ns in of)
    assert all(len({part for part, _ in of}) == len(of) for of in poured.values())
    filled = list(loads)
    for name, of in poured.items():
        for part, ns in of:
            filled[part] += ns + makers[name]
    level = (sum(loads) + sum(work.values()) + sum(makers[name] for name in work)) / len(loads)
    more = LEAST_NS + sum(makers[name] * len(of) for name, of in poured.items())
    assert max(filled) <= max(level + 2 * more, *loads, 0)


@given(
    st.lists(st.tuples(st.integers(0, 30), st.integers(0, 10**6)), min_size=1, max_size=30),
    st.lists(st.integers(1, 10**7), min_size=1, max_size=4),
)
def test_every_call_is_in_one_slice(calls: list[tuple[int, int]], amounts: list[int]) -> None:
    setup = FiringRecord(operator="x", incarnation=0, index=0, kind="setup", stamp=0)
    records = [setup] + [
        FiringRecord(operator="x", incarnation=0, index=k, kind="fire", stamp=stamp, duration=ns)
        for k, (stamp, ns) in enumerate(calls, start=1)
    ]

    made = cut(records, amounts, PER_CALL)

    assert 1 <= len(made) <= len(amounts)
    places = [len(calls) if s.end is None else next(k for k, (t, _) in enumerate(calls) if t >= s.end) for s in made]
    begins = [0 if s.begin is None else next(k for k, (t, _) in enumerate(calls) if t >= s.begin) for s in made]
    assert begins == [0, *places[:-1]]
    assert places[-1] == len(calls)
    assert places == sorted(set(places))


@pytest.mark.long
def test_divided_operator_gets_verdict_and_digests_of_undivided(
    kept: Path, divided: list[dict[str, Any]], with_class: WithClass
) -> None:
    graph, seen = with_class("look", "Alone"), list[Status]()

    whole, parts = (verify(kept, graph=graph, jobs=jobs, watch=seen.append) for jobs in (1, 3))

    assert sum("look" in each for each in divided) > 1
    assert seen[-1].operators["look"].firings == parts.work["look"].firings
    assert parts.identical
    assert told(parts) == told(whole)
    assert parts.digests == whole.digests
    assert parts.work["look"].firings == whole.work["look"].firings


@pytest.mark.long
def test_first_difference_of_divided_operator_is_that_of_undivided(
    kept: Path, divided: list[dict[str, Any]], with_class: WithClass
) -> None:
    graph = with_class("look", "Moody")

    whole, parts = (verify(kept, graph=graph, jobs=jobs) for jobs in (1, 3))

    assert sum("look" in each for each in divided) > 1
    assert parts.culprits == ("look",)
    assert told(parts) == told(whole)


@pytest.mark.long
def test_operator_that_wrongly_declares_stateless_is_verified_as_a_whole(
    kept: Path, divided: list[dict[str, Any]], with_class: WithClass
) -> None:
    report = verify(kept, graph=with_class("look", "Forgetful"), jobs=3)

    assert any(each["look"]["operator"]["first"] for each in divided if "look" in each)
    assert report.identical


def test_producer_of_unrecorded_inputs_is_repeated_with_differing_operator(
    kept: Path, tmp_path: Path, divided: list[dict[str, Any]], with_class: WithClass
) -> None:
    thin = tampered(
        kept,
        tmp_path / "thin.mcap",
        messages=lambda found: [] if found.stream == "kept/smooth/mean" else [(found.message, found.seq)],
    )

    report = verify(thin, graph=with_class("look", "Moody"), jobs=2)

    assert sum("look" in each for each in divided) > 1
    assert "look" in report.culprits
