"""Steers the sources of a running graph that need not keep up with the world: a replay's, or a plain run's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Any

import msgpack

from dataflow.client.attach import NotRunning, reached
from dataflow.transport import Bus, NetworkConfig
from dataflow.transport.keys import runtime_key
from dataflow.transport.registry import RunningGraph

ANSWER_WITHIN = 5.0


@contextmanager
def steering(found: RunningGraph) -> Iterator[Steering]:
    """Connects to a running graph, to steer it several times."""
    with Bus(NetworkConfig(connect=found.endpoints)) as bus:
        reached(bus, found)
        yield Steering(bus, found)


def ask(found: RunningGraph, action: str | None, steps: int = 1, **more: Any) -> dict[str, Any]:
    """Asks once, as `Steering.ask` does."""
    with steering(found) as steered:
        return steered.ask(action, steps=steps, **more)


class Steering:
    """Asks the processes that have the sources of a graph."""

    def __init__(self, bus: Bus, found: RunningGraph) -> None:
        self._bus, self._found = bus, found

    def ask(self, action: str | None = None, *, timeout: float = ANSWER_WITHIN, **fields: Any) -> dict[str, Any]:
        """Asks the sources to do something, or (None) how they stand.

        Actions are `pause`, `resume`, `step` (`steps`), `rate` (`rate`: a factor of real time; None: as fast as it
        goes) and `to` (`stamp`, ns: there as fast as it goes, forward only). The answer holds `paused`, `ended`,
        `rate`, the `span` of the recording (None without one) and `stamp`, the last one given. Raises `NotRunning`
        where nobody answers, and `ValueError` for what cannot be done.
        """
        request = {} if action is None else {"action": action, **fields}
        key = runtime_key(self._found.namespace, "playback")
        answers = [
            msgpack.unpackb(each, raw=False) for each in self._bus.ask(key, msgpack.packb(request), timeout=timeout)
        ]
        if not answers:
            raise NotRunning(
                f"graph {self._found.name!r} did not answer within {timeout:g} s: its sources are live, "
                "or their process is busy"
            )
        if refused := [answer["error"] for answer in answers if not answer["ok"]]:
            raise ValueError(refused[0])
        stamps = [answer["stamp"] for answer in answers if answer["stamp"] is not None]
        return answers[0] | {
            "ended": all(answer["ended"] for answer in answers),
            "stamp": max(stamps, default=None),
        }


class ReplayControls:
    """A replay through a graph, moved as a player of recordings is.

    Requests may come on any thread and return at once: `carry_out` does what was asked, on the thread of its caller. A
    jump goes forward only, at full speed; backward nothing happens, since operators cannot be taken back.
    """

    def __init__(self, steered: Steering) -> None:
        """Raises `NotRunning` for a graph whose sources do not come from a recording."""
        self._steered = steered
        answer = steered.ask(None)
        if answer["span"] is None:
            raise NotRunning("the sources of the graph do not come from a recording")
        self.first, self.last = answer["span"]
        self._asked: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._state = not answer["paused"], self.first, answer["rate"] or 1.0

    def request(self, *, playing: bool, speed: float, seek: int | None) -> bool:
        """Goes on or stops; goes on at the rate `speed` if that is above 0; goes to the stamp `seek` if it lies ahead.

        Tells whether it goes there.
        """
        was_playing, stamp, was_speed = self._state
        goes = seek is not None and seek > stamp
        if seek is not None and goes:
            stamp = min(seek, self.last)
            self._asked.put({"action": "to", "stamp": stamp})
        if speed > 0 and speed != was_speed:
            self._asked.put({"action": "rate", "rate": speed})
        if playing != was_playing:
            self._asked.put({"action": "resume" if playing else "pause"})
        self._state = playing, stamp, speed if speed > 0 else was_speed
        return goes

    def state(self) -> tuple[bool, int, float]:
        """Tells whether it plays, the stamp it is at, and its rate (1 for one that is as fast as it goes)."""
        return self._state

    def carry_out(self) -> None:
        """Has the sources do what was requested. Raises `NotRunning` and `ValueError` as `Steering.ask` does."""
        while not self._asked.empty():
            self._steered.ask(**self._asked.get())

    def look(self, shown: int) -> bool:
        """Asks how the replay stands, which others may steer too; `shown`: the stamp of what was shown last.

        Tells whether it is another way than before. Raises `NotRunning`.
        """
        answer = self._steered.ask(None)
        if not self._asked.empty():  # asked meanwhile: the answer is old
            return False
        before, playing = self._state, not answer["paused"] and not answer["ended"]
        self._state = playing, min(max(before[1], shown), self.last), answer["rate"] or 1.0
        return self._state != before
