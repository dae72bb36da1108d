"""Compares the machine that made a recording with this one."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.execution.threads import environment
from dataflow.graph.model import Graph
from dataflow.recording.streams.facts import FACTS, group_of, machine_facts


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
