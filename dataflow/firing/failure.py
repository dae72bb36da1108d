"""Failures of an operator, with what a reader needs to find them."""

from __future__ import annotations

import traceback

RAISED = (Exception, SystemExit, KeyboardInterrupt)
"""What an operator may raise."""


class OperatorFailure(RuntimeError):
    """An operator raised or broke its contract. Carries its name, the firing and the operator's own traceback."""

    def __init__(self, operator: str, when: str, error: BaseException) -> None:
        self.operator, self.when = operator, when
        self.summary = readable(error)
        try:
            self.traceback = _printable("".join(traceback.format_exception(error)))
        except Exception:  # its own text cannot be made
            self.traceback = "".join(traceback.format_tb(error.__traceback__)) + self.summary
        super().__init__(f"operator {operator!r} failed in {when}: {self.summary}")


class InputMutated(RuntimeError):
    """An operator changed the memory of a message it was given."""


class TooManyTicks(RuntimeError):
    """The stamps of an operator's inputs jump so far ahead that its timer would fire for hours, or for ever."""


def readable(error: BaseException) -> str:
    """The type and text of an error, whatever it is made of."""
    try:
        text = str(error)
    except Exception as problem:
        text = f"(its text cannot be made: {type(problem).__name__})"
    return _printable(f"{type(error).__name__}: {text}" if text else type(error).__name__)


def _printable(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()
