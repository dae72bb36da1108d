"""The playback of sources that need not keep up with the world: when messages are given, never which meet."""

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
        self._hurried_to: int | None = None

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

    def hurry_to(self, stamp: int) -> None:
        """Lets everything up to a stamp pass, paused or not, without waiting for the clock."""
        self._hurried_to = stamp

    @property
    def hurrying(self) -> bool:
        """Tells whether somebody asked to go to a stamp that is not reached yet."""
        return self._hurried_to is not None

    def arrives(self, stamp: int) -> bool:
        """Tells whether the next step, of this stamp, lies beyond where it was asked to go; it then hurries no more."""
        if self._hurried_to is None or stamp <= self._hurried_to:
            return False
        self._hurried_to = None
        return True

    @property
    def holds(self) -> bool:
        """Tells whether the next step has to wait for somebody to let it pass."""
        return self.paused and not self._steps and not self.hurrying

    @property
    def stepping(self) -> bool:
        """Tells whether the next step was asked for, so that it does not wait for the clock."""
        return self.hurrying or (self.paused and self._steps > 0)

    def passed(self) -> None:
        """A step was given."""
        if self.paused and self._steps and not self.hurrying:
            self._steps -= 1
