"""Libraries that are loaded inside a call: what the call draws is what it would draw if they had been loaded before."""

from __future__ import annotations

import importlib
import random
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from firing_operators import Collector, entry, node, run_all, value

from dataflow.execution.calls import Calls
from dataflow.execution.runner import OperatorRunner
from dataflow.execution.source import SourceRunner
from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Source

OPEN3D = """
class utility:
    class random:
        seeds = []
        seed = seeds.append
"""
TORCH = """
class _Generator:
    def __init__(self): self.seeds = []
    def manual_seed(self, seed): self.seeds.append(seed)
default_generator = _Generator()
def get_num_threads(): return 1
def set_num_threads(threads): pass
class version:
    cuda = "13.0"
class cuda:
    default_generators = ()
    queued, ready = [], False
    is_initialized = classmethod(lambda cls: cls.ready)
    _lazy_call = classmethod(lambda cls, call: cls.queued.append(call))
    @classmethod
    def init(cls):
        cls.default_generators, cls.ready = (_Generator(), _Generator()), True
        for call in cls.queued: call()
"""
DRAWING = """
import random
import numpy as np
random.seed(0), np.random.seed(0)
random.random(), np.random.random()
"""


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of modules that nothing has loaded yet."""
    for name, text in {"open3d": OPEN3D, "torch": TORCH, "drawing": DRAWING}.items():
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.setitem(sys.modules, name, sys)  # so that what the test loads is taken out again
        del sys.modules[name]
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return tmp_path


class Does(Operator):
    """Does in each call what a test asks for, and emits what it gives."""

    x: In[FeatureVector]
    y: Out[FeatureVector]

    todo: Callable[[], float] = staticmethod(lambda: 0.0)

    def process(self, x: FeatureVector) -> FeatureVector:
        return value(x.stamp, self.todo())


def made(todo: Callable[[], float], *, calls: int = 1, version: int = 3) -> list[float]:
    """What an operator emits that does `todo` in each call."""
    operator, collector = Does(), Collector()
    operator.todo = todo
    runner = OperatorRunner(node(Does, {"x": ["t/s/x"]}), collector, static=frozenset(), operator=operator)
    runner.calls = Calls(runner.node, operator, 0, version=version)
    runner.setup()
    for k in range(calls):
        runner.push("t/s/x", entry("t/s/x", 10 + k, k))
        run_all(runner)
    assert len(collector.numbers) == calls
    return collector.numbers


def open3d_seed() -> float:
    import open3d

    return float(open3d.utility.random.seeds[-1])


def test_a_library_is_seeded_in_the_call_that_loads_it(modules: Path) -> None:
    loads_it = made(open3d_seed)

    assert loads_it == made(open3d_seed)  # which finds it loaded


def test_runs_of_a_scheme_before_are_not_seeded_while_they_load(modules: Path) -> None:
    def seeds() -> float:
        import open3d

        return len(open3d.utility.random.seeds)

    assert made(seeds, version=2, calls=2) == [0, 1]


def test_a_library_that_a_thread_of_the_call_loads_is_seeded(modules: Path) -> None:
    def in_a_thread() -> float:
        thread = threading.Thread(target=open3d_seed)
        thread.start()
        thread.join()
        return open3d_seed()

    assert made(in_a_thread) == made(open3d_seed)


def test_gpu_generators_are_seeded_on_initialisation_and_at_each_call(modules: Path) -> None:
    def seeds(k: int) -> float:
        torch: Any = importlib.import_module("torch")
        if not torch.cuda.is_initialized():
            torch.cuda.init()
        assert torch.default_generator.seeds[-1] == torch.cuda.default_generators[k].seeds[-1]
        return float(torch.cuda.default_generators[k].seeds[-1] % 2**52)

    first = made(lambda: seeds(0), calls=2)

    assert first[0] != first[1]
    assert first == made(lambda: seeds(1), calls=2)


@pytest.mark.parametrize("before", [0, 2], ids=["nothing drawn before", "drawn before"])
def test_random_draws_during_import_are_undone(modules: Path, before: int) -> None:
    def draws() -> float:
        for _ in range(before):
            random.random(), np.random.random()
        import drawing  # noqa: F401

        return random.random() + float(np.random.random())

    loads_it = made(draws)

    assert loads_it == made(draws)


def test_a_module_that_fails_to_load_leaves_the_generators_as_they_were(modules: Path) -> None:
    (modules / "drawing.py").write_text(DRAWING + "raise ImportError('not here')")

    def draws() -> float:
        with pytest.raises(ImportError, match="not here"):
            import drawing  # noqa: F401
        return random.random()

    assert made(draws) == made(random.random)


def test_modules_imported_outside_of_calls_are_left_alone(modules: Path) -> None:
    made(random.random)
    random.seed(5)
    import drawing  # noqa: F401

    left = random.random()
    random.seed(0)
    assert [random.random(), random.random()][1] == left


class Loading(Source):
    """Loads a library while its stream is read."""

    out: Out[FeatureVector]

    def stream(self) -> Any:
        for stamp in (1, 2):
            yield {"out": value(stamp, open3d_seed())}


def test_a_library_that_a_source_loads_is_seeded_in_that_step(modules: Path) -> None:
    def numbers() -> list[float]:
        collector = Collector()
        runner = SourceRunner(node(Loading, {}), collector, operator=Loading())
        runner.setup()
        while runner.look_ahead() is not None:
            runner.admit()
        return collector.numbers

    loads_it = numbers()

    assert len(set(loads_it)) == 2
    assert loads_it == numbers()
