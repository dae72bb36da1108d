"""What arrives on a process's keys, and what of it reaches the operators."""

from __future__ import annotations

import os

import pytest
from process_doubles import STREAM, RecordedChannel, end, frontier, message

from dataflow.process.streams.inlet import Inlet
from dataflow.process.streams.losses import StreamDamaged, losses_of
from dataflow.process.throttled_warnings import ThrottledWarnings
from dataflow.sync import FOREVER
from dataflow.transport import Envelope, Kind, encode


class Inflow:
    """An inlet, and what came out of it."""

    def __init__(self, *, live: bool = True, static: tuple[str, ...] = (), from_start: bool = False) -> None:
        self.delivered: list[tuple[Kind, int]] = []
        self.printed: list[str] = []
        self.channel = RecordedChannel()
        self.now = 0.0
        self.inlet = Inlet(
            self.channel,
            lambda stream, envelope: self.delivered.append((envelope.kind, envelope.seq)),
            static=static,
            losses=losses_of("taker", self.channel, live=live),
            from_start=from_start,
            complaints=ThrottledWarnings(lambda: self.now, lambda line: self.printed.append(line) is None),
        )

    def take(self, *envelopes: Envelope) -> None:
        for envelope in envelopes:
            self.inlet.take(STREAM, encode(envelope))


@pytest.mark.parametrize("live", [True, False])
@pytest.mark.parametrize(
    "strange",
    [
        frontier(0, FOREVER),  # the end of time
        frontier(1, FOREVER),  # the same at the place that is due
        frontier(0, FOREVER - 1),  # far ahead, at a place that is past
        end(0, 5),  # below its promise
        message(0, 1000),  # once more
        Envelope(Kind.FRONTIER, "test/other/y", 0, 1, 2000),  # of another stream
    ],
)
def test_contradicting_envelope_is_ignored_and_counted(strange: Envelope, live: bool) -> None:
    inflow = Inflow(live=live)

    inflow.take(message(0), strange, message(1), message(2))

    assert inflow.delivered == [(Kind.MESSAGE, 0), (Kind.MESSAGE, 1), (Kind.MESSAGE, 2)]
    assert (inflow.inlet.received, inflow.inlet.misplaced, inflow.inlet.malformed) == (3, 1, 0)
    assert not inflow.channel.of("gap")
    (line,) = inflow.printed
    assert STREAM in line


def test_a_gap_is_an_event_in_a_live_run_and_a_failure_in_any_other() -> None:
    live = Inflow()
    live.take(message(0), message(3), message(4))

    assert live.channel.of("gap") == [{"stream": STREAM, "first": 1, "following": 3}]
    assert [seq for _, seq in live.delivered] == [0, 3, 4]
    with pytest.raises(StreamDamaged, match=r"'test/left/fast' lost messages .* 'taker': number 1 was due, 3 came"):
        Inflow(live=False).take(message(0), message(3), message(4))


def test_the_loss_of_the_last_messages_is_noticed_too() -> None:
    with pytest.raises(StreamDamaged, match="number 1 was due, 3 came"):
        Inflow(live=False).take(message(0), frontier(3, 1020), end(3, 1020))


def test_messages_lost_before_the_first_are_a_gap_for_a_consumer_from_the_start() -> None:
    lossy, late = Inflow(from_start=True), Inflow()

    for inflow in (lossy, late):
        inflow.take(message(4), message(5))
        assert inflow.delivered == [(Kind.MESSAGE, 4), (Kind.MESSAGE, 5)]

    assert lossy.channel.of("gap") == [{"stream": STREAM, "first": 0, "following": 4}]
    assert not late.channel.of("gap")


def test_a_stream_that_goes_back_fails_a_run_that_is_not_live() -> None:
    with pytest.raises(StreamDamaged, match="went back to incarnation 0"):
        Inflow(live=False).take(message(0, incarnation=1), message(1, incarnation=0))


def test_garbage_is_counted_and_complained_about_once_in_a_while() -> None:
    inflow = Inflow()

    for _ in range(2000):
        inflow.inlet.take(STREAM, os.urandom(50))
    inflow.now = 60.0
    inflow.inlet.take(STREAM, b"garbage")

    assert inflow.inlet.malformed == 2001
    assert len(inflow.printed) == 2
    assert "(1999 more like it before)" in inflow.printed[1]


def test_unread_warnings_are_counted_instead_of_waited_for() -> None:
    read: list[str] = []
    reading = False
    complaints = ThrottledWarnings(lambda: 0.0, lambda line: reading and read.append(line) is None)

    complaints.say("left", "first")
    complaints.say("left", "second")
    reading = True
    complaints.say("left", "third")

    assert read == ["third (2 more like it before)"]


def test_a_static_stream_without_a_message_ends() -> None:
    """As that of a sensor which is off."""
    inflow = Inflow(static=(STREAM,))

    inflow.take(end(0, -1))

    assert inflow.delivered == [(Kind.END, 0)]
    assert not inflow.inlet.statics_missing([STREAM])


def test_a_static_stream_is_taken_once_and_its_end_only_after_it() -> None:
    inflow = Inflow(static=(STREAM,))

    inflow.take(end(1, 5), message(0), end(1, 1000), message(0, incarnation=1))

    assert inflow.delivered == [(Kind.MESSAGE, 0), (Kind.END, 1)]
    assert (inflow.inlet.received, inflow.inlet.misplaced) == (3, 1)
    assert not inflow.inlet.statics_missing([STREAM])


def test_probe_is_reported_once_until_its_process_was_restarted() -> None:
    inflow = Inflow()
    probe = Envelope(Kind.PROBE, STREAM, 0, 1, 0)

    inflow.take(probe, probe)
    inflow.inlet.restarted([STREAM])
    inflow.take(probe)

    assert inflow.channel.of("seen") == [{"stream": STREAM}] * 2
    assert inflow.inlet.received == 0
