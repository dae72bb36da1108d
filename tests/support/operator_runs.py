"""Runs of an operator that every estimator must bear: interrupted, and with a calibration that is repeated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pytest

from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.messages import Message
from dataflow.operator import Context, Operator
from dataflow.testing import play

Streams = Mapping[str, Sequence[Any]]


def assert_resumes_alike(make: Callable[[], Any], firings: Sequence[tuple[Any, ...]], at: int) -> Any:
    """Fires one operator, and from a firing on another that was restored from its snapshot: equal bytes throughout."""
    one, other = make(), make()
    for operator in (one, other):
        operator.setup()
    other.restore(unpack_state(pack_state(one.snapshot())))  # of no firing
    for k, given in enumerate(firings):
        if k == at:
            recorded = pack_state(one.snapshot())
            other.restore(unpack_state(recorded))
            assert pack_state(other.snapshot()) == recorded
        sent = _digests(one, given)
        assert k < at or _digests(other, given) == sent
    assert pack_state(one.snapshot()) == pack_state(other.snapshot())
    assert one.summary() == other.summary()
    return one


def _digests(operator: Operator, given: tuple[Any, ...]) -> dict[str, str]:
    sent = operator.process(*given) or {}
    return {port: message.digest().hex() for port, message in sent.items() if message is not None}


def firings_of(streams: Streams, *sampled: Message) -> list[tuple[Any, ...]]:
    """Returns the firings of a merging operator with one input of many streams, in order of time."""
    rows: dict[int, dict[str, Message]] = {}
    for name, messages in streams.items():
        for message in messages:
            rows.setdefault(message.stamp, {})[f"ns/{name}"] = message
    return [(given, Context(stamp), *sampled) for stamp, given in sorted(rows.items())]


def assert_one_calibration(
    make: Callable[[], Operator], streams: Streams, static: Sequence[str], by: str, other: Message, at: int
) -> None:
    """A calibration may come with every message of `by`; another, for the last of `static`, is refused."""
    stamps = [message.stamp for message in streams[by]]
    each = {**streams} | {name: [streams[name][0].replace(stamp=stamp) for stamp in stamps] for name in static}
    assert play(make(), each).digests() == play(make(), streams, static=static).digests()
    each[static[-1]][at] = other.replace(stamp=stamps[at])
    with pytest.raises(Exception, match="the calibration changed"):
        play(make(), each)
