"""The run that a recording holds: its graph, its streams' types, how they ended."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dataflow.execution.feeds.playable import PlayableStreams
from dataflow.execution.generators.seeding import version_of
from dataflow.graph.model import Graph, Node
from dataflow.graph.sections import Network
from dataflow.messages.base import Message, message_type
from dataflow.messages.declaration import Declaration
from dataflow.recording import Recording, RecordingError
from dataflow.recording.layout import ENDS, GRAPH, RUN

if TYPE_CHECKING:
    from dataflow.graph.lookup import NotFound
    from dataflow.operator import Operator

_PROCESS = "process of "


class ReplayError(ValueError):
    """Raised when a recording cannot drive a graph; the message names the missing stream and a remedy."""


class NotRecorded(ReplayError):
    """A stream that operators need, that the recording does not hold, and that cannot be made again."""

    def __init__(self, message: str, stream: str) -> None:
        super().__init__(message)
        self.stream = stream


def recorded_graph(recording: PlayableStreams) -> Graph:
    """Returns the graph that made a recording, without its network: a recording opens no port and no connection. Its
    operators are imported. Raises `ReplayError` when the recording does not hold a graph, `GraphError`."""
    return isolated(graph_as_recorded(recording))


def graph_that_is_here(recording: Recording) -> tuple[Graph, dict[str, str]]:
    """Returns the graph that made a recording, and why operators of it are not here, by operator: their modules or
    classes are gone, or lack a parameter or a port of then. These are external in it, so that what they made is taken
    from the recording.

    Raises as `recorded_graph`; `ReplayError` where none of its operators is here.
    """
    from dataflow.graph import GraphError
    from dataflow.graph.lookup import NotFound, find_operator

    try:
        return recorded_graph(recording), {}
    except GraphError:
        graph = resolved_graph(recording)
        found = {} if graph is None else {name: find_operator(node.use) for name, node in graph.nodes.items()}
        if graph is None:
            raise
        absent = {name: why for name, node in graph.nodes.items() if (why := _missing(node, found[name]))}
        if not absent:
            raise
        if absent.keys() >= {name for name, node in graph.nodes.items() if not node.external}:
            raise ReplayError(_none_here(recording, absent, found)) from None
    nodes = {
        name: replace(node, external=True)
        if name in absent
        else replace(node, use=node.use if isinstance(cls, NotFound) else f"{cls.__module__}:{cls.__qualname__}")
        for name, node in graph.nodes.items()
        for cls in (found[name],)
    }
    return isolated(replace(graph, nodes=nodes)), absent


def _none_here(recording: Recording, absent: Mapping[str, str], found: Mapping[str, type[Operator] | NotFound]) -> str:
    """Returns in words that no operator of a recording is here: each reason once, with its operators."""
    from dataflow.graph.lookup import NotFound

    names: dict[str, list[str]] = {}
    for name, reason in absent.items():
        names.setdefault(reason, []).append(name)
    reasons = "; ".join(f"{reason} ({', '.join(of)})" for reason, of in names.items())
    hints = [line for name in absent if isinstance(each := found[name], NotFound) for line in each.hint.splitlines()]
    return "\n".join([f"{recording.path}: the code of its operators is not here: {reasons}", *dict.fromkeys(hints)])


def _missing(node: Node, found: type[Operator] | NotFound) -> str:
    """Returns why the class of a node is gone, or which parameters and ports of then it lacks; "" where it is here."""
    if not isinstance(found, type):
        return found.message if found.deleted else ""
    spec = found.spec
    gone = [f"parameter {name!r}" for name in sorted(node.params.keys() - spec.parameters.model_fields.keys())]
    gone += [f"input {name!r}" for name in sorted(node.inputs.keys() - spec.inputs.keys())]
    return f"{node.use} has no {', no '.join(gone)} any more" if gone else ""


def isolated(graph: Graph) -> Graph:
    """Returns a graph whose processes can only be reached from this machine, regardless of its `network:` section."""
    return replace(graph, network=Network(shared_memory=graph.network.shared_memory))


def graph_as_recorded(recording: PlayableStreams) -> Graph:
    """Returns the graph that made a recording, as it is; its operators are imported. Raises as `recorded_graph`."""
    from dataflow.graph import load_bundle  # workers are given a graph that is loaded already, and load none

    bundle = recording.metadata.get(GRAPH, {}).get("bundle")
    if bundle is None:
        raise ReplayError(f"{recording.path} does not hold the graph that made it: name one with --graph")
    try:
        packed = json.loads(bundle)
    except (ValueError, RecursionError):
        packed = None
    if not isinstance(packed, dict) or not packed.keys() >= {"format", "file", "files"}:
        raise ReplayError(
            f"{recording.path}: what it holds in place of the graph that made it is no graph: name one with --graph"
        )
    return load_bundle(bundle)


def resolved_graph(recording: PlayableStreams) -> Graph | None:
    """Returns the graph that made a recording as it was resolved then, for tools that look: imports no operator. None
    where the recording holds none, or none that is sound (another version's, or another program's)."""
    held = recording.metadata.get(GRAPH, {})
    try:
        graph = Graph.from_json(json.loads(held["resolved"]) | {"bundle": _bundle(json.loads(held["bundle"]))})
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
    makers = {stream.node for stream in graph.streams.values()}
    taken = {stream for node in graph.nodes.values() for streams in node.inputs.values() for stream in streams}
    return graph if makers <= graph.nodes.keys() and taken <= graph.streams.keys() else None


def _bundle(packed: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in packed.items() if name != "format"}


def graph_metadata(graph: Graph) -> dict[str, dict[str, str]]:
    """Returns what a recording must hold so that its graph can be loaded again, or looked at without its operators."""
    resolved = {name: value for name, value in graph.to_json().items() if name != "bundle"}
    return {
        GRAPH: {
            "name": graph.name,
            "bundle": graph.bundle(),
            "text": graph.text,
            "resolved": json.dumps(resolved, ensure_ascii=False),
        }
    }


def check_type(recording: PlayableStreams, graph: Graph, stream: str) -> None:
    """Raises `ReplayError` unless a recorded stream holds what the graph's stream of that name carries."""
    info = recording.streams[stream]
    wanted = graph.streams[stream].types
    if info.message_type is None or info.message_type.SCHEMA not in wanted:
        raise ReplayError(
            f"{recording.path}: stream {stream!r} holds {info.schema}, "
            f"the graph's {graph.streams[stream].node!r} emits {' | '.join(wanted)}"
        )
    if info.declaration is None:
        return
    schema = info.declaration.schema
    expected = graph.types.get(schema) or Declaration.of(message_type(schema))
    if faults := info.declaration.differences(expected, "the recording", expected.path):
        raise ReplayError(
            f"{recording.path}: stream {stream!r} holds {schema} as it was declared when it was recorded, and "
            f"{expected.path} declares it differently: {'; '.join(faults)}. Restore the fields, or give the new type "
            "another schema name: class ...(Message, schema=...)"
        )


def final_stamps(recording: PlayableStreams, streams: Iterable[str]) -> dict[str, int]:
    """Returns the stamps that streams ended with in the recorded run, where the recording holds them. Raises
    `RecordingError` where it cannot be read."""
    ends = recording.metadata.get(ENDS, {})
    finals: dict[str, int] = {}
    for stream in streams:
        try:
            final = json.loads(ends[stream])["final"] if stream in ends else None
            if final is not None:
                finals[stream] = int(final)
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise RecordingError(f"{recording.path}: how stream {stream!r} ended cannot be read: {error!r}") from error
    return finals


def recorded_message(recording: Recording, stream: str, place: tuple[int, int], stamp: int) -> Message | None:
    """Returns the message of a stream with that place (incarnation, number) and stamp (ns); None where the recording
    does not hold it."""
    info = recording.streams.get(stream)
    if info is None or info.message_type is None:
        return None
    for found in recording.messages([stream], start=stamp, end=stamp):
        if (found.incarnation, found.seq) == place:
            return found.message
    return None


def processes_of(recording: Recording) -> dict[str, str]:
    """Returns the process in which each operator ran, by operator, where the recording holds it."""
    facts = recording.metadata.get(RUN, {})
    return {fact.removeprefix(_PROCESS): label for fact, label in facts.items() if fact.startswith(_PROCESS)}


def seeding_of(recording: Recording) -> int:
    """Returns the version of the scheme by which the recorded run seeded its generators."""
    return version_of(recording.metadata.get(RUN, {}))
