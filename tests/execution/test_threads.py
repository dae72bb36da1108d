"""Thread limits also hold for a library that an operator imports in its `setup()`."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
from firing_operators import Collector, Echo, node

from dataflow.execution import threads
from dataflow.execution.runner import OperatorRunner


def test_a_library_that_setup_loads_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_limit", None)
    monkeypatch.delitem(sys.modules, "cv2", raising=False)
    limits: list[int] = []

    def load(self: Echo) -> None:
        monkeypatch.setitem(
            sys.modules, "cv2", SimpleNamespace(setNumThreads=limits.append, setRNGSeed=lambda seed: None)
        )

    monkeypatch.setattr(Echo, "setup", load)
    threads.limit_threads(3)
    assert limits == []

    OperatorRunner(node(Echo, {"x": ["t/s/x"]}), Collector(), static=frozenset()).setup()

    assert limits == [3]


def test_each_loaded_library_is_limited_and_one_that_is_not_loaded_stays_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_limit", None)
    limits: list[tuple[str, int]] = []
    monkeypatch.setitem(sys.modules, "cv2", SimpleNamespace(setNumThreads=lambda n: limits.append(("cv2", n))))
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(set_num_threads=lambda n: limits.append(("torch", n))))

    threads.limit_threads(2)
    assert limits == [("cv2", 2), ("torch", 2)]

    monkeypatch.delitem(sys.modules, "torch")
    threads.limit_threads_again()
    assert limits[2:] == [("cv2", 2)]


def test_an_inner_limit_gives_the_outer_one_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_limit", 3)
    limits: list[int] = []
    monkeypatch.setitem(sys.modules, "cv2", SimpleNamespace(setNumThreads=limits.append, getNumThreads=lambda: 3))
    monkeypatch.delitem(sys.modules, "torch", raising=False)

    with threads.limited_threads(1):
        threads.limit_threads_again()
    threads.limit_threads_again()

    assert limits == [1, 1, 3, 3]
