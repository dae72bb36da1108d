"""The life of a process: one table, in which every way ends."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from plays import LEFT, SUM, Play

from dataflow.supervision.core.events import (
    Disconnected,
    Event,
    Exited,
    NotReading,
    Printed,
    Received,
    StopRequested,
    Tick,
)
from dataflow.supervision.core.life import HAS_PROCESS, TRANSITIONS, Life, Step, after


def test_every_state_is_in_the_table_and_can_be_reached() -> None:
    reached = {Life.STARTING} | {to for steps in TRANSITIONS.values() for to in steps.values()}

    assert set(TRANSITIONS) == set(Life) == reached


@pytest.mark.parametrize("state", sorted(HAS_PROCESS, key=lambda life: life.value))
def test_every_process_can_die(state: Life) -> None:
    assert after(state, Step.DIE) is Life.GONE


def test_only_a_process_that_died_can_come_back_and_a_killed_one_can_only_die() -> None:
    assert {state for state, steps in TRANSITIONS.items() if Step.AWAIT in steps} == {Life.GONE}
    assert set(TRANSITIONS[Life.KILLED]) == {Step.DIE}
    assert after(Life.GONE, Step.GO) is None


LABELS = ("left", "smooth", "sum", "@recorder")
SMOOTH = "smooth: {use: runtime_operators:Smooth, inputs: {x: left/fast}, live: {restart: {max: 3, backoff: 50ms}}}"


def messages(label: str) -> st.SearchStrategy[Event]:
    """What a process may say, at any time."""
    operator = "left" if label == "@recorder" else label
    work = st.sampled_from([None, (operator, 5, 0.5), (operator, 5, 500.0)])
    counts = {operator: [1, 1, 0, 0, 5]}
    said = [
        ("joined", {}),
        ("ready", {"first": 1, "steps": None}),
        ("seen", {"stream": "test/left/fast"}),
        ("progress", {"done": {operator: 5}, "counts": counts, "behind": {"left": [3.0, 3.0]}}),
        ("overdue", {"operator": operator, "stamp": 5, "seconds": 2.0}),
        ("backlog", {"messages": 5, "bytes": 5}),
        ("state", {"round": 1, "idle": True, "sent": 1, "received": 1, "full": True, "waiting": {}}),
        ("ended", {"report": {"counts": counts, "streams": {}}}),
        ("closed", {"facts": {}}),
        ("failed", {"operator": operator, "when": "fire", "summary": "no", "where": "", "traceback": ""}),
        ("failed", {"operator": None, "when": "", "summary": "no", "where": "", "traceback": ""}),
        (
            "restarting",
            {"operator": operator, "when": "fire", "summary": "no", "where": "", "traceback": "", "pause": 0.1},
        ),
        ("gap", {"stream": "test/left/fast", "first": 1, "following": 4}),
        ("stream_ended", {"stream": "test/left/fast", "reason": "end of source"}),
        ("jumped", {"operator": "left", "stamp": 3}),
        ("early", {"operator": "left", "last": None, "stamp": 3, "seconds": 50.0}),
        ("lacks", {"operator": operator}),
    ]
    return st.one_of(
        st.sampled_from([Received(label, kind, fields) for kind, fields in said]),
        work.map(lambda at: Received(label, "beat", {"memory": 1, "work": at})),
        st.sampled_from([Disconnected(label), Printed(label, "…"), Exited(label, -9), Exited(label, None)]),
        st.sampled_from([NotReading(label, 5.0, 3), NotReading(label, 5.0, 3, overflowed=True)]),
    )


anything = st.one_of(
    st.sampled_from(LABELS).flatmap(messages),
    st.just(Tick()),
    st.just(StopRequested()),
    st.floats(0.05, 30.0),  # time passes
)


@given(st.booleans(), st.sets(st.sampled_from(LABELS)), st.lists(anything, max_size=40))
def test_run_ends_after_any_sequence_of_events(live: bool, deaf: set[str], course: list[Event | float]) -> None:
    """Nothing raises, no wait is without bound, and after two Ctrl-C the end comes within seconds."""
    play = Play(LEFT, SMOOTH, SUM, live=live, record="run.mcap", stall_timeout=20.0)
    play.deaf |= deaf
    play.begins()
    for event in course:
        if isinstance(event, float):
            play.wait(event)
        else:
            play.tell(event)
    play.stops()
    play.stops()
    play.wait(15.0)

    assert play.over is not None
    assert (play.over.report is None) != (play.over.failure is None)
    assert not any(p.life in HAS_PROCESS for p in play.core.run.processes.values())
