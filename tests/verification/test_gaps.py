"""A recording in which messages of a source are missing is replayed: its processes are given what there is."""

from __future__ import annotations

from pathlib import Path

import pytest
from tampering import Kept, as_it_is, tampered

from dataflow.recording import Recorded, Recording
from dataflow.reexecution.recorded_run import recorded_graph
from dataflow.supervision.run import replay


@pytest.fixture
def gapped(kept: Path, tmp_path: Path) -> tuple[Path, str]:
    """A recording that lacks three messages of a source, and the stream that they were on."""
    with Recording(kept) as recording:
        graph = recorded_graph(recording)
        stream = next(
            s
            for s, made in graph.streams.items()
            if graph.nodes[made.node].source and not made.static and s in recording.streams
        )

    def without(found: Recorded) -> Kept:
        return [] if found.stream == stream and found.seq in (10, 11, 15) else as_it_is(found)

    return tampered(kept, tmp_path / "gapped.mcap", messages=without), stream


@pytest.mark.long
def test_a_recording_with_gaps_is_replayed_in_processes_as_in_one(gapped: tuple[Path, str]) -> None:
    path, stream = gapped

    apart = replay(path, placement="process_each")

    assert apart.digests() == replay(path, placement="one_process").digests()
    with Recording(path) as recording:
        assert apart.streams[stream][0] == recording.streams[stream].count
