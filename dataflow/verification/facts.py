"""Compares the machine that made a recording with this one."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.firing.threads import environment
from dataflow.graph.model import Graph
from dataflow.recording.facts import machine_facts


def differing_facts(metadata: Mapping[str, Mapping[str, str]], graph: Graph) -> tuple[tuple[str, str, str], ...]:
    """Returns the facts of the machine, packages, threads and devices that are not as when it was recorded."""
    here = machine_facts(environment(graph.threads))
    here["threads"] = {name: value for name, value in here["threads"].items() if name in metadata.get("threads", {})}
    facts = [
        (f"{group} {name}", metadata[group].get(name, "–"), here[group].get(name, "–"))
        for group in sorted(here.keys() & metadata.keys())
        for name in sorted(here[group].keys() | metadata[group].keys())
        if metadata[group].get(name) != here[group].get(name)
    ]
    threads = metadata.get("dataflow:run", {}).get("threads", str(graph.threads))
    if threads != str(graph.threads):
        facts.append(("graph threads", threads, str(graph.threads)))
    return tuple(facts)
