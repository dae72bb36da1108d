"""A recording of which nothing was replayed has failed, and one that ends early is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dataflow.recording.mcap.index import NO_END
from dataflow.sweep.plan import Source, Task
from dataflow.sweep.work import perform


class Worker:
    """Prints a report, and what a command says of a recording."""

    def __init__(self, first: int | None, said: str) -> None:
        self._first, self._said = first, said

    def call(self, name: str, words: Any, operators: Any, output: tuple[Path, Path], *left: Any) -> int:
        figures = {"score": {"err_m": 0.0}}
        report = {"operators": {}, "streams": {}, "namespace": "n", "restarts": {}, "summaries": figures}
        output[0].write_text(json.dumps({**report, "first_stamp": self._first}))
        output[1].write_text(self._said)
        return 0


@pytest.mark.parametrize(
    ("first", "said", "outcome", "torn"),
    [
        (7, "", "done", False),
        (7, f"r.mcap {NO_END}", "done", True),
        (None, "", "failed", False),
        (None, f"r.mcap {NO_END}", "failed", True),
    ],
)
def test_figures_of_nothing_are_none(first: int | None, said: str, outcome: str, torn: bool) -> None:
    task = Task(Source("r.mcap", "/r.mcap", "d"), "replay", (), ("replay", None), "key")

    found = perform(task, 9.0, Worker(first, said))

    assert (found.outcome, found.torn) == (outcome, torn)
    assert bool(found.rows[0]) == (first is not None)
    if first is None:
        assert found.error.startswith("it holds no message for this graph")
        assert (NO_END in found.error) == torn
