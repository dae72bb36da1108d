"""The faults that are planted to try the tests are valid code, each in one place, and repeat by their seed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from mutants import drawn, mutants_of

SOURCE = '''
def share(a: int | None, b: float = 0.5) -> float:
    """Returns 1 + 1."""
    if not a:
        raise ValueError(f"{a + 1}")
    self.total[a] = b
    log(a)
    return a + b < 2.5 and True
'''


def test_faults_are_comparisons_operators_numbers_returns_and_dropped_statements() -> None:
    source = SOURCE.encode()
    found = {(source[m.start : m.end].decode(), m.text): m.written(source) for m in mutants_of(Path("a.py"), source)}

    assert set(found) == {
        ("0.5", "(1.5)"),
        ("not a", "(a)"),
        ("self.total[a] = b", "pass"),
        ("log(a)", "pass"),
        ("return a + b < 2.5 and True", "return None"),
        ("a + b < 2.5 and True", "(a + b < 2.5 or True)"),
        ("a + b < 2.5", "(a + b <= 2.5)"),
        ("a + b", "(a - b)"),
        ("2.5", "(3.5)"),
        ("True", "False"),
    }
    for text in found.values():
        compile(text, "a.py", "exec")


def test_a_seed_draws_equal_faults(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text(SOURCE)

    assert drawn(tmp_path, 4, 1) == drawn(tmp_path, 4, 1) != drawn(tmp_path, 4, 2)
    assert len(drawn(tmp_path / "a.py", 60, 1)) == 10


PACKAGE = """
def is_above(a, b):
    return a > b

def half(a):
    return a / 2

def never_run(a):
    return -a
"""
TESTS = """
import subprocess, sys, time
from dataflow.toy.a import half, is_above

def test_above():
    assert is_above(2, 1)

def test_half_in_another_process():
    command = "from dataflow.toy.a import half; exit(half(4) != 2)"
    subprocess.run([sys.executable, "-c", command], check=True)

def test_leaves_a_process_in_a_session():
    left = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(300)"], start_new_session=True)
    with open("PLACE", "a") as file:
        file.write(f"{left.pid} ")
"""


@pytest.mark.long
def test_mutant_verdicts_leave_no_test_process_behind(tmp_path: Path, repository: Path) -> None:
    for file, text in {
        "dataflow/toy/a.py": PACKAGE,
        "tests/toy/test_a.py": TESTS.replace("PLACE", f"{tmp_path}/left"),
    }.items():
        (tmp_path / file).parent.mkdir(parents=True)
        (tmp_path / file).write_text(text)
    command = [sys.executable, "tools/mutants.py", "dataflow/toy", "--checkout", str(tmp_path)]

    lines = subprocess.run(command, cwd=repository, check=True, capture_output=True, text=True).stdout.splitlines()

    assert {line.partition("  [")[0] for line in lines[1:-1]} == {
        "killed   dataflow/toy/a.py:3: return None",
        "SURVIVED dataflow/toy/a.py:3: (a >= b)",
        "killed   dataflow/toy/a.py:6: return None",
        "killed   dataflow/toy/a.py:6: (a * 2)",
        "killed   dataflow/toy/a.py:6: (3)",
        "NOT RUN  dataflow/toy/a.py:9: return None",
    }
    assert "killed   dataflow/toy/a.py:6: (3)  [tests/toy/test_a.py::test_half_in_another_process]" in lines
    assert lines[-1].startswith("4 of 6 killed (seed 0)")
    left = (tmp_path / "left").read_text().split()
    assert len(left) >= 2
    assert not [process for process in left if Path("/proc", process).exists()]
