"""Which processes a run has, what each takes and gives, and how each is configured."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dataflow.environments import EnvError
from dataflow.graph import Graph, load_text
from dataflow.messages import FeatureVector
from dataflow.recording.streams.cutting import CUT
from dataflow.reexecution.recorded_run import ENDS, ReplayError
from dataflow.supervision.configs import configurations
from dataflow.supervision.plan import (
    FLIGHT_SETTLES,
    LogPlan,
    ProcessPlan,
    Rendezvous,
    RunPlan,
    process_plans,
    replaced_in,
    taken_keys,
)
from dataflow.supervision.replay import plan_replay
from dataflow.transport import NetworkError

GRAPH = """\
graph: robot
namespace: test
operators:
  left: {use: runtime_operators:Counter}
  smooth: {use: runtime_operators:Smooth, inputs: {x: left/fast}}
  sum: {use: runtime_operators:Sum, inputs: {x: smooth/mean}}
  other: {use: runtime_operators:Sum, inputs: {x: left/fast}}
"""
FAST, SLOW, CONSTANT, MEAN = "test/left/fast", "test/left/slow", "test/left/constant", "test/smooth/mean"


def graph(more: str = "") -> Graph:
    return load_text(GRAPH + more)


def plans(more: str = "", **options: Any) -> dict[str, ProcessPlan]:
    return process_plans(RunPlan(graph(more), **{"placement": "process_each"} | options))


def configs(**options: Any) -> dict[str, dict[str, Any]]:
    plan = RunPlan(graph(), **{"placement": "process_each"} | options)
    processes = process_plans(plan)
    endpoints = {label: f"tcp/127.0.0.1:{7000 + k}" for k, label in enumerate(processes)}
    return {label: config for label, (_, config) in configurations(plan, processes, endpoints).items()}


def test_each_stream_goes_to_the_processes_that_take_it() -> None:
    found = plans()
    assert list(found) == ["left", "smooth", "sum", "other"]
    assert {label: p.publish for label, p in found.items()} == {
        "left": {FAST: 2}, "smooth": {MEAN: 1}, "sum": {}, "other": {}
    }  # fmt: skip
    assert {label: p.subscribe for label, p in found.items()} == {
        "left": (), "smooth": (FAST,), "sum": (MEAN,), "other": (FAST,)
    }  # fmt: skip
    assert not any(p.has_log or p.firings or p.sink for p in found.values())


def test_streams_within_a_process_are_not_published() -> None:
    found = plans(placement={"left": "a", "smooth": "a", "sum": "b", "other": "b"})
    assert {label: (p.nodes, p.publish, p.subscribe) for label, p in found.items()} == {
        "a": (("left", "smooth"), {FAST: 1, MEAN: 1}, ()),
        "b": (("sum", "other"), {}, (FAST, MEAN)),
    }


def test_recorder_subscribes_to_all_streams_and_firing_records() -> None:
    found = plans(record=Path("run.mcap"), compression="lz4", overwrite=True, metadata={"a": {"b": "c"}})
    recorder = found["@recorder"]
    assert (recorder.sink, recorder.nodes, recorder.publish) == ("record", (), {})
    assert recorder.firings == ("left", "smooth", "sum", "other")
    assert taken_keys(graph(), recorder) == {FAST, SLOW, CONSTANT, MEAN} | {
        f"test/@/firings/{name}" for name in recorder.firings
    }
    assert found["left"].publish == {FAST: 3, SLOW: 1, CONSTANT: 1, "test/@/firings/left": 1}
    given = dict(recorder.options)
    assert (given["path"], given["compression"], given["overwrite"]) == ("run.mcap", "lz4", True)
    assert given["metadata"] == {"a": {"b": "c"}}
    assert given["storage"]["on_failure"] == "end"
    some = plans("record: {topics: [smooth/mean]}\n", record=Path("run.mcap"))
    assert some["@recorder"].streams == (MEAN,)


def test_flight_recorder_settles_first_and_runs_without_sinks_have_no_records() -> None:
    options = dict(plans(flight=Path("kept"), live=True)["@recorder"].options)
    assert (options["flight"], options["overwrite"], options["settle"]) == ("kept", True, FLIGHT_SETTLES)
    assert options["label"].startswith("robot-")
    assert options["storage"]["on_failure"] == "go_on"
    assert not any("firings" in key for p in plans().values() for key in p.publish)


def test_viewer_file_omits_the_streams_hidden_by_the_graph() -> None:
    found = plans("view: {hide: [smooth/mean, left/slow]}\n", view_file=Path("run.rrd"))
    assert (found["@view"].sink, found["@view"].streams) == ("view", (CONSTANT, FAST))
    assert found["@view"].options["path"] == "run.rrd"
    assert found["@view"].firings == ()


LOG = LogPlan(Path("run.mcap"), (FAST, CONSTANT), {FAST: 99}, first=7)


def test_recording_replaces_the_operators_of_its_streams() -> None:
    assert replaced_in(graph(), None) == set()
    assert replaced_in(graph(), LOG) == {"left"}
    found = plans(log=LOG, record=Path("again.mcap"))
    log = found["@log"]
    assert (log.nodes, log.has_log, log.publish) == ((), True, {FAST: 3, CONSTANT: 1, "test/@/firings/left": 1})
    assert list(found) == ["@log", "smooth", "sum", "other", "@recorder"]
    assert SLOW not in found["@recorder"].streams  # which the recording lacks
    one = plans(log=LOG, placement="one_process")
    assert list(one) == ["all"]
    assert (one["all"].nodes, one["all"].has_log) == (("smooth", "sum", "other"), True)


def test_log_of_an_inner_operator_keeps_its_upstream_for_others() -> None:
    middle = plans(log=LogPlan(Path("run.mcap"), (MEAN,)))
    assert middle["left"].publish == {FAST: 1}  # to `other` alone
    assert middle["@log"].publish == {MEAN: 1}
    assert "smooth" not in middle


def test_machines_and_environments_are_those_of_a_process_as_a_whole() -> None:
    text = GRAPH.replace("Sum, inputs: {x: smooth", "Sum, machine: arm, env: gpu, inputs: {x: smooth")
    apart = RunPlan(load_text(text), placement="process_each", machines=Rendezvous("tcp/0.0.0.0:7447"))
    found = process_plans(apart)
    assert {label: (p.machine, p.env) for label, p in found.items() if p.machine or p.env} == {"sum": ("arm", "gpu")}
    here = process_plans(RunPlan(load_text(text), placement="process_each"))
    assert (here["sum"].machine, here["sum"].env) == (None, "gpu")
    both = {"smooth": "both", "sum": "both"}
    with pytest.raises(
        NetworkError, match=r"'both' would be on several machines \(arm, this one\): place its operators"
    ):
        process_plans(RunPlan(load_text(text), placement=both, machines=Rendezvous("tcp/0.0.0.0:7447")))
    with pytest.raises(EnvError, match=r"'both' would be in several environments \(gpu, this one\)"):
        process_plans(RunPlan(load_text(text), placement=both))


def test_processes_are_configured_by_the_plan() -> None:
    found = configs(record=Path("run.mcap"), paranoid=True, window=(9, 99))
    assert {label: c["listen"] for label, c in found.items() if "listen" in c} == {
        label: [f"tcp/127.0.0.1:{7000 + k}"] for k, label in enumerate(("left", "smooth", "sum", "other"))
    }
    left = found["left"]
    publish = {FAST: 3, SLOW: 1, CONSTANT: 1, "test/@/firings/left": 1}
    assert (left["nodes"], left["publish"], left["subscribe"]) == (["left"], publish, [])
    assert (left["paranoid"], left["window"], left["firings"], left["warm"], left["replay"]) == (
        True, [9, 99], True, None, None
    )  # fmt: skip
    assert found["sum"]["links_in"] == [[MEAN]]
    assert left["links_out"][1:] == [(False, [FAST]), (False, [FAST])]
    assert found["@recorder"]["kind"] == "record"
    assert found["@recorder"]["links_in"]


@pytest.mark.parametrize(
    ("live", "rate", "expected"), [(True, None, 1.0), (True, 2.0, 2.0), (False, None, None), (False, 0.5, 0.5)]
)
def test_live_run_is_paced_by_the_clock_and_sources_drop_instead_of_waiting(
    live: bool, rate: float | None, expected: float | None
) -> None:
    left = configs(live=live, rate=rate, record=Path("run.mcap"))["left"]
    assert (left["rate"], left["live"]) == (expected, live)
    assert [dropping for dropping, _ in left["links_out"]] == [False, live, live]  # the recorder takes all


def test_a_replay_from_the_middle_begins_warm() -> None:
    begun = LogPlan(Path("run.mcap"), (FAST,), {FAST: 99}, first=7, start=40, end=90)
    found = configs(log=begun)
    expected = {"path": "run.mcap", "streams": [FAST], "finals": {FAST: 99}, "first": 7, "start": 40, "end": 90}
    assert found["@log"]["replay"] == expected | {"bag": None}
    assert found["smooth"]["replay"] is None
    assert found["smooth"]["warm"] == {"path": "run.mcap", "stamp": 40}
    assert configs(log=LOG)["smooth"]["warm"] is None
    foreign = LogPlan(Path("run.bag"), (FAST,), start=40, bag={"format": "bag1"})
    assert configs(log=foreign)["smooth"]["warm"] is None


# -- what a recording plays --------------------------------------------------------------------------------------------


def recorded(*streams: str, cut: int | None = None) -> Any:
    """A recording of streams that begin at 5 s, the static one at 0, and what of each is known."""
    infos = {
        s: SimpleNamespace(
            first=0 if s == CONSTANT else 5_000_000_000, static=s == CONSTANT, schema=FeatureVector.SCHEMA,
            message_type=FeatureVector, declaration=None,
        )
        for s in streams
    }  # fmt: skip
    metadata = {ENDS: {FAST: json.dumps({"final": 99})}}
    if cut is not None:
        metadata[CUT] = {"of": "x", "start": str(cut)}
    return SimpleNamespace(path=Path("run.mcap"), streams=infos, metadata=metadata, opening=lambda: None)


def test_recorded_streams_take_the_place_of_the_sources_from_so_many_seconds_on() -> None:
    plan = plan_replay(recorded(FAST, SLOW, CONSTANT, MEAN), graph(), start=1.5, end=3.0)
    assert plan == LogPlan(
        Path("run.mcap"),
        (CONSTANT, FAST, SLOW),
        {FAST: 99},
        first=5_000_000_000,
        start=6_500_000_000,
        end=8_000_000_000,
    )
    whole = plan_replay(recorded(FAST), graph())
    assert (whole.first, whole.start, whole.end) == (5_000_000_000, None, None)
    middle = plan_replay(recorded(FAST, MEAN), graph(), replaced=["smooth"])
    assert middle.streams == (MEAN,)


def test_a_part_of_a_recording_begins_where_it_was_cut() -> None:
    part = plan_replay(recorded(FAST, cut=7_000_000_000), graph(), end=1.0)
    assert (part.first, part.start, part.end) == (7_000_000_000, 7_000_000_000, 8_000_000_000)
    assert plan_replay(recorded(FAST, cut=7_000_000_000), graph(), start=0.5).start == 7_500_000_000


def test_missing_stream_is_named_with_its_consumer() -> None:
    with pytest.raises(
        ReplayError, match=r"no stream of 'left' is in the recording \(looked for .*; it holds test/smooth"
    ):
        plan_replay(recorded(MEAN), graph())
    with pytest.raises(ReplayError, match="'test/left/fast' of 'left' was not recorded, but 'smooth' takes it"):
        plan_replay(recorded(SLOW), graph())
    assert plan_replay(recorded(SLOW), graph(), resting=["smooth", "other"]).streams == (SLOW,)
    with pytest.raises(ReplayError, match=r"nothing of run\.mcap can be played into graph 'robot'"):
        plan_replay(recorded(FAST), graph(), replaced=[])
    wrong = recorded(FAST)
    wrong.streams[FAST].message_type = None
    with pytest.raises(ReplayError, match=r"stream 'test/left/fast' holds .*, the graph's 'left' emits"):
        plan_replay(wrong, graph())
