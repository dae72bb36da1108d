"""Programs outside of Python that tests run."""

from __future__ import annotations

import shutil

import pytest


def need(program: str) -> None:
    """Skips the test where a program is not installed."""
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed here")
