"""Freed memory is kept where it is asked for."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dataflow.graph import load_graph
from dataflow.recording.parts import Storage
from dataflow.sinks import freed_memory
from dataflow.sinks.sink import SinkConfig
from dataflow.supervision import process_main as main

GRAPH = Path(__file__).resolve().parents[2] / "graphs" / "synthetic_rgbd.yaml"
PROGRAM = """
import resource, sys
from dataflow.sinks.freed_memory import keep_freed_memory
if sys.argv[1] == "keep" and not keep_freed_memory():
    sys.exit(77)
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    chunk = bytearray(4 * 2**20)
    copy = bytes(chunk)
    del chunk, copy
before = faults()
for _ in range(20):
    chunk = bytearray(4 * 2**20)
    copy = bytes(chunk)
    del chunk, copy
print(faults() - before)
"""


def faults(how: str) -> int:
    plain = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    done = subprocess.run([sys.executable, "-c", PROGRAM, how], capture_output=True, text=True, timeout=60, env=plain)
    if done.returncode == 77:
        pytest.skip("the C library has no mallopt")
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


def test_chunks_are_made_of_pages_that_are_there() -> None:
    assert faults("keep") < 1000 < faults("plain")


def test_a_recorder_keeps_freed_memory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[bool] = []
    monkeypatch.setattr(freed_memory, "keep_freed_memory", lambda: asked.append(True))
    graph = load_graph(GRAPH)
    options = {"path": str(tmp_path / "run.mcap"), "metadata": {}, "compression": "zstd", "overwrite": False}
    options["storage"] = Storage().to_json()

    main._recorder(SinkConfig("@recorder", "record", graph.to_json(), [], [], options), graph).close("complete")

    assert asked == [True]
