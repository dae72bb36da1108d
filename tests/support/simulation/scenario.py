"""What is run, on which machine, and what happens to it: a scenario, made from a seed."""

from __future__ import annotations

import contextlib
import functools
import random
from collections.abc import Mapping
from dataclasses import dataclass, replace

from dataflow.chaos.plan import Fault
from dataflow.graph import Graph, GraphError, load_text
from dataflow.graph.model import Placement
from simulation.blocks import by_blocks
from simulation.drawn import NESTED, drawn, nested, repeats
from simulation.keeping import PLAIN, Keeping, keeping_of, thinner
from simulation.operators import Revised
from simulation.run import LIMIT, Happening, Machine

_USE = "use: simulation.operators"
_SOURCE = f"{_USE}:Counter, params: {{count: COUNT, period: PERIOD, work: READING}}"
_DEVICE = f"{_USE}:Device, params: {{count: COUNT, period: PERIOD}}RESTARTED"
_PAIR = f"{_USE}:Pair, params: {{count: COUNT, period: PERIOD}}"
_JUMPS = f"{_USE}:JumpingPair, params: {{count: COUNT, period: PERIOD}}RESTARTED"
_OTHER = f"{_USE}:Counter, params: {{count: COUNT, period: PERIOD, offset: 1000000, ratio: 2, work: READING}}"
_SHORT = f"{_USE}:Counter, params: {{count: 1, period: PERIOD, offset: 30000000}}"
_WORK = "params: {work: WORK}"

GRAPHS: Mapping[str, str] = {
    "chain": f"""
  left: {{SOURCE}}
  relay: {{{_USE}:Relay, inputs: {{x: left/fast}}, {_WORK}LIVE}}
  sum: {{{_USE}:Sum, inputs: {{x: relay/y}}, {_WORK}LIVE}}
""",
    "join": f"""
  left: {{SOURCE}}
  right: {{SOURCE}}
  mount: {{{_USE}:Pose, inputs: {{x: left/slow}}LIVE}}
  mix:
    {_USE}:Mix
    inputs: {{a: left/fast, b: right/fast, constant: mount/mount, feedback: smooth/y, recent: right/fast}}
    {_WORK}LINE
  smooth: {{{_USE}:Smooth, inputs: {{x: mix/y}}LIVE}}
""",
    "diamond": f"""
  left: {{SOURCE}}
  one: {{{_USE}:Relay, inputs: {{x: left/fast}}, {_WORK}LIVE}}
  two: {{{_USE}:Smooth, inputs: {{x: left/fast}}LIVE}}
  merge: {{{_USE}:Merge, inputs: {{all: [one/y, two/y, left/slow]}}, {_WORK}LIVE}}
""",
}
TICKS = f"""
  left: {{SOURCE}}
  timer: {{{_USE}:Timer, inputs: {{x: left/fast}}LIVE}}
  sum: {{{_USE}:Sum, inputs: {{x: timer/y}}, {_WORK}LIVE}}
"""
"""A graph of which every step makes many messages, more than what keeps its source from running ahead knows of: those
between two processes can become too many."""
TICKING = "ticks"
DRAWN = "drawn"
"""A graph that its seed wires (`drawn`)."""
MOST_TRIES = 30
PLACEMENTS: tuple[Placement, ...] = ("graph", "graph", "process_each", "one_process")
TICK = 250e-6
"""Its timer's period, s."""
_RESTART = "restart: {max: 5, backoff: 10ms}"
POLICIES = (
    "",
    _RESTART,
    "queue: block, size: 16",
    "queue: newest, size: 1",
    "queue: oldest, size: 2, wait: 15ms",
    f"queue: block, size: 16, {_RESTART}",
    f"queue: newest, size: 1, {_RESTART}",
    f"queue: newest, size: 16, wait: forever, {_RESTART}",
    f"queue: oldest, size: 2, wait: 15ms, deadline: 200ms, {_RESTART}",
    "wait: 0ms, restart: {max: 1, backoff: 100ms}",
    f"on_stale: drop, {_RESTART}",
    f"queue: newest, size: 1, on_stale: drop, wait: 15ms, {_RESTART}",
)
FOREVER = 1e6
"""Seconds that a process is frozen for good."""
GENTLE = ("pause", "set", "play", "reload", "trigger", "room")
LONGEST_PAUSE = 40.0
"""Seconds for which a whole machine stands still, at most."""
PATIENCE = 2.5
"""Seconds of a freeze that every run outlives."""
TIMEOUT = 20.0
"""Seconds allowed for the start, and without progress."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """One run to be simulated. `live` operators have the policy `policy`, YAML fields of `live:`."""

    seed: int
    graph: str
    live: bool
    count: int
    period: int
    work: float
    reading: float
    policy: str
    placement: Placement
    window: int
    machine: Machine
    keeping: Keeping = PLAIN
    happenings: tuple[Happening, ...] = ()
    faults: tuple[Fault, ...] = ()
    parts: tuple[str, ...] = ()
    """The operators of a drawn graph, a line of YAML each."""
    inner: tuple[str, ...] = ()
    """The nested graph that it uses, line by line."""
    rate: float | None = None

    def load(self) -> Graph:
        drawn_here = "".join(f"\n  {part}" for part in self.parts) + "\n"
        operators = {TICKING: TICKS, DRAWN: drawn_here}.get(self.graph) or GRAPHS[self.graph]
        text = f"graph: {self.graph}\nnamespace: sim\noperators:{operators}{self.keeping.section}"
        words = {
            "SOURCE": _DEVICE if self.live else _SOURCE,
            "PAIR": _JUMPS if self.live else _PAIR,
            "OTHER": _OTHER,
            "SHORT": _SHORT,
            "LIVE": f", live: {{{self.policy}}}" if self.policy else "",
            "LINE": f"\n    live: {{{self.policy}}}" if self.policy else "",
            "RESTARTED": f", live: {{{_RESTART}}}" if "restart" in self.policy else "",
            "COUNT": str(self.count),
            "PERIOD": str(self.period),
            "READING": str(self.reading),
            "WORK": str(self.work),
        }
        part = "\n".join(self.inner)
        for word, meaning in words.items():
            text, part = text.replace(word, meaning), part.replace(word, meaning)
        return _loaded(text, part)

    @property
    def may_fail(self) -> bool:
        """Whether anything happens that the run need not outlive.

        A run that is stopped while a process is to be started again ends at once, as after a freeze beyond a deadline.
        """
        kinds = [h.kind for h in self.happenings]
        ends = any(
            h.kind.startswith("kill") or (h.kind == "freeze" and h.fields["span"] > PATIENCE) for h in self.happenings
        )
        ends = ends or kinds.count("stop") > 1 or ("deadline" in self.policy and {"freeze", "stop"} <= set(kinds))
        full = self.machine.room is not None and self.keeping.storage.on_failure == "end"
        return ends or full or any(f.kind in ("raise", "hang") for f in self.faults)

    @property
    def only_paused(self) -> bool:
        """Whether nothing happens for which a process may be killed or blamed."""
        harmless = all(h.kind in GENTLE for h in self.happenings)
        return harmless and not self.faults and self.machine.room is None and self.machine.slow_disk == 0.0

    @property
    def limit(self) -> float:
        """Simulated seconds after which the run hangs: ticks that came due while processes stood still are all made up
        for."""
        spans: float = sum(min(h.fields["span"], TIMEOUT) for h in self.happenings if h.kind == "freeze")
        pauses: float = sum(h.fields["span"] for h in self.happenings if h.kind == "pause")
        return LIMIT + pauses + ((spans + pauses) / TICK * self.work if self.graph == TICKING else 0.0)

    def describe(self) -> str:
        """Tells what is run, and what happens, one line each."""
        how = f"live ({self.policy or 'default policies'})" if self.live else "not live"
        machine = self.machine
        lines = [
            f"seed {self.seed}: graph {self.graph!r}, {how}, {self.placement}, {self.count} steps of "
            f"{self.period / 1e6:g} ms, work up to {self.work:g} s, window {self.window}"
            + str(self.keeping)
            + ("" if self.rate is None else f", rate {self.rate:g}"),
            f"  machine: seed {machine.seed}, pace {machine.pace:g}, gives way {machine.preempt:g}"
            + ("" if machine.room is None else f", disk of {machine.room} bytes")
            + (f", writes take up to {machine.slow_disk:g} s" if machine.slow_disk else "")
            + (f", sockets hold {machine.socket_room} messages" if machine.socket_room != 278 else "")
            + (f", rings of {machine.ring_bytes} bytes" if machine.ring_bytes != 1 << 20 else ""),
        ]
        lines += [f"  {part}" for part in self.parts]
        lines += [f"  | {line}" for line in self.inner]
        lines += [f"  {happening}" for happening in self.happenings]
        lines += [f"  {f.at:.4f} s after the release {f.kind} {f.operator} {dict(f.fields)}" for f in self.faults]
        return "\n".join(lines)


@functools.lru_cache(maxsize=4096)
def _loaded(text: str, part: str) -> Graph:
    """Loads a graph, with the nested one that it uses; loading takes longer than some runs, so each is loaded once."""
    with by_blocks():
        return load_text(text, files={NESTED: part} if part else None)


def scenario_of(seed: int) -> Scenario:
    """Returns the scenario of a seed."""
    r = random.Random(f"scenario {seed}")
    live = r.random() < 0.5
    graph = r.choice(sorted(GRAPHS))
    machine = Machine(
        seed,
        pace=r.choice((0.3, 1.0, 5.0)),
        preempt=r.choice((0.0, 0.02, 0.2)),
        room=r.choice((6_000, 12_000)) if r.random() < 0.05 else None,
        slow_disk=r.choice((0.01, 0.2)) if r.random() < 0.1 else 0.0,
        socket_room=r.choice((278, 12)),
        ring_bytes=r.choice((1 << 20, 4096)),
    )
    plain = Scenario(
        seed=seed,
        graph=graph,
        live=live,
        count=r.choice((6, 12)),
        period=r.choice((5_000_000, 20_000_000)),
        work=r.choice((0.0, 0.05)),
        reading=0.005 if not live and r.random() < 0.3 else 0.0,
        policy=r.choice(POLICIES) if live else "",
        placement=r.choice(("process_each", "process_each", "one_process")),
        window=r.choice((2, 4, 256)),
        keeping=Keeping(states="snapshots: 60ms" if r.random() < 0.3 else ""),
        machine=machine,
    )
    if live and random.Random(f"ticks {seed}").random() < 0.05:
        plain = replace(plain, graph=TICKING)
    elif random.Random(f"drawn {seed}").random() < 0.6:
        plain = _drawn(plain, random.Random(f"wired {seed}"))
    kept = random.Random(f"kept {seed}")
    whole = keeping_of(kept, plain.keeping)
    for keeping in (whole, thinner(whole, random.Random(f"less {seed}"))):
        with contextlib.suppress(GraphError):  # its streams are not in this graph
            recorded = replace(plain, keeping=keeping)
            recorded.load()
            plain = recorded
    if plain.keeping.storage.on_failure == "go_on" and (plain.machine.room is not None or kept.random() < 0.5):
        plain = replace(plain, machine=replace(plain.machine, room=kept.choice((20_000, 30_000, 60_000))))
    if plain.keeping.flight or plain.keeping.has_parts:
        plain = replace(plain, count=kept.choice((12, 40)))
    return _with_events(plain, r)


def _drawn(plain: Scenario, r: random.Random) -> Scenario:
    """The same with a graph that is wired at random; some of what is not live keeps the pace of a clock."""
    rate = r.choice((0.5, 1.0, 4.0)) if not plain.live and r.random() < 0.2 else None
    for _ in range(MOST_TRIES):
        placement = r.choice(PLACEMENTS)
        parts = drawn(r, live=plain.live)
        found = replace(plain, graph=DRAWN, parts=parts, rate=rate, placement=placement)
        with contextlib.suppress(GraphError):  # its feedback would wait for itself
            found.load()
            if repeats(parts):
                outer, inner = nested(parts, r) if r.random() < 0.25 else (parts, ())
                return replace(found, parts=outer, inner=inner)
    return plain


def _with_events(plain: Scenario, r: random.Random) -> Scenario:
    graph = plain.load()
    labels = [*graph.processes(plain.placement)]
    happenings = [_happening(plain, labels, r) for _ in range(r.choice((0, 0, 1, 1, 2, 3)))]
    happenings += _gentle(plain, graph, r)
    happenings += _asked(plain, graph, random.Random(f"asked {plain.seed}"))
    faults = [_fault(graph, r) for _ in range(r.choice((0, 0, 1, 2)))] if plain.live else []
    return replace(
        plain,
        happenings=tuple(sorted(happenings, key=lambda h: h.at)),
        faults=tuple(sorted(faults, key=lambda f: f.at)),
    )


def _happening(plain: Scenario, labels: list[str], r: random.Random) -> Happening:
    at = round(r.random() * 0.4, 4) if r.random() < 0.75 else 0.0
    kinds = ("freeze", "freeze", "kill_before", "kill", "stop")
    kind, target = r.choice(kinds), r.choice(labels) if r.random() < 0.9 else "@recorder"
    match kind:
        case "freeze":
            return Happening(at, kind, target, {"span": r.choice((0.05, 0.2, 1.0, 2.0, 6.0, FOREVER))})
        case "kill_before":
            return Happening(0.0, kind, target, {"effect": r.randint(1, 150), "life": r.choice((1, 1, 1, 2))})
        case "stop":
            return Happening(at, kind)
        case _:
            return Happening(at, kind, target)


def _gentle(plain: Scenario, graph: Graph, r: random.Random) -> list[Happening]:
    """What happens to a run that it outlives: parameters are set, its machine or its supervisor stands still for a
    while, what is not live is paused and goes on."""
    found = []
    for name, node in graph.nodes.items():
        if "gain" in node.params and r.random() < 0.5:
            found.append(Happening(round(r.random() * 0.3, 4), "set", name, {"gain": r.choice((2.0, 3.0))}))
    if r.random() < 0.15:
        where = r.choice(("*", "*", "", r.choice([*graph.processes(plain.placement), "@recorder"])))
        at = round(r.random() * 0.3, 4)
        found.append(Happening(at, "pause", where, {"span": r.choice((1.0, 4.0, 6.0, 15.0, LONGEST_PAUSE))}))
    if not plain.live and r.random() < 0.1:
        at = round(r.random() * 0.2, 4)
        found.append(Happening(at, "play", "", {"action": "pause"}))
        found.append(
            Happening(round(at + r.random(), 4), "play", "", {"action": r.choice(("resume", "resume", "step"))})
        )
        found.append(Happening(round(at + 1.0 + r.random(), 4), "play", "", {"action": "resume"}))
    return found


def _asked(plain: Scenario, graph: Graph, r: random.Random) -> list[Happening]:
    """What a person asks of a run, and a disk that has room again."""
    found = []
    span = plain.count * plain.period * 1e-9
    operators = [name for name, node in graph.nodes.items() if issubclass(node.operator, Revised)]
    if plain.live and operators and r.random() < 0.35:
        for _ in range(r.choice((1, 1, 2, 3))):
            found.append(Happening(round(r.random() * max(span, 0.2), 4), "reload", r.choice(operators)))
    if plain.keeping.flight:
        found += [Happening(round(r.random() * span, 4), "trigger") for _ in range(r.choice((0, 1, 2)))]
    if plain.machine.room is not None and r.random() < 0.8:
        for _ in range(r.choice((1, 2, 5))):
            found.append(
                Happening(round(r.random() * 0.6, 4), "room", fields={"bytes": r.choice((2_000, 9_000, 1 << 30))})
            )
    return found


def _fault(graph: Graph, r: random.Random) -> Fault:
    at = round(r.random() * 0.4, 4)
    sources = [name for name, node in graph.nodes.items() if node.source]
    others = [name for name, node in graph.nodes.items() if not node.source]
    kind = r.choice(("raise", "slow", "stop", "flood", "jump", "past", "malformed", "hang"))
    target = r.choice(sources if kind in ("stop", "flood", "jump", "past") else others)
    fields = {
        "slow": {"by": 0.05, "span": 0.1},
        "stop": {"span": 0.1},
        "flood": {"factor": 5, "span": 0.05},
        "jump": {"by": 0.2, "back": True},
        "past": {"by": 0.1, "back": True},
    }
    return Fault(at, kind, target, fields.get(kind, {}))
