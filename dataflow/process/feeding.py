"""Admits messages from the feeds of a process: sources of a run that is not live, recordings that stand in for them."""

from __future__ import annotations

from dataflow.feeds.log import LogFeed
from dataflow.feeds.playback import Action, Playback
from dataflow.feeds.window import Feed, Window
from dataflow.process.pace import Pace

PROMISE_EVERY = 8
"""Steps after which a frontier is sent on streams that had no message."""


class Feeding:
    """Of several feeds, the oldest step first, as far as the window and the pace allow."""

    def __init__(self, window: Window, pace: Pace) -> None:
        self.feeds: list[Feed] = []
        self.playback = Playback()
        self._window, self._pace = window, pace
        self._since_promise = 0

    @property
    def ended(self) -> bool:
        return all(feed.ended for feed in self.feeds)

    @property
    def full(self) -> bool:
        """Tells whether a step waits for room in the window."""
        return self._window.full and not self.ended

    @property
    def logs(self) -> list[LogFeed]:
        """The recordings among the feeds."""
        return [feed for feed in self.feeds if isinstance(feed, LogFeed)]

    def first_stamps(self) -> list[int]:
        """The stamps that the feeds begin with."""
        return [stamp for feed in self.feeds if (stamp := feed.look_ahead()) is not None]

    def admit(self) -> bool:
        """Emits the next step; False when there is none, or it has to wait."""
        due = self._oldest()
        if due is not None and self.playback.arrives(due[0]):
            self._pace.put(due[0])
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

    def play(self, action: Action, steps: int = 1) -> None:
        """Pauses, resumes or steps; the clock goes on from where it stopped. Raises `ValueError`."""
        was_paused = self.playback.paused
        self.playback.do(action, steps)
        if was_paused and not self.playback.paused and (due := self._oldest()) is not None:
            self._pace.put(due[0])

    @property
    def rate(self) -> float | None:
        """The factor of real time at which steps are given; None: as fast as they are taken."""
        return self._pace.rate

    def set_rate(self, rate: float | None) -> None:
        """Goes on at another rate."""
        due = self._oldest()
        self._pace.change(rate, None if due is None else due[0])

    def go_to(self, stamp: int) -> None:
        """Gives what comes up to a stamp as fast as it is taken. Raises `ValueError` where that was given already."""
        due = self._oldest()
        if due is not None and stamp < due[0]:
            raise ValueError(f"{stamp} lies before {due[0]}, which comes next: this goes only forward; start it again")
        self.playback.hurry_to(stamp)

    @property
    def span(self) -> tuple[int, int] | None:
        """The first and the last stamp of the recordings among the feeds; None where there are none."""
        spans = [span for log in self.logs if (span := log.span) is not None]
        return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None

    def promise(self) -> None:
        """Sends the frontiers of streams which had no message of late."""
        self._since_promise = 0
        for feed in self.feeds:
            if not feed.ended:
                feed.promise()

    def next_due(self) -> float | None:
        """Seconds until the next paced step; None when nothing waits for the clock."""
        if not self._pace.held or self._window.full or self.playback.paused or self.playback.hurrying:
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
