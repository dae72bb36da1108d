"""Admits messages from the feeds of a process: sources of a run that is not live, recordings that stand in for them."""

from __future__ import annotations

from dataflow.execution.feeds.log import LogFeed
from dataflow.execution.feeds.pace import Pace
from dataflow.execution.feeds.playback import Action, Playback
from dataflow.execution.feeds.window import Feed, Window
from dataflow.sync import FOREVER, NEVER

PROMISE_EVERY = 8
"""Steps after which a frontier is sent on streams that had no message."""


class Feeding:
    """Of several feeds, the oldest step first, as far as the window and the pace allow; without these, at once."""

    def __init__(
        self,
        window: Window | None = None,
        pace: Pace | None = None,
        *,
        paused: bool = False,
        speed: float | None = None,
    ) -> None:
        if window is None:
            window = Window(1, 1)
            window.cover(FOREVER)
        self.feeds: list[Feed] = []
        self.logs: list[LogFeed] = []
        """The recordings among the feeds."""
        self.playback = Playback(paused=paused, speed=speed)
        self._window, self._pace = window, pace or Pace(None)
        self._since_promise = 0

    @property
    def ended(self) -> bool:
        return all(feed.ended for feed in self.feeds)

    @property
    def full(self) -> bool:
        """Returns whether a step waits for room in the window."""
        return self._window.full and not self.ended

    def play_back(self, log: LogFeed) -> None:
        """Takes a recording among the feeds."""
        self.feeds.append(log)
        self.logs.append(log)

    def first_stamps(self) -> list[int]:
        """The stamps that the feeds begin with."""
        return [stamp for feed in self.feeds if (stamp := feed.look_ahead()) is not None]

    def admit(self) -> bool:
        """Emits the next step; False when there is none, or it has to wait."""
        due = self._oldest()
        if due is None or self._window.full or self.playback.holds:
            return False
        if self._pace.due_in(due[0]) > 0 and not self.playback.stepping:
            return False
        stamp, feed = due
        self._window.add(stamp, *feed.admit())
        self.playback.passed()
        self._since_promise += 1
        if self._since_promise >= PROMISE_EVERY:
            self.promise()
        if feed.look_ahead() is None:
            feed.finish("end of source")
        return True

    def play(self, action: Action, steps: int = 1, speed: float | None = None) -> None:
        """Pauses, resumes, steps, changes the speed; the clock goes on from where it stopped. Raises `ValueError`."""
        was_paused, was_speed = self.playback.paused, self.playback.speed
        self.playback.do(action, steps, speed)
        resumed = was_paused and not self.playback.paused
        if not resumed and self.playback.speed == was_speed:
            return
        if (due := self._oldest()) is not None:
            if self.playback.speed != was_speed:
                self._pace.change(self.playback.speed, due[0])
            if resumed:
                self._pace.put(due[0])

    @property
    def last(self) -> int | None:
        """The stamp that was given last; None before the first."""
        last = max((feed.last for feed in self.feeds), default=NEVER)
        return None if last == NEVER else last

    def promise(self) -> None:
        """Sends the frontiers of streams which had no message of late."""
        self._since_promise = 0
        for feed in self.feeds:
            if not feed.ended:
                feed.promise()

    def next_due(self) -> float | None:
        """Seconds until the next paced step; None when nothing waits for the clock."""
        if not self._pace.held or self._window.full or self.playback.paused:
            return None
        stamps = [s for feed in self.feeds if not feed.ended and (s := feed.look_ahead()) is not None]
        return self._pace.due_in(min(stamps)) if stamps else None

    def finish(self, reason: str) -> None:
        """Ends all feeds."""
        for feed in self.feeds:
            feed.finish(reason)

    def _oldest(self) -> tuple[int, Feed] | None:
        """The feed whose next step has the oldest stamp, in graph order at a tie."""
        best: tuple[int, Feed] | None = None
        for feed in self.feeds:
            if feed.ended:
                continue
            stamp = feed.look_ahead()
            if stamp is None:
                feed.finish("end of source")
            elif best is None or stamp < best[0]:
                best = (stamp, feed)
        return best
