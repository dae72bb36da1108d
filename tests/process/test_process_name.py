"""The name that ps and top show for a process of a graph."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SHOW = (
    "from dataflow.supervision.process_main import show_name; show_name({!r}); "
    "print(open('/proc/self/comm').read(), end='')"
)


@pytest.mark.skipif(not Path("/proc/self/comm").exists(), reason="this system has no /proc/self/comm")
@pytest.mark.parametrize(("label", "shown"), [("odometry", "odometry"), ("front/odometry-left", "front/odometry-")])
def test_a_process_bears_its_label_as_far_as_linux_allows(label: str, shown: str) -> None:
    found = subprocess.run([sys.executable, "-c", SHOW.format(label)], capture_output=True, text=True, timeout=60)
    assert found.stdout == shown + "\n", found.stderr
