"""Writes what a process logs and prints, line by line with its level, operator and time, to the pipe to its supervisor.

The pipe also carries what libraries outside of Python write there. So a line of ours is marked: a control character
that no text has, then JSON; `heard` reads either.
"""

from __future__ import annotations

import io
import json
import logging
import os
import sys
import threading
import time
from typing import Any, Final, TextIO

from dataflow.execution.failure import OperatorFailure
from dataflow.execution.generators.shared_generators import CALLS_IN_PROGRESS
from dataflow.process.channel import Channel
from dataflow.recording.streams.logs import LogLine

MARK: Final = "\x1e"
LEVEL_VARIABLE: Final = "DATAFLOW_LOG_LEVEL"
"""Environment variable: the least level that operators' loggers hand on; `info` where it is not set."""
LONGEST: Final = 16_384
"""Characters of a line; the rest is left out, and counted."""
SOURCE_THREAD: Final = "source "
"""Prefix of the names of threads that read live sources, before the operator's name."""


def install() -> None:
    """Makes Python's logging, `print` and warnings of this process speak in marked lines."""
    root = logging.getLogger()
    root.handlers[:] = [_Handler()]
    root.setLevel(logging.getLevelNamesMapping().get(os.environ.get(LEVEL_VARIABLE, "").upper(), logging.INFO))
    logging.captureWarnings(True)
    sys.stdout = _Lines(sys.stdout, "info", "stdout")
    sys.stderr = _Lines(sys.stderr, "warning", "stderr")


def log_failure(error: BaseException) -> None:
    """Logs the traceback of a failure that is outlived, as an error of its operator, with file and line."""
    failure = error if isinstance(error, OperatorFailure) else OperatorFailure("", "", error)
    logger = logging.getLogger("dataflow.failure")
    place, about = (failure.file, failure.line), {"operator": failure.operator}
    logger.handle(
        logger.makeRecord(
            logger.name, logging.ERROR, *place, failure.traceback.rstrip() or failure.summary, (), None, "", about
        )
    )


def heard(line: str, process: str, operators: tuple[str, ...]) -> LogLine:
    """A line from the pipe of a process that runs these operators."""
    only = operators[0] if len(operators) == 1 else ""
    if line.startswith(MARK):
        try:
            said = LogLine.from_json(json.loads(line.removeprefix(MARK)))
            known = said.operator if said.operator in operators else ""
            return LogLine(
                said.level, said.text, process, known or only, said.stamp, said.time, said.source, said.file, said.line
            )
        except (ValueError, KeyError, TypeError):
            line = line.removeprefix(MARK)
    return LogLine("info", line, process, only, time=time.time_ns())


def shown(line: LogLine) -> list[str]:
    """The lines for people: what was printed as it is, what was logged with its level from warnings on."""
    printed = line.source in ("", "stdout", "stderr")
    prefix = "" if printed or line.severity < 2 else f"{line.level}: "
    return [f"{prefix}{part}" for part in line.text.split("\n")]


def _whereabouts() -> tuple[str, int | None]:
    """Returns the operator whose call is under way, as far as this thread shows it, and the event time of the call."""
    thread = threading.current_thread()
    if thread.name.startswith(SOURCE_THREAD):
        return thread.name.removeprefix(SOURCE_THREAD), None
    if CALLS_IN_PROGRESS.begun == CALLS_IN_PROGRESS.ended:
        return "", None
    return CALLS_IN_PROGRESS.operator, CALLS_IN_PROGRESS.stamp if CALLS_IN_PROGRESS.stamp > 0 else None


def _say(
    descriptor: int, level: str, text: str, source: str, file: str = "", line: int = 0, *, operator: str = ""
) -> None:
    """Writes a line; of the operator whose call is under way where no other is named."""
    at_work, stamp = _whereabouts()
    more = len(text) - LONGEST
    said = LogLine(
        level,
        f"{text[:LONGEST]}… ({more} characters more)" if more > 0 else text,
        operator=operator or at_work,
        stamp=stamp,
        time=time.time_ns(),
        source=source,
        file=file,
        line=line,
    )
    data = f"{MARK}{json.dumps(said.to_json(), ensure_ascii=True)}\n".encode()
    while data:
        data = data[os.write(descriptor, data) :]


class _Handler(logging.Handler):
    """Speaks for Python's loggers; the lock of the handler keeps the lines of threads apart."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            text = self.format(record)
        except Exception as error:  # arguments that do not fit their text
            text = f"{record.msg} {record.args} (cannot be formatted: {error})"
        severity = ("debug", "info", "warning", "error", "fatal")[min(max(record.levelno // 10 - 1, 0), 4)]
        _say(
            2,
            severity,
            text,
            record.name,
            record.pathname,
            record.lineno,
            operator=str(getattr(record, "operator", "")),
        )


class _Lines(io.TextIOBase):
    """Takes the place of a standard stream: whole lines are said at once, what has no end yet when it is flushed."""

    def __init__(self, stream: TextIO, level: str, source: str) -> None:
        self._descriptor, self._level, self._source = stream.fileno(), level, source
        self.buffer = stream.buffer
        """Bytes that are written to it go into the pipe unmarked."""
        self._rest = ""
        self._lock = threading.RLock()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return "utf-8"

    @property
    def errors(self) -> str:  # type: ignore[override]
        return "backslashreplace"

    def fileno(self) -> int:
        return self._descriptor

    def reconfigure(self, **options: Any) -> None:
        """Lines are said at once and in ASCII whatever the options ask for."""

    def isatty(self) -> bool:
        return False

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        with self._lock:
            *lines, self._rest = (self._rest + text).split("\n")
            for line in lines:
                _say(self._descriptor, self._level, line, self._source)
        return len(text)

    def flush(self) -> None:
        with self._lock:
            rest, self._rest = self._rest, ""
            if rest:
                _say(self._descriptor, self._level, rest, self._source)


def tell_outlived(channel: Channel, failure: OperatorFailure, pause: float) -> None:
    """Logs the traceback of a failure, and reports to the supervisor that the operator is made anew in `pause` s.
    Raises `ChannelClosed`."""
    log_failure(failure)
    channel.send(
        "restarting",
        operator=failure.operator,
        when=failure.when,
        summary=failure.summary,
        where=failure.where,
        traceback=failure.traceback,
        pause=pause,
    )
