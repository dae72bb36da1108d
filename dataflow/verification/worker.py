"""A worker: a process that calls one function for its parent, with the environment of operators, and ends.

The function is named by `module:name`; it takes plain values and the `Board` on which it shows how far it is, and
returns plain values. The process ends when its parent does, however that ends.
"""

from __future__ import annotations

import ctypes
import faulthandler
import importlib
import os
import signal
import sys
import threading
import traceback

from dataflow.process.channel import Channel, ChannelClosed
from dataflow.verification.board import Board
from dataflow.verification.errors import WRONG_INPUT
from dataflow.verification.letters import read_letter, write_letter

FAILED = 1
_PR_SET_PDEATHSIG = 1


def main(descriptor: int, letter: int, board: int) -> int:
    """Makes the call that the file `letter` holds, and puts the answer in its place; returns the exit code."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # for a parent that is killed while we hold the GIL
    faulthandler.enable()
    channel = Channel(descriptor)
    threading.Thread(target=_end_with, args=(channel,), name="parent", daemon=True).start()
    fields = read_letter(letter)
    code = 0
    try:
        module, _, name = fields["function"].partition(":")
        function = getattr(importlib.import_module(module), name)
        answer = {"value": function(fields["request"], Board(board, fields["operators"]))}
        kind = "returned"
    except BaseException as error:
        text = "" if isinstance(error, WRONG_INPUT) else "".join(traceback.format_exception(error))
        text = getattr(error, "traceback", None) or text
        summary = str(error) or type(error).__name__
        kind, code = "failed", FAILED
        answer = {"summary": summary, "traceback": text, "operator": getattr(error, "operator", None)}
    write_letter(letter, answer)
    try:
        channel.send(kind)
    except ChannelClosed:
        code = FAILED
    return code


def _end_with(channel: Channel) -> None:
    """Ends this process, and what its operators have started, when the parent is gone: it never says anything more."""
    try:
        while True:
            channel.receive()
    except ChannelClosed:
        os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    exit_code = main(*map(int, sys.argv[1:]))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(exit_code)  # libraries' threads must not be able to hold up the end
