"""`import dataflow` is light: names are loaded when they are used, and heavy libraries not even then."""

from __future__ import annotations

import subprocess
import sys

import pytest

import dataflow

HEAVY = ("torch", "open3d", "rerun", "zenoh", "cv2", "scipy", "pandas", "onnxruntime", "matplotlib", "typer")


def loaded_after(code: str) -> set[str]:
    """The top-level modules that a fresh interpreter has loaded after `code`."""
    script = f"{code}\nimport sys; print(*{{name.partition('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    return set(done.stdout.split())


def test_importing_the_package_loads_nothing_else() -> None:
    before = loaded_after("import typing, importlib")

    assert loaded_after("import dataflow") - before <= {"dataflow", "__future__"}


def test_opening_a_recording_loads_no_heavy_library(path: object) -> None:
    code = f"import dataflow; dataflow.open({str(path)!r})['imu'].columns()"

    assert not loaded_after(code) & set(HEAVY)


def test_every_name_is_there_and_an_unknown_one_is_an_error() -> None:
    for name in dataflow.__all__:
        assert getattr(dataflow, name) is not None
    assert set(dataflow.__all__) <= set(dir(dataflow))
    with pytest.raises(AttributeError, match="no attribute 'opened'; it has Graph"):
        dataflow.opened  # noqa: B018
