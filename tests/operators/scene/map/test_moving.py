"""Whether vehicles move, by scans of a made street: the centre of what is seen of one says little."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.execution.snapshots import pack_state, unpack_state
from operators.scene.map.map_object import MapObject
from operators.scene.map.moving import RecentPlaces
from operators.scene.map.range_view import RangeView
from operators.scene.map.voxels import VoxelSet

Array = NDArray[np.float64]
Block = tuple[Sequence[float], Sequence[float]]
"""Centre and full size of a block along the axes."""
TENTH, SIDE = 100_000_000, 0.1
HOUSE: Block = ((45, 0, 2), (1, 60, 6))
TRUCK: Block = ((0, -4, 1), (9, 2.4, 3.2))


def scanned(blocks: Sequence[Block], eye: Array) -> tuple[Array, NDArray[np.int64]]:
    """Returns the nearest returns (N, 3) of a scanner that looks all around, and the block (N,) that each is of."""
    around, rise = np.meshgrid(np.radians(np.arange(-180, 180, 0.5)), np.radians(np.arange(-16, 4, 1.0)))
    ways = np.stack([np.cos(rise) * np.cos(around), np.cos(rise) * np.sin(around), np.sin(rise)], -1).reshape(-1, 3)
    best, of = np.full(len(ways), np.inf), np.full(len(ways), -1)
    for k, (center, size) in enumerate(blocks):
        low, high = np.array(center) - np.array(size) / 2, np.array(center) + np.array(size) / 2
        with np.errstate(divide="ignore"):
            a, b = (low - eye) / ways, (high - eye) / ways
        enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        hit = (enter < leave) & (enter > 0) & (enter < best)
        best[hit], of[hit] = enter[hit], k
    there = np.isfinite(best)
    return eye + ways[there] * best[there, None], of[there]


def judged(
    place: Callable[[float], Block], speed: float, ahead: float, again: int | None = None, house: Block = HOUSE
) -> MapObject:
    """Returns a vehicle as it is after two seconds, scanned ten times a second from a car that drives at a speed.

    Only what lies `ahead` of the scanner by its x is seen of it, as in a camera's image. `again`: the scan at which a
    snapshot takes the place of what was kept.
    """
    recent, vehicle = RecentPlaces(0.1), None
    for k in range(21):
        eye = np.array([speed * k / 10, 0.0, 1.7])
        points, of = scanned([house, place(k / 10)], eye)
        view = RangeView(points - eye, np.block([[np.eye(3), eye[:, None]], [np.zeros(3), 1.0]]), 0.012)
        voxels = VoxelSet.of(points[(of == 1) & (points[:, 0] > eye[0] + ahead)], SIDE)
        if vehicle is None:
            vehicle = MapObject(7, voxels, np.array([1.0]), 1.0, 0, 0)
        vehicle.voxels, vehicle.center = voxels, voxels.middle
        recent.judge(k * TENTH, [vehicle], view)
        if k == again:
            kept, recent = recent.snapshot(), RecentPlaces(0.1)
            recent.restore(kept)
    assert vehicle is not None
    return vehicle


def beside(x: float) -> Block:
    return ((x, 3, 1), (4.5, 1.8, 1.5))


def test_a_car_that_is_driven_past_stands_though_the_part_in_sight_moves() -> None:
    at_first, later = (scanned([HOUSE, beside(8)], np.array([x, 0, 1.7])) for x in (0.0, 5.0))
    seen = [points[(of == 1) & (points[:, 0] > 3 + x)] for (points, of), x in ((at_first, 0), (later, 5))]
    assert seen[1][:, 0].mean() - seen[0][:, 0].mean() > 0.5  # the middle of what is seen moves
    assert judged(lambda t: beside(8), 2.5, 3).moving < 0.4


@pytest.mark.parametrize("own", [0.0, 2.5])
def test_a_car_in_front_that_drives_is_seen_to(own: float) -> None:
    assert judged(lambda t: ((9 + 2.5 * t, 0, 1), (4.5, 1.8, 1.5)), own, 0).moving > 0.9


def test_overtaking_truck_with_uniform_side_is_moving() -> None:
    def place(t: float) -> Block:
        return ((4 + 6 * t, *TRUCK[0][1:]), TRUCK[1])

    assert judged(place, 2.0, 2).moving > 0.6
    assert judged(lambda t: place(0), 2.0, 2).moving < 0.4


def test_motion_is_open_at_the_first_view_and_a_restored_memory_goes_on() -> None:
    eye = np.array([0.0, 0.0, 1.7])
    points, of = scanned([HOUSE, beside(8)], eye)
    vehicle = MapObject(7, VoxelSet.of(points[of == 1], SIDE), np.array([1.0]), 1.0, 0, 0)
    assert np.isnan(vehicle.moving)
    RecentPlaces(0.1).judge(0, [vehicle], RangeView(points - eye, np.eye(4), 0.012))
    assert vehicle.moving == 0.5
    assert judged(lambda t: beside(8 + t), 2.0, 0).moving == judged(lambda t: beside(8 + t), 2.0, 0, again=9).moving


def test_voxels_that_are_added_later_are_of_no_moment_before() -> None:
    eye = np.array([0.0, 0.0, 1.7])
    points, of = scanned([HOUSE, beside(8)], eye)
    vehicle = MapObject(7, VoxelSet.of(points[of == 1], SIDE), np.array([1.0]), 1.0, 0, 0)
    recent = RecentPlaces(0.1)
    view = RangeView(points - eye, np.block([[np.eye(3), eye[:, None]], [np.zeros(3), 1.0]]), 0.012)
    recent.judge(0, [vehicle], view)
    restored = RecentPlaces(0.1)
    restored.restore(unpack_state(pack_state(recent.snapshot())))
    vehicle.voxels.add(VoxelSet.of(points[of == 1] - [0, 6, 0], SIDE))
    vehicle.voxels = VoxelSet.of(points[of == 1], SIDE)
    again = replace(vehicle)
    recent.judge(6 * TENTH, [vehicle], view)
    restored.judge(6 * TENTH, [again], view)
    assert vehicle.moving == again.moving


def test_motion_of_a_car_of_few_voxels_is_that_of_its_centre() -> None:
    far = ((200, 0, 10), (1, 400, 30))
    car = judged(lambda t: ((90 + 10 * t, 3, 1), (4.5, 1.8, 1.5)), 0, 0, house=far)
    assert 0 < len(car.voxels) < 5
    assert np.isnan(car.moving)


def test_knowledge_of_a_car_outlasts_an_empty_view() -> None:
    recent, voxels = RecentPlaces(0.1), VoxelSet.of(np.array([[8.0, 3, 1]]), SIDE)
    car = MapObject(7, voxels, np.array([1.0]), 1.0, 0, 0)
    empty = RangeView(np.zeros((0, 3)), np.eye(4), 0.012)
    recent.judge(0, [car], empty)
    car.moving = 0.04
    kept = [recent.judge((6 + k) * TENTH, [car], empty) or car.moving for k in range(5)]
    assert kept[:2] == [0.27, 0.385]
    assert np.isnan(kept[-1])


def test_whether_a_car_that_was_hidden_moves_is_open() -> None:
    eye, T = np.array([0.0, 0.0, 1.7]), np.block([[np.eye(3), np.array([[0.0], [0.0], [1.7]])], [np.zeros(3), 1.0]])
    wall: Block = ((8, 2, 1.5), (0.5, 6, 3))
    before, _ = scanned([HOUSE, beside(20), wall], eye)
    now, of = scanned([HOUSE, beside(20)], eye)
    car, other = (MapObject(i, VoxelSet.of(now[of == 1], SIDE), np.array([1.0]), 1.0, 0, 0) for i in (7, 8))
    recent = RecentPlaces(0.1)
    recent.judge(0, [other], RangeView(before - eye, T, 0.012))
    recent.judge(6 * TENTH, [car], RangeView(now - eye, T, 0.012))
    assert car.moving == 0.5
