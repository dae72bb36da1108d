"""The notebooks run from top to bottom without a display, and every cell shows what it promises."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
ENVIRONMENT = {
    **os.environ,
    "MPLBACKEND": "agg",
    "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
    "PYTHONWARNINGS": "ignore",
}

RUNNER = """
import ast, json, sys

cells = json.load(open(sys.argv[1], encoding="utf-8"))["cells"]
shown = []
for cell in cells:
    if cell["cell_type"] != "code":
        continue
    body = ast.parse("".join(cell["source"])).body
    last = body.pop() if isinstance(body[-1], ast.Expr) else None
    exec(compile(ast.Module(body, []), cell["id"], "exec"), globals())
    value = None if last is None else eval(compile(ast.Expression(last.value), cell["id"], "eval"), globals())
    html = getattr(value, "_repr_html_", None)
    shown.append(html() if html is not None else repr(value))
json.dump(shown, sys.stdout)
"""
"""Runs the cells as a notebook does, in `__main__`, and prints what each shows: HTML where it has that."""


def cells_of(notebook: Path) -> list[dict[str, Any]]:
    return [cell for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]


@pytest.fixture(scope="module")
def shown() -> list[str]:
    """Runs the tour; returns what each code cell shows."""
    pytest.importorskip("pandas", reason="the extra [notebook] is not installed")
    command = [sys.executable, "-c", RUNNER, "recording.ipynb"]
    done = subprocess.run(command, cwd=FOLDER, env=ENVIRONMENT, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stderr
    found: list[str] = json.loads(done.stdout)
    return found


def test_the_tour_has_twenty_cells_without_outputs() -> None:
    cells = cells_of(FOLDER / "recording.ipynb")

    assert len(cells) == 20
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "words"),
    [
        (0, ["robot/imu", "100.00", "without messages: robot/depth,"]),
        (2, ["data:image/jpeg;base64,"]),
        (3, ["data:image/png;base64,", "SegmentationMap"]),
        (4, ["data:image/png;base64,", "PointCloud"]),
        (6, ["(2100, 3)"]),
        (9, ["book", "861.0"]),
        (12, ["true path 10.45 m"]),
        (15, ["imu ← robot/imu"]),
        (18, ["<b>identical</b>", "1,001 messages"]),
    ],
)
def test_notebook_cells_show_the_stated_output(shown: list[str], cell: int, words: list[str]) -> None:
    assert len(shown) == 20
    for word in words:
        assert word in shown[cell]


@pytest.mark.long
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run_in_a_kernel(notebook: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("nbclient", reason="nbclient (the [dev] extra) is not installed")
    if importlib.util.find_spec("ipykernel") is None:
        pytest.skip("ipykernel (the [dev] extra) is not installed")
    import nbclient
    import nbformat

    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("MPLBACKEND")
    read = nbformat.read(notebook, as_version=4)
    nbclient.NotebookClient(read, timeout=100, resources={"metadata": {"path": str(FOLDER)}}).execute()
    assert all(output.output_type != "error" for cell in read.cells for output in cell.get("outputs", ()))
