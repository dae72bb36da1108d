"""Compares the machine and the graph that made a recording with those here."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.execution.threads import environment
from dataflow.graph.model import Graph, Node
from dataflow.recording import Recording
from dataflow.recording.streams.facts import FACTS, group_of, machine_facts
from dataflow.reexecution.recorded_run import resolved_graph


def differing_facts(metadata: Mapping[str, Mapping[str, str]], graph: Graph) -> tuple[tuple[str, str, str], ...]:
    """Returns the facts of machines, packages, threads and devices that are not as when it was recorded: those of each
    machine of the run against this one's."""
    here = machine_facts(environment(graph.threads))
    here["threads"] = {name: value for name, value in here["threads"].items() if name in metadata.get("threads", {})}
    facts = []
    for record in sorted(metadata):
        group, machine = group_of(record)
        if group in here and (not machine or group in FACTS):
            then, now, on = metadata[record], here[group], f" on {machine}" if machine else ""
            for name in sorted({*then, *now}):
                if then.get(name) != now.get(name):
                    facts.append((f"{group} {name}{on}", then.get(name, "–"), now.get(name, "–")))
    threads = metadata.get("dataflow:run", {}).get("threads", str(graph.threads))
    if threads != str(graph.threads):
        facts.append(("graph threads", threads, str(graph.threads)))
    return tuple(facts)


def changes_of(recording: Recording, graph: Graph) -> dict[str, tuple[str, ...]]:
    """Returns, by operator, what a graph has otherwise than the one that made a recording: class, parameters, inputs.
    Nothing where the recording holds none."""
    recorded = resolved_graph(recording)
    if recorded is None:
        return {}
    found = {name: _changes(recorded.nodes.get(name), node) for name, node in graph.nodes.items()}
    return {name: changes for name, changes in found.items() if changes}


def _changes(then: Node | None, now: Node) -> tuple[str, ...]:
    if then is None:
        return ("it is not in the recorded graph",)
    found = [] if then.use == now.use else [f"class {then.use} → {now.use}"]
    for what, before, after in (("parameter", then.params, now.params), ("input", then.inputs, now.inputs)):
        for key in sorted({*before, *after}):
            if before.get(key) != after.get(key):
                found.append(f"{what} {key} {_text(before.get(key))} → {_text(after.get(key))}")
    return tuple(found)


def _text(value: object) -> str:
    if value is None:
        return "none"
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)
