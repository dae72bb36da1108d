"""Leads a process of a running graph from its first to its last moment. Forked by the nursery."""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import threading
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dataflow.execution.failure import MOST_OF_A_TRACEBACK, cut
from dataflow.messages.fields.memory import make_large_arrays_in
from dataflow.process.awake_clock import LOOK_EVERY, AwakeClock
from dataflow.process.channel import Channel, ChannelClosed
from dataflow.process.descriptors import Descriptors, take_descriptors
from dataflow.process.log_pipe import log_failure
from dataflow.process.streams.inbox import Inbox

if TYPE_CHECKING:
    from dataflow.graph.model import Graph
    from dataflow.sinks.sink import SinkConfig, StreamSink

LEAVE_WITHIN = 8.0
SUPERVISOR_GONE = 3
FAILED = 1
SWITCH_INTERVAL = 0.0005
"""Seconds that a thread may compute in Python before another gets its turn: Zenoh's threads must not wait long."""


def _listen(channel: Channel, inbox: Inbox) -> None:
    """Moves control messages to the inbox. When the supervisor is gone, makes sure that this process goes too."""
    try:
        while True:
            kind, fields = channel.receive()
            inbox.put(("control", kind, fields))
    except ChannelClosed:
        inbox.put(("control", "lost", {}))
        AwakeClock().sleep(LEAVE_WITHIN)
        os._exit(SUPERVISOR_GONE)


def _make(kind: str, config: dict[str, Any], channel: Channel, inbox: Inbox, handed: Descriptors) -> Any:
    """Makes the process that the supervisor asks for: "operators" runs operators, "sink" takes whole streams."""
    if kind == "sink":
        from dataflow.sinks.sink import LiveSinkProcess, SinkConfig, SinkProcess

        sink = SinkConfig(**config)
        make_sink = _recorder if sink.kind == "record" else _viewer_file
        return (LiveSinkProcess if sink.live else SinkProcess)(sink, channel, inbox, make_sink)
    if kind == "link":
        from dataflow.machines.hub import Hub, HubConfig

        return Hub(HubConfig(**config), channel, inbox, handed.outgoing)
    from dataflow.process.config import ProcessConfig
    from dataflow.process.operator_process import OperatorProcess

    process = OperatorProcess(ProcessConfig(**config), channel, inbox, handed.outgoing, box=handed.box)
    make_large_arrays_in(process.outlet.room)
    return process


def _recorder(config: SinkConfig, graph: Graph) -> StreamSink:
    """The sink that writes an MCAP recording; options: `path` (or `flight`: a folder), `metadata`,
    `compression`, `overwrite`, `storage`."""
    from dataflow.recording.parts import Storage
    from dataflow.sinks.freed_memory import keep_freed_memory

    keep_freed_memory()
    options = {**config.options, "storage": Storage.from_json(config.options["storage"])}
    if "flight" in options:
        from dataflow.sinks.flight_recorder import FlightSink

        return FlightSink(Path(options["flight"]), graph, config.streams, options)
    from dataflow.sinks.parts import PartsSink

    return PartsSink(Path(options["path"]), graph, config.streams, options, life=config.life)


def _viewer_file(config: SinkConfig, graph: Graph) -> StreamSink:
    """The sink that writes a viewer file; options: `path`, `storage`."""
    from dataflow.recording.parts import Storage
    from dataflow.sinks.viewer_file import ViewerFileSink

    os.umask(0o666 & ~Storage.from_json(config.options["storage"]).mode)  # the viewer's library opens the file

    return ViewerFileSink(config.options["path"], graph, config.streams)


def show_name(label: str) -> None:
    """Gives this process the name that ps, top and htop show: the first 15 bytes of its label, as Linux allows."""
    with contextlib.suppress(OSError):  # no /proc here: it keeps the name of the interpreter
        Path("/proc/self/comm").write_bytes(label.encode()[:15])


def _hand_over(process: Any) -> None:
    """Sends the firing records that a process still holds; where that fails too, the first cause is reported."""
    try:
        if process is not None:
            process.hand_over()
    except Exception as error:
        print(f"firing records are lost: {type(error).__name__}: {error}", file=sys.stderr)


def _report(channel: Channel, error: BaseException, phase: str) -> None:
    """Reports to the supervisor what failed, and in which phase of this process, if it is still there."""
    operator = getattr(error, "operator", None)
    own: str | None = getattr(error, "traceback", None)
    text = cut("".join(traceback.format_exception(error)) if own is None else own, MOST_OF_A_TRACEBACK)
    summary = cut(getattr(error, "told", None) or f"{type(error).__name__}: {error}")
    when, where = getattr(error, "when", ""), getattr(error, "where", "")
    try:
        channel.send("failed", operator=operator, when=when, phase=phase, summary=summary, where=where, traceback=text)
    except ChannelClosed:
        print(text, file=sys.stderr)


def await_leave(inbox: Inbox) -> bool:
    """After a failure: waits (bounded) until the supervisor has dealt with it; True when this process is to be started
    again."""
    clock = AwakeClock()
    deadline = clock() + LEAVE_WITHIN
    while (left := deadline - clock()) > 0:
        try:
            item = inbox.get(timeout=min(left, LOOK_EVERY))
        except queue.Empty:
            continue  # something else has woken it, or the time is up
        if item[0] == "control" and item[1] in ("leave", "lost"):
            return bool(item[2].get("again"))
    return False


def main(descriptor: int, handed: Sequence[int]) -> int:
    """Runs one process to its end; returns the exit code.

    `descriptor` is its end of the control channel, `handed` what it inherits besides (`take_descriptors`).
    """
    for each in handed:
        os.set_inheritable(each, False)  # operators' own processes get none of it
    channel = Channel(descriptor)
    try:
        kind, config = channel.receive()
    except ChannelClosed:
        return SUPERVISOR_GONE
    show_name(config["label"])
    given = take_descriptors(handed, config)
    inbox = Inbox(given.wake, given.incoming)
    sys.setswitchinterval(SWITCH_INTERVAL)
    threading.Thread(target=_listen, args=(channel, inbox), name="control", daemon=True).start()
    code, process, phase = 0, None, "starting"
    try:
        process = _make(kind, config, channel, inbox, given)
        process.open()
        phase = "running"
        process.run()
    except ChannelClosed:
        code = SUPERVISOR_GONE
        _hand_over(process)
    except BaseException as error:
        code = FAILED
        _hand_over(process)
        _report(channel, error, phase)
        if await_leave(inbox):  # else the end of the run reports it
            log_failure(error)
    facts: Any = {}
    try:
        if process is not None:
            facts = process.close() or {}
    except Exception as error:
        code = code or FAILED
        _report(channel, error, "closing")
    try:
        channel.send("closed", facts=dict(facts))
    except ChannelClosed:
        code = code or SUPERVISOR_GONE
    return code
