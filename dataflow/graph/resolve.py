"""From the flat list of operators to the graph: streams wired and checked, cycles refused, policies settled."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from dataflow.graph.drafts import Draft, Expansion, GraphInput, Pattern
from dataflow.graph.fields import Fields
from dataflow.graph.keys import canonical, has_wildcard, key_fault, matching, may_reach
from dataflow.graph.model import (
    Bundle,
    Graph,
    Node,
    Record,
    Stream,
    View,
)
from dataflow.graph.network import read_network
from dataflow.graph.policies import live_policy, sync_every, sync_tolerance
from dataflow.graph.problems import Place, Problems, did_you_mean, nearest
from dataflow.graph.tree import Leaf, Tree
from dataflow.messages.base import Message, is_built_in
from dataflow.messages.declaration import Declaration
from dataflow.operator import InputPort, Source, is_source
from dataflow.sync.demand import Edge as DemandEdge
from dataflow.sync.demand import stuck_cycle
from dataflow.sync.stamps import format_duration

MAX_THREADS = 256
MAX_CYCLES = 8
"""Cycles that are reported at most."""

_INPUT_WORD = {"in": "In", "sampled": "Sampled", "batch": "Batch"}


@dataclass(slots=True)
class _Wired:
    """A draft with the streams of its inputs; `places` says where each came from."""

    draft: Draft
    inputs: dict[str, tuple[str, ...]]
    places: dict[tuple[str, str], Place]


class Resolver:
    """Wires and checks; faults go to `problems`, and the graph that comes out is only right when there are none."""

    def __init__(self, expansion: Expansion, problems: Problems, live: bool = False) -> None:
        self.expansion, self.problems, self.live = expansion, problems, live
        self.fields = Fields(problems)
        self.streams: dict[str, Stream] = {}
        self.types: dict[str, tuple[type[Message], ...]] = {}
        self.own_types: dict[str, Declaration] = {}
        self.aliases: dict[str, str] = {}

    def resolve(self, bundle: Bundle) -> Graph:
        drafts = self.expansion.drafts
        for draft in drafts:
            for port in draft.cls.spec.outputs.values():
                name = f"{self.expansion.namespace}/{draft.name}/{port.name}"
                schemas = tuple(t.SCHEMA or "Message" for t in port.types)
                self.streams[name] = Stream(name, draft.name, port.name, schemas, port.static, port.lag)
                self.types[name] = port.types
                self.own_types |= {t.SCHEMA: Declaration.of(t) for t in port.types if not is_built_in(t)}
        self.settle_aliases()
        self.check_graph_inputs()
        wired = [self.wire(draft) for draft in drafts]
        self.check_cycles(wired)
        self.check_machines(drafts)
        live_fed = self.fed_by_devices(wired)
        nodes = {w.draft.name: self.node(w, w.draft.name in live_fed) for w in wired}
        root = self.expansion.root
        seed = self.fields.integer(root.get("seed"), "seed", 0, 2**63 - 1)
        threads = self.fields.integer(root.get("threads"), "threads", 1, MAX_THREADS)
        return Graph(
            name=self.expansion.name,
            namespace=self.expansion.namespace,
            nodes={name: nodes[name] for name in self.order(wired)},
            streams=self.streams,
            record=self.record(root.get("record"), drafts),
            sources_bundle=bundle,
            seed=0 if seed is None else seed,
            threads=1 if threads is None else threads,
            view=self.view(root.get("view")),
            network=read_network(root.get("network"), self.fields),
            aliases=self.aliases,
            types=self.own_types,
        )

    # -- streams -------------------------------------------------------------------------------------------------

    def settle_aliases(self) -> None:
        """Exported outputs, inner graphs first, so that an outer graph may export an inner one's export."""
        waiting = list(self.expansion.aliases)
        while waiting:
            later = []
            for alias in waiting:
                target = self.aliases.get(alias.target.key, alias.target.key)
                if target in self.streams:
                    self.aliases[alias.key] = target
                else:
                    later.append(alias)
            if len(later) == len(waiting):
                for alias in later:
                    self.no_match(alias.target, f"output {alias.key.rpartition('/')[2]!r}", None)
                return
            waiting = later

    def check_graph_inputs(self) -> None:
        """Checks that what an outer graph binds to a nested graph's typed input carries that type."""
        for name, graph_input in self.expansion.graph_inputs:
            if graph_input.type is not None:
                for pattern in graph_input.patterns:
                    for stream in self.match(pattern):
                        self.check_graph_input(name, graph_input, pattern, stream)

    def check_graph_input(self, name: str, declared: GraphInput, pattern: Pattern, stream: str) -> None:
        assert declared.type is not None
        if not all(issubclass(t, declared.type) for t in self.types[stream]):
            self.problems.add(
                pattern.place,
                f"graph input {name!r} takes {declared.type.SCHEMA}, but {self.told(stream, pattern.scope)}",
                self.carriers((declared.type,), pattern.scope),
                [(declared.place, "declared here")],
            )

    def match(self, pattern: Pattern) -> list[str]:
        """The streams that an expression reaches, exported names included, sorted."""
        found = set(matching(pattern.key, self.streams))
        found |= {self.aliases[alias] for alias in matching(pattern.key, self.aliases)}
        return sorted(found)

    # -- one operator's inputs -----------------------------------------------------------------------------------

    def wire(self, draft: Draft) -> _Wired:
        spec = draft.cls.spec
        wired = _Wired(draft, {}, {})
        for name in draft.inputs:
            if name not in spec.inputs:
                place = draft.input_places[name]
                hint = did_you_mean(name, spec.inputs, f"inputs of {spec.name}")
                self.problems.add(place, f"{draft.name}: {spec.name} has no input {name!r}", hint)
        for port in spec.inputs.values():
            if port.name in draft.inputs:
                wired.inputs[port.name] = self.wire_input(draft, port, wired)
                continue
            wired.inputs[port.name] = ()
            if port.kind != "sampled" or port.required:
                self.problems.add(
                    draft.inputs_place,
                    f"{draft.name}: input {port.name!r} ({self.input_text(port)}) is not wired",
                    self.carriers(port.types, self.scope_of(draft)) or f"no stream carries {port.type_text()}",
                )
        if spec.every is not None and not is_source(draft.cls):
            self.check_ticks(wired)
        return wired

    def wire_input(self, draft: Draft, port: InputPort, wired: _Wired) -> tuple[str, ...]:
        what = f"{draft.name}.{port.name}"
        own = f"{self.expansion.namespace}/{draft.name}/"
        streams: dict[str, Pattern] = {}
        for pattern in draft.inputs[port.name]:
            found = self.match(pattern)
            wild = has_wildcard(pattern.key)
            if wild:
                found = [s for s in found if not s.startswith(own)]
                if port.kind != "sampled":
                    found = [s for s in found if not self.streams[s].static]
            if not found:
                self.no_match(pattern, what, port)
            for stream in found:
                streams.setdefault(stream, pattern)
                wired.places.setdefault((port.name, stream), pattern.place)
        if len(streams) > 1 and not port.many:
            self.too_many(draft, port, streams)
        else:
            for stream, pattern in streams.items():
                self.check_stream(what, port, pattern, stream)
        return tuple(sorted(streams))

    def check_stream(self, what: str, port: InputPort, pattern: Pattern, stream: str) -> None:
        """The stream's type, and that a static stream is only sampled."""
        if not port.accepts(self.types[stream]):
            self.problems.add(
                pattern.place,
                f"{what} takes {port.type_text()}, but {self.told(stream, pattern.scope)}",
                self.carriers(port.types, pattern.scope),
                self.via(pattern),
            )
        elif self.streams[stream].static and port.kind != "sampled":
            self.problems.add(
                pattern.place,
                f"{what}: {self.short(stream, pattern.scope)!r} is static (one message, valid at all times), "
                f"which {'cannot trigger' if port.kind == 'in' else 'makes no batch'}",
                f"the operator should declare it {port.name}: Sampled[{port.type_text()}]",
                self.via(pattern),
            )

    def no_match(self, pattern: Pattern, what: str, port: InputPort | None) -> None:
        if any(may_reach(pattern.key, prefix) for prefix in self.expansion.broken):
            return
        written = pattern.text
        names = [*self.streams, *self.aliases]
        hint = ""
        below = [self.short(n, pattern.scope) for n in names if n.startswith(pattern.key + "/")]
        if has_wildcard(pattern.key):
            hint = self.carriers(port.types, pattern.scope) if port else ""
        elif below:
            hint = f"name one of its ports: {', '.join(below)}"
        else:
            operator = pattern.key.rpartition("/")[0]
            ports = [self.short(n, pattern.scope) for n in names if n.rpartition("/")[0] == operator]
            near = self.nearest_stream(pattern, ports) or self.nearest_stream(
                pattern, [self.short(n, pattern.scope) for n in names]
            )
            if near is not None:
                hint = f"did you mean {near!r}?"
            elif ports:
                hint = f"its ports: {', '.join(ports)}"
            else:
                hint = f"streams here: {', '.join(self.short(n, pattern.scope) for n in self.streams) or 'none'}"
        missing = "matches no stream" if has_wildcard(pattern.key) else "is no stream of this graph"
        self.problems.add(pattern.place, f"{what}: {written!r} {missing}", hint, self.via(pattern))

    def nearest_stream(self, pattern: Pattern, names: list[str]) -> str | None:
        """By whole key, or else by the port alone when every candidate is of the same operator."""
        near = nearest(pattern.text, names)
        if near is None and names and len({n.rpartition("/")[0] for n in names}) == 1:
            port = nearest(pattern.text.rpartition("/")[2], [n.rpartition("/")[2] for n in names])
            near = next((n for n in names if port is not None and n.endswith(f"/{port}")), None)
        return near

    def too_many(self, draft: Draft, port: InputPort, streams: Mapping[str, Pattern]) -> None:
        first = next(iter(streams.values()))
        joined = len(draft.cls.spec.triggers) > 1 and not draft.cls.spec.merge and port.kind == "in"
        why = "a joined input takes one stream" if joined else "it takes one stream"
        listed = ", ".join(self.short(s, first.scope) for s in sorted(streams))
        hint = "name one of them" if joined else f"name one, or declare the input {_INPUT_WORD[port.kind]}(many=True)"
        if carriers := self.carriers(port.types, first.scope):
            hint += f"; {carriers}"
        self.problems.add(
            first.place,
            f"{draft.name}.{port.name}: {why}, but {len(streams)} match: {listed}",
            hint,
            self.via(first),
        )

    def check_ticks(self, wired: _Wired) -> None:
        """Ticks begin and end with an input that is neither static nor fed back."""
        draft = wired.draft
        spec = draft.cls.spec
        if any(not wired.inputs[name] for name in draft.inputs if name in wired.inputs):
            return  # an input that matches nothing is reported already
        every = 0 if spec.every is None else spec.every
        for name, port in spec.inputs.items():
            if not port.before and any(not self.streams[s].static for s in wired.inputs[name]):
                return
        self.problems.add(
            draft.inputs_place,
            f"{draft.name}: {spec.name} ticks every {format_duration(every)}, but every wired input is static or "
            "'before': nothing says when ticks begin and end",
            "wire an input to a stream that is neither",
        )

    # -- words for messages --------------------------------------------------------------------------------------

    def input_text(self, port: InputPort) -> str:
        return f"{_INPUT_WORD[port.kind]}[{port.type_text()}]"

    def told(self, stream: str, scope: str) -> str:
        made = self.streams[stream]
        draft = next(d for d in self.expansion.drafts if d.name == made.node)
        short = self.short(stream, scope)
        return f"{short!r} ({draft.cls.spec.name}.{made.port}) carries {' | '.join(made.types)}"

    def short(self, stream: str, scope: str) -> str:
        """The stream as it is written in the file at hand."""
        if stream.startswith(f"{scope}/"):
            return stream.removeprefix(f"{scope}/")
        return f"/{stream}"

    def scope_of(self, draft: Draft) -> str:
        parent = draft.name.rpartition("/")[0]
        return f"{self.expansion.namespace}/{parent}" if parent else self.expansion.namespace

    def carriers(self, wanted: Iterable[type[Message]], scope: str) -> str:
        """A hint that lists the streams of a type."""
        types = tuple(wanted)
        names = [n for n, produced in self.types.items() if all(issubclass(p, types) for p in produced)]
        if not names:
            return ""
        word = " | ".join(t.SCHEMA or "Message" for t in types)
        return f"streams of {word}: {', '.join(self.short(n, scope) for n in names)}"

    def via(self, pattern: Pattern) -> list[tuple[Place, str]]:
        return [] if pattern.via is None else [(pattern.via, "used here, inside the nested graph")]

    # -- the graph as a whole ------------------------------------------------------------------------------------

    def check_cycles(self, wired: Iterable[_Wired]) -> None:
        edges: list[DemandEdge] = []
        places: dict[DemandEdge, tuple[Place, str]] = {}
        for w in wired:
            spec = w.draft.cls.spec
            joined = len(spec.triggers) > 1 and not spec.merge
            tolerance = sync_tolerance(w.draft, Fields(Problems())) if joined else 0
            for name, streams in w.inputs.items():
                port = spec.inputs[name]
                for stream in streams:
                    made = self.streams[stream]
                    edge = DemandEdge(
                        producer=made.node,
                        consumer=w.draft.name,
                        input=name,
                        kind="trigger" if port.kind == "in" else port.kind,
                        before=port.before or None,
                        tolerance=tolerance,
                        anchor=joined and spec.triggers[0].name == name,
                        lag=made.lag,
                        static=made.static,
                    )
                    edges.append(edge)
                    places[edge] = (w.places[name, stream], f"{w.draft.name}.{name} takes {made.node}/{made.port}")
        for _ in range(MAX_CYCLES):
            cycle = stuck_cycle(edges)
            if cycle is None:
                return
            found = sorted(cycle.edges, key=lambda e: edges.index(e))
            start = cycle.edges.index(found[0])
            around = (*cycle.edges[start:], *cycle.edges[:start])
            way = " -> ".join([around[0].producer, *(e.consumer for e in around)])
            place, _ = places[around[0]]
            if any(e.before for e in around):
                what, hint = "cycle whose 'before' is too short", "lengthen it by more than that sum"
            else:
                what, hint = "cycle without 'before'", "declare one of these inputs Sampled(before=True)"
            self.problems.add(
                place,
                f"{what}: {way} would wait for itself (its demands sum to {format_duration(cycle.demand)}, and must be "
                "below 0)",
                hint,
                [places[e] for e in around],
            )
            edges = [e for e in edges if e not in cycle.edges]

    def check_machines(self, drafts: Iterable[Draft]) -> None:
        """Operators that share a process must be on one machine."""
        owners: dict[str, Draft] = {}
        for draft in drafts:
            label = draft.process.value if draft.process else draft.name
            first = owners.setdefault(label, draft)
            here = draft.machine.value if draft.machine else None
            there = first.machine.value if first.machine else None
            if here != there:
                place = (draft.machine or first.machine or draft.process or Leaf(None, draft.place)).place
                self.problems.add(
                    place,
                    f"process {label!r} is on two machines: {first.name} on {there or 'this one'}, "
                    f"{draft.name} on {here or 'this one'}",
                    "give them the same 'machine:', or different 'process:' labels",
                )

    def fed_by_devices(self, wired: Iterable[_Wired]) -> set[str]:
        """Names of the operators that have a source upstream that cannot wait (`Source.live`; in a live run, any)."""
        downstream: dict[str, list[str]] = {}
        reached: list[str] = []
        for w in wired:
            if issubclass(w.draft.cls, Source) and (w.draft.cls.live or self.live):
                reached.append(w.draft.name)
            for streams in w.inputs.values():
                for stream in streams:
                    downstream.setdefault(self.streams[stream].node, []).append(w.draft.name)
        seen = set(reached)
        while reached:
            for name in downstream.get(reached.pop(), ()):
                if name not in seen:
                    seen.add(name)
                    reached.append(name)
        return seen

    def order(self, wired: list[_Wired]) -> list[str]:
        """Producers before consumers, otherwise as written; edges of inputs with `before` count only where they can."""
        index = {w.draft.name: i for i, w in enumerate(wired)}
        firm: dict[str, set[str]] = {name: set() for name in index}
        for w in wired:
            for name, streams in w.inputs.items():
                if not w.draft.cls.spec.inputs[name].before:
                    firm[w.draft.name] |= {self.streams[s].node for s in streams} - {w.draft.name}
        waiting = {name: set(before) for name, before in firm.items()}
        consumers: dict[str, list[str]] = {name: [] for name in index}
        for name, producers in firm.items():
            for producer in producers:
                consumers[producer].append(name)
        ready = [index[name] for name, before in waiting.items() if not before]
        heapq.heapify(ready)
        names = list(index)
        ordered: list[str] = []
        while ready:
            name = names[heapq.heappop(ready)]
            ordered.append(name)
            for consumer in consumers[name]:
                waiting[consumer].discard(name)
                if not waiting[consumer]:
                    heapq.heappush(ready, index[consumer])
        return ordered + [name for name in names if name not in set(ordered)]  # the rest: a cycle, which is reported

    # -- the resolved parts --------------------------------------------------------------------------------------

    def node(self, wired: _Wired, devices: bool) -> Node:
        draft = wired.draft
        spec = draft.cls.spec
        return Node(
            name=draft.name,
            use=draft.use,
            params=draft.params,
            inputs=wired.inputs,
            outputs={port: f"{self.expansion.namespace}/{draft.name}/{port}" for port in spec.outputs},
            live=live_policy(draft, devices, self.fields),
            process=draft.process.value if draft.process else None,
            machine=draft.machine.value if draft.machine else None,
            tolerance=sync_tolerance(draft, self.fields),
            every=sync_every(draft, self.fields),
            source=is_source(draft.cls),
            external=draft.cls.external,
            file=draft.file,
            line=draft.place.line,
        )

    def record(self, tree: Tree | None, drafts: Iterable[Draft]) -> Record:
        everything = tuple(sorted(self.streams))
        if tree is None or (isinstance(tree, Leaf) and tree.value == "all"):
            return Record(everything)
        if isinstance(tree, Leaf):
            self.fields.wrong(tree, "record", "'all' or a mapping with 'topics' or 'exclude'")
            return Record(everything)
        table = self.fields.table(tree, "record", ("topics", "exclude", "snapshots"))
        if table is None:
            return Record(everything)
        kept = set(everything if table.get("topics") is None else self.topics(table.get("topics"), "record"))
        kept -= set(self.topics(table.get("exclude"), "exclude"))
        external = {d.name for d in drafts if d.cls.external}
        kept |= {name for name, stream in self.streams.items() if stream.node in external}
        snapshots = self.fields.duration(table.get("snapshots"), "snapshots")
        if snapshots == 0:
            self.problems.add(table.get("snapshots").place, "snapshots must be further apart than 0")  # type: ignore[union-attr]
        return Record(tuple(sorted(kept)), thin=len(kept) < len(everything), snapshots=snapshots)

    def view(self, tree: Tree | None) -> View:
        table = self.fields.table(tree, "view", ("hide",))
        return View(self.topics(table.get("hide"), "hide") if table else ())

    def topics(self, tree: Tree | None, what: str) -> tuple[str, ...]:
        """The streams that a list of key expressions matches; each must match one at least."""
        found: set[str] = set()
        namespace = self.expansion.namespace
        for leaf in self.fields.texts(tree, what):
            text = leaf.value
            absolute = text.startswith("/")
            if fault := key_fault(text[1:] if absolute else text):
                self.problems.add(leaf.place, f"{text!r} is no key expression: {fault}")
                continue
            key = canonical(text[1:] if absolute else f"{namespace}/{text}")
            pattern = Pattern(text, key, leaf.place, namespace)
            streams = self.match(pattern)
            if not streams:
                self.no_match(pattern, what, None)
            found.update(streams)
        return tuple(sorted(found))
