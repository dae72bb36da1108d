"""Carries out the supervisor's messages to a process of operators, and keeps the state that they set."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from dataflow.chaos.faults import OperatorFaults
from dataflow.execution.driver import Driver
from dataflow.execution.feeds.window import Window
from dataflow.execution.protocol import Runner
from dataflow.operator import ParameterError
from dataflow.process.channel import ChannelClosed
from dataflow.process.live_sources import LiveSources
from dataflow.process.requests import Requests
from dataflow.process.streams.inlet import Inlet
from dataflow.process.streams.outlet import Outlet
from dataflow.sync import FOREVER

MALFORMED = b"\x00malformed\xff" * 8


class Control:
    """The orders that one process was given."""

    def __init__(
        self,
        windows: tuple[Window, Window],
        driver: Driver,
        live: LiveSources,
        inlet: Inlet,
        outlet: Outlet,
        requests: Requests,
        release: Callable[[int | None, float], None],
    ) -> None:
        """`windows`: what sources may be ahead, and what may wait for operators that drop; `release`: begins."""
        self._window, self._backlog = windows
        self._driver, self._live = driver, live
        self._inlet, self._outlet, self._requests, self._release = inlet, outlet, requests, release
        self.probing = False
        """Probes are to be sent: consumers prove that they listen."""
        self.released = False
        """All are linked, and sources may begin."""
        self.stopping = False
        """Sources are to end."""
        self.left = False
        """The process is to leave."""
        self.asked: int | None = None
        """The round in which it is asked for its state, until it has answered."""

    def obey(self, kind: str, fields: Mapping[str, Any]) -> None:
        """Carries out one message. Raises `ChannelClosed` when the supervisor is gone."""
        match kind:
            case "covered":
                self._window.cover(fields["frontier"])
                self._backlog.cover(fields.get("backlog", FOREVER))
            case "probe":
                self.probing = True
            case "go":
                self.probing, self.released = False, True
                self._release(fields["first"], fields["at"])
            case "clock":
                self._live.clock_measured(fields["offset"], fields["delay"])
            case "absent":
                self._mark(fields["streams"], absent=fields["absent"])
            case "ended_elsewhere":
                for stream in fields["streams"]:
                    for runner in self._driver.taking(stream):
                        runner.end(stream, None, fields["reason"])
            case "fault":
                self._begin_fault(fields["fault"], fields["operator"], fields["fields"])
            case "grow":
                self._window.grow()
            case "poll":
                self.asked = fields["round"]
            case "playback":
                self._requests.play(fields["action"], fields["steps"], fields["speed"])
            case "stop":
                self.stopping = True
                self._driver.feeding.finish("interrupted")
                self._live.finish("interrupted")
            case "gone":
                self._outlet.consumer_gone(fields["ring"], fields["life"])
            case "lacks":
                self._outlet.send_again(fields["operator"])
            case "leave":
                self.left = True
            case "lost":
                raise ChannelClosed("the supervisor is gone")

    def _mark(self, streams: list[str], *, absent: bool) -> None:
        """Marks these streams, for their consumers, as having no producer, or as having one again."""
        for stream in streams:
            for consumer in self._driver.taking(stream):
                (consumer.absent.add if absent else consumer.absent.discard)(stream)
        if not absent:
            self._inlet.restarted(streams)

    def _begin_fault(self, kind: str, operator: str, fields: Mapping[str, Any]) -> None:
        """Does one planned fault now, or lets it begin. What each kind means: docs/faults.md."""
        print(f"planned fault: {kind} {operator} {dict(fields)}", file=sys.stderr)
        if self._live.begin_fault(kind, operator, fields):
            return
        maker = self._driver[operator]
        match kind:
            case "param":
                try:
                    maker.set_parameter(fields["name"], fields["value"])
                except ParameterError as error:
                    print(f"planned fault: {error}", file=sys.stderr)
            case "malformed":
                for stream in maker.node.outputs.values():
                    self._outlet.put_raw(stream, MALFORMED)
            case "raise" | "hang" | "slow" | "leak" if isinstance(maker, Runner):
                maker.faults = maker.faults or OperatorFaults()
                maker.faults.begin(kind, fields, time.monotonic())
