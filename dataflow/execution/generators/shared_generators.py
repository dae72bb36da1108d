"""Finds a live source that draws from the global random generators beside operators in the same process.

A live source is read by a separate thread, while operators run on the main one. The global generators of `random`,
numpy and torch are one for all threads: what the source draws, a firing that is under way does not get. No lock helps,
since a source mostly waits for its device inside `stream()`. So such a source is refused as soon as it draws while no
operator is at work, when nothing else can have drawn. (OpenCV has a generator for each thread.)
"""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any

from dataflow.execution.generators import lazy_numpy, lazy_random
from dataflow.execution.generators.loading import LOADS


class SharedGenerators(RuntimeError):
    """A live source draws from generators that operators of its process depend on."""


class CallTracker:
    """The calls of operators in this process: how many began and ended. Entered and left on the main thread."""

    def __init__(self) -> None:
        self.begun = self.ended = 0
        self.fires = False
        """True when an operator of this process fires at all."""
        self.operator, self.stamp = "", 0
        """Of the last call that began: the operator, and its event time; 0 or less where it has none."""

    def call(self, operator: str, stamp: int) -> CallTracker:
        """This, to be entered for a call of an operator."""
        self.operator, self.stamp = operator, stamp
        return self

    def __enter__(self) -> None:
        self.begun += 1

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        LOADS.seed = None
        self.ended += 1


CALLS_IN_PROGRESS = CallTracker()


class Tripwire:
    """Compares the global generators before and after one step of a source."""

    def __init__(self, work: CallTracker = CALLS_IN_PROGRESS) -> None:
        self._work = work
        self._begun = 0
        self._before: tuple[object, ...] | None = None

    def set(self) -> None:
        """To be called before the step."""
        work = self._work
        self._begun = work.begun
        idle = work.fires and work.ended == self._begun
        self._before = _state() if idle else None

    def check(self, source: str) -> None:
        """Raises `SharedGenerators` if the step has drawn. Passes where an operator was at work meanwhile."""
        if self._before is None:
            return
        same = _state() == self._before
        if not same and self._work.begun == self._begun:
            raise SharedGenerators(
                f"{source} draws from the global random generators (of random, numpy or torch) while operators fire in "
                "the same process, whose results would change: draw from self.rng, or run the source in a "
                "separate process (process: or --place)"
            )


def _state() -> tuple[object, ...]:
    modules: dict[str, Any] = sys.modules
    torch = modules.get("torch")
    drawn = None if torch is None else torch.default_generator.get_state().numpy().tobytes()
    return lazy_random.peek(), lazy_numpy.peek(), drawn
