"""From a resolved node to what its aligner waits for."""

from __future__ import annotations

from dataflow.graph.model import Node
from dataflow.operator import OperatorSpec
from dataflow.sync import AlignSpec, BatchSpec, SampledSpec, TriggerSpec


def align_spec(node: Node, spec: OperatorSpec, static: frozenset[str]) -> AlignSpec:
    """The alignment of one operator; `static` names the graph's static streams. An input left unwired takes no part."""
    triggers: list[TriggerSpec] = []
    sampled: list[SampledSpec] = []
    batches: list[BatchSpec] = []
    for name, port in spec.inputs.items():
        streams = node.inputs.get(name, ())
        if not streams:
            continue
        if port.kind == "in":
            triggers.append(TriggerSpec(name, streams, port.many))
        elif port.kind == "sampled":
            sampled.append(SampledSpec(name, streams, port.max_age, port.required, port.before or None, port.many))
        else:
            batches.append(BatchSpec(name, streams, port.max, port.max_age, port.many))
    merged = spec.merge
    joined = len(triggers) > 1 and not merged
    return AlignSpec(
        triggers=tuple(triggers),
        sampled=tuple(sampled),
        batches=tuple(batches),
        mode="merge" if merged else "join",
        tolerance=node.tolerance if joined else 0,
        every=node.every,
        static=static & node.taken,
    )
