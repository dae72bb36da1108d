"""Text of somebody else reaches a terminal as text only."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.text import visible, visible_json, visible_lines


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
def test_control_characters_are_escaped(text: str, shown: str) -> None:
    assert visible(text) == shown


@given(st.text())
def test_visible_text_is_one_line_and_stays_as_it_is(text: str) -> None:
    shown = visible(text)
    assert visible(shown) == shown
    assert len(shown.splitlines()) <= 1
    assert "\x1b" not in shown


@given(st.text())
def test_printable_text_is_unchanged(text: str) -> None:
    shown = visible_lines(text)
    assert visible_lines(shown) == shown
    assert shown.encode().decode() == shown
    if text.isprintable():
        assert shown == text


@given(st.lists(st.text()))
def test_lines_and_tabs_stay_where_they_are(lines: list[str]) -> None:
    assert visible_lines("\t\n".join(map(visible, lines))) == "\t\n".join(map(visible, lines))
    assert visible_lines("\n".join(lines)).count("\n") == "\n".join(lines).count("\n")


@given(st.dictionaries(st.text(), st.text()))
def test_json_is_visible_and_means_the_same(value: dict[str, str]) -> None:
    shown = visible_json(json.dumps(value, indent=2, ensure_ascii=False))
    assert json.loads(shown) == value
    assert visible_lines(shown) == shown
