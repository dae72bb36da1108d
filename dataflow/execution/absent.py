"""Changes a firing of a live run whose producers are gone: what they still hold is stale."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from dataflow.graph.model import Node
from dataflow.sync import Firing


def without_absent(firing: Firing, node: Node, absent: Collection[str]) -> Firing:
    """Marks the Sampled inputs stale that take an `absent` stream; drops what they hold where the policy requires it.

    Required inputs, and inputs of several streams, stay.
    """
    ports = node.spec.inputs
    gone = frozenset(
        name
        for name, port in ports.items()
        if port.kind == "sampled" and any(stream in absent for stream in node.inputs.get(name, ()))
    )
    if not gone:
        return firing
    inputs = dict(firing.inputs)
    if node.live.on_stale == "drop":
        inputs |= {
            name: None for name in gone if not ports[name].required and not isinstance(inputs.get(name), Mapping)
        }
    return Firing(firing.stamp, firing.kind, firing.tick, inputs, firing.stale | gone, firing.late)
