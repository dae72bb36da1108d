"""A host: one process that runs one or more operators on one thread, between its inbox and its emitter.

Zenoh's threads and the control thread only append to the inbox. The main thread takes from it, feeds the aligners, runs
the firings that are decided, lets feeds admit what the window allows, and waits (bounded) when there is nothing to do.
"""

from __future__ import annotations

import contextlib
import queue
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgpack

from dataflow.chaos.faults import SourceFaults
from dataflow.chaos.plan import TO_SOURCES
from dataflow.feeds.log import LogFeed
from dataflow.feeds.window import Feed, Handover, Window
from dataflow.firing.admission import LiveRunner
from dataflow.firing.runner import OperatorFailure, OperatorRunner, summary_of
from dataflow.firing.source import SourceRunner, step_size, step_stamp
from dataflow.firing.threads import limit_threads
from dataflow.graph.model import Graph, Node
from dataflow.messages.base import Message
from dataflow.operator import ParameterError, is_live
from dataflow.process.channel import Channel, ChannelClosed
from dataflow.process.config import HostConfig, Resumed
from dataflow.process.network import network_config
from dataflow.process.outlet import Outlet
from dataflow.process.watchdog import Watchdog
from dataflow.recording import Recording
from dataflow.records.reading import recorded_digests, recorded_firings
from dataflow.reexecution.recorded import RecordedRunner
from dataflow.sync import FOREVER, NEVER, Entry
from dataflow.transport import Bus, DecodeError, Envelope, Kind, TapServer, decode
from dataflow.transport.bus import BusError
from dataflow.transport.keys import runtime_key

IDLE_WAIT = 0.1
REPORT_EVERY = 0.004
PROBE_EVERY = 0.01
PROMISE_EVERY = 8
STATICS_WITHIN = 5.0
MISSED_AFTER = 0.2
BACKLOG = (16, 8)
"""How many windows of messages and of bytes may wait for operators that no source waits for."""
BACKLOG_EVERY = 0.5


class HostFailure(RuntimeError):
    """A failure of the host itself, not of one of its operators."""


class Host:
    """Runs its operators until they end, it is told to leave, or something fails."""

    def __init__(self, config: HostConfig, channel: Channel, inbox: queue.SimpleQueue[tuple[Any, ...]]) -> None:
        self.config, self.channel, self.inbox = config, channel, inbox
        self.graph = Graph.from_json(config.graph)
        self.static = frozenset(name for name, stream in self.graph.streams.items() if stream.static)
        self.received = 0
        self.malformed = 0
        self.consumers: dict[str, list[OperatorRunner | RecordedRunner]] = {}
        self.remote: dict[str, Any] = {}
        self.outlet = Outlet(self)
        self.runners: list[OperatorRunner | RecordedRunner] = []
        self.sources: list[SourceRunner] = []
        self.feeds: list[Feed] = []
        self.live: list[SourceRunner] = []
        self.faults: dict[str, SourceFaults] = {}
        self._static_seen: set[str] = set()
        self.window = Window(*config.window)
        self.backlog = Window(*(most * times for most, times in zip(config.window, BACKLOG, strict=True)))
        self._unread: dict[str, Handover] = {}
        self._backlog_due = 0.0
        self._expected: dict[str, tuple[int, int]] = {}
        self._probed: set[str] = set()
        self._probing = False
        self._released = False
        self._start: tuple[int, float] | None = None
        self._counted: dict[str, list[int]] = {}
        self._dropped: dict[str, list[list[Any]]] = {}
        self._reported: dict[str, int] = {}
        self._report_due = 0.0
        self._watch: Watchdog | None = None
        self._ended = False
        self._stopping = threading.Event()
        self._left = False
        self._since_promise = 0
        self._step_done = 0
        self._asked: int | None = None

    @property
    def makers(self) -> list[SourceRunner | OperatorRunner | RecordedRunner]:
        """Everything that emits, sources first."""
        return [*self.sources, *self.runners]

    # Life

    def open(self) -> None:
        """Joins the network, makes the operators and sets them up, then tells the supervisor that it is ready."""
        self.bus = Bus(network_config(self.graph.network, self.config.listen, self.config.connect))
        self.taps = TapServer(self.bus, self.graph.namespace)
        for stream, consumers in self.config.publish.items():
            self.remote[stream] = self.bus.publisher(stream, consumers=consumers)
        for stream in self.config.subscribe:
            self.bus.subscribe(stream, self._receiver(stream))
        self.channel.send("joined")
        for stream in self.config.subscribe:
            self.graph.message_types(stream)  # its messages may be of a type that no operator here names
        for name in self.config.nodes:
            self._make(self.graph.nodes[name])
            self.bus.serve(runtime_key(self.graph.namespace, "param", name), self._parameter_asked(name))
        self.bus.serve(runtime_key(self.graph.namespace, "status", self.config.label), self._status_asked)
        if self.config.replay is not None:
            self._make_log(self.config.replay)
        limit_threads(self.graph.threads)
        for maker in self.makers:
            self.bus.alive(self.graph.namespace, maker.node.name)
            maker.setup()
        if self.config.resume is not None:
            self._fetch_statics()
        for feed in self.feeds:
            if isinstance(feed, LogFeed):
                feed.setup()
        ahead = [*self.feeds, *(source for source in self.live if not source.source.live)]
        first = [stamp for feed in ahead if (stamp := feed.look_ahead()) is not None]
        lengths = [n for source in self.sources if (n := source.source.length()) is not None]
        self.channel.send("ready", first=min(first, default=None), steps=sum(lengths) if lengths else None)

    def _receiver(self, stream: str) -> Callable[[Any], None]:
        put = self.inbox.put

        def receive(payload: Any) -> None:
            put(("envelope", stream, payload))

        return receive

    def _fetch_statics(self) -> None:
        """The static streams that were given before this host came to be."""
        wanted = {s for s in self.config.subscribe if s in self.static}
        deadline = time.monotonic() + STATICS_WITHIN
        while missing := wanted - self._static_seen:
            for stream, payload in self.bus.query_static(self.graph.namespace, timeout=1.0).items():
                if stream in missing:
                    self._receive(stream, payload)
            if time.monotonic() > deadline:
                raise HostFailure(
                    f"host {self.config.label!r} was started again and did not get the static streams "
                    f"{', '.join(sorted(wanted - self._static_seen))} within {STATICS_WITHIN:g} s"
                )
            time.sleep(0.01)

    def _make(self, node: Node) -> None:
        resumed = Resumed(**(self.config.resume or {}).get(node.name, {}))
        if node.source:
            source = SourceRunner(node, self.outlet, seed=self.graph.seed, live=self.config.live)
            resumed.apply(source)
            self.sources.append(source)
            if self.config.live:
                self.live.append(source)
                self.faults[node.name] = SourceFaults()
            else:
                self.feeds.append(source)
            return
        runner = self._recorded_runner(node) if self.config.verify is not None else self._runner(node)
        if isinstance(runner, LiveRunner):
            resumed.apply(runner)
        self.runners.append(runner)
        for stream in {s for streams in node.inputs.values() for s in streams}:
            self.consumers.setdefault(stream, []).append(runner)

    def _runner(self, node: Node) -> OperatorRunner:
        common: dict[str, Any] = {
            "static": self.static,
            "seed": self.graph.seed,
            "paranoid": self.config.paranoid,
            "snapshots": self.config.snapshots,
        }
        if self.config.live:
            return LiveRunner(
                node, self.outlet, **common, event_clock=self._event_clock, on_failure=self._on_outlived_failure
            )
        runner = OperatorRunner(node, self.outlet, **common)
        if self.config.warm is not None:
            self._begin_in_the_middle(runner, Path(self.config.warm["path"]), self.config.warm["stamp"])
        return runner

    def _begin_in_the_middle(self, runner: OperatorRunner, path: Path, stamp: int) -> None:
        from dataflow.reexecution.warm_start import held_before, warm_start

        held, began = held_before(path, runner.node, stamp, self.static)
        if began:
            runner.aligner.begin_at(stamp)
        warm = warm_start(path, self.graph, runner.node, stamp)
        if warm is not None:
            runner.take_over(warm.operator, stamp)
        for entry in held:
            runner.aligner.push(entry.stream, entry)

    def _on_outlived_failure(self, failure: OperatorFailure, pause: float) -> None:
        self.channel.send(
            "restarting", operator=failure.operator, when=failure.when, summary=failure.summary, pause=pause
        )

    def _event_clock(self) -> int:
        """Event time now: the clock's own, or, where sources are held to the clock, as far as they have been let."""
        if self._start is None:
            return time.time_ns()
        first, at = self._start
        return first + round((time.time() - at) * 1e9 * (self.config.rate or 1.0))

    def _recorded_runner(self, node: Node) -> RecordedRunner:
        assert self.config.verify is not None
        inputs = frozenset(s for streams in node.inputs.values() for s in streams)
        producers = [self.graph.nodes[name] for name in {self.graph.streams[s].node for s in inputs}]
        with Recording(self.config.verify) as recording:
            return RecordedRunner(
                node,
                self.outlet,
                static=self.static,
                records=recorded_firings(recording, node.name),
                inputs=recorded_digests(recording, producers, inputs),
                seed=self.graph.seed,
                paranoid=self.config.paranoid,
            )

    def _make_log(self, replay: Mapping[str, Any]) -> None:
        recording = Recording(replay["path"])
        nodes = {self.graph.streams[s].node for s in replay["streams"]}
        self.feeds.append(
            LogFeed(
                recording,
                {s: self.graph.streams[s].node for s in replay["streams"]},
                self.outlet,
                ports={n: tuple(self.graph.nodes[n].outputs.values()) for n in nodes},
                finals=replay["finals"],
                start=replay["start"],
                end=replay["end"],
                promises=self.config.verify is None,
            )
        )

    def run(self) -> None:
        """The main loop; returns when the supervisor has let the host go."""
        while True:
            if self._probing:
                self._probe()
            self._take(self._wait_time())
            if self._left:
                break
            worked = self._work()
            self.outlet.flush_due()
            self._report(idle=not worked)
            self._answer_poll(idle=not worked)
        self.hand_over()

    def _answer_poll(self, *, idle: bool) -> None:
        """Answers after the work that was there: a host is idle only when a look at everything found nothing to do."""
        if self._asked is None:
            return
        asked, self._asked = self._asked, None
        self.outlet.flush_all()
        settled = idle and self.inbox.empty() and not self._waits_for_clock() and all(s.ended for s in self.live)
        self.channel.send(
            "state",
            round=asked,
            idle=settled,
            sent=self.outlet.sent,
            received=self.received,
            full=self.window.full and any(not f.ended for f in self.feeds),
            waiting=self._waiting(),
        )

    def _wait_time(self) -> float:
        if self._probing:
            return PROBE_EVERY
        due = [IDLE_WAIT, self._next_due(), *(r.next_due() for r in self.runners if isinstance(r, LiveRunner))]
        return max(0.0, min(seconds for seconds in due if seconds is not None))

    def _take(self, timeout: float) -> None:
        """Handles everything in the inbox; waits up to `timeout` for the first."""
        try:
            item = self.inbox.get(timeout=timeout) if timeout > 0 else self.inbox.get_nowait()
            while True:
                self._handle(item)
                item = self.inbox.get_nowait()
        except queue.Empty:
            return

    def _handle(self, item: tuple[Any, ...]) -> None:
        match item:
            case ("envelope", stream, payload):
                self._receive(stream, payload)
            case ("control", kind, fields):
                self._control(kind, fields)
            case ("source", runner, step, lost):
                self._from_live(runner, step, lost)
            case ("param", name, query):
                self._set_parameter(name, query)
            case ("source_failed", failure):
                raise failure

    # Streams

    def _receive(self, stream: str, payload: Any) -> None:
        try:
            envelope = decode(payload)
        except DecodeError as error:
            self.malformed += 1  # from outside: of our own, the next number would show the gap
            print(f"dropped a malformed message on {stream!r}: {error}", file=sys.stderr)
            return
        if envelope.kind is Kind.PROBE:
            if stream not in self._probed:
                self._probed.add(stream)
                self.channel.send("seen", stream=stream)
            return
        self.received += 1
        if stream in self.static and envelope.kind is Kind.MESSAGE:
            if stream in self._static_seen:
                return  # its operator was started again
            self._static_seen.add(stream)
        runners = self.consumers.get(stream, ())
        match envelope.kind:
            case Kind.MESSAGE:
                self._check_gap(stream, envelope)
                message = envelope.message
                assert message is not None
                entry = Entry(envelope.stamp, message, envelope.seq, envelope.incarnation, message.digest(), stream)
                for runner in runners:
                    runner.push(stream, entry)
            case Kind.FRONTIER:
                for runner in runners:
                    runner.advance(stream, envelope.stamp)
            case Kind.END:
                for runner in runners:
                    runner.end(stream, None if envelope.stamp == NEVER else envelope.stamp, envelope.reason)

    def _check_gap(self, stream: str, envelope: Envelope) -> None:
        if self.config.verify is not None:
            return  # an operator that makes less than it did is what verification is there to report
        incarnation, expected = self._expected.get(stream, (envelope.incarnation, envelope.seq))
        if envelope.seq != expected and incarnation == envelope.incarnation:
            if self.config.live:  # what a host that was started again missed, or a link that broke
                self.channel.send("gap", stream=stream, first=expected, following=envelope.seq)
                self._expected[stream] = (envelope.incarnation, envelope.seq + 1)
                return
            raise HostFailure(
                f"stream {stream!r} lost messages on its way to host {self.config.label!r}: "
                f"number {expected} was due, {envelope.seq} came"
            )
        self._expected[stream] = (envelope.incarnation, envelope.seq + 1)

    # Work

    def _work(self) -> bool:
        """Runs what is decided; then, when nothing is, admits from the feeds. True when anything was done."""
        worked = False
        while self.inbox.empty() and not self._left:
            if self._step_all() or self._admit():
                worked = True
            else:
                self._keep_promises()
                if not self._step_all():
                    break
            self._report(idle=False)
        if not self._ended and self._released:
            self._end_if_done()
        return worked

    def _step_all(self) -> bool:
        """One step of every operator, last ones first, so that what is under way is done before more is begun."""
        if self.config.live and not self._released:
            return False  # a host that was started again is sent messages before it is told what time it is
        worked = False
        for runner in reversed(self.runners):
            worked = runner.step() or worked
        return worked

    def _admit(self) -> bool:
        if not self._released or self._stopping.is_set():
            return False
        due = self._oldest()
        if due is None or self.window.full or self._too_early(due[0]):
            return False
        stamp, feed = due
        messages, nbytes = feed.admit()
        self.window.add(stamp, messages, nbytes)
        self._since_promise += 1
        if self._since_promise >= PROMISE_EVERY:
            self._keep_promises()
        if feed.look_ahead() is None:
            feed.finish(getattr(feed, "END_REASON", "end of source"))
        return True

    def _keep_promises(self) -> None:
        self._since_promise = 0
        for feed in self.feeds:
            if not feed.ended:
                feed.promise()

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

    def _too_early(self, stamp: int) -> bool:
        return self._start is not None and self._due_in(stamp) > 0

    def _due_in(self, stamp: int) -> float:
        assert self._start is not None
        first, at = self._start
        assert self.config.rate is not None
        return at + (stamp - first) * 1e-9 / self.config.rate - time.time()

    def _waits_for_clock(self) -> bool:
        patient = (r.next_due() for r in self.runners if isinstance(r, LiveRunner))
        return self._next_due() is not None or any(due is not None for due in patient)

    def _next_due(self) -> float | None:
        """Seconds until the next paced step; None when nothing waits for the clock."""
        if self._start is None or not self._released or self.window.full:
            return None
        stamps = [s for feed in self.feeds if not feed.ended and (s := feed.look_ahead()) is not None]
        return self._due_in(min(stamps)) if stamps else None

    # Live sources

    def _start_live(self, runner: SourceRunner) -> None:
        faults = self.faults[runner.node.name]
        behind = self.config.resume is not None
        unread = self._unread[runner.node.name] = Handover()
        lost = 0

        def read() -> None:
            nonlocal behind, lost
            try:
                while not self._stopping.is_set():
                    step = runner.take()
                    if step is None:
                        self.inbox.put(("source", runner, None, lost))
                        return
                    if not runner.source.live:
                        stamp = step_stamp(step)
                        if behind and self._start is not None and self._due_in(stamp) < -MISSED_AFTER:
                            continue  # what a device would have seen while it was away
                        behind = False
                        self._pace(stamp)
                    for given in faults.apply(step, time.monotonic()):
                        if unread.count >= self.backlog.messages or unread.size >= self.backlog.nbytes:
                            lost += 1
                            self._tell_backlog(unread.count, unread.size)
                            continue
                        unread.put(*step_size(given))
                        self.inbox.put(("source", runner, given, lost))
                        lost = 0
                runner.close_stream()
            except OperatorFailure as failure:
                self.inbox.put(("source_failed", failure))

        threading.Thread(target=read, name=f"source {runner.node.name}", daemon=True).start()

    def _pace(self, stamp: int) -> None:
        """Holds a source that could wait to the clock, as a device would be. Ends early when the host stops."""
        if self._start is not None:
            self._stopping.wait(max(0.0, self._due_in(stamp)))

    def _from_live(self, runner: SourceRunner, step: dict[str, Message] | None, lost: int) -> None:
        """Takes a step that the source's thread has read, and how many it dropped before, since they were too many."""
        if step is not None:
            self._unread[runner.node.name].take(*step_size(step))
        if runner.ended:
            return
        if lost:
            runner.refused["overflow"] += lost
        if step is None:
            runner.finish()
            return
        if self.window.full or self.backlog.full:
            runner.refused["overflow"] += 1
            if self.backlog.full:
                self._tell_backlog(self.backlog.count, self.backlog.size)
            return
        incarnation = runner.records.incarnation
        admitted = runner.emit_live(step)
        if admitted is None:
            return
        if runner.records.incarnation != incarnation:
            self.window.clear()
            self.backlog.clear()
            self.channel.send("jumped", operator=runner.node.name, stamp=runner.last)
        runner.promise()
        self.window.add(runner.last, *admitted)
        self.backlog.add(runner.last, *admitted)

    def _tell_backlog(self, messages: int, nbytes: int) -> None:
        """Tells the supervisor, now and then, that a source drops since so much waits; on any thread."""
        now = time.monotonic()
        if now >= self._backlog_due:
            self._backlog_due = now + BACKLOG_EVERY
            with contextlib.suppress(ChannelClosed):  # the control thread sees to it
                self.channel.send("backlog", messages=messages, bytes=nbytes)

    # Progress

    def _report(self, *, idle: bool) -> None:
        now = time.monotonic()
        if not idle and now < self._report_due:
            return
        done = {r.node.name: r.done for r in self.runners if self._reported.get(r.node.name) != r.done}
        firings = sum(maker.firings for maker in (*self.runners, *self.feeds, *self.live))
        if not done and firings == self._step_done:
            return
        self._report_due = now + REPORT_EVERY
        self._reported.update(done)
        self._step_done = firings
        self._counted = self._counts()
        drops = {name: found for name, found in self._drops().items() if found != self._dropped.get(name)}
        self._dropped |= drops
        self.channel.send("progress", done=done, counts=self._counted, drops=drops)

    def _counts(self) -> dict[str, list[int]]:
        """For each operator: firings, messages emitted, messages dropped, nanoseconds of work, last stamp."""
        counts = {}
        for source in self.sources:
            counts[source.node.name] = [
                source.firings,
                source.ports.emitted,
                source.refused.total(),
                source.busy_ns,
                source.last,
            ]
        for runner in self.runners:
            drops = sum(runner.drops.values())
            counts[runner.node.name] = [runner.firings, runner.ports.emitted, drops, runner.busy_ns, runner.done]
        for feed in self.feeds:
            if isinstance(feed, LogFeed):
                counts["@log"] = [feed.firings, sum(n for _, n, _ in feed.counts()), 0, feed.busy_ns, feed.last]
        return counts

    def _drops(self) -> dict[str, list[list[Any]]]:
        """For each operator: input ("" for a source), reason and number of what it dropped."""
        return {r.node.name: [[i, why, n] for (i, why), n in sorted(r.drops.items())] for r in self.runners} | {
            s.node.name: [["", why, n] for why, n in sorted(s.refused.items())] for s in self.live
        }

    def _end_if_done(self) -> None:
        if all(f.ended for f in self.feeds) and all(s.ended for s in self.live) and all(r.ended for r in self.runners):
            self._ended = True
            self.outlet.flush_all()
            self._report(idle=True)
            self.channel.send("ended", report=self._final_report())

    def _final_report(self) -> dict[str, Any]:
        streams: dict[str, list[Any]] = {}
        for maker in self.makers:
            for state in maker.ports.states.values():
                assert state.digest is not None
                streams[state.stream] = [state.digest.count, state.digest.hexdigest()]
        for feed in self.feeds:
            if isinstance(feed, LogFeed):
                streams |= {name: [count, digest] for name, count, digest in feed.counts()}
        return {
            "streams": streams,
            "counts": self._counts(),
            "drops": self._drops(),
            "summaries": {r.node.name: s for r in self.runners if (s := summary_of(r.operator, r.node.name))},
            "transport": {**self.bus.counters(), "malformed": self.malformed},
            "verifications": [r.result.to_wire() for r in self.runners if isinstance(r, RecordedRunner)],
        }

    # Control

    def _control(self, kind: str, fields: Mapping[str, Any]) -> None:
        match kind:
            case "probe":
                self._probing = True
            case "go":
                self._probing = False
                self._released = True
                self.outlet.release()
                if self.config.rate is not None and fields["first"] is not None:
                    self._start = (fields["first"], fields["at"])
                for runner in self.live:
                    self._start_live(runner)
                runners = [r for r in self.runners if isinstance(r, OperatorRunner)]
                self._watch = Watchdog(self.channel, runners, deadlines=self.config.live)
            case "absent":
                for stream in fields["streams"]:
                    for consumer in self.consumers.get(stream, ()):
                        if isinstance(consumer, LiveRunner):
                            (consumer.absent.add if fields["absent"] else consumer.absent.discard)(stream)
                    if not fields["absent"]:
                        self._probed.discard(stream)
            case "ended_elsewhere":
                for stream in fields["streams"]:
                    for consumer in self.consumers.get(stream, ()):
                        consumer.end(stream, None, fields["reason"])
            case "fault":
                self._fault(fields["fault"], fields["operator"], fields["fields"])
            case "covered":
                self.window.cover(fields["frontier"])
                self.backlog.cover(fields.get("backlog", FOREVER))
            case "grow":
                self.window.grow()
            case "poll":
                self._asked = fields["round"]
            case "stop":
                self._stopping.set()
                for feed in self.feeds:
                    feed.finish("interrupted")
                for source in self.live:
                    source.finish("interrupted")
            case "leave":
                self._left = True
            case "lost":
                raise ChannelClosed("the supervisor is gone")

    def _fault(self, kind: str, operator: str, fields: Mapping[str, Any]) -> None:
        """Does a planned fault to an operator or source of this host."""
        print(f"planned fault: {kind} {operator} {dict(fields)}", file=sys.stderr)
        if operator in self.faults and kind in TO_SOURCES:
            self.faults[operator].begin(kind, fields, time.monotonic())
            return
        maker = next(m for m in self.makers if m.node.name == operator)
        match kind:
            case "param":
                self._set_parameter_quietly(maker, fields["name"], fields["value"])
            case "malformed":
                for stream in maker.node.outputs.values():
                    self.bus.session.put(stream, b"\x00malformed\xff" * 8)
            case "raise" | "hang" | "slow" | "leak":
                if isinstance(maker, LiveRunner):
                    maker.begin_fault(kind, fields)

    def _parameter_asked(self, name: str) -> Callable[[Any], None]:
        put = self.inbox.put

        def asked(query: Any) -> None:
            put(("param", name, query))

        return asked

    def _set_parameter(self, name: str, query: Any) -> None:
        """Answers a request to change a parameter, between two firings: with the value as validated, or an error.

        A request `{"get": true}` is answered with the values of all, and whether they can change now.
        """
        maker = next(m for m in self.makers if m.node.name == name)
        with query:
            try:
                asked = msgpack.unpackb(query.payload.to_bytes(), raw=False)
                if asked.get("get"):
                    fields = maker.operator.spec.parameters.model_fields
                    values = maker.operator.params.model_dump(mode="json")
                    value = {n: {"value": values[n], "live": is_live(field)} for n, field in fields.items()}
                elif isinstance(maker, RecordedRunner):
                    raise ParameterError("the parameters of a re-execution are the recorded ones")
                else:
                    value = maker.set_parameter(asked["name"], asked["value"])
                answer = {"ok": True, "operator": name, "value": value}
            except (ParameterError, KeyError, TypeError, ValueError, AttributeError) as error:
                answer = {"ok": False, "operator": name, "error": str(error)}
            query.reply(query.key_expr, msgpack.packb(answer))

    def _set_parameter_quietly(
        self, maker: SourceRunner | OperatorRunner | RecordedRunner, name: str, value: Any
    ) -> None:
        assert not isinstance(maker, RecordedRunner)
        try:
            maker.set_parameter(name, value)
        except ParameterError as error:
            print(f"planned fault: {error}", file=sys.stderr)

    def _status_asked(self, query: Any) -> None:
        """Answers with the counts of the last report; on Zenoh's thread, so an operator at work holds up nothing."""
        with query:
            status = {
                "host": self.config.label,
                "counts": self._counted,
                "restarts": {m.node.name: self._restarts_of(m) for m in self.makers},
                "ended": [m.node.name for m in self.makers if m.ended],
            }
            query.reply(query.key_expr, msgpack.packb(status))

    def _restarts_of(self, maker: SourceRunner | OperatorRunner | RecordedRunner) -> int:
        """How often an operator was started again, by this process and in place of those before it."""
        before = int((self.config.resume or {}).get(maker.node.name, {}).get("restarts", 0))
        return before + (maker.restarts.total if isinstance(maker, LiveRunner) else 0)

    def _waiting(self) -> dict[str, list[Any]]:
        """Per operator that is not done: the stamp it cannot decide, and the inputs (with frontiers) that hold it."""
        waiting: dict[str, list[Any]] = {}
        for runner in self.runners:
            if not runner.ended:
                waiting[runner.node.name] = list(runner.waiting())
        return waiting

    def _probe(self) -> None:
        for publisher in self.remote.values():
            publisher.probe()

    def hand_over(self) -> None:
        """Sends the firing records that were not sent yet: after a failure here, the failed one among them."""
        if self._released:
            self.outlet.flush_all()

    def close(self) -> None:
        """Closes every operator and the network; the first error is raised when all are closed."""
        self._stopping.set()
        if self._watch is not None:
            self._watch.stop()
        first: Exception | None = None
        for maker in self.makers:
            try:
                if isinstance(maker, SourceRunner) and maker not in self.live:
                    maker.close_stream()
                maker.operator.close()
            except Exception as error:
                first = first or OperatorFailure(maker.node.name, "close()", error)
        for feed in self.feeds:
            if isinstance(feed, LogFeed):
                feed.close()
        self.taps.close()
        try:
            self.bus.close()
        except BusError as error:  # a neighbour that hangs takes no leave; everything that was to be done is done
            print(f"host {self.config.label!r} leaves the network unheard: {error}", file=sys.stderr)
        if first is not None:
            raise first
