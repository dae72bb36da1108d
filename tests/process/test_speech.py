"""Lines of processes keep their level, operator and time through the pipe; what others write there stays text."""

from __future__ import annotations

import io
import json
import logging
import os
import threading

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dataflow.execution.failure import OperatorFailure
from dataflow.execution.generators.shared_generators import CALLS_IN_PROGRESS
from dataflow.process.log_pipe import LONGEST, MARK, SOURCE_THREAD, _Handler, _Lines, _say, heard, log_failure, shown
from dataflow.recording.streams.logs import LEVELS, LogLine


def piped(speak) -> list[str]:
    """The lines that arrive when `speak(descriptor)` writes to a pipe."""
    reading, writing = os.pipe()
    try:
        speak(writing)
    finally:
        os.close(writing)
    with open(reading, encoding="utf-8", newline="\n") as file:
        return file.read().split("\n")[:-1]


@given(st.text(max_size=200), st.sampled_from(LEVELS), st.text(max_size=5))
def test_any_text_comes_through_on_one_line(text: str, level: str, source: str) -> None:
    (line,) = piped(lambda descriptor: _say(descriptor, level, text, source))
    said = heard(line, "p", ("a", "b"))
    assert (said.level, said.text, said.process, said.source) == (level, text, "p", source)


@given(st.text(max_size=50).filter(lambda text: "\n" not in text))
def test_line_without_the_log_format_is_plain_text(text: str) -> None:
    assert heard(text, "p", ()).level == "info"
    assert heard(text, "p", ()).text == text.removeprefix(MARK)
    assert heard(MARK + json.dumps(["x"]), "p", ()).text == '["x"]'


def test_line_without_operator_is_attributed_to_the_only_one() -> None:
    assert heard("x", "p", ("camera",)).operator == "camera"
    assert heard("x", "p", ("camera", "lidar")).operator == ""
    forged = MARK + json.dumps(LogLine("info", "x", operator="somebody else").to_json())
    assert heard(forged, "p", ("camera", "lidar")).operator == ""


def test_a_call_under_way_names_its_operator_and_event_time() -> None:
    def speak(descriptor: int) -> None:
        with CALLS_IN_PROGRESS.call("lidar", 7):
            _say(descriptor, "info", "inside", "")
        _say(descriptor, "info", "between", "")
        reader = threading.Thread(target=lambda: _say(descriptor, "info", "x", ""), name=f"{SOURCE_THREAD}camera")
        reader.start()
        reader.join()

    found = [heard(line, "p", ("lidar", "camera")) for line in piped(speak)]
    assert [(line.operator, line.stamp) for line in found] == [("lidar", 7), ("", None), ("camera", None)]


def test_very_long_line_is_cut_with_a_note() -> None:
    (line,) = piped(lambda descriptor: _say(descriptor, "info", "x" * (LONGEST + 5), ""))
    assert heard(line, "p", ()).text.endswith("x… (5 characters more)")


def test_prints_become_whole_lines_and_the_rest_at_a_flush() -> None:
    def speak(descriptor: int) -> None:
        with open(os.dup(descriptor), "w") as stream:
            lines = _Lines(stream, "info", "stdout")
            print("one\ntwo", end="", file=lines)
            print(" and more", file=lines)
            print("rest", end="", file=lines)
            lines.flush()
            lines.flush()
            assert not lines.isatty()
            assert isinstance(lines, io.TextIOBase)

    assert [heard(line, "p", ()).text for line in piped(speak)] == ["one", "two and more", "rest"]


def test_log_record_with_unfit_arguments_is_still_logged(monkeypatch) -> None:
    said: list[str] = []
    monkeypatch.setattr("dataflow.process.log_pipe._say", lambda *fields, operator: said.append(fields[2]))
    _Handler().emit(logging.LogRecord("n", logging.WARNING, "f.py", 3, "%d apples", ("no",), None))
    assert "%d apples" in said[0]
    assert "cannot be formatted" in said[0]


def test_a_failure_that_is_outlived_is_an_error_of_its_operator_with_file_and_line(monkeypatch) -> None:
    def crash() -> None:
        np.linalg.inv(np.zeros((2, 2)))

    written: list[bytes] = []
    monkeypatch.setattr("dataflow.process.log_pipe.os.write", lambda _, data: written.append(bytes(data)) or len(data))
    monkeypatch.setattr(logging.getLogger("dataflow.failure"), "handlers", [_Handler()])
    try:
        crash()
    except np.linalg.LinAlgError as error:
        log_failure(OperatorFailure("crashy", "fire at stamp 5", error))

    said = heard(b"".join(written).decode().rstrip(), "p", ("other", "crashy"))
    assert (said.level, said.operator, said.file) == ("error", "crashy", __file__)
    assert said.line == crash.__code__.co_firstlineno + 1  # not that of NumPy, which raised
    assert said.text.startswith("Traceback (most recent call last):")
    assert said.text.endswith("LinAlgError: Singular matrix")


def test_people_see_levels_of_what_was_logged_and_prints_as_they_are() -> None:
    assert shown(LogLine("error", "a\nb", source="my.module")) == ["error: a", "error: b"]
    assert shown(LogLine("info", "a", source="my.module")) == ["a"]
    assert shown(LogLine("warning", "a", source="stderr")) == ["a"]
