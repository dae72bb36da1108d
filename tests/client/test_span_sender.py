"""Spans on their way to a collector on loopback: repeated, refused, lost, and counted."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from span_collector import collector

from dataflow.client.span_sender import SpanSender, SpansRejected, into_file, to_collector


def outcome(write: Callable[[str], int], requests: int = 1, **how: Any) -> tuple[int, int, str]:
    """Sent, lost and the reason after so many requests of 10 spans each."""
    sender = SpanSender(write, again_after=0.01, **how)
    for k in range(requests):
        sender.put(json.dumps({"k": k}), 10)
    sender.close(5)
    return sender.sent, sender.lost, sender.reason


def test_requests_arrive_in_order_and_are_repeated_where_the_collector_asks_for_it() -> None:
    with collector([(503, ""), (429, ""), (200, "{}")]) as (url, taken):
        assert outcome(to_collector(url), 3)[:2] == (30, 0)
    assert [body["k"] for _, _, body in taken] == [0, 0, 0, 1, 2]
    assert {(path, kind) for path, kind, _ in taken} == {("/v1/traces", "application/json")}


def test_spans_refused_by_the_collector_are_counted_as_lost() -> None:
    with collector([(400, ""), (200, '{"partialSuccess": {"rejectedSpans": "4"}}'), (200, "fine")]) as (url, taken):
        sent, lost, reason = outcome(to_collector(f"{url}/own/path"), 3)
    assert (sent, lost) == (16, 14)
    assert "/own/path answers 400" in reason
    assert len(taken) == 3


def test_where_nothing_answers_spans_wait_within_bounds_and_are_lost_at_the_end() -> None:
    def write(text: str) -> int:
        raise ConnectionRefusedError(111, "Connection refused")

    sender = SpanSender(write, at_most=25, again_after=60)
    for _ in range(5):
        sender.put("{}", 10)
    assert sender.lost == 30  # two requests wait
    sender.close(0.05)

    assert (sender.sent, sender.lost) == (0, 50)
    assert sender.reason in ("Connection refused", "they come faster than they are taken")


def test_a_file_holds_a_request_a_line(tmp_path: Path) -> None:
    assert outcome(into_file(tmp_path / "spans.jsonl"), 2)[:2] == (20, 0)
    assert (tmp_path / "spans.jsonl").read_text() == '{"k": 0}\n{"k": 1}\n'


def test_a_file_that_cannot_be_written_refuses() -> None:
    with pytest.raises(SpansRejected, match="/dev/full: No space left"):
        into_file(Path("/dev/full"))("{}")


@pytest.mark.parametrize("url", ["127.0.0.1:4318", "file:///etc/passwd", "http://", "ftp://127.0.0.1/x"])
def test_malformed_collector_url_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match=r"no URL of a collector, such as http://127.0.0.1:4318/v1/traces"):
        to_collector(url)
