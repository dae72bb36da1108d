"""Operators are divided among workers: each once, together with what must make its inputs, and evenly."""

from __future__ import annotations

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from dataflow.graph import load_graph
from dataflow.verification.workers.partition import START_NS, Job, balanced, jobs_for, units, with_checks

MIXED = Path(__file__).resolve().parent.parent / "runtime" / "mixed.yaml"
OPERATORS = ("mix", "smooth", "merge", "sum")
loads = st.lists(st.integers(0, 10**9), min_size=1, max_size=12)


@given(loads, st.integers(1, 5))
def test_every_unit_is_in_one_part_and_no_part_is_much_heavier_than_another(work: list[int], jobs: int) -> None:
    by_name = {f"operator {k}": load for k, load in enumerate(work)}
    alone = [frozenset({name}) for name in by_name]

    parts = balanced(alone, by_name, jobs)

    assert sorted(name for part in parts for name in part) == sorted(by_name)
    assert len(parts) == min(jobs, len(work))
    assert all(parts)
    sums = [sum(by_name[name] for name in part) for part in parts]
    assert max(sums) - min(sums) <= max(work)


def test_an_operator_whose_input_was_not_recorded_is_with_the_one_that_makes_it() -> None:
    graph = load_graph(MIXED)
    everything = set(graph.streams)

    assert units(graph, everything, OPERATORS) == {name: {name} for name in OPERATORS}
    assert units(graph, everything - {"test/mix/mixed"}, ["smooth", "sum"]) == {"smooth": {"smooth"}, "sum": {"sum"}}
    assert units(graph, everything - {"test/mix/mixed"}, OPERATORS) == {
        "smooth": {"mix", "smooth"},
        "merge": {"mix", "merge"},
        "sum": {"sum"},
    }
    assert set().union(*units(graph, [], OPERATORS).values()) == set(OPERATORS)


def test_operators_that_feed_only_one_another_are_one_unit() -> None:
    graph = load_graph(MIXED)  # mix takes what smooth makes of what mix has made

    assert units(graph, set(graph.streams) - {"test/mix/mixed", "test/smooth/mean"}, ["mix", "smooth"]) == {
        "mix": {"mix", "smooth"}
    }


def test_cheap_operators_are_repeated_by_several_parts_and_costly_ones_once() -> None:
    decoding = [frozenset({"decoder", "odometry"}), frozenset({"decoder", "detector"})]

    assert balanced(decoding, {"decoder": 1, "odometry": 10, "detector": 9}, 2) == decoding
    assert balanced(decoding, {"decoder": 10, "odometry": 1, "detector": 2}, 2) == [decoding[0] | decoding[1]]


def test_where_other_work_levels_the_parts_a_unit_goes_where_it_adds_least() -> None:
    decoding = [frozenset({"decoder", "odometry"}), frozenset({"decoder", "cloud"}), frozenset({"score"})]
    work = {"decoder": 2, "odometry": 10, "cloud": 4, "score": 1}

    assert balanced(decoding, work, 2) == [decoding[0], decoding[1] | decoding[2]]
    assert balanced(decoding, work, 2, level=20) == [decoding[0] | decoding[1], decoding[2]]


def test_stream_is_checked_by_its_reader_else_its_producer_else_the_first_part() -> None:
    graph = load_graph(MIXED)
    checks = ["test/left/slow", "test/merge/seen", "test/mix/mixed", "test/smooth/mean"]

    parts = with_checks(graph, [Job(("sum",)), Job(("smooth", "merge"))], checks)

    assert [part.checks for part in parts] == [
        ("test/left/slow", "test/merge/seen"),
        ("test/mix/mixed", "test/smooth/mean"),
    ]


def test_no_worker_is_started_for_less_work_than_its_start() -> None:
    assert jobs_for({"a": START_NS // 2}, 8) == 1
    assert jobs_for({"a": START_NS, "b": START_NS}, 8) == 3
    assert jobs_for({"a": 100 * START_NS}, 8) == 8
