"""Replay and verification that begin in the middle of a recording, with the states that operators had there."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dataflow.chaos.plan import plan_of
from dataflow.execution.failure import OperatorFailure
from dataflow.execution.recorded import RecordedRunner
from dataflow.graph import load_graph
from dataflow.recording import Recording
from dataflow.recording.streams import reader
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import FiringLog, recorded_firings
from dataflow.reexecution import engine
from dataflow.reexecution.engine import Recomputation, plan_feeding
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.reexecution.warm_start import _taken_from, held_before, warm_start
from dataflow.state import StateError
from dataflow.supervision.run import replay, run
from dataflow.sync import Entry, MessageRef
from dataflow.verification.verify import verify

pytestmark = pytest.mark.usefixtures("in_process")

HERE = Path(__file__).resolve().parent


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("middle") / "run.mcap"
    report = run(load_graph(HERE / "chaos.yaml", settings=["count=120"]), placement="one_process", record=path)
    assert not report.interrupted  # a signal that ends tests is taken by the run, whose recording is then a part
    return path


def messages(path: Path) -> dict[str, dict[int, bytes]]:
    with Recording(path) as recording:
        return {
            name: {item.message.stamp: item.message.digest() for item in recording.messages([name])}
            for name, stream in recording.streams.items()
            if not stream.static and "/@/" not in name
        }


@pytest.mark.long
def test_replay_from_the_middle_equals_the_whole_one_there(recorded: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.mcap"

    replay(recorded, start=0.5, placement="process_each", record=again)

    whole, part = messages(recorded), messages(again)
    assert part["test/tuned/y"]
    for stream, found in part.items():
        assert found.items() <= whole[stream].items(), stream
        assert len(found) < len(whole[stream])


@pytest.mark.long
def test_verification_from_the_middle_takes_up_recorded_states(recorded: Path) -> None:
    whole = {v.operator: v for v in verify(recorded, jobs=1).operators}

    report = verify(recorded, start=0.5)

    assert report.identical, report.as_json()
    found = {v.operator: v for v in report.operators}
    assert found["tuned"].began == "snapshot"
    assert 0 < found["tuned"].verified < whole["tuned"].verified
    assert found["smooth"].began == "start"  # it has a state and gives no snapshot
    assert found["smooth"].verified == whole["smooth"].verified


def test_a_state_that_restores_to_something_else_is_found(recorded: Path, tmp_path: Path) -> None:
    text = (HERE / "chaos.yaml").read_text().replace("runtime_operators:Tuned", "runtime_operators:TunedForgetful")
    changed = tmp_path / "changed.yaml"
    changed.write_text(text)

    report = verify(recorded, graph=load_graph(changed, settings=["count=120"]), start=0.5, only=["tuned"])

    assert report.culprits == ("tuned",)


@pytest.mark.long
def test_replay_from_the_middle_has_the_parameters_of_the_last_restart(tmp_path: Path) -> None:
    text = (HERE / "chaos.yaml").read_text().replace("runtime_operators:Tuned", "runtime_operators:TunedAtStart")
    file, path = tmp_path / "chaos.yaml", tmp_path / "run.mcap"
    file.write_text(text)
    graph = load_graph(file, settings=["count=180"], live=True)
    plan = {
        "faults": [
            {"kind": "param", "operator": "tuned", "name": "factor", "values": [3.0], "at": "200ms"},
            {"kind": "raise", "operator": "tuned", "at": "400ms"},
            {"kind": "param", "operator": "tuned", "name": "factor", "values": [2.0], "at": "1s"},
        ]
    }
    run(graph, live=True, placement="one_process", record=path, faults=plan_of(plan, graph), rate=1.0)

    report = verify(path, start=1.2, only=["tuned"])

    with Recording(path) as recording:
        kinds = [r.kind for r in recorded_firings(recording, "tuned") if r.kind in ("setup", "param")]
    assert kinds == ["setup", "param", "setup", "param"]
    assert report.identical, report.as_json()
    assert report.operators[0].began == "snapshot"


def test_a_tolerance_for_messages_is_none_for_the_states_between_them(recorded: Path, tmp_path: Path) -> None:
    text = (HERE / "chaos.yaml").read_text().replace("runtime_operators:Tuned", "runtime_operators:TunedNudged")
    changed = tmp_path / "changed.yaml"
    changed.write_text(text)

    graph = load_graph(changed, settings=["count=120"])
    exact, tolerant = (verify(recorded, graph=graph, only=["tuned"], tolerance=t) for t in (None, 0.01))

    assert exact.culprits == ("tuned",)
    assert exact.operators[0].states > 0
    assert tolerant.within_tolerance, tolerant.as_json()


def test_a_replay_passes_over_states_that_do_not_fit_the_class_as_it_is_now(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = load_graph(HERE / "chaos.yaml", settings=["count=120"])
    stamp = [r.stamp for r in recorded_firings(Recording(recorded), "tuned") if r.kind == "fire"][80]
    by_state = warm_start(recorded, graph, graph.nodes["tuned"], stamp)

    def misfits(operator: Any, state: Any) -> None:
        raise StateError("it has no total, which the class has now")

    monkeypatch.setattr("runtime_operators.Tuned.restore", misfits)
    repeated = warm_start(recorded, graph, graph.nodes["tuned"], stamp)

    assert by_state is not None
    assert repeated is not None
    assert (by_state.began, repeated.began) == ("snapshot", "start")
    assert by_state.operator.snapshot() == repeated.operator.snapshot()
    monkeypatch.setattr("runtime_operators.Tuned.setup", misfits)
    with pytest.raises(OperatorFailure, match=r"failed in setup\(\)"):
        warm_start(recorded, graph, graph.nodes["tuned"], stamp)


def test_a_start_beyond_the_end_is_refused(recorded: Path) -> None:
    with pytest.raises(ReplayError, match="s long"):
        verify(recorded, start=1e9)


@pytest.mark.long
def test_a_replay_that_begins_where_a_state_was_recorded_gives_nothing_twice(recorded: Path, tmp_path: Path) -> None:
    with Recording(recorded) as recording:
        first = min(s.first for s in recording.streams.values() if s.first and not s.static)
        state = next(r.stamp for r in recorded_firings(recording, "tuned") if r.kind == "snapshot" and r.stamp > first)

    replay(recorded, start=(state - first) * 1e-9, placement="one_process", record=tmp_path / "again.mcap")

    whole, part = messages(recorded), messages(tmp_path / "again.mcap")
    assert part["test/tuned/y"].items() <= whole["test/tuned/y"].items()


@pytest.mark.long
def test_reexecution_from_the_middle_reads_only_needed_messages(tmp_path: Path) -> None:
    text = (
        (HERE / "chaos.yaml")
        .read_text()
        .replace(
            "use: runtime_operators:Tuned, inputs: {x: merge/seen}",
            "use: runtime_operators:TunedByConstant, inputs: {x: merge/seen, constant: left/constant}",
        )
    )
    file, path = tmp_path / "chaos.yaml", tmp_path / "run.mcap"
    file.write_text(text)
    graph = load_graph(file, settings=["count=120"])
    run(graph, placement="one_process", record=path)
    read: dict[str, list[int]] = {}

    with Recording(path) as recording:
        begin = sorted(item.message.stamp for item in recording.messages(["test/left/fast"]))[90]
        feeding = plan_feeding(recording, graph, ["tuned"]).reading(["test/right/fast"])
        work = Recomputation(
            recording,
            graph,
            feeding,
            FiringLog.read(recording),
            made=lambda stream, entry: None,
            read=lambda stream, entry: read.setdefault(stream, []).append(entry.stamp),
            begin=begin,
        )
        state = max(r.stamp for r in recorded_firings(recording, "tuned") if r.kind == "snapshot" and r.stamp <= begin)
        result = work.run()["tuned"]

    assert result.whole
    assert result.first is None
    assert len(read["test/left/constant"]) == 1
    assert state < min(read["test/merge/seen"]) <= begin
    assert min(read["test/right/fast"]) >= begin


def test_setting_up_is_no_part_of_the_time_of_a_re_execution(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    set_up = RecordedRunner.setup

    def slow(runner: RecordedRunner) -> None:
        clock[0] += 100.0
        set_up(runner)

    def made(stream: str, entry: Entry) -> None:
        clock[0] += 0.001

    monkeypatch.setattr(engine, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr(RecordedRunner, "setup", slow)
    graph = load_graph(HERE / "chaos.yaml", settings=["count=120"])
    with Recording(recorded) as recording:
        feeding = plan_feeding(recording, graph, ["tuned"])
        work = Recomputation(recording, graph, feeding, FiringLog.read(recording), made=made)
        work.run()

    assert 0.0 < work.wall < 100.0


def test_held_messages_are_found_without_reading_the_whole_recording(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = load_graph(HERE / "chaos.yaml", settings=["count=120"])
    static = frozenset(name for name, stream in graph.streams.items() if stream.static)
    with Recording(recorded) as recording:
        messages = list(recording.messages(["test/left/fast"]))
    decoded: list[str] = []
    decode = reader.decoded

    def counted(path: Path, stream: str, *rest: Any) -> Any:
        decoded.append(stream)
        return decode(path, stream, *rest)

    monkeypatch.setattr(reader, "decoded", counted)

    held, began = held_before(recorded, graph.nodes["mix"], messages[90].message.stamp, static)

    assert began
    assert held
    assert all(entry.stamp < messages[90].message.stamp for entry in held)
    assert len(decoded) <= len(held) + len(graph.nodes["mix"].inputs)


def test_of_what_later_calls_took_only_messages_before_the_stamp_are_noted() -> None:
    records = (FiringRecord("op", 0, k, "fire", 10 * k, inputs={"x": MessageRef("s", 0, k - 2)}) for k in range(5000))
    taken, began = _taken_from(records, 40, {"s": (0, 3)})
    assert began
    assert taken == {"s": {(0, 2), (0, 3)}}
