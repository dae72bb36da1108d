"""Firing records and digests out of a recording, for re-execution."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from dataflow.firing.seeding import version_of
from dataflow.graph.model import Node
from dataflow.recording import Recording
from dataflow.recording.layout import RUN
from dataflow.records.firing import FiringRecord, decode_batch
from dataflow.records.reading import Digests


def recorded_firings(recording: Recording, operator: str) -> Iterator[FiringRecord]:
    """The firing records of one operator, in order."""
    for _, payload in recording.firings(operator):
        yield from decode_batch(payload).records


def recorded_digests(recording: Recording, nodes: Iterable[Node], streams: frozenset[str]) -> Digests:
    """What the given nodes had emitted on the given streams."""
    found: dict[str, dict[tuple[int, int], bytes]] = {stream: {} for stream in streams}
    for node in nodes:
        outputs = list(node.outputs.values())
        if not streams.isdisjoint(outputs):
            for record in recorded_firings(recording, node.name):
                for stream, emission in zip(outputs, record.outputs, strict=False):  # a failed call has none
                    if emission is not None and stream in found:
                        found[stream][record.incarnation, emission.seq] = emission.digest
    return found


def seeding_of(recording: Recording) -> int:
    """The version of the scheme by which the recorded run seeded its generators."""
    return version_of(recording.metadata.get(RUN, {}))
