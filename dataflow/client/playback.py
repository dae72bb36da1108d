"""Asks a running graph that is not live to pause, go on, make some steps, or change its speed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgpack

from dataflow.client.attach import NotRunning, network_of, reached
from dataflow.transport import Bus
from dataflow.transport.keys import runtime_key
from dataflow.transport.registry import RunningGraph

ANSWER_WITHIN = 5.0


class Steering:
    """Steers one run. Thread-safe."""

    def __init__(self, found: RunningGraph, bus: Bus) -> None:
        self._found, self._bus = found, bus
        self._one_at_a_time = threading.Lock()

    def ask(
        self, action: str | None, steps: int = 1, speed: float | None = None, *, timeout: float = ANSWER_WITHIN
    ) -> dict[str, Any]:
        """Asks a run to do something, or (None) how it stands.

        `paused`, `ended`, `speed` (None: as fast as it goes), `stamp`, the last one given, and `replay`, where a
        recording stands in for its sources: the `span` of stamps that is played, and the `first`, which `--start`
        counts from. All processes with sources answer as one. Raises `NotRunning` where no process answers,
        or the run is live.
        """
        request = {} if action is None else {"action": action, "steps": steps, "speed": speed}
        key = runtime_key(self._found.namespace, "playback")
        with self._one_at_a_time:
            answers = self._bus.ask(key, msgpack.packb(request), timeout=timeout)
        name = self._found.name
        if not answers:
            raise NotRunning(
                f"graph {name!r} did not answer within {timeout:g} s: its processes are busy, or it has no sources"
            )
        told: list[dict[str, Any]] = [msgpack.unpackb(answer, raw=False) for answer in answers]
        for one in told:
            if not one["ok"]:
                raise NotRunning(f"graph {name!r} cannot do that: {one['error']}")
        stamps = [one["stamp"] for one in told if one["stamp"] is not None]
        return {
            "paused": any(one["paused"] for one in told),
            "ended": all(one["ended"] for one in told),
            "speed": told[0]["speed"],
            "stamp": max(stamps, default=None),
            "replay": next((one["replay"] for one in told if one["replay"] is not None), None),
        }


@contextmanager
def steering(found: RunningGraph) -> Iterator[Steering]:
    """Opens what steers a run."""
    with Bus(network_of(found)) as bus:
        reached(bus, found)
        yield Steering(found, bus)


def ask(
    found: RunningGraph,
    action: str | None,
    steps: int = 1,
    speed: float | None = None,
    *,
    timeout: float = ANSWER_WITHIN,
) -> dict[str, Any]:
    """As `Steering.ask`, once."""
    with steering(found) as steered:
        return steered.ask(action, steps, speed, timeout=timeout)


ANSWER_WITHIN = 2.0
"""Seconds that a bar waits for a replay; then it keeps showing the last state."""


class ReplayBar:
    """Hands on what a playback bar asks for: pause, play and speed. It refuses to jump. Thread-safe. A replay that goes
    as fast as its graph does is shown with speed 1, and stays so until a bar asks for another speed."""

    def __init__(self, steering: Steering, standing: dict[str, Any]) -> None:
        """`standing`: the last answer of the replay."""
        self._steering = steering
        self._guard = threading.Lock()
        self._standing = standing
        self._speed = self._speed_of(standing)
        begin, end = standing["replay"]["span"]
        self.span: tuple[int, int] = (begin, end)
        self._first: int = standing["replay"]["first"]

    def request(self, *, playing: bool, speed: float, seek: int | None) -> str | None:
        """Does it; returns why something was not done."""
        refused = None if seek is None else self._why_not_there(seek)
        with self._guard:
            new_speed = speed > 0 and abs(speed - self._speed) > 1e-6 * speed
            paused = self._standing["paused"]
        try:
            if new_speed:
                self._take(self._steering.ask("speed", speed=speed, timeout=ANSWER_WITHIN))
            if playing == paused:
                self._take(self._steering.ask("resume" if playing else "pause", timeout=ANSWER_WITHIN))
        except NotRunning as error:
            return str(error)
        return refused

    def state(self) -> tuple[bool, int, float]:
        """Returns whether it plays, the stamp it is at, and its speed."""
        with self._guard:
            stamp = self._standing["stamp"]
            playing = not self._standing["paused"] and not self._standing["ended"]
            return playing, self.span[0] if stamp is None else stamp, self._speed

    @property
    def ended(self) -> bool:
        """Returns whether everything has been given."""
        with self._guard:
            return bool(self._standing["ended"])

    def refresh(self) -> None:
        """Asks how the replay stands; keys in its terminal move it too. Without an answer, the last state stays."""
        try:
            self._take(self._steering.ask(None, timeout=ANSWER_WITHIN))
        except NotRunning:
            return

    def _take(self, standing: dict[str, Any]) -> None:
        with self._guard:
            self._standing, self._speed = standing, self._speed_of(standing)

    @staticmethod
    def _speed_of(standing: dict[str, Any]) -> float:
        return 1.0 if standing["speed"] is None else float(standing["speed"])

    def _why_not_there(self, seek: int) -> str:
        seconds = (min(max(seek, self.span[0]), self.span[1]) - self._first) * 1e-9
        return (
            "A replay through a graph cannot jump: its operators hold what they were given before. To begin there, "
            "with the states that operators had, end it and say: "
            f"dataflow replay RECORDING --start {max(seconds, 0.0):.3f}"
        )
