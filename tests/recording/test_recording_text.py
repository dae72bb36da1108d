"""Text of a recording reaches a terminal as text only."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer

from dataflow.recording import Recording, RecordingError, visible


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain/stream", "plain/stream"),
        ("Küche 3 ☃ 部屋", "Küche 3 ☃ 部屋"),
        ("\x1b[2J\x1b]0;owned\x07", "\\x1b[2J\\x1b]0;owned\\x07"),
        ("one\nline\ttwo\r\x7f", "one\\nline\\ttwo\\r\\x7f"),
        ("\x9b31m", "\\x9b31m"),  # a control sequence in one character
        ("a\u202eb\u2028c", "a\\u202eb\\u2028c"),  # right to left, line separator
        ("\ud800", "\\ud800"),
    ],
)
def test_what_a_terminal_would_obey_is_escaped(text: str, shown: str) -> None:
    assert visible(text) == shown


@given(st.text())
def test_visible_text_is_one_line_and_stays_as_it_is(text: str) -> None:
    shown = visible(text)
    assert visible(shown) == shown
    assert len(shown.splitlines()) <= 1
    assert "\x1b" not in shown


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
