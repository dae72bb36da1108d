"""The control channel: the supervisor waits for nobody, a process waits for the supervisor."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from dataflow.process.channel import Channel, ChannelClosed, QueuedChannel
from dataflow.process.polling import readable

READS = """
import sys
from dataflow.process.channel import Channel, ChannelClosed
channel = Channel(int(sys.argv[1]))
try:
    while True:
        kind, fields = channel.receive()
        if kind == "covered":
            last = fields["frontier"]
        if kind == "end":
            channel.send("last", frontier=last)
except ChannelClosed:
    pass
"""


@pytest.fixture
def stopped() -> Iterator[tuple[QueuedChannel, subprocess.Popen[bytes]]]:
    """A process that reads its channel, stopped by a signal."""
    channel = QueuedChannel(most=1 << 20)
    process = subprocess.Popen([sys.executable, "-c", READS, str(channel.theirs)], pass_fds=(channel.theirs,))
    os.close(channel.theirs)
    process.send_signal(signal.SIGSTOP)
    os.waitpid(process.pid, os.WUNTRACED)
    yield channel, process
    channel.close()
    process.kill()
    process.wait()


def answer(channel: QueuedChannel) -> tuple[str, dict[str, object]]:
    """Sends what is queued as it is taken, until an answer comes."""
    while True:
        channel.flush()
        select.select([channel], [channel] if channel.waiting else [], [], 10)
        for message in channel.receive():
            return message


def test_stopped_process_blocks_no_sender_and_reads_the_latest_message(
    stopped: tuple[QueuedChannel, subprocess.Popen[bytes]],
) -> None:
    channel, process = stopped

    for frontier in range(5000):  # the socket takes a few hundred
        channel.send("covered", {"frontier": frontier}, replaces=True)
        channel.flush()
    assert channel.waiting <= 2
    assert not channel.overflowed
    assert not channel.flush()
    channel.send("end", {})
    process.send_signal(signal.SIGCONT)

    assert answer(channel) == ("last", {"frontier": 4999})


def test_queue_of_irreplaceable_messages_is_bounded(stopped: tuple[QueuedChannel, subprocess.Popen[bytes]]) -> None:
    channel, _ = stopped

    for _ in range(50):
        channel.send("records", {"batches": [bytes(100_000)]})
        channel.flush()

    assert channel.overflowed
    assert channel.queued < 1.2 * (1 << 20)


def test_replacing_message_keeps_the_latest_value_only() -> None:
    channel = QueuedChannel()
    process = Channel(channel.theirs)
    channel.send("covered", {"frontier": 1}, replaces=True)
    channel.send("stop", {})
    channel.send("covered", {"frontier": 2}, replaces=True)
    assert channel.flush()

    assert process.receive() == ("covered", {"frontier": 2})
    assert process.receive() == ("stop", {})
    process.send("ended", report={"streams": {"a": [1, "b"]}})
    assert readable([process], 0) == []
    assert list(channel.receive()) == [("ended", {"report": {"streams": {"a": [1, "b"]}}})]
    assert list(channel.receive()) == []


def test_large_messages_arrive_whole_and_in_order() -> None:
    channel = QueuedChannel()
    child = os.fork()
    if not child:
        channel.close()
        process = Channel(channel.theirs)
        with contextlib.suppress(ChannelClosed):
            while True:
                kind, fields = process.receive()
                process.send(kind, **fields)
        os._exit(0)
    os.close(channel.theirs)
    sent = [{"data": bytes([k]) * (k * 200_000)} for k in range(5)]
    for fields in sent:
        channel.send("record", fields)

    found: list[dict[str, object]] = []
    while len(found) < len(sent):
        channel.flush()
        select.select([channel], [channel] if channel.waiting else [], [], 10)
        found += [fields for _, fields in channel.receive()]
    channel.close()
    os.waitpid(child, 0)

    assert found == sent


def test_the_end_is_read_after_the_last_words() -> None:
    channel = QueuedChannel()
    process = Channel(channel.theirs)
    process.send("closed", facts={})
    process.close()

    assert list(channel.receive()) == [("closed", {"facts": {}})]
    with pytest.raises(ChannelClosed):
        list(channel.receive())
    channel.send("leave", {})
    with pytest.raises(ChannelClosed):
        channel.flush()
    channel.close()
