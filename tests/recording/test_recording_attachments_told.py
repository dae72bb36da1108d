"""describe tells which files lie inside a recording."""

from __future__ import annotations

from pathlib import Path

from dataflow.recording import Recording, RecordingWriter, describe
from dataflow.recording.attachments import Attachment


def test_a_description_lists_attachments(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, metadata={"note": {"robot": "kitchen"}}) as writer:
        writer.add_attachment(Attachment("map.png", "image/png", 7, 5, b"1234"))
    with Recording(path) as recording:
        told = describe(recording).as_json()
    assert [dict(a) for a in told["attachments"]] == [
        {"name": "map.png", "media_type": "image/png", "bytes": 4, "log_time": 7, "created": 5}
    ]
    assert told["metadata"]["note"] == {"robot": "kitchen"}
