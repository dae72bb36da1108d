"""Where operators run, and how fast, never changes a result: every stream's digest is the same."""

from __future__ import annotations

import multiprocessing
import random
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from tests_runtime_graphs import chain

from dataflow.graph import Graph, load_graph
from dataflow.recording import Recording
from dataflow.supervision.run import replay, run

HERE = Path(__file__).resolve().parent


def _burn(until: float) -> None:
    import time

    while time.monotonic() < until:
        sum(range(10_000))


@contextmanager
def busy_cores(count: int = 2, seconds: float = 60.0) -> Iterator[None]:
    """Other processes that want all the cores."""
    import time

    context = multiprocessing.get_context("spawn")
    burners = [context.Process(target=_burn, args=(time.monotonic() + seconds,), daemon=True) for _ in range(count)]
    for burner in burners:
        burner.start()
    try:
        yield
    finally:
        for burner in burners:
            burner.terminate()
            burner.join(5)


def groupings(graph: Graph, count: int, seed: int) -> list[dict[str, str]]:
    """Random assignments of operators to at most four processes."""
    dice = random.Random(seed)
    return [{node: f"process{dice.randrange(1, 5)}" for node in graph.nodes} for _ in range(count)]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """A recorded run in a process each, and its digests."""
    path = tmp_path_factory.mktemp("recorded") / "run.mcap"
    report = run(load_graph(HERE / "mixed.yaml"), placement="process_each", record=path, paranoid=True)
    return path, report.digests()


@pytest.mark.long
def test_a_run_gives_the_same_digests_in_one_process_and_in_a_process_each(mixed: Graph) -> None:
    together = run(mixed, placement="one_process")
    apart = run(mixed, placement="process_each")

    assert together.digests() == apart.digests()
    assert set(together.streams) == set(mixed.streams)
    assert together.streams["test/left/fast"][0] == 100
    assert together.summaries == apart.summaries
    assert together.drops == apart.drops


EVERY = ["one_process", "process_each", *groupings(load_graph(HERE / "mixed.yaml"), 2, seed=7)]


@pytest.mark.parametrize("placement", [EVERY[-1], *(pytest.param(each, marks=pytest.mark.long) for each in EVERY[:-1])])
def test_replay_gives_the_digests_of_the_run_in_every_placement(
    recording: tuple[Path, dict[str, str]], placement: Any
) -> None:
    path, expected = recording

    assert replay(path, placement=placement).digests() == expected


@pytest.mark.long
def test_replay_gives_the_same_digests_on_loaded_cores_with_operators_that_sleep_at_random(
    recording: tuple[Path, dict[str, str]],
) -> None:
    path, expected = recording
    graph = load_graph(HERE / "mixed.yaml", settings=["sleep=0.004"])

    with busy_cores():
        assert replay(path, graph=graph, placement="process_each").digests() == expected


@pytest.mark.long
@pytest.mark.parametrize("window", [(1, 1), (3, 1 << 20)])
def test_flow_control_does_not_change_the_digests(
    recording: tuple[Path, dict[str, str]], window: tuple[int, int]
) -> None:
    path, expected = recording

    assert replay(path, window=window).digests() == expected


@pytest.mark.long
def test_a_replay_can_be_recorded_and_holds_the_same_streams(
    recording: tuple[Path, dict[str, str]], tmp_path: Path
) -> None:
    path, expected = recording

    replay(path, record=tmp_path / "again.mcap")

    with Recording(path) as first, Recording(tmp_path / "again.mcap") as second:
        assert dict(first.digests()) == dict(second.digests()) == expected


@pytest.mark.long
def test_a_replay_in_two_halves_covers_every_source_message_once(recording: tuple[Path, dict[str, str]]) -> None:
    path, _ = recording

    first, second = replay(path, end=0.495), replay(path, start=0.496)

    assert first.streams["test/left/fast"][0] + second.streams["test/left/fast"][0] == 100
    assert first.streams["test/left/constant"][0] == second.streams["test/left/constant"][0] == 1


@pytest.mark.long
def test_the_window_grows_when_the_graph_must_look_further_ahead() -> None:
    graph = chain("far: {use: runtime_operators:LookAhead, inputs: {a: left/fast, b: left/slow}}", count=300, ratio=60)

    report = run(graph, window=(8, 1 << 30))

    assert report.streams["test/far/y"][0] == 5
    assert any("doubled" in note for note in report.notes)


@pytest.mark.long
def test_large_messages_arrive_whole(mixed: Graph) -> None:
    graph = load_graph(HERE / "mixed.yaml", settings=["count=20", "padding=300000"])

    assert run(graph, placement="one_process").digests() == run(graph, placement="process_each").digests()


@pytest.mark.long
def test_operators_of_nested_graphs_run_in_separate_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    graph = load_graph(HERE / "outer.yaml")

    together = run(graph, placement="one_process")
    apart = run(graph, placement="process_each", record=tmp_path / "run.mcap")

    assert together.digests() == apart.digests()
    assert apart.streams["fleet/robot1/front/counter/constant"][0] == 1
    assert replay(tmp_path / "run.mcap", placement="process_each").digests() == apart.digests()
