"""When a process reports: not too often, and no later than when there is nothing else to do."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from process_doubles import RecordedChannel

from dataflow.execution.driver import Driver
from dataflow.execution.work import Work
from dataflow.process.progress import REPORT_EVERY, REPORT_IDLE, Progress


class Reporting:
    """The progress of one operator, and a clock for it."""

    def __init__(self) -> None:
        ports = SimpleNamespace(emitted=0, states={})
        node = SimpleNamespace(name="last")
        self.operator = SimpleNamespace(
            node=node, done=0, firings=0, drops={}, timeouts={}, late={}, ports=ports, work=Work(),
            working_since=None,
            operator=SimpleNamespace(finding=lambda: f"{self.operator.done} things lie askew"),
        )  # fmt: skip
        self.channel, self.now = RecordedChannel(), 0.0
        driver = Driver()
        driver.operators.append(self.operator)
        live: Any = SimpleNamespace(runners=[], behind=dict)
        channel: Any = self.channel
        self.progress = Progress(channel, driver, live, lambda: self.now)

    def fires(self, *, idle: bool) -> None:
        self.operator.done += 10
        self.operator.firings += 1
        self.progress.report(idle=idle)

    @property
    def told(self) -> list[int]:
        return [fields["done"].get("last", 0) for fields in self.channel.of("progress")]


def test_a_finding_is_logged_once_while_it_lasts(caplog: pytest.LogCaptureFixture) -> None:
    one = Reporting()
    for _ in range(3):
        one.now += 1
        one.fires(idle=False)
    (line,) = caplog.records
    assert line.getMessage() == "10 things lie askew"
    assert vars(line)["operator"] == "last"
    assert one.progress.found == {"last": "30 things lie askew"}


def test_a_busy_process_reports_now_and_then() -> None:
    one = Reporting()
    for _ in range(8):
        one.fires(idle=False)
        one.now += REPORT_EVERY / 4

    assert one.told == [10, 50]
    assert one.progress.next_due() is None


def test_an_idle_process_reports_at_once_or_wakes_up_to_do_so() -> None:
    one = Reporting()
    one.fires(idle=True)
    one.now += REPORT_IDLE
    one.fires(idle=True)
    one.fires(idle=True)

    assert one.told == [10, 20]
    assert one.progress.next_due() == pytest.approx(REPORT_IDLE)
    one.now += REPORT_IDLE
    one.progress.report(idle=True)
    assert one.told == [10, 20, 30]
    assert one.progress.next_due() is None


def test_unchanged_process_reports_nothing() -> None:
    one = Reporting()
    one.fires(idle=True)
    one.now += 1.0
    one.progress.report(idle=True)

    assert one.told == [10]
    assert one.progress.next_due() is None


def test_counts_that_a_busy_process_has_left_out_follow_when_it_is_idle() -> None:
    one = Reporting()
    one.fires(idle=False)
    one.now += REPORT_EVERY
    one.fires(idle=False)
    assert ["last" in fields["counts"] for fields in one.channel.of("progress")] == [True, False]

    one.now += REPORT_EVERY
    one.progress.report(idle=True)

    assert one.channel.of("progress")[-1]["counts"]["last"][0] == 2
    assert one.progress.counted["last"][0] == 2
    one.now += 1.0
    one.progress.report(idle=True)
    assert len(one.channel.of("progress")) == 3


def test_pending_progress_is_reported_at_once_on_request() -> None:
    one = Reporting()
    one.fires(idle=True)
    one.fires(idle=True)
    one.progress.report(idle=True, at_once=True)
    one.progress.report(idle=True, at_once=True)

    assert one.told == [10, 20]
    assert one.progress.next_due() is None


def test_the_time_since_the_last_firing_is_known_while_a_call_does_not_end() -> None:
    one = Reporting()
    one.fires(idle=True)
    one.now += 7.5

    assert one.progress.silences() == {"last": 7.5}


def test_an_operator_at_its_first_call_is_silent_since_that_began() -> None:
    one = Reporting()
    one.now, one.operator.working_since = 9.0, 2.0

    assert one.progress.silences() == {"last": 7.0}
