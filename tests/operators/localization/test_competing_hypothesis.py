"""Another place that explains as much: found, followed, decided, and said before a pose is believed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from made_room import CELL, Drive, mounts

from dataflow.messages import OccupancyGrid
from dataflow.state import StateError
from dataflow.testing import Played, play
from operators.localization import ParticleFilterLocalizer
from operators.localization.competing_hypothesis import CompetingHypothesis, apart


def hall(*, notch: bool = False) -> OccupancyGrid:
    """A hall of 8 by 6 m that looks the same from the other end; a notch makes the ends differ."""
    rows, columns = np.mgrid[0:128, 0:168]
    x, y = columns * CELL - 4.2, rows * CELL - 3.2
    inside = (np.abs(x) < 4) & (np.abs(y) < 3)
    inside &= ~((np.abs(x) > 2.6) & (np.abs(y) > 2.2)) & ~((np.abs(x) < 0.3) & (np.abs(y) < 0.2))
    if notch:
        inside &= ~((x > 1.8) & (y > 1.2))
    cells = np.where(inside, 0, 100).astype(np.int8)
    return OccupancyGrid(stamp=0, frame="world", resolution=CELL, cells=cells, position=[-4.2, -3.2, 0.0])


class HallDrive(Drive):
    """A loop around the middle of the hall."""

    def __init__(self, seconds: float, *, notch: bool = False, seed: int = 0) -> None:
        super().__init__(seconds, seed)
        self.grid = hall(notch=notch)

    def pose(self, t: float) -> np.ndarray:
        a = 0.35 * t + 0.4
        return np.array([2.0 * math.cos(a), 1.4 * math.sin(a), math.atan2(1.4 * math.cos(a), -2.0 * math.sin(a))])


def localized(drive: Drive, sensors: dict[str, Any], **params: Any) -> tuple[Played, ParticleFilterLocalizer]:
    operator = ParticleFilterLocalizer(modality_particles=0, **params)
    streams = {"odometry": drive.odometry(), "measurements": sensors, "map": [drive.grid], "extrinsics": [mounts()]}
    return play(operator, streams, static=("map", "extrinsics"), paranoid=False), operator


def off(drive: Drive, played: Played) -> list[float]:
    return [float(np.hypot(*(p.position[:2] - drive.pose(p.stamp * 1e-9)[:2]))) for p in played["pose"]]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2, 3))])
def test_symmetric_hall_is_ambiguous_and_both_places_are_named(seed: int) -> None:
    drive = HallDrive(5.0, seed=seed)
    played, operator = localized(drive, {"scan": drive.scans()})
    assert not played["pose"]
    assert operator.summary()["poses ambiguous"] > 80
    last = played["status"][-1]
    assert last.messages[0] == "ambiguous: another place explains as much"
    other = np.array([float(word) for word in dict(last.pairs(0))["other place"].split()])
    true = drive.pose(last.stamp * 1e-9)
    both = [true, [-true[0], -true[1], true[2] + math.pi]]
    assert min(float(np.hypot(*(other[:2] - place[:2]))) for place in both) < 0.2


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_asymmetry_resolves_the_ambiguous_hall(seed: int) -> None:
    drive = HallDrive(5.0, notch=True, seed=seed)
    played, _ = localized(drive, {"scan": drive.scans()})
    assert len(played["pose"]) > 50
    assert max(off(drive, played)) < 0.15


@pytest.mark.long
def test_a_known_start_or_a_position_decides() -> None:
    drive = HallDrive(4.0)
    known, _ = localized(drive, {"scan": drive.scans()}, start=tuple(drive.pose(0.05).tolist()))
    assert len(known["pose"]) > 70
    placed, _ = localized(drive, {"scan": drive.scans(), "place": drive.positions()})
    for played in (known, placed):
        assert len(played["pose"]) > 50
        assert max(off(drive, played)) < 0.2


def test_competing_hypothesis_is_restored_from_a_snapshot() -> None:
    drive = HallDrive(2.0)
    _, operator = localized(drive, {"scan": drive.scans()})
    rival = operator.state.fused.competing
    other = CompetingHypothesis()
    other.restore(rival.snapshot())
    assert other.mean is not None
    np.testing.assert_array_equal(other.mean, rival.mean)
    assert (other.lead, other.decided) == (rival.lead, False)
    with pytest.raises(StateError, match="the state of CompetingHypothesis has no _expected"):
        other.restore({})


class TwoPlaces:
    """An observation that two places explain: one with a logarithm of likelihood of 0, the other with `gain`."""

    whole = True
    here, there = np.zeros(3), np.array([6.0, 0.0, math.pi])

    def __init__(self, gain: float) -> None:
        self.gain = gain

    def score(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        off = np.linalg.norm(poses[:, None, :2] - np.array([self.here, self.there])[None, :, :2], axis=2)
        logarithms = np.where(off[:, 0] < off[:, 1], 0.0, self.gain) - 0.5 * (off.min(axis=1) / 0.3) ** 2
        return logarithms, np.exp(np.minimum(logarithms, 0.0))

    def misfit(self, pose: np.ndarray, covariance: np.ndarray) -> float:
        return 1.0

    def propose(self, count: int, rng: np.random.Generator) -> np.ndarray:
        return np.tile([self.here, self.there], (count // 2, 1))


@pytest.mark.parametrize(("gain", "doubtful", "within"), [(9.0, False, 12), (9.0, True, 3), (1.0, False, None)])
def test_a_decided_pose_is_in_question_again_where_another_place_explains_more(
    gain: float, doubtful: bool, within: int | None
) -> None:
    competing, rng = CompetingHypothesis(), np.random.default_rng(0)
    competing.settle()
    taken, better = 0, None
    while better is None and taken < 30:
        better = competing.update(TwoPlaces.here, 0.0, TwoPlaces(gain), 1.0, doubtful, rng)
        taken += 1
    if within is None:
        assert better is None
        assert competing.decided
    else:
        assert taken <= within
        np.testing.assert_allclose(better[:, :2].mean(axis=0), TwoPlaces.there[:2], atol=0.2)


class EverNewPlaces(TwoPlaces):
    """An observation that explains a new place at every search, a little worse than the pose."""

    searches = 0

    def propose(self, count: int, rng: np.random.Generator) -> np.ndarray:
        self.searches += 1
        return np.tile([5.0 * self.searches, 0.0, 0.0], (count, 1))

    def score(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full(len(poses), -4.0), np.full(len(poses), 0.5)


def test_places_that_were_decided_against_are_remembered_in_bounded_number() -> None:
    competing, rng, observation = CompetingHypothesis(), np.random.default_rng(0), EverNewPlaces(0.0)
    for _ in range(150):
        competing.update(TwoPlaces.here, 0.0, observation, 1.0, False, rng)
    refuted = competing.snapshot()["_refuted"]
    assert observation.searches > 30
    assert len(refuted) <= 16
    assert refuted[-1, 0] > 5.0 * (observation.searches - 3), "the last ones"


def test_places_are_apart_by_way_or_turn() -> None:
    here = np.array([1.0, 2.0, 3.1])
    assert not apart(here, np.array([1.3, 2.3, -3.1]))
    assert apart(here, np.array([2.5, 2.0, 3.1]))
    assert apart(here, np.array([1.0, 2.0, 2.4]))
