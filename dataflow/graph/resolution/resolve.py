"""From the flat list of operators to the graph: streams wired and checked, cycles refused, policies settled."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from dataflow.graph.drafts import Expansion, GraphInput, OperatorDraft, Pattern, WiredOperator
from dataflow.graph.expansion.wiring import read_pattern
from dataflow.graph.keys import has_wildcard
from dataflow.graph.model import INPUT_CLASS, Bundle, Graph, Node, input_text
from dataflow.graph.problems import Problems, did_you_mean
from dataflow.graph.resolution.order import fed_by_devices, in_order, refuse_stuck_cycles
from dataflow.graph.resolution.policies import live_policy, sync_every, sync_tolerance
from dataflow.graph.resolution.presence import said
from dataflow.graph.resolution.sections import FLIGHT_KEYS, read_flight, read_network
from dataflow.graph.resolution.streams import Streams
from dataflow.graph.sections import ON_FAILURE, PANELS, Record, Snapshots, View
from dataflow.graph.yaml.fields import Fields
from dataflow.graph.yaml.tree import Leaf, Tree
from dataflow.operator import InputPort, is_source
from dataflow.sync.stamps import format_duration

MAX_THREADS = 256


class Resolver:
    """Wires and checks; faults go to `problems`, and the graph that comes out is only right when there are none."""

    def __init__(self, expansion: Expansion, problems: Problems, live: bool = False) -> None:
        self.expansion, self.problems, self.live = expansion, problems, live
        self.fields = Fields(problems)
        self.known = Streams(expansion, problems)
        self.streams, self.types = self.known.streams, self.known.types

    def resolve(self, bundle: Bundle) -> Graph:
        drafts = self.expansion.drafts
        self.known.settle_aliases()
        self.check_graph_inputs()
        wired = [self.wire(draft) for draft in drafts]
        refuse_stuck_cycles(wired, self.streams, self.problems)
        self.check_processes(drafts)
        live_fed = fed_by_devices(wired, self.streams, live=self.live)
        nodes = {w.draft.name: self.node(w, w.draft.name in live_fed) for w in wired}
        root = self.expansion.root
        seed = self.fields.integer(root.get("seed"), "seed", 0, 2**63 - 1)
        threads = self.fields.integer(root.get("threads"), "threads", 1, MAX_THREADS)
        return Graph(
            name=self.expansion.name,
            namespace=self.expansion.namespace,
            nodes={name: nodes[name] for name in in_order(wired, self.streams)},
            streams=self.streams,
            record=self.record(root.get("record"), drafts),
            sources_bundle=bundle,
            seed=0 if seed is None else seed,
            threads=1 if threads is None else threads,
            view=self.view(root.get("view")),
            network=read_network(root.get("network"), self.fields),
            aliases=self.known.aliases,
            types=self.known.own_types,
            left_out={name: said(reasons) for name, reasons in self.expansion.left_out.items()},
        )

    # -- streams -------------------------------------------------------------------------------------------------

    def check_graph_inputs(self) -> None:
        """Checks that what an outer graph binds to a nested graph's typed input carries that type."""
        for name, graph_input in self.expansion.graph_inputs:
            if graph_input.type is not None:
                for pattern in graph_input.patterns:
                    for stream in self.known.match(pattern):
                        self.check_graph_input(name, graph_input, pattern, stream)

    def check_graph_input(self, name: str, declared: GraphInput, pattern: Pattern, stream: str) -> None:
        assert declared.type is not None
        if not all(issubclass(t, declared.type) for t in self.types[stream]):
            text = f"graph input {name!r} takes {declared.type.SCHEMA}, but {self.known.told(stream, pattern.scope)}"
            hint = self.known.carriers((declared.type,), pattern.scope)
            self.problems.add(pattern.place, text, hint, [(declared.place, "declared here")])

    # -- one operator's inputs -----------------------------------------------------------------------------------

    def wire(self, draft: OperatorDraft) -> WiredOperator:
        spec = draft.cls.spec
        wired = WiredOperator(draft, {}, {})
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
                text = f"{draft.name}: input {port.name!r} ({input_text(port)}) is not wired"
                hint = self.known.carriers(port.types, self.known.scope_of(draft))
                self.problems.add(draft.inputs_place, text, hint or f"no stream carries {port.type_text()}")
        if spec.every is not None and not is_source(draft.cls):
            self.check_ticks(wired)
        return wired

    def wire_input(self, draft: OperatorDraft, port: InputPort, wired: WiredOperator) -> tuple[str, ...]:
        what = f"{draft.name}.{port.name}"
        own = f"{self.expansion.namespace}/{draft.name}/"
        streams: dict[str, Pattern] = {}
        for pattern in draft.inputs[port.name]:
            found = self.known.match(pattern)
            wild = has_wildcard(pattern.key)
            if wild:
                found = [s for s in found if not s.startswith(own)]
                if port.kind != "sampled":
                    found = [s for s in found if not self.streams[s].static]
            if not found:
                self.known.no_match(pattern, what, port)
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
            text = f"{what} takes {port.type_text()}, but {self.known.told(stream, pattern.scope)}"
            hint = self.known.carriers(port.types, pattern.scope)
        elif self.streams[stream].static and port.kind != "sampled":
            text = f"{what}: {self.known.short(stream, pattern.scope)!r} is static (one message, valid at all times), "
            text += f"which {'cannot trigger' if port.kind == 'in' else 'makes no batch'}"
            hint = f"the operator should declare it {port.name}: Sampled[{port.type_text()}]"
        else:
            return
        self.problems.add(pattern.place, text, hint, self.known.via(pattern))

    def too_many(self, draft: OperatorDraft, port: InputPort, streams: Mapping[str, Pattern]) -> None:
        first = next(iter(streams.values()))
        joined = len(draft.cls.spec.triggers) > 1 and not draft.cls.spec.merge and port.kind == "in"
        why = "a joined input takes one stream" if joined else "it takes one stream"
        listed = ", ".join(self.known.short(s, first.scope) for s in sorted(streams))
        hint = "name one of them" if joined else f"name one, or declare the input {INPUT_CLASS[port.kind]}(many=True)"
        if carriers := self.known.carriers(port.types, first.scope):
            hint += f"; {carriers}"
        text = f"{draft.name}.{port.name}: {why}, but {len(streams)} match: {listed}"
        self.problems.add(first.place, text, hint, self.known.via(first))

    def check_ticks(self, wired: WiredOperator) -> None:
        """Ticks begin and end with an input that is neither static nor fed back."""
        draft = wired.draft
        spec = draft.cls.spec
        if any(not wired.inputs[name] for name in draft.inputs if name in wired.inputs):
            return  # an input that matches nothing is reported already
        every = 0 if spec.every is None else spec.every
        for name, port in spec.inputs.items():
            if not port.before and any(not self.streams[s].static for s in wired.inputs[name]):
                return
        text = f"{draft.name}: {spec.name} ticks every {format_duration(every)}, but every wired input is static or "
        text += "'before': the beginning and the end of ticks are unknown"
        self.problems.add(draft.inputs_place, text, "wire an input to a stream that is neither")

    # -- the graph as a whole ------------------------------------------------------------------------------------

    def check_processes(self, drafts: Iterable[OperatorDraft]) -> None:
        """Operators that share a process must be on one machine and in one environment."""
        owners: dict[str, OperatorDraft] = {}
        for draft in drafts:
            label = draft.process.value if draft.process else draft.name
            first = owners.setdefault(label, draft)
            for key, words in (("machine", ("on", "machines")), ("env", ("in", "environments"))):
                mine, other = getattr(draft, key), getattr(first, key)
                here, there = (leaf.value if leaf else None for leaf in (mine, other))
                if here != there:
                    at = (mine or other or draft.process or draft).place
                    text = f"process {label!r} is {words[0]} two {words[1]}: {first.name} {words[0]} "
                    text += f"{there or 'this one'}, {draft.name} {words[0]} {here or 'this one'}"
                    self.problems.add(at, text, f"give them the same '{key}:', or different 'process:' labels")

    # -- the resolved parts --------------------------------------------------------------------------------------

    def node(self, wired: WiredOperator, devices: bool) -> Node:
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
            env=draft.env.value if draft.env else None,
            tolerance=sync_tolerance(draft, self.fields),
            every=sync_every(draft, self.fields),
            source=is_source(draft.cls),
            external=draft.cls.external,
            file=draft.file,
            line=draft.place.line,
        )

    def record(self, tree: Tree | None, drafts: Iterable[OperatorDraft]) -> Record:
        everything = tuple(sorted(self.streams))
        if tree is None or (isinstance(tree, Leaf) and tree.value == "all"):
            return Record(everything)
        if isinstance(tree, Leaf):
            self.fields.wrong(tree, "record", "'all' or a mapping with 'topics' or 'exclude'")
            return Record(everything)
        table = self.fields.table(tree, "record", ("topics", "exclude", "snapshots", "on_failure", *FLIGHT_KEYS))
        if table is None:
            return Record(everything)
        kept = set(everything if table.get("topics") is None else self.topics(table.get("topics"), "record"))
        kept -= set(self.topics(table.get("exclude"), "exclude"))
        external = {d.name for d in drafts if d.cls.external}
        kept |= {name for name, stream in self.streams.items() if stream.node in external}
        spacing = table.get("snapshots")
        by_cpu = isinstance(spacing, Leaf) and spacing.value == "cpu"
        snapshots: Snapshots | None = "cpu" if by_cpu else self.fields.duration(spacing, "snapshots")
        flight = read_flight(table, self.fields, [draft.name for draft in drafts], self.topics)
        if spacing is not None and snapshots == 0:
            self.problems.add(spacing.place, "snapshots must be further apart than 0")
        if spacing is not None and by_cpu and flight is not None:
            problem = "snapshots: cpu may be far apart in event time; a flight recorder needs a duration, such as 10s"
            self.problems.add(spacing.place, problem)
        if flight is not None and snapshots is None:
            snapshots = max(flight.keep // 6, 1_000_000_000)
        on_failure = self.fields.choice(table.get("on_failure"), "on_failure", ON_FAILURE)
        thin = len(kept) < len(everything)
        return Record(tuple(sorted(kept)), thin, snapshots, flight, on_failure)

    def view(self, tree: Tree | None) -> View:
        table = self.fields.table(tree, "view", ("hide", "panels", "layout", "keep", "every"))
        if table is None:
            return View()
        words = self.fields.texts(table.get("panels"), "panels")
        panels = [self.fields.choice(leaf, "panels", {name: name for name in PANELS}) for leaf in words]
        layout = self.fields.text(table.get("layout"), "layout") or ""
        if layout and not layout.endswith(".rbl"):
            self.fields.wrong(table.get("layout"), "layout", "a file of the viewer's, NAME.rbl")
        hidden, kept = (self.topics(table.get(what), what) for what in ("hide", "keep"))
        every = self.fields.duration(table.get("every"), "every")
        return View(hidden, tuple(filter(None, panels)), layout, kept, every)

    def topics(self, tree: Tree | None, what: str) -> tuple[str, ...]:
        """The streams that a list of key expressions matches; each must match one at least."""
        found: set[str] = set()
        for leaf in self.fields.texts(tree, what):
            pattern = read_pattern(leaf, self.expansion.namespace, self.problems)
            if pattern is not None:
                streams = self.known.match(pattern)
                if not streams:
                    self.known.no_match(pattern, what, None)
                found.update(streams)
        return tuple(sorted(found))
