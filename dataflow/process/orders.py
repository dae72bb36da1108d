"""Does what the supervisor tells a process of operators, and keeps what it has told."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from dataflow.process.channel import ChannelClosed
from dataflow.process.planned_faults import do_fault
from dataflow.sync import FOREVER

if TYPE_CHECKING:
    from dataflow.process.operator_process import OperatorProcess


class Orders:
    """The orders that one process was given."""

    def __init__(self, process: OperatorProcess) -> None:
        self._process = process
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
        """Does what a message says. Raises `ChannelClosed` when the supervisor is gone."""
        process = self._process
        match kind:
            case "covered":
                process.window.cover(fields["frontier"])
                process.backlog.cover(fields.get("backlog", FOREVER))
            case "probe":
                self.probing = True
            case "go":
                self.probing, self.released = False, True
                process.release(fields["first"], fields["at"])
            case "absent":
                self._mark(fields["streams"], absent=fields["absent"])
            case "ended_elsewhere":
                for stream in fields["streams"]:
                    for runner in process.runners.taking(stream):
                        runner.end(stream, None, fields["reason"])
            case "fault":
                kind, operator = fields["fault"], fields["operator"]
                do_fault(
                    kind,
                    operator,
                    fields["fields"],
                    runners=process.runners,
                    live=process.live,
                    outlet=process.outlet,
                )
            case "grow":
                process.window.grow()
            case "poll":
                self.asked = fields["round"]
            case "playback":
                process.requests.play(fields["action"], fields["steps"], fields["speed"])
            case "stop":
                self.stopping = True
                process.feeding.finish("interrupted")
                process.live.finish("interrupted")
            case "gone":
                process.outlet.consumer_gone(fields["ring"], fields["life"])
            case "lacks":
                process.outlet.send_again(fields["operator"])
            case "leave":
                self.left = True
            case "lost":
                raise ChannelClosed("the supervisor is gone")

    def _mark(self, streams: list[str], *, absent: bool) -> None:
        """Notes for whom takes some streams that nobody makes them at the moment, or that somebody does again."""
        for stream in streams:
            for consumer in self._process.runners.taking(stream):
                (consumer.absent.add if absent else consumer.absent.discard)(stream)
        if not absent:
            self._process.inlet.restarted(streams)
