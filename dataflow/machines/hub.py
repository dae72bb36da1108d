"""The link: the process beside the supervisor that other machines, and tools on them, connect to.

Its Zenoh session routes what tools ask. Streams and control messages between machines pass through its gate.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import zenoh

from dataflow.machines.gate import Gate, Routes, Word
from dataflow.machines.keys import GRAPH_KEY, KEYS, OVER_KEY, access, own_name, settings
from dataflow.machines.pipe import AWAY_AFTER, Pipe
from dataflow.process.channel import Channel, ChannelClosed
from dataflow.process.streams.inbox import Inbox
from dataflow.transport import Bus, Fanout, NetworkConfig, Outgoing
from dataflow.transport.keys import runtime_key

LOOK_EVERY = 0.05
REPORT_EVERY = 1.0
LEAVE_WITHIN = 2.0
LEASE = 6_000
"""Milliseconds after which a link on which nothing comes is given up, and connected anew."""
BLOCKED = 3.0
"""Seconds for which a frame waits for a link that takes nothing; a router's tables, and a new link, wait as long."""
POOL_BYTES = 256 << 20


@dataclass(frozen=True, slots=True)
class HubConfig:
    """Configuration of the link, as plain values.

    `endpoint`: where other machines connect; `listen`: the socket for tools here; `connect`: those of the operators'
    processes. `run`: a word of this run alone. `graph`: the running graph, for tools elsewhere.
    """

    label: str
    endpoint: str
    keys: str | None
    listen: str
    connect: Sequence[str]
    run: str
    machines: Sequence[str]
    namespace: str
    routes: Mapping[str, Any]
    graph: Mapping[str, Any]
    live: bool
    links_out: Sequence[tuple[bool, Sequence[str]]] = ()
    links_in: Sequence[Sequence[str]] = ()
    life: int = 1


def machine_key(machine: str, *chunks: str) -> str:
    """Returns a key of a machine's agent."""
    return "/".join((KEYS, "machine", machine, *chunks))


def router(listen: Sequence[str], connect: Sequence[str], more: Mapping[str, Any]) -> Bus:
    """Opens a session that routes between those that connect to it. Raises `BusError`, `NetworkError`."""
    common = {"mode": "router", "transport/link/tx/lease": LEASE, "transport/link/tx/keep_alive": 6}
    return Bus(NetworkConfig(tuple(listen), tuple(connect), exposed=True, blocked=BLOCKED, zenoh={**common, **more}))


class Claims:
    """The agent of each machine of a run: the first that came, as long as it is there."""

    def __init__(self, run: str) -> None:
        self._run = run
        self._agents: dict[str, tuple[bytes, float]] = {}  # by machine, its agent, and when that last said hello

    def answer(self, name: str, agent: bytes, run: str, silence: float | None, now: float) -> str:
        """Returns what an agent's hello calls for: "offer" it the run, "busy" with another run, "another" agent of that
        name, one that has left the run or was started "anew", or "" for nothing.

        `run`: that which it takes part in; `silence` (s): that of the machine's pipe, None if it was never heard.
        """
        first, said_at = self._agents.get(name, (agent, now))
        left = silence is not None and silence > AWAY_AFTER
        if first != agent and not left and (silence is not None or now - said_at < AWAY_AFTER):
            return "another"
        if left and (first != agent or run != self._run):
            return "anew"
        self._agents[name] = (agent, now)
        if run == self._run:
            return ""
        return "busy" if run else "offer"


class Hub:
    """Runs the link until it is asked to leave."""

    def __init__(
        self, config: HubConfig, channel: Channel, inbox: Inbox, outgoing: Sequence[tuple[Sequence[str], Outgoing]]
    ) -> None:
        self.config, self._channel, self._inbox = config, channel, inbox
        self._fanout = Fanout(outgoing, pool_bytes=POOL_BYTES)
        self._up = dict.fromkeys(config.machines, False)
        self._claims = Claims(config.run)
        self._reported = 0.0
        self._left = False

    def open(self) -> None:
        """Listens, and looks out for the machines."""
        config = self.config
        more = settings(None if config.keys is None else Path(config.keys), config.endpoint)
        if config.keys is not None:
            more |= access(config.machines, config.namespace, own_name(Path(config.keys)))
        self._bus = router((config.endpoint, config.listen), config.connect, more)
        self._pipes = {
            name: Pipe(
                self._bus,
                machine_key(name, config.run, "down"),
                machine_key(name, config.run, "up"),
                lambda frame, name=name: self._inbox.put(("frame", name, frame)),  # type: ignore[misc]
                bounded=config.live,
            )
            for name in config.machines
        }
        self._gate = Gate(self._inbox, self._fanout, self._pipes, Routes.from_json(config.routes), self._said)
        self._offers = {
            name: self._bus.session.declare_publisher(machine_key(name, "start")) for name in config.machines
        }
        self._hellos = [
            self._bus.session.declare_subscriber(
                machine_key(name, "hello"), zenoh.handlers.Callback(self._greeted(name), indirect=False)
            )
            for name in config.machines
        ]
        self._started = time.time()
        described = msgpack.packb({"graph": dict(config.graph), "started": self._started}, use_bin_type=True)
        self._bus.serve(GRAPH_KEY, lambda query: query.reply(GRAPH_KEY, described))
        key = runtime_key(config.namespace, "machines")
        self._bus.serve(key, lambda query: query.reply(key, msgpack.packb(self._states())))
        self._channel.send("joined")

    def _greeted(self, name: str) -> Any:
        return lambda sample: self._inbox.put(("hello", name, sample.payload.to_bytes()))

    def run(self) -> None:
        """Carries until it is asked to leave."""
        while not self._left:
            self._gate.push()
            try:
                item = self._inbox.get(timeout=LOOK_EVERY)
            except queue.Empty:
                item = ()
            if item:
                self._handle(item)
            self._look()

    def _handle(self, item: tuple[Any, ...]) -> None:
        match item:
            case ("control", "to", fields):
                word = (fields["label"], fields["kind"], fields["fields"])
                self._gate.handle(("say", fields["machine"], word))
            case ("control", "leave", _):
                self._inbox.put(("leave",))  # behind the words that are on their way to the pipes
            case ("leave",):
                self._left = True
            case ("control", "lost", _):
                raise ChannelClosed("the supervisor is gone")
            case ("hello", name, agent):
                self._meet(name, agent)
            case _:
                self._gate.handle(item)

    def _meet(self, name: str, said: bytes) -> None:
        """Offers the run to an agent that has none; one that gets nothing is reported."""
        try:
            hello = msgpack.unpackb(said, raw=False)
            agent, run = hello["agent"], hello["run"]
        except (ValueError, TypeError, KeyError):
            return  # no agent of ours
        pipe = self._pipes[name]
        answer = self._claims.answer(name, agent, run, pipe.silence if pipe.heard else None, time.monotonic())
        if answer in ("offer", "busy"):
            self._offers[name].put(msgpack.packb({"run": self.config.run}))
        if answer not in ("", "offer"):
            self._channel.send(answer, machine=name)

    def _said(self, machine: str, word: Word) -> None:
        """Passes on a word of an agent. What its process had sent before it closed has arrived first."""
        label, kind, fields = word
        if kind == "said" and fields["kind"] == "closed":
            self._gate.push_all()
        elif kind == "said":
            self._gate.add_extra(label, fields)
        self._channel.send("from", machine=machine, label=label, kind=kind, fields=fields)

    def _states(self) -> dict[str, dict[str, Any]]:
        """Returns for each machine whether its link is up, its clock's offset and that measurement's delay (ns), and
        the messages that its link dropped."""
        states = {}
        for name, pipe in self._pipes.items():
            delay, offset = pipe.clocks.best or (0, 0)
            states[name] = {"up": self._up[name], "offset": offset, "delay": delay, "dropped": pipe.dropped}
        return states

    def _look(self) -> None:
        """Reports links that went down or came up, and now and then the clocks."""
        for name, pipe in self._pipes.items():
            up = pipe.heard and pipe.silence < AWAY_AFTER
            if up != self._up[name]:
                self._up[name] = up
                self._channel.send("link", machine=name, up=up)
        now = time.monotonic()
        if now - self._reported < REPORT_EVERY:
            return
        self._reported = now
        for name, state in self._states().items():
            if state["delay"]:
                self._channel.send("clock", machine=name, **state)

    def hand_over(self) -> None:
        """Holds no firing records."""

    def close(self) -> dict[str, Any]:
        """Ends the pipes, once agents have taken what was said last (bounded), and the session."""
        self._bus.session.put(OVER_KEY, msgpack.packb(self._started))
        for pipe in self._pipes.values():
            pipe.close(LEAVE_WITHIN if pipe.heard and pipe.silence < AWAY_AFTER else 0.0)
        self._bus.close()
        self._fanout.close()
        return {}
