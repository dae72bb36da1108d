"""What commands load before they act: attaching to a running graph must not wait for what only runs need."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

LOADED = "import sys; import {}; print(*(name for name in {!r}.split() if name in sys.modules))"


@pytest.mark.parametrize(
    ("modules", "heavy"),
    [
        ("dataflow.cli.main", "numpy zenoh pydantic mcap dataflow.graph.load"),
        ("dataflow.client.attach", "pydantic ruamel.yaml mcap scipy dataflow.graph.load dataflow.operator"),
        (
            "dataflow.supervision.process_main, dataflow.process.operator_process, dataflow.sinks.recorder",
            "rosbags ruamel.yaml",
        ),
        ("dataflow.supervision.early_nursery", "numpy zenoh pydantic mcap dataflow.graph.load"),
    ],
)
def test_commands_import_no_heavy_modules(modules: str, heavy: str) -> None:
    code = LOADED.format(modules, heavy)
    command = [sys.executable, "-P", "-c", code]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    told = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=True)

    assert told.stdout.split() == []
