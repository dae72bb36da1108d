"""The resolved graph: what a graph file means once every name, stream, parameter and policy in it is settled.

Everything here is plain data that travels between processes as JSON (`Graph.to_json`, `Graph.from_json`); a node's
operator class is imported at its first use, so a process imports its own operators and no others.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from dataflow.environments import require_environment
from dataflow.extras import missing_extra
from dataflow.graph.sections import (
    Network,
    Record,
    View,
    as_values,
    record_from_json,
    record_to_json,
    view_from_json,
    view_to_json,
)
from dataflow.messages.base import Message, MessageError, import_type, message_type
from dataflow.messages.declaration import Declaration

if TYPE_CHECKING:  # what follows a running graph imports no operator
    from dataflow.operator import InputPort, Operator, OperatorSpec

QueuePolicy = Literal["newest", "oldest", "block"]
StalePolicy = Literal["use", "drop"]
Placement = Literal["graph", "one_process", "process_each"]


INPUT_CLASS = {"in": "In", "sampled": "Sampled", "batch": "Batch"}
"""By kind of an input, the class that declares it."""


def input_text(port: InputPort) -> str:
    """Returns an input as it is declared, such as `In[Image]`."""
    return f"{INPUT_CLASS[port.kind]}[{port.type_text()}]"


class OperatorImportError(ImportError):
    """An operator cannot be imported from its path; the message names the part that fails, and why."""


MOVED = "MOVED_OPERATORS"
"""The mapping in which a top package keeps the former import paths of its operators: former path → present path."""


def current_path(use: str) -> str:
    """Returns the present import path of the operator that `use` (`"package.module:Class"`) names.

    It differs from `use` where the top package lists that in its `MOVED_OPERATORS`. Imports the top package, and
    raises what that raises.
    """
    package = use.partition(":")[0].partition(".")[0]
    moved = getattr(sys.modules.get(package) or importlib.import_module(package), MOVED, None)
    return moved.get(use, use) if isinstance(moved, Mapping) else use


def import_operator(use: str) -> type[Operator]:
    """The class behind `"operators.cloud:CloudBuilder"`, also by a former path; raises `OperatorImportError`."""
    from dataflow.operator import Operator

    module_name, _, name = use.partition(":")
    try:
        module_name, _, name = current_path(use).partition(":")
        module = sys.modules.get(module_name) or importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # a module may fail in any way when it runs
        raise _failed(module_name, error) from error
    try:
        found = getattr(module, name, None)
    except (Exception, SystemExit) as error:  # a package may import what it offers only now
        raise _failed(use, error) from error
    if not (isinstance(found, type) and issubclass(found, Operator)):
        raise OperatorImportError(f"module {module_name!r} has no operator {name!r}")
    return found


def _failed(what: str, error: BaseException) -> OperatorImportError:
    reason = f"cannot import {what!r}: {type(error).__name__}: {error}"
    return OperatorImportError("; ".join(filter(None, (reason, missing_extra(error)))))


@dataclass(frozen=True, slots=True)
class Restart:
    """Restart policy of an operator in a live run: the most restarts, and the pause before each attempt (ns)."""

    max: int = 0
    backoff: int = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Live:
    """Policies of an operator in a live run; replay and verify ignore all of it.

    - `queue`, `size`: at most `size` undecided messages on each stream of a trigger; beyond that the oldest is dropped
      (`newest` is kept), the arriving one is dropped (`oldest` is kept), or the producer waits (`block`).
    - `wait`: per input, how long (ns) a decision waits for that input's frontier before it is forced; None: for ever.
    - `deadline`: longest one firing may take (ns) before the operator counts as hung; None: no limit.
    - `memory`: bytes of resident memory at which its process is restarted; None: no limit.
    - `on_stale`: whether messages of an input whose producer died still serve firings or count as absent.
    - `corrected`: of a source on another machine, whether its stamps are corrected by the measured offset of the clock.
    """

    queue: QueuePolicy
    size: int
    wait: Mapping[str, int | None]
    deadline: int | None = None
    restart: Restart = Restart()
    memory: int | None = None
    on_stale: StalePolicy = "use"
    corrected: bool = False


@dataclass(frozen=True, slots=True)
class Node:
    """One operator of the resolved graph.

    - `name`: full name; the names of nested graphs come first: `"front/cloud"`.
    - `use`: import path of the class; `operator` imports it.
    - `params`: every parameter, defaults included, as validated; plain JSON values.
    - `inputs`: input port → names of the streams it takes, sorted; an optional input left out has none.
    - `outputs`: output port → stream name.
    - `process`, `machine`: labels as the graph gives them, or None. `env`: the path of its environment, or None.
    - `tolerance`, `every`: nanoseconds; the class's own, or the graph's `sync:`.
    - `source`, `external`: as the class declares.
    - `file`, `line`: where the graph names the operator.
    """

    name: str
    use: str
    params: Mapping[str, Any]
    inputs: Mapping[str, tuple[str, ...]]
    outputs: Mapping[str, str]
    live: Live
    process: str | None = None
    machine: str | None = None
    env: str | None = None
    tolerance: int = 0
    every: int | None = None
    source: bool = False
    external: bool = False
    file: str = ""
    line: int = 0

    @property
    def operator(self) -> type[Operator]:
        """The operator class, imported on first use; raises `OperatorImportError`."""
        return import_operator(self.use)

    @property
    def spec(self) -> OperatorSpec:
        """The declaration of the class. Mind `tolerance` and `every`, which the graph may change: the node's count."""
        return self.operator.spec

    @property
    def taken(self) -> frozenset[str]:
        """The streams that its inputs take."""
        return frozenset(stream for streams in self.inputs.values() for stream in streams)

    @property
    def process_label(self) -> str:
        """The process it runs in unless the placement is overridden: its `process:` label, or its own name."""
        return self.process or self.name

    def input_port(self, name: str) -> InputPort:
        return self.spec.inputs[name]

    def make(self) -> Operator:
        """A new operator object with this node's parameters. Raises `EnvError` in a process of another environment."""
        require_environment(self.name, self.env)
        return self.operator(**self.params)


@dataclass(frozen=True, slots=True)
class Stream:
    """One stream: the node and port that make it, and what its consumers need to know without importing the class.

    `types` are schema names (a port may declare a union); `lag` is in nanoseconds.
    """

    name: str
    node: str
    port: str
    types: tuple[str, ...]
    static: bool = False
    lag: int = 0


@dataclass(frozen=True, slots=True)
class Edge:
    """One stream into one input."""

    stream: str
    producer: str
    port: str
    consumer: str
    input: str


@dataclass(frozen=True, slots=True)
class Bundle:
    """Everything that a graph was loaded from, so that it can be loaded again where the files are not.

    `files` maps a path relative to the root file's folder (the root file itself by its name) to its text; `settings`
    are the `--set` words; `environment` holds the variables that `${env:NAME}` asked for (None: not set); `folder` is
    the root file's folder as the graph was named, where `${graph:folder}` asked for it.
    """

    file: str
    files: Mapping[str, str]
    settings: tuple[str, ...] = ()
    environment: Mapping[str, str | None] = field(default_factory=dict)
    folder: str = ""


@dataclass(frozen=True, slots=True)
class Graph:
    """A resolved, wholly checked graph. `nodes` is in a deterministic topological order (feedback edges aside)."""

    name: str
    namespace: str
    nodes: Mapping[str, Node]
    streams: Mapping[str, Stream]
    record: Record
    sources_bundle: Bundle
    seed: int = 0
    threads: int = 1
    view: View = field(default_factory=View)
    network: Network = field(default_factory=Network)
    aliases: Mapping[str, str] = field(default_factory=dict)
    """Exported outputs of nested graphs: alias key → stream name."""
    types: Mapping[str, Declaration] = field(default_factory=dict)
    """Message types that are not of `dataflow.messages`: schema name → declaration, with the module to import."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Operators that are in the files but not in this graph: name → why."""

    @property
    def text(self) -> str:
        """The YAML text; nested files follow, each under a comment line with its path."""
        bundle = self.sources_bundle
        nested = (f"# file: {path}\n{text}" for path, text in sorted(bundle.files.items()) if path != bundle.file)
        return "\n".join((bundle.files[bundle.file], *nested))

    def bundle(self) -> str:
        """JSON that `load_bundle` turns into this very graph again, without its files."""
        return json.dumps(
            {"format": "dataflow-graph/1", **as_values(self.sources_bundle)}, indent=1, ensure_ascii=False
        )

    def to_json(self) -> dict[str, Any]:
        """The resolved graph as JSON values; `Graph.from_json` rebuilds it without importing operators."""
        return {
            "name": self.name,
            "namespace": self.namespace,
            "seed": self.seed,
            "threads": self.threads,
            "nodes": [as_values(node) for node in self.nodes.values()],
            "streams": [as_values(stream) for stream in self.streams.values()],
            "aliases": dict(self.aliases),
            "types": [declaration.to_json() for declaration in self.types.values()],
            "left_out": dict(self.left_out),
            "record": record_to_json(self.record),
            "view": view_to_json(self.view),
            "network": as_values(self.network),
            "bundle": as_values(self.sources_bundle),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Graph:
        """The graph that `to_json` described; it was checked when it was loaded and is not checked again."""
        network, bundle = data["network"], data["bundle"]
        nodes = [_node_from_json(values) for values in data["nodes"]]
        streams = [Stream(**{**values, "types": tuple(values["types"])}) for values in data["streams"]]
        types = [Declaration.from_json(values) for values in data["types"]]
        return cls(
            name=data["name"],
            namespace=data["namespace"],
            seed=data["seed"],
            threads=data["threads"],
            nodes={node.name: node for node in nodes},
            streams={stream.name: stream for stream in streams},
            aliases=dict(data["aliases"]),
            types={declaration.schema: declaration for declaration in types},
            left_out=dict(data.get("left_out", {})),
            record=record_from_json(data["record"]),
            view=view_from_json(data["view"]),
            network=Network(**{**network, "listen": tuple(network["listen"]), "connect": tuple(network["connect"])}),
            sources_bundle=Bundle(**{**bundle, "settings": tuple(bundle["settings"])}),
        )

    @property
    def static(self) -> frozenset[str]:
        """The static streams."""
        return frozenset(name for name, stream in self.streams.items() if stream.static)

    def producer(self, stream: str) -> tuple[Node, str]:
        """The node and output port that make `stream`; raises KeyError for an unknown stream."""
        made = self.streams[stream]
        return self.nodes[made.node], made.port

    def message_types(self, stream: str) -> tuple[type[Message], ...]:
        """The classes that `stream` carries. Imports the modules that declare them; raises `MessageError`."""
        return tuple(self._message_type(schema) for schema in self.streams[stream].types)

    def _message_type(self, schema: str) -> type[Message]:
        if schema == "Message":  # of a port that carries any type
            return Message
        declared = self.types.get(schema)
        if declared is None:
            return message_type(schema)
        found = import_type(declared.path, schema)
        if faults := declared.differences(Declaration.of(found), "the graph", "the module"):
            raise MessageError(f"{declared.path} has changed since the graph was loaded: {'; '.join(faults)}")
        return found

    def consumers(self, stream: str) -> tuple[tuple[Node, str], ...]:
        """(node, input port) of everything that takes `stream`, in graph order."""
        return tuple(
            (node, port) for node in self.nodes.values() for port, taken in node.inputs.items() if stream in taken
        )

    def edges(self) -> Iterator[Edge]:
        """Every stream into every input, in graph order."""
        for node in self.nodes.values():
            for port, taken in node.inputs.items():
                for stream in taken:
                    made = self.streams[stream]
                    yield Edge(stream, made.node, made.port, node.name, port)

    def sources(self) -> tuple[Node, ...]:
        """The operators without inputs that produce by themselves: devices, datasets, simulators, logs."""
        return tuple(node for node in self.nodes.values() if node.source)

    def sinks(self) -> tuple[Node, ...]:
        """The operators without outputs."""
        return tuple(node for node in self.nodes.values() if not node.outputs)

    def processes(self, placement: Placement | Mapping[str, str] = "graph") -> dict[str, tuple[str, ...]]:
        """Process label → the nodes it runs, both in graph order.

        `placement`: as the graph's `process:` labels say, all in one process, one process each, or an explicit mapping
        from node name to label (nodes left out keep the graph's label). Raises ValueError for an unknown node or word.
        """
        if isinstance(placement, str) and placement not in ("graph", "one_process", "process_each"):
            raise ValueError(f"placement {placement!r}: expected graph, one_process, process_each or a mapping")
        if not isinstance(placement, str) and (unknown := sorted(placement.keys() - self.nodes.keys())):
            raise ValueError(f"placement names no operator of the graph: {', '.join(unknown)}")
        grouped: dict[str, list[str]] = {}
        for node in self.nodes.values():
            match placement:
                case "one_process":
                    label = "all"
                case "process_each":
                    label = node.name
                case "graph":
                    label = node.process_label
                case _:
                    label = placement.get(node.name, node.process_label)
            grouped.setdefault(label, []).append(node.name)
        return {label: tuple(names) for label, names in grouped.items()}

    def relative(self, stream: str) -> str:
        """`stream` without the namespace, for people."""
        return stream.removeprefix(f"{self.namespace}/")


def _node_from_json(values: Mapping[str, Any]) -> Node:
    live = values["live"]
    return Node(
        **{
            **values,
            "inputs": {port: tuple(streams) for port, streams in values["inputs"].items()},
            "live": Live(**{**live, "restart": Restart(**live["restart"])}),
        }
    )
