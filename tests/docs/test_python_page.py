"""The code of docs/python.md runs, in order, and prints what the page says."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

SHOWN = re.compile(r"```python\n(.*?)```\n(?:\n((?:    [^\n]*\n)+))?", re.DOTALL)


def test_the_blocks_run_and_print_what_stands_below_them(repository: Path, tmp_path: Path) -> None:
    pytest.importorskip("pandas", reason="the extra [notebook] is not installed")
    text = (repository / "docs" / "python.md").read_text(encoding="utf-8")
    blocks = SHOWN.findall(text)
    assert len(blocks) == 8
    (tmp_path / "recordings").symlink_to(repository / "recordings")
    script = "\n".join(code for code, _ in blocks)
    path = f"import sys; sys.path[:0] = {[str(repository), *sys.path]!r}\n"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", path + script], cwd=tmp_path, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    expected = [line[4:] for _, lines in blocks for line in lines.splitlines()]
    assert done.stdout.splitlines() == expected
