"""Health follows from counts alone."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow.messages import Diagnostics, Level
from dataflow.sinks.sink import _diagnostics
from dataflow.supervision.core.health import SILENT_AFTER, Health, HealthMonitor, diagnostics_fields

Counts = dict[str, tuple[int, int, int, int, int, int]]


def only(healths: list[Health]) -> Health:
    (health,) = healths
    return health


def after(*samples: tuple[float, int, int, float]) -> Health:
    """The health at the last of (time s, firings, dropped, CPU time s); calls take twice that in wall time."""
    monitor = HealthMonitor()
    found = [monitor.update({"op": counts(n, lost, cpu)}, at) for at, n, lost, cpu in samples]
    return only(found[-1])


def counts(firings: int, dropped: int = 0, cpu: float = 0.0) -> tuple[int, int, int, int, int, int]:
    return firings, firings, dropped, round(cpu * 1e9), 0, round(2 * cpu * 1e9)


def while_waiting(before: dict[tuple[str, str], int], now: dict[tuple[str, str], int], dropped: int = 0) -> Health:
    """The health of an operator that fires on while its waits go from `before` to `now`, within 2 s."""
    monitor = HealthMonitor()
    monitor.update({"op": counts(10)}, 10.0, waits={"op": before})
    return only(monitor.update({"op": counts(30, dropped)}, 12.0, waits={"op": now}))


def test_rates_and_load_are_those_since_the_last_update() -> None:
    health = after((10.0, 100, 4, 1.0), (12.0, 140, 4, 2.0))

    assert health.state == "running"
    assert health.rate == pytest.approx(20.0)
    assert health.load == pytest.approx(0.5)
    assert health.wall == 1.0
    assert health.drop_rate == 0.0
    assert health.level == Level.OK


def test_dropping_operator_reports_the_number() -> None:
    health = after((10.0, 100, 4, 1.0), (12.0, 140, 10, 2.0))

    assert (health.state, health.drop_rate, health.note) == ("dropping", 3.0, "6 dropped in 2.0 s")
    assert health.level == Level.WARN


def test_timeout_is_reported_apart_from_drops() -> None:
    health = while_waiting({("image", "timeout"): 2}, {("image", "timeout"): 5})

    assert (health.state, health.dropped, health.drop_rate) == ("timeout", 0, 0.0)
    assert health.note == "3 waits for an input given up in 2.0 s"
    assert health.level == Level.WARN


def test_late_messages_are_reported_apart_from_drops() -> None:
    health = while_waiting({}, {("image", "late"): 4})

    assert (health.state, health.note) == ("late", "4 messages in 2.0 s came after their firing")
    assert health.drop_rate == 0.0


def test_waits_of_long_ago_say_nothing_of_now() -> None:
    old = {("image", "late"): 4, ("image", "timeout"): 2}

    assert while_waiting(old, old).state == "running"


def test_drops_take_precedence_over_timeouts() -> None:
    assert while_waiting({}, {("image", "late"): 4, ("image", "timeout"): 4}, dropped=1).state == "dropping"


def test_an_operator_that_has_not_fired_is_starting() -> None:
    assert after((10.0, 0, 0, 0.0), (20.0, 0, 0, 0.0)).state == "starting"


def test_an_operator_that_stops_is_silent_after_a_moment() -> None:
    quick = [(t * 0.5, t * 5, 0, 0.0) for t in range(10)]

    assert after(*quick, (4.5 + 0.9 * SILENT_AFTER, 45, 0, 0.0)).state == "running"
    silent = after(*quick, (4.5 + 2.0 * SILENT_AFTER, 45, 0, 0.0))
    assert (silent.state, silent.note, silent.level) == ("silent", "nothing for 2.0 s", Level.STALE)


def test_one_that_is_slow_by_nature_is_given_longer() -> None:
    slow = [(t * 2.0, t, 0, 0.0) for t in range(1, 8)]

    assert after(*slow, (14.0 + 8.0, 7, 0, 0.0)).state == "running"
    assert after(*slow, (14.0 + 11.0, 7, 0, 0.0)).state == "silent"


def test_restarting_and_ended_take_precedence() -> None:
    monitor = HealthMonitor()
    of: Counts = {"gone": counts(5), "through": counts(5)}
    monitor.update(of, 0.0)
    gone, through = monitor.update(
        of, 60.0, away={"gone": "was killed by SIGKILL"}, ended=frozenset({"through"}), restarts={"gone": 3}
    )

    assert (gone.state, gone.note, gone.restarts, gone.level) == ("restarting", "was killed by SIGKILL", 3, Level.ERROR)
    assert (through.state, through.level) == ("ended", Level.OK)


def test_counts_reset_by_a_new_process_give_no_negative_rates() -> None:
    health = after((0.0, 100, 50, 9.0), (1.0, 3, 0, 0.1), (2.0, 13, 0, 0.2))

    assert health.rate == pytest.approx(10.0)
    again = after((0.0, 100, 50, 9.0), (1.0, 3, 0, 0.1))
    assert (again.state, again.rate, again.drop_rate, round(again.load, 6)) == ("running", 3.0, 0.0, 0.1)


def test_drops_are_reported_by_input_and_reason() -> None:
    monitor = HealthMonitor()
    drops = {"op": {("image", "overflow"): 3, ("image", "late"): 1, ("", "past"): 2}}

    values = only(monitor.update({"op": counts(5, 6)}, 0.0, drops=drops)).values()

    assert values["dropped"] == "6"
    told = {key: count for key, count in values.items() if key.startswith("dropped.")}
    assert told == {"dropped.image.overflow": "3", "dropped.image.late": "1", "dropped.past": "2"}


def test_diagnostics_stream_matches_health() -> None:
    healths = [
        Health("camera", "silent", 7, 7, 0, 0.0, 0.0, 0.0, 0.0, 0, "nothing for 3.0 s"),
        Health("detector", "dropping", 9, 9, 4, 5.0, 2.0, 0.9, 1.0, 1, "4 dropped in 2.0 s"),
    ]

    message = _diagnostics(diagnostics_fields(healths, 123))

    assert isinstance(message, Diagnostics)
    assert message.stamp == 123
    assert message.names == ("camera", "detector")
    assert message.messages == ("nothing for 3.0 s", "4 dropped in 2.0 s")
    assert np.array_equal(message.levels, [Level.STALE, Level.WARN])
    assert message.pairs(1) == {"state": "dropping", **healths[1].values()}
