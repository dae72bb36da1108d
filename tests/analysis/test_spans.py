"""Firings as spans of OpenTelemetry: traces from sources' messages, in the encoding that the specification gives."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from diamond_records import DIAMOND, message, one_round, record

from dataflow.analysis.spans import AT_ONCE, Line, Spans
from dataflow.graph import load_text
from dataflow.records.firing import FiringRecord
from dataflow.sync import RunRef


def spans_of(graph_text: str, records: Mapping[str, list[FiringRecord]]) -> list[dict[str, Any]]:
    """Reads what a collector reads: each line a request. The operator that the resource names is added."""
    return read(Spans(load_text(graph_text)).lines(records))


def read(lines: Iterable[Line]) -> list[dict[str, Any]]:
    found = []
    for line, number in lines:
        (resource,) = json.loads(line)["resourceSpans"]
        about = {each["key"]: each["value"]["stringValue"] for each in resource["resource"]["attributes"]}
        (scope,) = resource["scopeSpans"]
        assert len(scope["spans"]) == number
        found += [{**span, "operator": about["service.name"]} for span in scope["spans"]]
    return found


def test_a_trace_runs_from_a_message_of_a_source_to_all_that_it_caused() -> None:
    graph = load_text(DIAMOND)
    rounds = [one_round(graph, k, 100.0 + 20 * k, slow=10) for k in range(2)]

    spans = spans_of(DIAMOND, {name: [r for each in rounds for r in each[name]] for name in rounds[0]})

    by_id = {span["spanId"]: span for span in spans}
    assert len(by_id) == len(spans) == 8
    parents = {span["operator"]: by_id[p]["operator"] for span in spans if (p := span.get("parentSpanId"))}
    assert parents == {"fast": "camera", "slow": "camera", "join": "fast"}
    assert len({span["traceId"] for span in spans}) == 2
    assert {by_id[link["spanId"]]["operator"] for span in spans for link in span["links"]} == {"slow"}
    join = next(span for span in spans if span["operator"] == "join")
    assert int(join["endTimeUnixNano"]) - int(join["startTimeUnixNano"]) == 2_000_000
    for span in spans:
        assert re.fullmatch("[0-9a-f]{32}", span["traceId"])
        assert re.fullmatch("[0-9a-f]{16}", span["spanId"])


def test_a_trace_does_not_depend_on_the_clocks_of_machines() -> None:
    graph = load_text(DIAMOND)
    rounds = [one_round(graph, k, 100.0 + 20 * k, slow=10) for k in range(30)]
    records = {name: [r for each in rounds for r in each[name]] for name in rounds[0]}

    def links(early: int) -> dict[str, tuple[str, str | None, list[Any]]]:
        clocks = {"slow": -early, "join": -early}
        by_clock = {
            name: [replace(r, wall_start=r.wall_start + clocks.get(name, 0)) for r in each]
            for name, each in records.items()
        }
        spans = spans_of(DIAMOND, by_clock)
        assert len(spans) == 120
        return {s["spanId"]: (s["traceId"], s.get("parentSpanId"), s["links"]) for s in spans}

    assert links(500_000_000) == links(-500_000_000) == links(0)


def test_calls_whose_causes_have_lost_their_records_come_all_the_same() -> None:
    graph = load_text(DIAMOND)
    fast = [record("fast", k, k, 1, {"x": message(graph, "slow", 99)}) for k in range(3)]
    slow = [record("slow", k, k, 1, {"x": message(graph, "fast", 99)}) for k in range(3)]

    assert len(spans_of(DIAMOND, {"fast": fast, "slow": slow})) == 6


def test_an_error_has_its_text_and_a_message_that_is_not_known_no_parent() -> None:
    graph = load_text(DIAMOND)
    lost = record("fast", 0, 1, 1, {"x": message(graph, "camera", 99)})
    failed = replace(lost, index=1, outcome="error", detail={"error": "ValueError: no"})

    first, second = spans_of(DIAMOND, {"fast": [lost, failed]})

    assert "parentSpanId" not in first
    assert "status" not in first
    assert second["status"] == {"code": 2, "message": "ValueError: no"}


def test_the_newest_message_of_a_batch_is_the_cause_and_long_runs_come_in_parts() -> None:
    graph = load_text(DIAMOND)
    camera = [record("camera", k, k, 0.5) for k in range(AT_ONCE + 1)]
    stream = message(graph, "camera", 0).stream
    batch = record("fast", 0, AT_ONCE + 5, 1, {"x": (RunRef(stream, 0, 0, 7),)})

    assert len(list(Spans(graph).lines({"camera": camera}))) == 2
    spans = spans_of(DIAMOND, {"camera": camera, "fast": [batch]})

    (cause,) = [span for span in spans if span["spanId"] == spans[-1]["parentSpanId"]]
    assert [each["value"]["intValue"] for each in cause["attributes"]][:2] == ["7", "7"]


def test_spans_of_a_running_graph_wait_for_causes_that_arrive_later() -> None:
    graph = load_text(DIAMOND)
    rounds = [one_round(graph, k, 100.0 + 20 * k, slow=10) for k in range(4)]
    whole = spans_of(DIAMOND, {name: [r for each in rounds for r in each[name]] for name in rounds[0]})
    live, found = Spans(graph, whole=False), []
    for k in range(5):  # the camera's process was asked before it made what the others were given
        late = {"camera": rounds[k - 1]["camera"]} if k else {}
        others = {name: each for name, each in rounds[k].items() if name != "camera"} if k < 4 else {}
        found += [read(live.round({**late, **others}))]
    found += [read(live.rest())]

    def known(spans: list[dict[str, Any]]) -> set[tuple[str, str, str | None, str]]:
        return {(s["traceId"], s["spanId"], s.get("parentSpanId"), str(s["links"])) for s in spans}

    assert [len(each) for each in found] == [0, 4, 4, 4, 4, 0]
    assert known([span for each in found for span in each]) == known(whole)
    assert {a["key"] for a in found[1][0]["attributes"]} == {"dataflow.stamp", "dataflow.incarnation"}
    assert read(live.rest()) == []
