"""The playback of a recording: paused, stepped, resumed. It decides when messages are given, never which meet."""

from __future__ import annotations

from typing import Literal, get_args

Action = Literal["pause", "resume", "toggle", "step"]
ACTIONS: tuple[Action, ...] = get_args(Action)
MOST_STEPS = 1_000_000


class Playback:
    """Decides whether a feed may give its next step (all messages of one stamp)."""

    def __init__(self, *, paused: bool = False) -> None:
        self.paused = paused
        self._steps = 0

    def do(self, action: Action, steps: int = 1) -> None:
        """Pauses, resumes, or lets so many steps pass while paused: a step of what plays pauses it.

        Raises `ValueError` for an action that is none.
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
            case _:
                raise ValueError(f"{action!r}: expected one of {', '.join(ACTIONS)}")

    @property
    def holds(self) -> bool:
        """Tells whether the next step has to wait for somebody to let it pass."""
        return self.paused and not self._steps

    @property
    def stepping(self) -> bool:
        """Tells whether the next step was asked for, so that it does not wait for the clock."""
        return self.paused and self._steps > 0

    def passed(self) -> None:
        """A step was given."""
        if self.paused and self._steps:
            self._steps -= 1
