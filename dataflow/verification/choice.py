"""Chooses what of a recording is verified: operators, and the streams that can be held against their records."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace

from dataflow.environments import EnvError, environment_of
from dataflow.graph.model import Graph
from dataflow.graph.reach import downstream
from dataflow.recording import Recording
from dataflow.recording.layout import CUT, OUTCOME, TOLD
from dataflow.reexecution.engine import plan_feeding
from dataflow.reexecution.recorded_run import NotRecorded, ReplayError
from dataflow.verification.ledger import COMPLETE
from dataflow.verification.record_totals import GraphRecordTotals


def chosen_operators(graph: Graph, first: str | None, only: Collection[str] | None) -> set[str]:
    """The operators to verify: all that are neither sources nor external, or those asked for.

    `first`: that one and what follows from it; `only`: those alone. Raises `ReplayError` for both, for an empty `only`,
    and for operators that cannot be verified.
    """
    if first is not None and only is not None:
        raise ReplayError("first and only exclude each other: an operator and what follows from it, or operators alone")
    if only is not None and not only:
        raise ReplayError("only: expected at least one operator; without it, all are verified")
    able = {name for name, node in graph.nodes.items() if not node.source and not node.external}
    if not able:
        raise ReplayError(
            f"graph {graph.name!r} holds nothing to verify: all its operators ({', '.join(graph.nodes)}) are sources "
            "or external, whose recorded output is taken as it is; name a graph with further operators with --graph"
        )
    for asked in [first] if first is not None else (only or ()):
        if asked not in able:
            raise ReplayError(
                f"{asked!r} cannot be verified: it is "
                + ("a source or external" if asked in graph.nodes else "no operator of the graph")
                + f"; those that can: {', '.join(sorted(able))}"
            )
    if only is not None:
        return set(only)
    if first is None:
        return able
    return ({first} | downstream(graph, [first])) & able


def without_environments(graph: Graph) -> tuple[Graph, dict[str, str]]:
    """Returns the graph, in which operators are external whose environment is not here, and why it is not, by operator.

    Raises `EnvError` where no other operator is left to repeat.
    """
    able = {name: node.env for name, node in graph.nodes.items() if not (node.source or node.external)}
    why: dict[str | None, str] = {}
    for env in dict.fromkeys(able.values()):
        try:
            if env is not None:
                environment_of(env)
        except EnvError as error:
            why[env] = str(error)
    absent = {name: why[env] for name, env in able.items() if env in why}
    if absent.keys() >= able.keys() and absent:
        raise EnvError(next(iter(absent.values())))
    nodes = {name: replace(node, external=name in absent or node.external) for name, node in graph.nodes.items()}
    return replace(graph, nodes=nodes), absent


def unfed_operators(
    recording: Recording, graph: Graph, operators: Collection[str], incomplete: Collection[str]
) -> dict[str, str]:
    """The operators whose inputs are not in the recording and cannot be made again, with the stream that is missing."""
    held, found = recording.streams.keys() - set(incomplete), dict[str, str]()
    for name in operators:
        try:
            makers = plan_feeding(recording, graph, [name], incomplete=incomplete).operators
            env_of(graph, makers, held)
        except NotRecorded as error:
            found[name] = error.stream
    return found


def env_of(graph: Graph, operators: Iterable[str], held: Collection[str]) -> str | None:
    """Returns the environment of operators that one process repeats. Raises `NotRecorded` where they have several, with
    the stream between two of them that is not `held`."""
    found = {name: graph.nodes[name].env for name in operators}
    if len({*found.values()}) < 2:
        return next(iter(found.values()), None)
    for edge in graph.edges():
        if edge.stream in held or not found.keys() >= {edge.consumer, edge.producer}:
            continue
        if found[edge.consumer] != found[edge.producer]:
            raise NotRecorded(
                f"{edge.producer!r} and {edge.consumer!r} run in two environments, so no process can repeat both, and "
                f"the recording does not hold (all of) {edge.stream!r}: record it",
                edge.stream,
            )
    raise ReplayError(f"operators run in several environments, so no process can repeat all: {', '.join(found)}")


def require_records(recording: Recording, recorded: Collection[str], operators: Iterable[str]) -> None:
    """Raises `ReplayError` for the first operator that is not among those that left firing records."""
    outcome = recording.metadata.get(OUTCOME, {}).get("outcome", "")
    for name in operators:
        if name in recorded:
            continue
        is_cut = CUT in recording.metadata
        unfinished = recording.torn or (TOLD in recording.metadata and not outcome and not is_cut)
        if unfinished or outcome not in ("", COMPLETE):
            why = "the recording has no proper end" if unfinished else f"its outcome: {outcome}"
            raise ReplayError(
                f"{recording.path}: the recorded run ended before operator {name!r} began ({why}): "
                "there is nothing to verify"
            )
        if is_cut:
            raise ReplayError(
                f"{recording.path}: this part of a recording has no firing records of operator {name!r}: verify the "
                "whole (dataflow merge), or other operators (--only)"
            )
        raise ReplayError(
            f"{recording.path}: operator {name!r} left no firing records there; "
            "name the graph that made the recording with --graph, or record with --record"
        )


def require_ports(recording: Recording, graph: Graph, books: GraphRecordTotals, operators: Iterable[str]) -> None:
    """Raises `ReplayError` for the first operator whose outputs are not those it was recorded with."""
    for name in operators:
        node, recorded = graph.nodes[name], books.of(name).ports
        if recorded not in (None, len(node.outputs)):
            raise ReplayError(
                f"{recording.path}: operator {name!r} was recorded with {recorded} output ports and has "
                f"{len(node.outputs)} now ({', '.join(node.outputs)}), so its firings cannot be compared: verify with "
                f"the operator as it was, or record anew"
            )


def accountable(recording: Recording, graph: Graph, books: GraphRecordTotals, name: str) -> bool:
    """Returns whether the records of a node can be held against its streams.

    Not where another operator made them (with another graph), nor where a replay did of a stream whose clock had
    jumped: its records count one incarnation, its messages several.
    """
    node = graph.nodes[name]
    streams = [s for s in node.outputs.values() if s in recording.streams]
    makers = {recording.streams[s].metadata.get("operator", name) for s in streams}
    book = books.of(name)
    jumped = any(len(recording.counts(s)) > 1 for s in streams)
    return makers == {name} and not (book.replayed and jumped) and book.ports in (None, len(node.outputs))


def stored_checks(
    recording: Recording, graph: Graph, books: GraphRecordTotals, nodes: Iterable[str]
) -> tuple[list[str], tuple[str, ...]]:
    """The recorded streams of `nodes` that can be compared with their records, and those that cannot be read as the
    messages that they were."""
    able: list[str] = []
    unable: list[str] = []
    for name in nodes:
        if not books.of(name).records:
            continue
        for stream in graph.nodes[name].outputs.values():
            info = recording.streams.get(stream)
            if info is not None:
                (able if info.message_type is not None and not info.declared_otherwise else unable).append(stream)
    return able, tuple(unable)
