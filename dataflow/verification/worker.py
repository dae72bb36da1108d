"""Calls a function in a process of its own, with the environment that hosts have: thread counts, hash seed.

The function is named by `module:name`; it takes plain values and a `Tell` by which it says how far it is, and returns
plain values. So results are computed as in a host, and an operator that crashes takes nobody with it.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from typing import IO, Any

from dataflow.firing.threads import environment
from dataflow.process.channel import Channel, ChannelClosed, ready
from dataflow.supervision.report import RunFailed

Tell = Callable[[Mapping[str, Any]], None]
"""Says how far the work is; cheap, may be called often."""

TELL_EVERY = 0.2
LEAVE_WITHIN = 10.0
LAST_WORDS = 4000
FAILED = 1


def apart(
    function: str,
    request: Mapping[str, Any],
    *,
    threads: int,
    told: Tell | None = None,
    stall_timeout: float = 120.0,
) -> Any:
    """What the function returns for `request`.

    `stall_timeout`: seconds allowed without a word from it. Raises `RunFailed` when it raises, dies or goes silent.
    """
    channel, descriptor = Channel.pair()
    with tempfile.TemporaryFile() as words:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "dataflow.verification.worker", str(descriptor)],
            pass_fds=(descriptor,),
            env=environment(threads),
            stdin=subprocess.DEVNULL,
            stdout=words,
            stderr=subprocess.STDOUT,
            process_group=0,
        )
        try:
            os.close(descriptor)  # the child has its own; with ours open its death would go unseen
            channel.send("call", function=function, request=dict(request))
            return _await(channel, process, function, words, told, stall_timeout)
        finally:
            channel.close()
            process.kill()
            process.wait(timeout=LEAVE_WITHIN)


def _await(
    channel: Channel,
    process: subprocess.Popen[bytes],
    function: str,
    words: IO[bytes],
    told: Tell | None,
    stall_timeout: float,
) -> Any:
    while True:
        if not ready([channel], stall_timeout):
            raise RunFailed(f"{function}: no progress for {stall_timeout:g} s", _last_words(words))
        try:
            kind, fields = channel.receive()
        except ChannelClosed:
            code = process.wait(timeout=LEAVE_WITHIN)
            raise RunFailed(f"{function}: its process ended with code {code}", _last_words(words)) from None
        match kind:
            case "told":
                if told is not None:
                    told(fields)
            case "failed":
                raise RunFailed(fields["summary"], fields["traceback"], fields["operator"])
            case _:
                return fields["value"]


def _last_words(words: IO[bytes]) -> str:
    size = words.seek(0, 2)
    words.seek(max(0, size - LAST_WORDS))
    return words.read().decode(errors="replace")


def main(descriptor: int) -> int:
    """The process itself: one call."""
    channel = Channel(descriptor)
    due = 0.0

    def tell(fields: Mapping[str, Any]) -> None:
        nonlocal due
        if time.monotonic() >= due:
            due = time.monotonic() + TELL_EVERY
            channel.send("told", **fields)

    try:
        _, fields = channel.receive()
        module, _, name = fields["function"].partition(":")
        value = getattr(importlib.import_module(module), name)(fields["request"], tell)
        channel.send("returned", value=value)
    except ChannelClosed:
        return FAILED
    except Exception as error:
        text = getattr(error, "traceback", None) or "".join(traceback.format_exception(error))
        summary = str(error) or type(error).__name__
        channel.send("failed", summary=summary, traceback=text, operator=getattr(error, "operator", None))
        return FAILED
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
