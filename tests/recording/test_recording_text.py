"""Text of a recording reaches a terminal as text only."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_recordings import foreign

from dataflow.recording import Recording, RecordingError


def test_errors_quote_a_recording_without_its_control_characters(tmp_path: Path) -> None:
    path = foreign(tmp_path / "a.mcap", ("t/\x1b[2J", "cbor", None, [(1, b"")]))
    with Recording(path) as recording, pytest.raises(RecordingError) as caught:
        list(recording.messages(["t/\x1b[2J"]))
    assert "\x1b" not in str(caught.value)
    assert "\\x1b[2J" in str(caught.value)
