"""The faults that are planted to try the tests are valid code, each in one place, and repeat by their seed."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from mutants import drawn, mutants_of, passes

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


LEAVING = """
import subprocess, sys
def test_leaves_a_process():
    left = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(300)"])
    open("left", "w").write(str(left.pid))
"""


@pytest.mark.long
def test_no_process_of_the_tests_is_left(tmp_path: Path) -> None:
    (tmp_path / "test_leaving.py").write_text(LEAVING)

    assert passes(tmp_path, "test_leaving.py")

    left = Path("/proc") / (tmp_path / "left").read_text()
    end = time.monotonic() + 10
    while left.exists() and " Z " not in (left / "stat").read_text() and time.monotonic() < end:
        time.sleep(0.01)
    assert not left.exists() or " Z " in (left / "stat").read_text()
