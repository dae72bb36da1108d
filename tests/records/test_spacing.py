"""How far apart states are recorded follows from what repeating the calls between them takes."""

from __future__ import annotations

import itertools

from dataflow.graph import load_text
from dataflow.graph.model import Graph
from dataflow.graph.reach import with_makers
from dataflow.records.spacing import CPU_SPACING, LARGE, MOST_OFTEN, REPEATING, StateSpacing

CHAIN = """
graph: chain
record: {{topics: [{topics}], snapshots: cpu}}
operators:
  cam: {{use: 'operators.sources:SyntheticRgbd'}}
  first: {{use: 'operators.monitoring:ImageWatch', inputs: {{image: cam/image}}}}
  second: {{use: 'operators.monitoring:ImageWatch', inputs: {{image: first/checked}}}}
  third: {{use: 'operators.monitoring:ImageWatch', inputs: {{image: second/checked}}}}
"""


def chain(topics: str) -> Graph:
    return load_text(CHAIN.format(topics=topics))


def due(spacing: StateSpacing, each: int, nbytes: int, calls: int) -> list[int]:
    """The calls, of `each` ns of CPU time, behind which a state of `nbytes` is recorded."""
    found = []
    for call in range(1, calls + 1):
        if spacing.is_due(call, call * each, call):
            found.append(call)
            spacing.took(nbytes)
    return found


def test_states_by_event_time_come_at_the_same_firings_whatever_they_cost() -> None:
    assert due(StateSpacing(3), 1, 1, 10) == due(StateSpacing(3), CPU_SPACING, LARGE, 10) == [4, 7, 10]


def test_a_large_state_is_recorded_for_each_spacing_of_cpu_time() -> None:
    each = CPU_SPACING // 10 - REPEATING
    found = due(StateSpacing("cpu"), each, LARGE, 50)
    assert [b - a for a, b in itertools.pairwise(found)] == [10, 10, 10, 10]
    assert due(StateSpacing("cpu"), each, 100 * LARGE, 50) == found


def test_a_small_state_is_recorded_more_often_within_a_bound() -> None:
    each = CPU_SPACING // MOST_OFTEN - REPEATING
    for nbytes, apart in ((LARGE // 4, 4), (49, 1), (0, 1)):
        found = due(StateSpacing("cpu"), each, nbytes, 40)
        assert {b - a for a, b in itertools.pairwise(found)} == {apart}


def test_operators_in_front_that_are_repeated_count_with_each_call() -> None:
    calls = CPU_SPACING // REPEATING
    alone, behind = (due(StateSpacing("cpu", repeated), 0, LARGE, 4 * calls) for repeated in (1, 5))
    assert alone[2] - alone[1] == calls
    assert behind[2] - behind[1] == calls // 5


def test_what_is_repeated_for_a_call_ends_at_recorded_streams() -> None:
    def repeated(record: str, name: str) -> set[str]:
        graph = chain(record)
        return with_makers(graph.record.streams, graph, [name])

    assert repeated("cam/**", "third") == {"first", "second", "third"}
    assert repeated("cam/**", "first") == {"first"}
    assert repeated("cam/**, second/checked", "third") == {"third"}
