"""What torch does not get done on its device."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import pytest

from operators.torch_models import Runner

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch")


def test_gpu_out_of_memory_falls_back_to_the_cpu_and_is_counted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    run = Runner(torch.nn.Linear(2, 1), torch.device("cpu"), half=False)
    full = [True, False, True, False, False]

    def call(model: object, tensor: object) -> str:
        if full.pop(0):
            raise torch.cuda.OutOfMemoryError
        return "done"

    with caplog.at_level(logging.WARNING):
        assert [run(torch.zeros(2), call) for _ in range(3)] == ["done"] * 3
    assert run.summary() == {"images_on_cpu_for_lack_of_memory": 2}
    assert len(caplog.records) == 1
    assert "does not suffice" in caplog.text
