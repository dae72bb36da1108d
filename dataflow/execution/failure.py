"""Failures of an operator, with what a reader needs to find them."""

from __future__ import annotations

import traceback
from pathlib import Path
from types import TracebackType

from dataflow.extras import INSTALL, missing_extra

RAISED = BaseException
"""The errors that an operator may raise: it has no right to end its process, whatever it derives its errors from."""
RESTORE = "restore()"
"""The call in which an operator fails that is given a state of another version of its class."""
MOST_OF_A_TRACEBACK = 20_000
"""Characters of a traceback that are kept."""
_ENGINE = Path(__file__).parent.parent


class OperatorFailure(RuntimeError):
    """An operator raised or broke its contract.

    Carries its name, the firing, the error as it is recorded (`summary`) and with the extra that brings a missing
    package (`told`), the operator's own traceback ("" where the error's text is all there is to know), and the file
    and line of its code that raised ("" and 0 where none did).
    """

    def __init__(self, operator: str, when: str, error: BaseException) -> None:
        self.operator, self.when = operator, when
        self.summary = readable(error)
        hint = "" if INSTALL in self.summary else missing_extra(error)
        self.told = "; ".join(filter(None, (self.summary, hint)))
        self.file, self.line = place_of(error.__traceback__)
        if tells_all(error) and not self.file:
            self.traceback = ""
        else:
            self.traceback = _traceback(error, self.summary)
        super().__init__(f"operator {operator!r} failed in {when}: {self.told}")

    @property
    def where(self) -> str:
        """Returns such as "crashy.py:12"; "" where no code of an operator raised."""
        return f"{Path(self.file).name}:{self.line}" if self.file else ""


def tells_all(error: BaseException) -> bool:
    """Returns whether an error's text is all there is to know, where no code of an operator raised it: the engine's
    own lines say nothing about a program that ended, or about messages that do not fit."""
    return bool(getattr(error, "tells_all", False))


def _traceback(error: BaseException, summary: str) -> str:
    try:
        return cut(_printable("".join(traceback.format_exception(error))), MOST_OF_A_TRACEBACK)
    except Exception:  # its own text cannot be made
        return "".join(traceback.format_tb(error.__traceback__)) + summary


def place_of(trace: TracebackType | None) -> tuple[str, int]:
    """Returns file and line of the innermost call of a traceback that lies in the operator's own folder: the line to
    look at, rather than one of a library. "" and 0 where only the engine was at work."""
    calls = [(Path(frame.f_code.co_filename), line) for frame, line in traceback.walk_tb(trace)]
    outside = [(path, line) for path, line in calls if _ENGINE not in path.parents]
    own = [(path, line) for path, line in outside if path.parent == outside[0][0].parent]
    return (str(own[-1][0]), own[-1][1]) if own else ("", 0)


class InputMutated(RuntimeError):
    """An operator changed the memory of a message it was given."""

    def __init__(self, operator: str, what: str) -> None:
        super().__init__(f"{operator} changed the memory of {what}; messages are immutable: copy before writing")


class TooManyTicks(RuntimeError):
    """The stamps of an operator's inputs jump so far ahead that its timer would fire for hours, or for ever."""


def readable(error: BaseException) -> str:
    """The type and text of an error, whatever it is made of."""
    text = text_of(error)
    return cut(f"{type(error).__name__}: {text}" if text else type(error).__name__)


def text_of(error: BaseException) -> str:
    """The text of an error, whatever it is made of."""
    try:
        return _printable(str(error))
    except Exception as problem:
        return f"(its text cannot be made: {type(problem).__name__})"


def cut(text: str, most: int = 2000) -> str:
    """The beginning and the end of a text that is longer than `most` characters, with a note of what is left out."""
    if len(text) <= most:
        return text
    return f"{text[: most // 2]} [... {len(text) - most // 2 * 2} characters left out ...] {text[-(most // 2) :]}"


def _printable(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()
