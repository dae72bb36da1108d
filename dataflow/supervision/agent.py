"""The agent of a machine: the hand of a supervisor that runs elsewhere. It starts, watches and ends processes here.

It waits for a run, takes part in it, and waits for the next one. Its processes end with it, with the run, and when
the supervisor is not heard for too long.
"""

from __future__ import annotations

import contextlib
import gc
import math
import os
import queue
import secrets
import selectors
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import astuple
from pathlib import Path
from typing import Any

import msgpack
import zenoh

from dataflow.execution.threads import environment
from dataflow.graph.model import Graph
from dataflow.machines import files
from dataflow.machines.gate import Gate, Routes, Word
from dataflow.machines.hub import POOL_BYTES, machine_key, router
from dataflow.machines.keys import settings
from dataflow.machines.pipe import AWAY_AFTER, Pipe
from dataflow.process.awake_clock import AwakeClock
from dataflow.process.descriptors import take_descriptors
from dataflow.process.streams.inbox import Inbox
from dataflow.recording.streams.facts import machine_facts
from dataflow.supervision.black_boxes import Boxes
from dataflow.supervision.children import Children
from dataflow.supervision.core import events
from dataflow.supervision.links import Links
from dataflow.supervision.nursery import Nursery, adopting, nurseries_of
from dataflow.supervision.plan import ProcessPlan
from dataflow.transport import Bus, Fanout, Reservation
from dataflow.transport.publisher import undeclare

HELLO_EVERY = 0.25
LEAVE_WITHIN = 2.0
END_WITHIN = 20.0
"""Seconds that a run gets to end when the agent is stopped."""
CLOCK_EVERY = 1.0
"""Seconds between two words to sources about the offset of the clock."""
TICK = 0.05
LINK_AFTER = 10.0
"""Seconds without a run after which the state of the link is shown."""
SUPERVISOR = ""
"""Its machine, as gates call it."""


class Agent:
    """One machine's agent. `stop()` may be called from a signal handler."""

    def __init__(
        self, name: str, endpoint: str, keys: Path | None, folder: Path, notice: Callable[[str], None], patience: float
    ) -> None:
        """`patience`: the seconds for which operators go on without a sign of life from the supervisor. `notice`
        shows a line to the user who has started the agent."""
        self.name, self.patience, self.notice, self._endpoint = name, patience, notice, endpoint
        self.folder, self._keys = folder.absolute(), keys and keys.absolute()  # it changes into its folder
        self._id = secrets.token_bytes(8)
        self._offered = ""
        self._over: set[str] = set()
        self.stopped = False
        self._run = ""
        self._connected, self._since = False, time.monotonic()
        self._said_connected: bool | None = None

    def stop(self) -> None:
        """Ends it: a run that it takes part in loses its operators here."""
        self.stopped = True

    def run(self, *, once: bool = False) -> None:
        """Takes part in runs until it is stopped; `once`: in one. Raises `BusError`, `NetworkError`."""
        more = settings(self._keys, self._endpoint)
        for number, path in enumerate(sys.path):  # processes run in the folder
            sys.path[number] = str(Path(path).absolute())
        self.folder.mkdir(parents=True, exist_ok=True)
        os.chdir(self.folder)
        with (
            Reservation(1) as reserved,
            contextlib.closing(router(reserved.endpoints, (self._endpoint,), more)) as bus,
        ):
            threading.Thread(target=self._greet, args=(bus,), name="hello", daemon=True).start()
            taken = bus.session.declare_subscriber(
                machine_key(self.name, "start"), zenoh.handlers.Callback(self._started, indirect=False)
            )
            self.notice(f"machine {self.name!r} waits for a run at {self._endpoint}")
            while not self.stopped:
                if not self._offered:
                    self._look_at_link(bus)
                    time.sleep(TICK)
                    continue
                self._run, self._offered = self._offered, ""
                gc.collect()  # the links of the stay before, whose pipe refers to it
                RunParticipation(self, bus, self._run, reserved.endpoints[0]).last()
                self._over.add(self._run)
                self._run = ""
                if once:
                    break
            self.stopped = True
            undeclare(taken)

    def _look_at_link(self, bus: Bus) -> None:
        """Prints what stands in the way where no run comes for a while."""
        connected, now = any(bus.session.info.routers_zid()), time.monotonic()
        if connected != self._connected:
            self._connected, self._since = connected, now
        if connected == self._said_connected or now - self._since < LINK_AFTER:
            return
        self._said_connected = connected
        self.notice(
            f"connected to {self._endpoint}, and offered no run: does its graph name the machine {self.name!r}, "
            "and are these the keys of that machine?"
            if connected
            else f"not connected to {self._endpoint}: no run is there yet, or its keys are of another authority"
        )

    def _started(self, sample: Any) -> None:
        run = msgpack.unpackb(sample.payload.to_bytes(), raw=False)["run"]
        if run != self._run and run not in self._over:
            self._offered = run

    def _greet(self, bus: Bus) -> None:
        """Announces this machine until it stops."""
        key = machine_key(self.name, "hello")
        with contextlib.suppress(zenoh.ZError):  # the session was closed
            while not self.stopped:
                hello = msgpack.packb({"agent": self._id, "run": self._run})
                bus.session.put(key, hello, congestion_control=zenoh.CongestionControl.DROP, express=True)
                time.sleep(HELLO_EVERY)

    @property
    def wanted_elsewhere(self) -> bool:
        """Returns whether it is to end: it was stopped, or another run asks for it."""
        return self.stopped or bool(self._offered)


class RunParticipation:
    """One run's stay on this machine."""

    def __init__(self, agent: Agent, bus: Bus, run: str, router_endpoint: str) -> None:
        self._agent, self._router = agent, router_endpoint
        self._words: deque[Word] = deque()
        self._over = False
        self._children: Children | None = None
        self._endpoints: dict[str, str] = {}
        self._wanted: Mapping[str, Any] = {}
        self._corrected: frozenset[str] = frozenset()
        self._going: set[str] = set()
        self._clock_due = 0.0
        self._woken, self._waking = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._pipe = Pipe(
            bus, machine_key(agent.name, run, "up"), machine_key(agent.name, run, "down"), self._came, bounded=False
        )
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._gate = self._gate_of(Inbox(self._wake), Fanout([]), Routes([], {}, {}, frozenset(), frozenset()))

    def _gate_of(self, inbox: Inbox, fanout: Fanout, routes: Routes) -> Gate:
        return Gate(inbox, fanout, {SUPERVISOR: self._pipe}, routes, self._heard)

    def last(self) -> None:
        """Does what the supervisor orders until the run is over, or it is not heard any more."""
        with adopting(), contextlib.ExitStack() as stack:
            self._stack = stack
            for each in (self._woken, self._waking, self._wake):
                stack.callback(os.close, each)
            stack.callback(self._gate.inbox.close)
            self._clock = AwakeClock()
            self._selector = stack.enter_context(selectors.DefaultSelector())
            self._selector.register(self._woken, selectors.EVENT_READ, None)
            carrying = threading.Thread(target=self._carry, name="gate", daemon=True)
            carrying.start()
            try:
                self._take_part()
            finally:
                self._over = True
                carrying.join(LEAVE_WITHIN)
                self._pipe.close()  # nothing is carried any more when the links close

    def _take_part(self) -> None:
        began = time.monotonic()
        stopped_at = math.inf
        while not self._over:
            self._turn()
            now = time.monotonic()
            if self._agent.stopped and stopped_at == math.inf:
                stopped_at = now
                self._say("", "failed", why="its agent was stopped")
            silence = self._pipe.silence if self._pipe.heard else now - began
            if now - stopped_at > END_WITHIN:
                break
            if silence > self._agent.patience or (self._agent.wanted_elsewhere and silence > AWAY_AFTER):
                self._agent.notice(f"the supervisor was not heard for {silence:.0f} s: its operators are ended")
                break

    def _turn(self) -> None:
        for key, mask in self._selector.select(TICK):
            if key.data is None:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._woken, 4096)
            elif self._children is not None:
                self._children.look(key, mask)
        while self._words:
            try:
                self._obey(*self._words.popleft())
            except (ImportError, OSError, ValueError, RuntimeError) as error:
                self._say("", "failed", why=f"{type(error).__name__}: {error}")
        if self._children is not None:
            self._tell_clock()
            self._children.tick()
            self._children.flush()

    def _carry(self) -> None:
        """Runs the gate, on its thread, until the stay is over."""
        while not self._over:
            gate = self._gate
            gate.push()
            with contextlib.suppress(queue.Empty):
                gate.handle(gate.inbox.get(timeout=TICK))

    # Words

    def _came(self, frame: bytes) -> None:
        self._gate.inbox.put(("frame", SUPERVISOR, frame))

    def _heard(self, machine: str, word: Word) -> None:
        self._words.append(word)
        with contextlib.suppress(BlockingIOError, OSError):  # full: it will wake up; closed: it is over
            os.write(self._waking, b"!")

    def _say(self, label: str, kind: str, /, **fields: Any) -> None:
        self._gate.inbox.put(("say", SUPERVISOR, (label, kind, fields)))

    def _obey(self, label: str, kind: str, fields: dict[str, Any]) -> None:
        match kind:
            case "prepare":
                self._prepare(fields)
            case "file":
                self._take_piece(fields)
            case "begin":
                self._begin()
            case "spawn" if self._children is not None:
                self._going.discard(label)  # until it has its configuration, it takes no other message
                self._children.spawn(label)
            case "send" if self._children is not None:
                self._send(label, fields["kind"], fields["fields"], replaces=fields["replaces"])
            case "signal" if self._children is not None:
                self._children.signal(label, fields["number"])
            case "over":
                self._over = True

    # Before the run

    def _prepare(self, wanted: dict[str, Any]) -> None:
        """Compares what the run needs with what is here."""
        self._wanted = wanted
        wrong = [] if wanted["python"] == files.python() else [f"{files.python()} here, {wanted['python']} there"]
        wrong += files.differences(wanted["code"], files.code_of(wanted["uses"]))
        lacks, others = files.lacking(wanted["files"], self._agent.folder)
        nodes = {name for process in wanted["processes"] for name in process["nodes"]}
        params = [node["params"] for node in wanted["graph"]["nodes"] if node["name"] in nodes]
        others += files.left_over(params, wanted["files"], self._agent.folder)
        if wrong + others:
            self._say("", "differs", what=wrong + others)
        else:
            self._say("", "lacks", files=lacks)

    def _take_piece(self, fields: Mapping[str, Any]) -> None:
        """Writes a piece of a file beside its place, and puts it there when it is whole and right."""
        path = files.inside(self._agent.folder, fields["path"])
        part = path.with_name(path.name + ".part")
        if fields["at"] + len(fields["data"]) > files.MOST_SENT:
            raise files.FilesError(f"file {fields['path']!r} has more than {files.MOST_SENT / 1e9:.1f} GB")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with part.open("ab" if fields["at"] else "wb") as file:
                file.write(fields["data"])
        except OSError as error:
            raise files.FilesError(
                f"file {fields['path']!r} cannot be written into {self._agent.folder}: {error.strerror}"
            ) from error
        self._say("", "took")
        if not fields["last"]:
            return
        if files.digest_of(part) != fields["digest"]:
            part.unlink()
            raise files.FilesError(f"file {fields['path']!r} changed while it was sent")
        part.replace(path)
        files.note_sent(self._agent.folder, fields["path"], fields["digest"])

    def _begin(self) -> None:
        """Makes the links of the processes here, and is ready to start them."""
        wanted, stack = self._wanted, self._stack
        lacks, _ = files.lacking(wanted["files"], self._agent.folder)
        if lacks:
            raise files.FilesError(f"files did not arrive: {', '.join(lacks)}")
        graph = Graph.from_json(wanted["graph"])
        processes = {fields["label"]: ProcessPlan(**fields) for fields in wanted["processes"]}
        corrected = {name for name, node in graph.nodes.items() if node.live.corrected}
        self._corrected = frozenset(label for label, process in processes.items() if corrected & {*process.nodes})
        gate = wanted["gate"]["label"]
        self._pipe.bounded = wanted["live"]
        links = Links([*processes, gate], {(maker, taker): tuple(keys) for maker, taker, keys in wanted["pairs"]})
        stack.callback(links.close)
        given = take_descriptors(links.handed(gate), wanted["gate"])
        fanout = Fanout(given.outgoing, pool_bytes=POOL_BYTES)
        stack.callback(fanout.close)
        inbox = Inbox(given.wake, given.incoming)
        stack.callback(inbox.close)
        self._gate = self._gate_of(inbox, fanout, Routes.from_json(wanted["routes"]))
        reserved = stack.enter_context(contextlib.closing(Reservation(len(processes))))
        self._endpoints = dict(zip(processes, reserved.endpoints, strict=True))
        common = environment(graph.threads)
        apart = nurseries_of({label: process.env for label, process in processes.items()}, common)
        nursery = Nursery(common)
        boxes = Boxes(graph, processes, live=wanted["live"])
        self._children = Children(nursery, apart, self._selector, links, boxes, self._clock, self._feed, self._printed)
        stack.callback(self._children.bury)
        self._say("", "ready", facts=machine_facts(common))

    # Processes

    def _send(self, label: str, kind: str, fields: dict[str, Any], *, replaces: bool) -> None:
        """Passes a message on, in this machine's terms: its sockets, its folder's files, its clock."""
        assert self._children is not None
        if kind == "operators":
            fields["listen"] = [self._endpoints[label]]
            fields["graph"]["network"] |= {"listen": [], "connect": [self._router], "tls": {}, "access_control": {}}
        elif kind == "go":
            self._going.add(label)
            if (best := self._pipe.clocks.best) is not None:
                fields["at"] -= best[1] * 1e-9
                self._clock_due = 0.0
                self._tell_clock()
        self._children.send(label, kind, fields, replaces=replaces)

    def _tell_clock(self) -> None:
        """Sends processes of sources with corrected stamps, now and then, by how much the clock here is ahead."""
        now, best = time.monotonic(), self._pipe.clocks.best
        if self._children is not None and best is not None and now >= self._clock_due:
            self._clock_due = now + CLOCK_EVERY
            for label in self._corrected & self._going:
                self._children.send(label, "clock", {"offset": -best[1], "delay": best[0]}, replaces=True)

    def _printed(self, label: str, line: str) -> None:
        self._say(label, "printed", line=line)

    def _feed(self, event: events.Event) -> None:
        match event:
            case events.Received(label, "beat", fields):  # behind a slow link's messages it would come too late
                self._gate.say_now(SUPERVISOR, (label, "said", {"kind": "beat", "fields": dict(fields)}))
            case events.Received(label, kind, fields):
                self._say(label, "said", kind=kind, fields=dict(fields))
            case events.Disconnected(label):
                self._say(label, "hung up")
            case events.NotReading(label, seconds, waiting, overflowed):
                self._say(label, "not reading", seconds=seconds, waiting=waiting, overflowed=overflowed)
            case events.RecordsRecovered(label, remains):
                reached = {name: list(astuple(each)) for name, each in remains.reached.items()}
                batches = {name: list(each) for name, each in remains.batches.items()}
                self._say(label, "remained", batches=batches, reached=reached)
            case events.Exited(label, code):
                self._say(label, "died", code=code)
            case events.OrphansKilled(labels, processes):
                self._say("", "left", labels=list(labels), processes=list(processes))
            case events.Aborted(why):
                self._say("", "failed", why=why)
