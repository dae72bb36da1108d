"""What every host process does from its first to its last moment. Forked by the nursery."""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
import traceback
from typing import Any

from dataflow.process.channel import Channel, ChannelClosed

LEAVE_WITHIN = 8.0
SUPERVISOR_GONE = 3
FAILED = 1


def _listen(channel: Channel, inbox: queue.SimpleQueue[tuple[Any, ...]]) -> None:
    """Moves control messages to the inbox. When the supervisor is gone, makes sure that this process goes too."""
    try:
        while True:
            kind, fields = channel.receive()
            inbox.put(("control", kind, fields))
    except ChannelClosed:
        inbox.put(("control", "lost", {}))
        time.sleep(LEAVE_WITHIN)
        os._exit(SUPERVISOR_GONE)


def _make(kind: str, config: dict[str, Any], channel: Channel, inbox: queue.SimpleQueue[tuple[Any, ...]]) -> Any:
    if kind == "sink":
        from dataflow.process.sink import SINKS, SinkConfig, SinkHost

        sink = SinkConfig(**config)
        return SinkHost(sink, channel, inbox, SINKS[sink.kind])
    from dataflow.process.config import HostConfig
    from dataflow.process.host import Host

    return Host(HostConfig(**config), channel, inbox)


def _hand_over(host: Any) -> None:
    """Sends the firing records that a host still holds; where that fails too, the first cause is reported."""
    try:
        if host is not None:
            host.hand_over()
    except Exception as error:
        print(f"firing records are lost: {type(error).__name__}: {error}", file=sys.stderr)


def _report(channel: Channel, error: BaseException) -> None:
    """Tells the supervisor what failed, if it is still there."""
    operator = getattr(error, "operator", None)
    text = getattr(error, "traceback", None) or "".join(traceback.format_exception(error))
    summary = getattr(error, "summary", None) or f"{type(error).__name__}: {error}"
    try:
        channel.send("failed", operator=operator, when=getattr(error, "when", ""), summary=summary, traceback=text)
    except ChannelClosed:
        print(text, file=sys.stderr)


def _await_leave(inbox: queue.SimpleQueue[tuple[Any, ...]]) -> str:
    """After a failure: waits (bounded) until the supervisor has dealt with it; returns the outcome it names."""
    deadline = time.monotonic() + LEAVE_WITHIN
    while (left := deadline - time.monotonic()) > 0:
        try:
            item = inbox.get(timeout=left)
        except queue.Empty:
            break
        if item[0] == "control" and item[1] in ("leave", "lost"):
            return str(item[2].get("outcome", "the supervisor is gone"))
    return "the supervisor did not answer"


def main(descriptor: int) -> int:
    """Runs one host to its end; returns the exit code."""
    channel = Channel(descriptor)
    inbox: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
    try:
        kind, config = channel.receive()
    except ChannelClosed:
        return SUPERVISOR_GONE
    threading.Thread(target=_listen, args=(channel, inbox), name="control", daemon=True).start()
    code = 0
    host = None
    try:
        host = _make(kind, config, channel, inbox)
        host.open()
        host.run()
    except ChannelClosed:
        code = SUPERVISOR_GONE
        _hand_over(host)
    except BaseException as error:
        code = FAILED
        _hand_over(host)
        _report(channel, error)
        _await_leave(inbox)
    facts: Any = {}
    try:
        if host is not None:
            facts = host.close() or {}
    except Exception as error:
        code = code or FAILED
        _report(channel, error)
    try:
        channel.send("closed", facts=dict(facts))
    except ChannelClosed:
        code = code or SUPERVISOR_GONE
    return code
