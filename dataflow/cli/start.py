"""The console script: makes the standard streams and signals safe, then loads the commands and calls one.

Next to nothing else is imported here, so that Ctrl-C and a closed output are met in order from the first moment.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from types import FrameType

from dataflow.cli.support import command_line
from dataflow.cli.support.standard_output import Output, OutputFailed

COULD_NOT_RUN = 2
INTERRUPTED = 130
COLLECT_AFTER = 20_000
"""Objects made between two searches for garbage: modules make many that stay, and 700 would cost a tenth of a start."""


def main() -> None:
    """Runs the command line of this process."""
    command_line.words = sys.argv[1:]
    interrupted = signal.getsignal(signal.SIGINT)
    if interrupted is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)  # while importing there is nothing to put in order
    _occupy_standard_streams()
    gc.set_threshold(COLLECT_AFTER)
    from dataflow.cli.app import call

    signal.signal(signal.SIGINT, interrupted)
    try:
        call()
    except KeyboardInterrupt:
        _end(INTERRUPTED)
    except SystemExit as ended:
        _end(ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1)
    except OutputFailed as error:
        _say_unwritable(error)
        _end(COULD_NOT_RUN)
    else:
        _end(0)


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)


def _occupy_standard_streams() -> None:
    """Refuses a closed standard output; gives the others something to read from and to write to.

    A file that is opened while one of the three is closed takes its place, and what is printed lands in that file.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            if descriptor == 1:
                if sys.stderr is not None:
                    print("error: standard output is closed; > /dev/null discards it", file=sys.stderr)
                sys.exit(COULD_NOT_RUN)
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
    sys.stderr.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    encoding = sys.stdout.encoding
    sys.stdout = Output(
        sys.stdout.detach(),  # type: ignore[union-attr]
        encoding,
        errors="backslashreplace",
        line_buffering=os.isatty(1),
    )


def _end(code: int) -> None:
    """Ends the process after flushing its output; reports output that could not be written, with a non-zero code."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        _discard_output()
        code = code or 1
    except OutputFailed as error:
        _say_unwritable(error)
        code = code or COULD_NOT_RUN
    sys.exit(code)


def _say_unwritable(error: OutputFailed) -> None:
    _discard_output()
    print(f"error: standard output cannot be written: {error.strerror}", file=sys.stderr)


def _discard_output() -> None:
    """Keeps the interpreter from trying again at its end what could not be written."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.close(null)
    sys.stdout.flush()


if __name__ == "__main__":
    main()
