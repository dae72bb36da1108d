"""A recording that ends before its run did, wherever that is: what is in it is verified, and it is said to be cut."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace

import pytest
from mcap.opcode import Opcode

from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.layout import CUT, RESERVED_METADATA
from dataflow.recording.streams.cutting import Cut
from dataflow.records.firing import encode_batch
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.verification.verify import _span, verify

pytestmark = pytest.mark.usefixtures("in_process")

CHUNK = 3000
OPCODE_AND_LENGTH = 9


def in_chunks(path: Path, out: Path) -> Path:
    """Writes a copy as a slow run is recorded: in many chunks, everything at its stamp, records one by one."""
    with Recording(path) as recording:
        kept = {n: dict(v) for n, v in recording.metadata.items() if n not in RESERVED_METADATA}
        namespace = recording.metadata["recording"]["namespace"]
        with RecordingWriter(out, metadata=kept, namespace=namespace, chunk_bytes=CHUNK) as writer:
            for name, info in recording.streams.items():
                assert info.message_type is not None
                extra = {key: info.metadata[key] for key in ("operator", "port") if key in info.metadata}
                writer.add_stream(name, info.message_type, static=info.static, extra=extra)
            log = FiringLog.read(recording)
            made = ((record.stamp, name, record) for name in log.operators for record in log.of(name))
            records = sorted(made, key=lambda each: each[0])
            at = 0
            for found in recording.messages():
                while at < len(records) and records[at][0] <= found.message.stamp:
                    _, name, record = records[at]
                    writer.write_firings(name, max(record.stamp, 1), encode_batch([record]))
                    at += 1
                writer.write(found.stream, found.message, seq=found.seq, incarnation=found.incarnation)
            for _, name, record in records[at:]:
                writer.write_firings(name, max(record.stamp, 1), encode_batch([record]))
    return out


def chunk_ends(path: Path) -> list[int]:
    """The places in a file at which a chunk has ended."""
    data, at, ends = path.read_bytes(), 8, []
    while at < len(data) - 8:
        opcode, length = data[at], int.from_bytes(data[at + 1 : at + OPCODE_AND_LENGTH], "little")
        at += OPCODE_AND_LENGTH + length
        if opcode == Opcode.CHUNK:
            ends.append(at)
    return ends


@pytest.mark.long
def test_a_recording_torn_at_any_chunk_is_cut_and_else_as_it_was(kept: Path, tmp_path: Path) -> None:
    whole = in_chunks(kept, tmp_path / "whole.mcap")
    assert verify(whole).identical
    ends, data = chunk_ends(whole), whole.read_bytes()
    assert len(ends) > 10
    said = []
    for end in (ends[0], *ends[-8:]):
        torn = tmp_path / "torn.mcap"
        torn.write_bytes(data[:end])
        try:
            report = verify(torn)
        except ReplayError:
            continue
        assert report.torn
        assert not any(v.first for v in report.operators)
        assert report.identical != report.cut, [v.to_wire() for v in report.operators]
        said.append(report.cut)

    assert said[0]
    assert [cut for cut, _ in itertools.groupby(said)] in ([True], [True, False])  # whole up to its index at the last


def test_a_part_that_has_no_message_has_nothing_to_verify() -> None:
    part = SimpleNamespace(path=Path("kept.mcap"), streams={}, metadata={CUT: Cut("run", 5, None).metadata()})

    with pytest.raises(ReplayError, match=r"kept\.mcap: it has no message from the stamp 5 on"):
        _span(part, None)
