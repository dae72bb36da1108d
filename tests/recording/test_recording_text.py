"""Text of a recording reaches a terminal as text only."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.writer import Writer

from dataflow.recording import Recording, RecordingError


def test_errors_quote_a_recording_without_its_control_characters(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("t/\x1b[2J", "cbor", 0)
        writer.add_message(channel, log_time=1, publish_time=1, data=b"")
        writer.finish()
    with Recording(path) as recording, pytest.raises(RecordingError) as caught:
        list(recording.messages(["t/\x1b[2J"]))
    assert "\x1b" not in str(caught.value)
    assert "\\x1b[2J" in str(caught.value)
