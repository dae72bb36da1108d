"""Runs of an operator that every estimator must bear, interrupted or with a repeated calibration; and their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.messages import Message
from dataflow.messages.geometry import invert
from dataflow.operator import Context, Operator
from dataflow.testing import Played, play
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.odometry.tracking import TrackResult

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
        sent = _digests(one, given, k)
        assert k < at or _digests(other, given, k) == sent
    assert pack_state(one.snapshot()) == pack_state(other.snapshot())
    assert one.summary() == other.summary()
    return one


def _digests(operator: Operator, given: tuple[Any, ...], seed: int) -> dict[str, str]:
    operator.seed_rng(seed)  # as a run does before every firing
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


def texts(played: Played) -> list[str]:
    """Returns the first text of every status."""
    return [status.messages[0] for status in played["status"]]


def largest_errors(results: Sequence[TrackResult], truth: Sequence[Matrix]) -> tuple[float, float]:
    """Returns the largest error of position (m) and rotation (rad), without alignment."""
    x = np.array([se3.log(invert(T) @ r.T_world_camera) for r, T in zip(results, truth, strict=True)])
    return float(np.linalg.norm(x[:, :3], axis=1).max()), float(np.linalg.norm(x[:, 3:], axis=1).max())


def errors_in_map(poses: Sequence[Any], truth: Sequence[Matrix], origin: Matrix) -> NDArray[np.float64]:
    """Returns distances (m) of poses in a map from the truth, where the map's origin is known; no alignment."""
    pairs = zip(poses, truth, strict=True)
    return np.array([np.linalg.norm((origin @ pose.matrix())[:3, 3] - T[:3, 3]) for pose, T in pairs])
