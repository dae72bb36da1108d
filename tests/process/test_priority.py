"""Recorders of live runs let others begin."""

from __future__ import annotations

import os
import platform
import threading
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dataflow.graph import load_graph
from dataflow.process import priority
from dataflow.sinks import sink
from dataflow.sinks.sink import SinkConfig
from dataflow.supervision import process_main as main

GRAPH = Path(__file__).resolve().parents[2] / "graphs" / "synthetic_rgbd.yaml"


def test_the_calling_thread_gives_way_and_no_other() -> None:
    found: list[tuple[bool, int, int]] = []

    def ask() -> None:
        given = priority.let_others_begin()
        found.append((given, os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)))

    before = os.getpriority(os.PRIO_PROCESS, 0)
    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    if not found[0][0]:
        pytest.skip(f"no such system call on {platform.machine()}, or it is not allowed here")
    assert found == [(True, os.SCHED_BATCH, min(19, before + priority.NICE))]
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    assert os.getpriority(os.PRIO_PROCESS, 0) == before


def test_on_an_unknown_machine_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "abacus")

    assert not priority.let_others_begin()

    assert os.sched_getscheduler(0) == os.SCHED_OTHER


@pytest.mark.parametrize("live", [True, False])
def test_sinks_of_live_runs_let_others_begin(monkeypatch: pytest.MonkeyPatch, live: bool) -> None:
    asked: list[bool] = []
    monkeypatch.setattr(sink, "let_others_begin", lambda: asked.append(True))
    monkeypatch.setattr(main, "_recorder", lambda *_: SimpleNamespace())
    config = SinkConfig("@recorder", "record", load_graph(GRAPH).to_json(), [], [], {}, live=live)
    channel: Any = SimpleNamespace(send=lambda *_, **__: None)

    main._make("sink", asdict(config), channel, SimpleNamespace(), None).open()

    assert asked == [True] * live
