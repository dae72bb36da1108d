"""Freed memory is kept where it is asked for."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys
from dataflow.process.freed_memory import keep_freed_memory
if sys.argv[1] == "keep" and not keep_freed_memory():
    sys.exit(77)
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
kept = b"x" * 1000
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
    done = subprocess.run([sys.executable, "-c", PROGRAM, how], capture_output=True, text=True, timeout=60)
    if done.returncode == 77:
        pytest.skip("the C library has no mallopt")
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


def test_chunks_are_made_of_pages_that_are_there() -> None:
    assert faults("keep") < 1000 < faults("plain")
