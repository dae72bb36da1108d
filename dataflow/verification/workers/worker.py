"""A worker: a process that calls one function for its parent, with the environment of operators, and ends.

The function is named by `module:name`; it takes plain values and the `Board` on which it shows how far it is, and
returns plain values. The process ends when its parent does, however that ends.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import importlib
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from typing import Any

from dataflow.execution.threads import take_over
from dataflow.parent import end_with_parent
from dataflow.process.channel import Channel, ChannelClosed
from dataflow.verification.errors import WRONG_INPUT
from dataflow.verification.workers.board import Board
from dataflow.verification.workers.job_file import read_job_file, write_job_file

FAILED = 1
PRELOAD = "dataflow.verification.workers.job"

Slot = tuple[int, ...]
"""Descriptors that a parent hands down for one worker: its channel, the job file, the board, its output."""


def main(slots: Sequence[Slot]) -> int:
    """Imports what verification needs, and serves one parent's slot; of several, each in a separate process, which
    becomes a child of that parent. Returns the exit code."""
    end_with_parent()  # it may be killed while we hold the GIL
    faulthandler.enable()
    importlib.import_module(PRELOAD)
    gc.freeze()  # modules live as long as the process: collections need not look at them
    if len(slots) == 1:
        return serve(slots[0])
    parent = os.getppid()
    for slot in slots:
        if not os.fork():
            return _serve_apart(slot, slots, parent)
    return 0


def _serve_apart(slot: Slot, slots: Sequence[Slot], parent: int) -> int:
    """Serves in a process that was just forked, in a separate process group, once it is a child of `parent`."""
    os.setpgid(0, 0)
    for descriptor in slot[3:]:
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
    for other in slots:
        for descriptor in other if other is not slot else slot[3:]:
            os.close(descriptor)
    forked_by = os.getppid()
    while os.getppid() == forked_by != parent:
        time.sleep(0.0005)  # it forks the others and ends
    end_with_parent()
    return serve(slot) if os.getppid() == parent else FAILED


def serve(slot: Slot) -> int:
    """Announces that it waits; when it may go, makes the call that the file holds and puts the answer in its place.
    Returns the exit code."""
    descriptor, job_file, board, *_ = slot
    channel = Channel(descriptor)
    try:
        channel.send("waiting", pid=os.getpid())
        while (said := channel.receive())[0] == "import":
            _import(said[1])
    except ChannelClosed:
        return FAILED
    threading.Thread(target=_end_with, args=(channel,), name="parent", daemon=True).start()
    fields = read_job_file(job_file)
    take_over(fields["environment"])
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
    write_job_file(job_file, answer)
    try:
        channel.send(kind)
    except ChannelClosed:
        code = FAILED
    return code


def _import(fields: Mapping[str, Any]) -> None:
    """Imports modules that a call will need; an error in one is reported by the call that needs it."""
    take_over(fields["environment"])
    for module in fields["modules"]:
        with contextlib.suppress(Exception, SystemExit):
            importlib.import_module(module)


def _end_with(channel: Channel) -> None:
    """Ends this process, and what its operators have started, when the parent is gone: it sends nothing more."""
    try:
        while True:
            channel.receive()
    except ChannelClosed:
        os.killpg(0, signal.SIGKILL)


def run(words: Sequence[str]) -> int:
    """Serves the slots that words name; returns the exit code."""
    return main([tuple(map(int, slot.split(","))) for slot in words])


if __name__ == "__main__":
    exit_code = run(sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(exit_code)  # libraries' threads must not be able to hold up the end
