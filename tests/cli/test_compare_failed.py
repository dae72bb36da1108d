"""`dataflow compare` names recordings that failed, with the reason and the side."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from dataflow.cli.commands.compare import MOST_NAMED, _failed, _failed_lines
from dataflow.sweep.table import Store
from dataflow.sweep.work import Result

CHOICES = (("gain", "1"),), (("gain", "2"),)


def plan(folder: Path, results: dict[str, tuple[Result | None, Result | None]]) -> Any:
    """A plan of these recordings, with what is kept of each by A and by B."""
    store, tasks = Store(folder), []
    for name, sides in results.items():
        for k, result in enumerate(sides):
            tasks.append(SimpleNamespace(key=f"{name}{k}", settings=CHOICES[k], source=SimpleNamespace(name=name)))
            if result is not None:
                store.keep(result)
    return SimpleNamespace(tasks=tasks, store=store, choices=CHOICES)


def result(key: str, error: str = "", log: str = "") -> Result:
    return Result(key, "failed" if error else "done", 0, error, (), 1.0, log)


def test_a_recording_that_failed_is_named_with_side_reason_and_output(tmp_path: Path) -> None:
    found = _failed(plan(tmp_path, {"a.mcap": (result("a.mcap0"), result("a.mcap1", "no end", "all of it"))}))

    log = str(tmp_path / "logs" / "a.mcap1.txt")
    assert found == [
        {"side": "b", "recording": "a.mcap", "settings": {"gain": "2"}}
        | {"outcome": "failed", "error": "no end", "log": log}
    ]
    assert list(_failed_lines(found)) == [f"failed: a.mcap by B: no end (its output: {log})"]


def test_equal_failures_of_both_sides_are_one_line(tmp_path: Path) -> None:
    both = result("a0", "error: no MCAP file", "1"), result("a1", "error: no MCAP file", "2")

    found = _failed(plan(tmp_path, {"a": both, "b": (result("b0"), None)}))

    assert list(_failed_lines(found)) == [
        f"failed: a by A and B: no MCAP file (its output: {tmp_path / 'logs' / 'a0.txt'})",
        "failed: b by B: not done",
    ]


def test_of_many_that_failed_the_first_are_printed(tmp_path: Path) -> None:
    found = _failed(plan(tmp_path, {f"r{k}": (result(f"r{k}0"), None) for k in range(MOST_NAMED + 2)}))

    lines = list(_failed_lines(found))
    assert len(lines) == MOST_NAMED + 1
    assert lines[-1] == "failed: 2 more: --json has all"
