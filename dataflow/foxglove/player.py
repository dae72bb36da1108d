"""Plays a recording under a user's control: to and fro, paused, slower or faster."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from dataflow.recording import Recorded

if TYPE_CHECKING:
    from dataflow.view.recordings import RecordedStreams

LOOK_BACK = (500_000_000, 5_000_000_000)
"""Spans before a place (ns) in which each stream's last message is looked for: the near one first: it is quick."""


class Clock:
    """The place in a recording that is played, moved by the controls. Thread-safe; times in ns.

    It stands at the beginning, and after each jump, until what is there has been found. `now` is the wall clock in s.
    """

    def __init__(self, first: int, last: int, *, speed: float = 1.0, now: Callable[[], float] = time.monotonic) -> None:
        self.first, self.last = first, last
        self._now = now
        self._changed = threading.Condition()
        self._playing, self._speed = True, speed
        self._stamp, self._since = first, now()
        self._standing = True
        self._jumps = 0
        self._closed = False

    def request(self, *, playing: bool, speed: float, seek: int | None) -> None:
        """Goes on, stops, changes the speed (which must be above 0; else it stays), goes to the stamp `seek`."""
        with self._changed:
            self._stamp, self._since = self._place(), self._now()
            self._playing = playing
            if speed > 0:
                self._speed = speed
            if seek is not None:
                self._stamp = min(max(seek, self.first), self.last)
                self._standing = True
                self._jumps += 1
            self._changed.notify_all()

    def state(self) -> tuple[bool, int, float]:
        """Returns whether it plays, the stamp it is at, and its speed."""
        with self._changed:
            return self._playing, self._place(), self._speed

    def jumps(self) -> int:
        """Counts how often it has gone elsewhere."""
        with self._changed:
            return self._jumps

    def begin(self) -> None:
        """Time goes on from here."""
        with self._changed:
            self._since, self._standing = self._now(), False

    def reached(self, stamp: int, jumps: int) -> bool:
        """Waits until the clock is at `stamp`. False: it was closed, or went elsewhere since it counted `jumps`."""
        with self._changed:
            while not self._closed and self._jumps == jumps:
                left = (stamp - self._place()) * 1e-9 / self._speed
                if self._playing and left <= 0:
                    return True
                self._changed.wait(left if self._playing else None)
            return False

    def moved(self, jumps: int) -> bool:
        """Waits, at the end, until the clock goes elsewhere. False: it was closed."""
        with self._changed:
            if self._jumps == jumps:
                self._stamp, self._playing = self.last, False
            self._changed.wait_for(lambda: self._closed or self._jumps != jumps)
            return not self._closed

    def close(self) -> None:
        """Ends every wait."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _place(self) -> int:
        if self._standing or not self._playing:
            return self._stamp
        return min(self._stamp + round((self._now() - self._since) * 1e9 * self._speed), self.last)


def play(
    recording: RecordedStreams,
    streams: Sequence[str],
    clock: Clock,
    show: Callable[[Recorded], None],
    *,
    arrived: Callable[[], None] = lambda: None,
    ended: Callable[[], None] = lambda: None,
) -> None:
    """Shows what `streams` hold as the clock passes it, until the clock is closed.

    Static streams first; after each jump the last message of every stream before that place, so that a picture that
    stands still is whole. `arrived` is called after those, `ended` at the end.
    """
    static = [s for s in streams if recording.streams[s].static]
    moving = [s for s in streams if not recording.streams[s].static]
    for recorded in recording.messages(static) if static else ():
        show(recorded)
    while True:
        jumps = clock.jumps()
        _, place, _ = clock.state()
        for found in _before(recording, moving, place):
            show(found)
        arrived()
        clock.begin()
        for recorded in recording.messages(moving, place + 1) if moving else ():
            if not clock.reached(recorded.stamp, jumps):
                break
            show(recorded)
        else:
            ended()
            if not clock.moved(jumps):
                return
        if clock.jumps() == jumps:
            return


def _before(recording: RecordedStreams, streams: Sequence[str], place: int) -> list[Recorded]:
    """The last message of each stream at or before `place`, in the order of their stamps."""
    found: dict[str, Recorded] = {}
    for back in LOOK_BACK:
        left = [s for s in streams if s not in found]
        for recorded in recording.messages(left, place - back, place) if left else ():
            found[recorded.stream] = recorded
    return sorted(found.values(), key=lambda recorded: recorded.stamp)
