"""The supervisor: starts the hosts, holds the sources until every edge is known to work, watches, and tears down.

It carries no data. Feeds learn from it how far the whole graph is done (flow control); it learns from the control
channels, at once, when a process dies.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from dataflow.firing.restarts import Restarts
from dataflow.firing.threads import environment
from dataflow.process.channel import Channel, ChannelClosed, ready
from dataflow.supervision.nursery import Child, Nursery, NurseryFailed
from dataflow.supervision.plan import RunPlan, expected_probes, host_plans
from dataflow.supervision.report import OperatorCounts, RunFailed, RunReport, Status
from dataflow.sync import FOREVER, NEVER
from dataflow.transport import registry, reserve_endpoints
from dataflow.transport.network import Reservation

TICK = 0.05
QUIET = 0.3
LEAVE_TIMEOUT = 10.0
LEAVE_AT_ONCE = 1.0
CLOSE_TIMEOUT = 60.0
"""Seconds for `close()` of every operator, at the orderly end of a run."""
MAX_WINDOW_DOUBLINGS = 12


@dataclass(slots=True)
class Supervised:
    """One process, as its supervisor sees it."""

    label: str
    nodes: tuple[str, ...]
    child: Child
    config: dict[str, Any]
    kind: str
    words: list[str] = field(default_factory=list)
    reader: threading.Thread | None = None
    over: threading.Event = field(default_factory=threading.Event)
    joined: bool = False
    ready: bool = False
    probing: bool = False
    unseen: set[str] = field(default_factory=set)
    done: dict[str, int] = field(default_factory=dict)
    report: dict[str, Any] | None = None
    closed: dict[str, Any] | None = None
    state: dict[str, Any] | None = None
    gone: bool = False
    restarts: Restarts | None = None
    beat: float | None = None
    work: tuple[str, int, float] | None = None
    """The firing that it was at for longer than a moment when it was last heard of: operator, stamp, seconds."""
    cause: str = ""
    """Why the supervisor killed it."""
    rejoining: float | None = None
    """Since when a host that took the place of another waits for its edges."""
    back: bool = True
    """False from its death until it works again."""

    @property
    def channel(self) -> Channel:
        return self.child.channel

    def describe(self) -> str:
        what = ", ".join(self.nodes)
        return f"host {self.label!r}" + (f" (operators {what})" if what and what != self.label else "")

    def at_work(self) -> str:
        """Such as "host 'camera', camera at stamp 5 for 3 s"."""
        if self.work is None:
            return self.describe()
        operator, stamp, seconds = self.work
        return f"{self.describe()}, {operator} at stamp {stamp} for {seconds:.0f} s"


class Supervisor:
    """Runs one plan. `stop()` may be called from a signal handler; `status` may be read at any time."""

    def __init__(self, plan: RunPlan, *, on_output: Callable[[str, str], None] | None = None) -> None:
        self.plan = plan
        self.status = Status()
        self._on_output = on_output or (lambda label, line: print(f"[{label}] {line}", file=sys.stderr))
        self._plans = host_plans(plan)
        self._processes: dict[str, Supervised] = {}
        self._covered = NEVER
        self._heard = time.monotonic()
        self._round = 0
        self._previous: tuple[int, int] | None = None
        self._doublings = 0
        self._stop_asked = 0
        self._stop_sent = False
        self._released_at = 0.0
        self._asked_at = 0.0
        self._nursery: Nursery | None = None
        self._reserved: Reservation | None = None
        self._endpoints: dict[str, str] = {}
        self._released: dict[str, Any] = {}

    def stop(self) -> None:
        """Asks for an orderly end: sources stop, everything drains. A second call ends at once."""
        self._stop_asked += 1

    def run(self) -> RunReport:
        """Runs to the end. Raises `RunFailed` with the first cause; no process is left in either case."""
        self.status.started = time.time()
        try:
            self._start()
            self._barrier()
            with self._registered():
                self._release()
                self._watch()
            return self._finish()
        except NurseryFailed as failure:
            self._abandon(str(failure))
            raise RunFailed(str(failure)) from failure
        except RunFailed as failure:
            self._abandon(str(failure).splitlines()[0])
            raise
        except BaseException:
            self._abandon("the supervisor was interrupted")
            raise
        finally:
            if self._reserved is not None:
                self._reserved.close()
            self._reap()

    # Start

    def _start(self) -> None:
        graph = self.plan.graph
        self._nursery = Nursery(environment(graph.threads))
        self._reserved = reserve_endpoints(len(self._plans))
        endpoints = dict(zip(self._plans, self._reserved.endpoints, strict=True))
        for label, host in self._plans.items():
            connect = [endpoints[up] for up in host.upstream]
            common: dict[str, Any] = {"label": label, "graph": graph.to_json(), "connect": connect}
            if host.sink is not None:
                config = common | {
                    "kind": host.sink,
                    "streams": list(host.streams),
                    "firings": list(graph.nodes) if host.sink == "record" else [],
                    "options": dict(host.options),
                    "live": self.plan.live,
                }
            else:
                config = common | {
                    "nodes": list(host.nodes),
                    "publish": dict(host.publish),
                    "subscribe": list(host.subscribe),
                    "listen": [endpoints[label], *(graph.network.listen if label == next(iter(self._plans)) else ())],
                    "replay": self._log_config() if host.has_log else None,
                    "window": list(self.plan.window),
                    "rate": 1.0 if self.plan.live and self.plan.rate is None else self.plan.rate,
                    "live": self.plan.live,
                    "paranoid": self.plan.paranoid,
                    "firings": self.plan.record is not None,
                    "verify": self._verified_recording(),
                    "snapshots": graph.record.snapshots,
                    "warm": self._warm_config(),
                }
            self._spawn(label, host.nodes, "sink" if host.sink else "host", config)
            for node in host.nodes or ((label,) if host.sink or host.has_log else ()):
                self.status.operators[node] = OperatorCounts()
                self.status.host_of[node] = label
        for label, keys in expected_probes(self.plan, self._plans).items():
            self._processes[label].unseen = keys
        self._endpoints = endpoints

    def _verified_recording(self) -> str | None:
        log = self.plan.log
        return str(log.path) if self.plan.verify is not None and log is not None else None

    def _warm_config(self) -> dict[str, Any] | None:
        log = self.plan.log
        if log is None or log.start is None or self.plan.verify is not None:
            return None
        return {"path": str(log.path), "stamp": log.start}

    def _log_config(self) -> dict[str, Any]:
        log = self.plan.log
        assert log is not None
        return {
            "path": str(log.path),
            "streams": list(log.streams),
            "finals": dict(log.finals),
            "start": log.start,
            "end": log.end,
        }

    def _spawn(self, label: str, nodes: tuple[str, ...], kind: str, config: dict[str, Any]) -> None:
        assert self._nursery is not None
        child = self._nursery.spawn()
        spawned = Supervised(label, nodes, child, config, kind)
        self._processes[label] = spawned
        spawned.reader = threading.Thread(target=self._read_words, args=(spawned,), daemon=True)
        spawned.reader.start()
        self._send(spawned, kind, **config)

    def _read_words(self, process: Supervised) -> None:
        for text in process.child.lines(process.over):
            process.words.append(text)
            del process.words[:-50]
            self._on_output(process.label, text)

    def _barrier(self) -> None:
        """Every host ready, and every edge proven by a probe that arrived."""
        deadline = time.monotonic() + self.plan.start_timeout
        probing = False
        assert self._reserved is not None
        while True:
            self._receive(TICK)
            if self._stop_asked:
                raise RunFailed("interrupted while starting", interrupted=True)
            processes = self._processes.values()
            self.status.waiting = tuple(p.label for p in processes if not p.ready or (probing and p.unseen))
            if all(p.ready for p in processes):
                if not probing:
                    probing = True
                    self._reserved.close()
                    self._send_all("probe")
                if not any(p.unseen for p in processes):
                    return
            if time.monotonic() > deadline:
                late = [p.describe() for p in processes if not p.ready]
                if late:
                    raise RunFailed(
                        f"not ready within {self.plan.start_timeout:g} s: {'; '.join(late)}", self._last_words()
                    )
                silent = [f"{k} → {p.label}" for p in processes for k in sorted(p.unseen)]
                raise RunFailed(f"no connection within {self.plan.start_timeout:g} s on: {', '.join(silent)}")

    @contextlib.contextmanager
    def _registered(self) -> Iterator[None]:
        graph = self.plan.graph
        endpoints = [self._endpoints[label] for label, p in self._processes.items() if p.kind == "host"]
        with registry.register(graph.name, graph.namespace, endpoints, graph=graph.to_json()):
            yield

    def _release(self) -> None:
        self.status.phase, self.status.waiting = "running", ()
        self._released_at = time.monotonic()
        self._heard = time.monotonic()
        self._released = {"first": self.status.first, "at": time.time()}
        self._send_all("go", **self._released)

    # Watch

    def _watch(self) -> None:
        while not all(p.report is not None for p in self._processes.values()):
            self._receive(TICK)
            self._watch_more()
            if self._stop_asked and not self._stop_sent:
                self._stop_sent = True
                self.status.phase = "stopping"
                self._send_all("stop")
            if self._stop_asked > 1:
                raise RunFailed("stopped before everything was drained", interrupted=True)
            quiet = time.monotonic() - self._heard
            if quiet > self.plan.stall_timeout:
                self._fail_stalled()
            if quiet > QUIET and self._counts_agree():
                self._poll_quiescence()

    def _watch_more(self) -> None:
        """What else is to be done every now and then while the graph runs; nothing, unless the run is live."""

    def _counts_agree(self) -> bool:
        """Whether what was sent and what was received can be compared."""
        return True

    def _outlives(self, process: Supervised, how: str) -> bool:
        """Whether the run goes on although a process died."""
        return False

    def _fail_stalled(self) -> None:
        """Names the hosts that do not answer and kills them: they could not leave in order."""
        silent = [p for p in self._processes.values() if p.state is None or p.state["round"] != self._round]
        busy = silent or [p for p in self._processes.values() if p.report is None]
        for process in silent:
            process.child.kill()
        names = "; ".join(p.at_work() for p in busy)
        raise RunFailed(f"no progress for {self.plan.stall_timeout:g} s; still busy: {names}", self._last_words())

    def _poll_quiescence(self) -> None:
        """Two rounds with everything idle, every envelope received and nothing new prove that nothing will happen."""
        processes = list(self._processes.values())
        states = [p.state for p in processes]
        if any(s is not None and s["round"] == self._round for s in states):
            if not all(s is not None and s["round"] == self._round for s in states):
                return  # answers are under way; the stall timeout bounds this wait
            answered = [s for s in states if s is not None]
            totals = (sum(s["sent"] for s in answered), sum(s["received"] for s in answered))
            settled = all(s["idle"] for s in answered) and totals[0] == totals[1]
            if settled and totals == self._previous:
                self._on_quiescence(processes)
                self._previous = None
            else:
                self._previous = totals if settled else None
        elif self._round and not any(s is None for s in states) and self._awaiting():
            return
        self._round += 1
        self._asked_at = time.monotonic()
        self._send_all("poll", round=self._round)

    def _awaiting(self) -> bool:
        return time.monotonic() - self._asked_at < 1.0

    def _on_quiescence(self, processes: list[Supervised]) -> None:
        full = [p for p in processes if p.state is not None and p.state["full"]]
        if full and self._doublings < MAX_WINDOW_DOUBLINGS:
            self._doublings += 1
            self.status.notes.append(
                f"the graph looks further ahead than the window: doubled to "
                f"{self.plan.window[0] << self._doublings} messages"
            )
            for process in full:
                self._send(process, "grow")
            self._heard = time.monotonic()
            return
        waiting = {node: held for p in processes if p.state is not None for node, held in p.state["waiting"].items()}
        lines = [
            f"  {node} waits at stamp {stamp} for " + (", ".join(f"{i} (≥ {f})" for i, f in needs.items()) or "input")
            for node, (stamp, needs) in waiting.items()
        ]
        raise RunFailed("the graph is stuck: nothing is on its way and no operator can fire", "\n".join(lines))

    def _receive(self, timeout: float) -> None:
        living = {p.channel: p for p in self._processes.values() if not p.gone}
        for channel in ready(living, timeout):
            process = living[channel]
            try:
                kind, fields = channel.receive()
            except ChannelClosed:
                self._on_death(process)
            else:
                self._on_message(process, kind, fields)

    def _on_message(self, process: Supervised, kind: str, fields: dict[str, Any]) -> None:
        match kind:
            case "joined":
                process.joined = True
            case "ready":
                process.ready = True
                first, steps = fields["first"], fields["steps"]
                if first is not None:
                    self.status.first = first if self.status.first is None else min(first, self.status.first)
                if steps is not None:
                    self.status.steps = max(steps, self.status.steps or 0)
            case "seen":
                process.unseen.discard(fields["stream"])
            case "progress":
                self._heard = time.monotonic()
                process.done |= fields["done"]
                self._count(fields["counts"])
                self._count_drops(fields.get("drops", {}))
                self._cover()
            case "beat":
                process.beat = time.monotonic()
                process.work = None if fields["work"] is None else tuple(fields["work"])
            case "state":
                process.state = fields
            case "ended":
                self._heard = time.monotonic()
                process.report = fields["report"]
                self._count(fields["report"]["counts"])
                self._count_drops(fields["report"].get("drops", {}))
                process.done = dict.fromkeys(process.done, FOREVER)
                self._cover()
            case "closed":
                process.closed = fields["facts"]
            case "failed":
                operator = fields["operator"]
                raise RunFailed(
                    f"operator {operator!r} failed in {fields['when']}: {fields['summary']}"
                    if operator
                    else f"{process.describe()} failed: {fields['summary']}",
                    fields["traceback"],
                    operator,
                )

    def _count(self, counts: Mapping[str, list[int]]) -> None:
        for name, values in counts.items():
            self.status.operators[name] = OperatorCounts(*values)

    def _count_drops(self, drops: Mapping[str, list[tuple[str, str, int]]]) -> None:
        for name, found in drops.items():
            self.status.drops[name] = Counter({(input_name, reason): n for input_name, reason, n in found})

    def _cover(self) -> None:
        """Tells the feeds how far everything is done."""
        expected = [
            process.done.get(name, NEVER)
            for process in self._processes.values()
            if process.report is None and process.back
            for name in self._consumers(process)
        ]
        covered = min(expected, default=FOREVER)
        if covered > self._covered:
            self._covered = covered
            for process in self._processes.values():
                if process.kind == "host" and process.report is None:
                    self._send(process, "covered", frontier=covered)

    def _consumers(self, process: Supervised) -> tuple[str, ...]:
        if process.kind == "sink":
            return (process.label,)
        return tuple(n for n in process.nodes if not self.plan.graph.nodes[n].source)

    def _on_death(self, process: Supervised) -> None:
        process.gone = True
        code = process.child.wait(timeout=LEAVE_TIMEOUT)
        if code is None:
            process.child.kill()
            code = process.child.wait(timeout=LEAVE_TIMEOUT)
        if process.closed is not None:
            return
        process.over.set()
        if process.reader is not None:
            process.reader.join(timeout=1.0)
        if code is None:
            how = "closed its channel and did not end"
        else:
            how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"exited with code {code}"
        if process.cause:
            how = process.cause
        if self._outlives(process, how):
            return
        at = [f"{n} had reached stamp {f}" for n, f in process.done.items() if f not in (NEVER, FOREVER)]
        phase = f" while {self.status.phase}" + (f" ({'; '.join(at)})" if at else "")
        raise RunFailed(f"{process.describe()} {how}{phase}", "\n".join(process.words[-20:]))

    # End

    def _finish(self) -> RunReport:
        wall = time.monotonic() - self._released_at
        self.status.phase = "closing"
        outcome = "interrupted" if self._stop_sent else "complete"
        self._send_all("leave", outcome=outcome)
        self._await_closed()
        reports = {p.label: p.report or {} for p in self._processes.values()}
        streams = {s: (n, d) for r in reports.values() for s, (n, d) in r.get("streams", {}).items()}
        reached = [c.done for c in self.status.operators.values() if c.done not in (NEVER, FOREVER)]
        return RunReport(
            graph=self.plan.graph.name,
            streams=dict(sorted(streams.items())),
            operators=dict(self.status.operators),
            drops={
                node: tuple((i, why, n) for (i, why), n in sorted(self.status.drops[node].items()))
                for node in self.status.operators
                if self.status.drops.get(node)
            },
            summaries={node: s for r in reports.values() for node, s in r.get("summaries", {}).items()},
            transport={label: r["transport"] for label, r in reports.items() if "transport" in r},
            files={p.label: p.closed or {} for p in self._processes.values() if p.kind == "sink"},
            verifications=tuple(v for r in reports.values() for v in r.get("verifications", ())),
            first=self.status.first,
            last=max(reached, default=None),
            wall=wall,
            interrupted=self._stop_sent,
            notes=tuple(self.status.notes),
            restarts=dict(self.status.restarts),
        )

    def _await_closed(self) -> None:
        deadline = time.monotonic() + CLOSE_TIMEOUT
        while not all(p.gone for p in self._processes.values()):
            self._receive(TICK)
            if self._stop_asked > 1:
                raise RunFailed("stopped before everything was closed", interrupted=True)
            if time.monotonic() > deadline:
                late = [p.describe() for p in self._processes.values() if not p.gone]
                raise RunFailed(f"did not close within {CLOSE_TIMEOUT:g} s: {'; '.join(late)}", self._last_words())

    def _abandon(self, outcome: str) -> None:
        """After a failure: lets every process close what it has open, for a bounded time.

        The sinks leave last, since hosts hand over firing records when they leave.
        """
        self.status.phase = "closing"
        within = LEAVE_AT_ONCE if self._stop_asked > 1 else LEAVE_TIMEOUT
        self._let_go("host", outcome, within / 2)
        self._hand_over_records()
        self._let_go("sink", outcome, within)

    def _let_go(self, kind: str, outcome: str, within: float) -> None:
        """Tells the processes of a kind to leave, and waits up to `within` seconds until they have."""
        leaving = [p for p in self._processes.values() if p.kind == kind]
        for process in leaving:
            self._send(process, "leave", outcome=f"failed: {outcome}")
        deadline = time.monotonic() + within
        while not all(p.gone for p in leaving) and time.monotonic() < deadline:
            try:
                self._receive(TICK)
            except RunFailed as later:  # a consequence; the first cause is already on its way to the user
                self.status.notes.append(f"then: {later}")

    def _hand_over_records(self) -> None:
        """Gives the recorder the firing records that the supervisor holds; none, unless the run is live."""

    def _reap(self) -> None:
        for process in self._processes.values():
            self._close_process(process)
        if self._nursery is not None:
            self._nursery.close()

    @staticmethod
    def _close_process(process: Supervised) -> None:
        process.child.kill()
        process.child.wait(timeout=LEAVE_TIMEOUT)
        process.over.set()
        if process.reader is not None:
            process.reader.join(timeout=LEAVE_TIMEOUT)
        process.channel.close()

    # Talking

    def _send(self, process: Supervised, kind: str, /, **fields: Any) -> None:
        if not process.gone:
            with contextlib.suppress(ChannelClosed):  # its death is noticed, with its cause, by _receive
                process.channel.send(kind, **fields)

    def _send_all(self, kind: str, /, **fields: Any) -> None:
        for process in self._processes.values():
            self._send(process, kind, **fields)

    def _last_words(self) -> str:
        return "\n".join(f"[{p.label}] {line}" for p in self._processes.values() for line in p.words[-5:])
