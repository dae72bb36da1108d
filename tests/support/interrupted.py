"""Trainings that are interrupted and go on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


class Interrupted(Exception):
    """A crash at a chosen moment."""


def interrupted(at: int, steps: int = 1) -> Any:
    """A progress that stops the training in a step of an epoch."""
    from operators.learning.loop import NoProgress

    class Stopping(NoProgress):
        left = steps

        def step(self, epoch: int, losses: object) -> None:
            self.left -= epoch == at
            if epoch == at and self.left <= 0:
                raise Interrupted

    return Stopping()


def trained_twice(task: Callable[[], Any], settings: Any, folder: Path, at: int = 1, steps: int = 1) -> Any:
    """Trains into whole.onnx, and into halved.onnx with an interruption; what the second run returns."""
    from operators.learning.loop import train

    train(task(), settings, folder / "whole.onnx")
    with pytest.raises(Interrupted):
        train(task(), settings, folder / "halved.onnx", progress=interrupted(at, steps))
    outcome = train(task(), settings, folder / "halved.onnx", resume=True)
    assert (folder / "whole.onnx").read_bytes() == (folder / "halved.onnx").read_bytes()
    return outcome
