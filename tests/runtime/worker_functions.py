"""Functions that tests call in a process of their own."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from typing import Any


def describe(request: Mapping[str, Any], tell: object) -> dict[str, Any]:
    """The request and the environment that matters; printing does not disturb the answer."""
    print("this goes nowhere")
    return {**request, **{name: os.environ[name] for name in ("OMP_NUM_THREADS", "PYTHONHASHSEED")}}


def fail(request: Mapping[str, Any], tell: object) -> None:
    raise RuntimeError("the wheels came off")


def hang(request: Mapping[str, Any], tell: object) -> None:
    time.sleep(3600)
