"""An operator process: it runs one or more operators on one thread, between its inbox and its outlet.

Other threads only append to the inbox. The main thread takes from it, feeds the aligners, runs the firings that are
decided, lets feeds admit what the window allows, and waits (bounded) when there is nothing to do. Meanwhile the reader
of a live source may emit a step itself, so that the main thread need not be woken for that.
"""

from __future__ import annotations

import gc
import math
import queue
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from dataflow.execution.driver import Driver
from dataflow.execution.feeds.feeding import Feeding
from dataflow.execution.feeds.pace import Pace
from dataflow.execution.feeds.window import Window
from dataflow.execution.threads import limit_threads
from dataflow.graph.model import Graph
from dataflow.process.awake_clock import AwakeClock
from dataflow.process.build import build, open_box
from dataflow.process.channel import Channel
from dataflow.process.config import ProcessConfig
from dataflow.process.control import Control
from dataflow.process.descriptors import BACKLOG
from dataflow.process.live_sources import LiveSources, Step
from dataflow.process.log_pipe import tell_outlived
from dataflow.process.network import leave_network, network_config
from dataflow.process.progress import Progress, final_report
from dataflow.process.requests import Requests
from dataflow.process.streams.inbox import Inbox
from dataflow.process.streams.inlet import Inlet
from dataflow.process.streams.losses import StreamDamaged, losses_of
from dataflow.process.streams.outlet import Network, Outlet, incarnations_of, left_by
from dataflow.process.watchdog import Watchdog
from dataflow.sync import NEVER, Entry, StreamOrderError
from dataflow.transport import Bus, Envelope, Fanout, Kind, Outgoing, OutsidePublisher, TapServer
from dataflow.transport.fanout import POOL_BYTES

IDLE_WAIT = 0.1
TAKE_WITHIN = 0.001
"""Seconds for what has arrived, before what is decided is run; live runs take all, to know the newest."""
PROBE_EVERY = 0.01
STATICS_WITHIN = 5.0

Links = Sequence[tuple[Sequence[str], Outgoing]]
"""The links to other processes, each with the keys of its channels."""


class OperatorProcess:
    """Runs its operators until they end, it is asked to leave, or something fails."""

    def __init__(
        self, config: ProcessConfig, channel: Channel, inbox: Inbox, outgoing: Links = (), box: int | None = None
    ) -> None:
        """`box`: the descriptor of the memory in which the latest firing records outlive this process."""
        self.config, self.channel, self.inbox = config, channel, inbox
        self.graph = Graph.from_json(config.graph)
        self.pace = Pace(config.rate)
        ahead = config.ahead or config.window
        self.window = Window(*ahead)
        backlog = (most * times for most, times in zip(config.window, BACKLOG, strict=True))
        self.backlog = Window(*map(max, ahead, backlog))
        feeding = Feeding(self.window, self.pace, paused=config.paused, speed=config.rate)
        self.driver = Driver(feeding, self._arrived)
        self.live = LiveSources(
            inbox,
            channel,
            self.pace,
            self.window,
            self.backlog,
            resumed=config.resume is not None,
            in_its_place=self._in_place_of_main,
        )
        self._losses = losses_of(config.label, channel, live=config.live)
        self.inlet = Inlet(
            channel,
            self._deliver,
            static=self.graph.static,
            losses=self._losses,
            from_start=config.live and config.resume is None,
        )
        self.outlet = self._outlet(outgoing, box)
        self.progress = Progress(channel, self.driver, self.live, paced=config.live)
        self.requests = Requests(
            config, self.driver, self.live, self.progress, self.outlet.recent, self.pace.event_time, channel
        )
        windows = self.window, self.backlog
        self.orders = Control(windows, self.driver, self.live, self.inlet, self.outlet, self.requests, self.release)
        self._ended = False
        self._take_within = math.inf if config.live else TAKE_WITHIN
        self._watch: Watchdog | None = None
        self._running = False

    def _outlet(self, outgoing: Links, box: int | None) -> Outlet:
        """Returns what sends the outputs; of restarted operators it goes on numbering where they ended."""
        config, graph = self.config, self.graph
        before = {name: config.resumed(name) for name in config.resume or ()}
        outputs = {name: node.outputs for name, node in graph.nodes.items()}
        pool_bytes = POOL_BYTES if graph.network.shared_memory else 0
        return Outlet(
            self.channel,
            self.driver.consumers,
            fanout=Fanout(outgoing, pool_bytes=pool_bytes, gives_way=config.live),
            namespace=graph.namespace,
            static=graph.static,
            box=None if box is None else open_box(box, config, graph),
            firings=config.firings,
            incarnations=incarnations_of(before, outputs),
            left=left_by(before, outputs),
        )

    # Life

    def open(self) -> None:
        """Joins the network, makes the operators and sets them up, then reports to the supervisor as ready."""
        config, graph = self.config, self.graph
        settings = network_config(graph.network, config.listen, live=config.live)
        self.bus = Bus(settings)
        self.outside = OutsidePublisher(self.bus.counted, lossless=not config.live)
        self.taps = TapServer(self.bus, graph.namespace)
        made = {*config.publish, *(s for name in config.nodes for s in graph.nodes[name].outputs.values())}
        publishers = {stream: self.bus.publisher(stream) for stream in sorted(made)}
        self.outlet.open(Network(self.bus, self.taps, self.outside, publishers))
        self.channel.send("joined")
        for stream in config.subscribe:
            graph.message_types(stream)  # its messages may be of a type that no operator here names
        self.make()
        self.requests.serve(self.bus, graph.namespace, self.inbox)
        self.set_up()
        if config.resume is not None:
            self._await_statics()
        first = [*self.driver.feeding.first_stamps(), *self.live.first_stamps()]
        lengths = [n for source in self.driver.sources if (n := source.source.length()) is not None]
        self.channel.send("ready", first=min(first, default=None), steps=sum(lengths) if lengths else None)

    def _await_statics(self) -> None:
        """Waits (bounded) for the static messages that were given before this process came to be: those that made them
        send them again. Raises `StreamDamaged`."""
        clock = AwakeClock()
        deadline = clock() + STATICS_WITHIN
        while (missing := self.inlet.statics_missing(self.config.subscribe)) and not self.orders.left:
            if clock() > deadline:
                raise StreamDamaged(
                    f"process {self.config.label!r} was restarted and did not get the static streams "
                    f"{', '.join(sorted(missing))} within {STATICS_WITHIN:g} s"
                )
            self._take(PROBE_EVERY)

    def make(self) -> None:
        """Makes the operators, and what stands in for sources. Raises `OperatorFailure` for one that cannot be made."""
        build(
            self.driver,
            self.graph,
            self.config,
            self.outlet,
            live=self.live,
            event_clock=self.pace.event_time,
            on_failure=partial(tell_outlived, self.channel),
        )

    def set_up(self) -> None:
        """Calls `setup()` of every operator, with as many library threads as the graph allows."""
        limit_threads(self.graph.threads)
        self.driver.set_up()
        gc.freeze()  # modules and operators live as long as the process: collections need not look at them

    def release(self, first: int | None, at: float) -> None:
        """All processes are linked: sends what was held back, and begins. Event time `first` (ns) is `at` (seconds)."""
        self.outlet.release()
        self.pace.begin(first, at)
        self.driver.ready.wake_all()
        self.live.start()
        self._watch = Watchdog(self.channel, self.driver.operators, deadlines=self.config.live)

    def run(self) -> None:
        """Runs the main loop; returns when the supervisor has let the process go."""
        self._running = True
        try:
            while self._turn_of_loop():
                pass
        finally:
            self._running = False
        self.hand_over()

    def _turn_of_loop(self) -> bool:
        """Takes what there is and works on it; False when the process is to leave."""
        if self.orders.probing:
            self.outlet.probe()
        self.outlet.push()
        self._take(self._wait_time() if self.inbox.empty() else 0.0)
        if self.orders.left:
            return False
        if self.live.runners:
            self.live.restart_due()
        worked = self._work()
        self.outlet.flush_due()
        self.progress.report(idle=self.inbox.empty())
        if self.orders.asked is not None:
            self._answer(idle=not worked)  # after the work that was there
        return True

    def _in_place_of_main(self, act: Callable[[Step], None], step: Step) -> bool:
        """Lets the thread that reads a source emit a step, where the main thread waits for something to do; False
        where it does not. Operators are left to the main thread."""
        inbox = self.inbox
        if not inbox.take_turn():
            return False
        try:
            if not self._running:
                return False
            act(step)
        finally:
            inbox.give_turn(wake=bool(self.driver.ready.woken))
        return True

    def hand_over(self) -> None:
        """Sends the firing records that were not sent yet: after a failure here, the failed one among them."""
        if self.orders.released:
            self.outlet.flush_all()
            self.outlet.push_all()

    def close(self) -> None:
        """Closes every operator and the network; the first error is raised when all are closed."""
        if self._watch is not None:
            self._watch.stop()
        reading, failures = self.live.await_readers()
        failures += self.driver.close(but=reading)
        leave_network(self.config.label, self.taps.close, self.outside.close, self.bus.close)
        self.outlet.close()
        if failures:
            raise failures[0]

    # Inbox

    def _wait_time(self) -> float:
        if self.orders.probing:
            return PROBE_EVERY
        due = [self.driver.ready.next_due(), self.progress.next_due()]
        if self.live.runners:
            due.append(self.live.next_due())
        feeding = self.driver.feeding
        if feeding.feeds and self.orders.released:
            due.append(feeding.next_due())
        wait = IDLE_WAIT
        for seconds in due:
            if seconds is not None and seconds < wait:
                wait = seconds
        return max(0.0, wait)

    def _take(self, timeout: float) -> None:
        """Handles what is in the inbox, but not for long; waits up to `timeout` for the first."""
        inbox = self.inbox
        try:
            item = inbox.get(timeout=timeout)
        except queue.Empty:
            return
        more = inbox.qsize()
        if item[0] == "envelope":  # the way of most, without a call more than it takes
            self.inlet.take(item[1], item[2])
        else:
            self._handle(item)
        if not more:
            return
        until = time.monotonic() + self._take_within
        while more and time.monotonic() < until:
            self._handle(inbox.get_nowait())
            more -= 1

    def _handle(self, item: tuple[Any, ...]) -> None:
        kind = item[0]
        if kind == "envelope":
            self.inlet.take(item[1], item[2])
        elif kind == "control":
            self.orders.obey(item[1], item[2])
        elif kind == "source":
            self.live.take(item[1], item[2], item[3])
        elif kind == "source_failed":
            self.live.failed(item[1], item[2])
        elif kind in ("param", "reload"):
            self.requests.answer_parameter(item[1], item[2], here=kind == "reload")
        elif kind == "playback":
            self.requests.answer_playback(item[2])

    def _deliver(self, stream: str, envelope: Envelope) -> None:
        """Gives an envelope to the operators that take its stream; what contradicts what they have seen is refused."""
        stamp, message, entry = envelope.stamp, envelope.message, None
        if message is not None:
            entry = Entry(stamp, message, envelope.seq, envelope.incarnation, b"", stream)
        for runner in self.driver.consumers.get(stream, ()):
            try:
                if entry is not None:
                    runner.push(stream, entry)
                elif envelope.kind is Kind.FRONTIER:
                    runner.advance(stream, stamp)
                elif envelope.kind is Kind.END:
                    runner.end(stream, None if stamp == NEVER else stamp, envelope.reason)
            except StreamOrderError as error:
                self._losses.contradicted(error)
                self.inlet.refuse(stream, str(error))

    # Work

    def _work(self) -> bool:
        """Does what there is to do, but not for long where something has arrived. True when anything was done. Nothing
        before all processes are linked: a restarted one is sent messages before it has the time."""
        if not self.orders.released:
            return False
        worked = False
        driver, inbox = self.driver, self.inbox
        feeds, woken = driver.feeding.feeds, driver.ready.woken
        while driver.turn():
            worked = True
            if not (feeds or woken) or not inbox.empty():
                break
            self.progress.report(idle=False)
        self._end_if_done()
        return worked

    # Reports

    def _end_if_done(self) -> None:
        """Sends what came of everything, once, when all feeds, sources and operators have ended."""
        for runner in self.driver.operators:
            if not runner.ended:
                return
        if self._ended or not (self.driver.feeding.ended and self.live.ended):
            return
        self._ended = True
        self.outlet.flush_all()
        self.progress.report(idle=True)
        refused = {"malformed": self.inlet.malformed, "misplaced": self.inlet.misplaced}
        moved = self.outlet.counters() | self.inbox.counters() | self.bus.counters() | refused
        self.channel.send("ended", report=final_report(self.driver, moved))

    def _answer(self, *, idle: bool) -> None:
        """Answers the supervisor's poll. `idle`: a look at everything has just found nothing to do. Envelopes and
        progress leave first: others may go on by them, and the answer is taken for a proof."""
        asked, self.orders.asked = self.orders.asked, None
        self.outlet.flush_all()
        self.progress.report(idle=idle, at_once=True)
        feeding = self.driver.feeding
        self.channel.send(
            "state",
            round=asked,
            idle=idle and self.inbox.empty() and not self._waits_for_clock() and self.live.ended,
            sent=self.outlet.sent,
            received=self.inlet.received,
            full=feeding.full,
            waiting=self.progress.waiting(),
            due=feeding.next_due(),
            **({"paused": feeding.playback.paused} if feeding.feeds else {}),
        )

    def _waits_for_clock(self) -> bool:
        feeding = self.driver.feeding
        return (
            (feeding.playback.holds and not feeding.ended)
            or (self.orders.released and feeding.next_due() is not None)
            or any(runner.next_due() is not None for runner in self.driver.operators)
        )

    def _arrived(self) -> bool:
        return not self.inbox.empty()
