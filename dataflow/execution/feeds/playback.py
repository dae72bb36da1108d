"""The playback of what is not live: paused, stepped, paced. It decides when messages are given, never which meet."""

from __future__ import annotations

from typing import Literal, get_args

Action = Literal["pause", "resume", "toggle", "step", "speed", "faster", "slower"]
ACTIONS: tuple[Action, ...] = get_args(Action)
MOST_STEPS = 1_000_000
SLOWEST, FASTEST = 1 / 64, 64.0
"""The ends of what `slower` and `faster` choose; faster than that is as fast as the graph goes."""


class Playback:
    """Decides whether a feed may give its next step (all messages of one stamp), and how fast event time passes.
    `speed`: event time against the clock, 1.0 is real time; None: as fast as the graph goes."""

    def __init__(self, *, paused: bool = False, speed: float | None = None) -> None:
        self.paused = paused
        self.speed = speed
        self._steps = 0

    def do(self, action: Action, steps: int = 1, speed: float | None = None) -> None:
        """Pauses, resumes, changes the speed, or lets so many steps pass while paused: a step of what plays pauses it.

        `steps` belongs to `step`, `speed` to `speed`. Raises `ValueError` for an action that is none, or a speed that
        is not above 0.
        """
        match action:
            case "pause":
                self.paused = True
                self._steps = 0
            case "resume":
                self.paused = False
            case "toggle":
                self.do("resume" if self.paused else "pause")
            case "step":
                self.paused = True
                self._steps = min(self._steps + max(1, steps), MOST_STEPS)
            case "speed":
                if speed is not None and not 0 < speed < float("inf"):
                    raise ValueError(f"a speed of {speed:g}: expected a factor of real time above 0")
                self.speed = speed
            case "faster":
                self.speed = None if self.speed is None or self.speed * 2 > FASTEST else self.speed * 2
            case "slower":
                self.speed = 1.0 if self.speed is None else max(self.speed / 2, min(self.speed, SLOWEST))
            case _:
                raise ValueError(f"{action!r}: expected one of {', '.join(ACTIONS)}")

    @property
    def holds(self) -> bool:
        """Returns whether the next step has to wait for a request to let it pass."""
        return self.paused and not self._steps

    @property
    def stepping(self) -> bool:
        """Returns whether the next step was asked for, so that it does not wait for the clock."""
        return self.paused and self._steps > 0

    def passed(self) -> None:
        """A step was given."""
        if self.paused and self._steps:
            self._steps -= 1
