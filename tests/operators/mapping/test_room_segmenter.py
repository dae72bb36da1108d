"""RoomSegmenter on made floor plans whose rooms and doors are known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from operator_runs import assert_resumes_alike

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import OccupancyGrid, Rooms
from dataflow.testing import play
from operators.mapping import RoomSegmenter

SIDE = 0.05
SECOND = 1_000_000_000
Rectangle = tuple[float, float, float, float]
"""x and y of the least corner, and of the greatest, metres."""


class FloorPlan:
    """A plan with its least corner at `corner`: walls 0.1 m thick around rooms, 0 free, 100 taken, -1 unknown."""

    def __init__(self, width: float, height: float, corner: tuple[float, float] = (0.0, 0.0)) -> None:
        self.corner = corner
        self.cells = np.full((round(height / SIDE), round(width / SIDE)), -1, np.int8)

    def fill(self, rectangle: Rectangle, value: int) -> FloorPlan:
        x0, y0, x1, y1 = (round((v - self.corner[k % 2]) / SIDE) for k, v in enumerate(rectangle))
        self.cells[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = value
        return self

    def rooms(self, *rectangles: Rectangle) -> FloorPlan:
        for x0, y0, x1, y1 in rectangles:
            self.fill((x0 - 0.1, y0 - 0.1, x1 + 0.1, y1 + 0.1), 100)
        for rectangle in rectangles:
            self.fill(rectangle, 0)
        return self

    def at(self, seconds: float, **more: Any) -> OccupancyGrid:
        return OccupancyGrid(
            stamp=1 + round(seconds * SECOND), resolution=SIDE, cells=self.cells,
            **{"frame": "map", "position": [*self.corner, 0.0]} | more,
        )  # fmt: skip


LEFT, RIGHT, HALL = (0.5, 2.0, 4.5, 6.0), (4.6, 2.0, 9.0, 6.0), (0.5, 0.7, 9.0, 1.9)


def flat() -> FloorPlan:
    """Two rooms along a corridor 1.2 m wide, each with a door of 0.8 m to it, and one of 0.7 m between them."""
    plan = FloorPlan(9.5, 6.5).rooms(LEFT, RIGHT, HALL)
    plan.fill((1.5, 1.9, 2.3, 2.0), 0).fill((7.0, 1.9, 7.8, 2.0), 0)
    return plan.fill((4.5, 4.0, 4.6, 4.7), 0)


def segmented(maps: Sequence[OccupancyGrid], **params: Any) -> list[Rooms]:
    found = play(RoomSegmenter(**params), {"map": maps})["rooms"]
    return [m for m in found if isinstance(m, Rooms)]


def only(plan: FloorPlan, **params: Any) -> Rooms:
    (found,) = segmented([plan.at(0)], **params)
    return found


def at(rooms: Rooms, x: float, y: float) -> int:
    """The id of the room at a place, 0 for none."""
    column, row = np.floor((np.array([x, y]) - rooms.position[:2]) / rooms.resolution).astype(int)
    k = int(rooms.cells[row, column])
    return 0 if k < 0 else int(rooms.ids[k])


def joined(rooms: Rooms) -> dict[tuple[int, int], tuple[float, float, float]]:
    """Place and width of each door, by the ids of the two rooms."""
    pairs = [(int(a), int(b)) for a, b in rooms.ids[rooms.doors]]
    places = np.column_stack([rooms.door_positions[:, :2], rooms.door_widths]).tolist()
    return {pair: (place[0], place[1], place[2]) for pair, place in zip(pairs, places, strict=True)}


def test_rooms_are_split_at_doors_with_position_and_width() -> None:
    rooms = only(flat())
    left, right, hall = at(rooms, 2.5, 4), at(rooms, 7, 4), at(rooms, 5, 1.3)
    assert sorted((left, right, hall)) == rooms.ids.tolist() == [1, 2, 3]
    areas = dict(zip(rooms.ids.tolist(), rooms.areas.tolist(), strict=True))
    for id, (x0, y0, x1, y1) in ((left, LEFT), (right, RIGHT), (hall, HALL)):
        assert areas[id] == pytest.approx((x1 - x0) * (y1 - y0), rel=0.02)
    doors = joined(rooms)
    wanted = {(left, hall): (1.9, 1.95, 0.8), (right, hall): (7.4, 1.95, 0.8), (left, right): (4.55, 4.35, 0.7)}
    assert doors.keys() == {tuple(sorted(pair)) for pair in wanted}
    for pair, place in wanted.items():
        np.testing.assert_allclose(doors[min(pair), max(pair)], place, atol=0.08)


def test_the_centre_of_a_room_is_farthest_from_its_walls() -> None:
    rooms = only(flat())
    np.testing.assert_allclose(rooms.centers[rooms.ids == at(rooms, 2.5, 4)][0], [2.5, 4.0, 0.0], atol=0.1)


def test_unknown_space_is_no_wall() -> None:
    """The shadow of a table across a room, and floor that was not seen yet, part nothing."""
    plan = FloorPlan(9.5, 6.5).rooms((0.5, 0.5, 9.0, 6.0))
    plan.fill((0.5, 3.0, 7.0, 3.6), -1).fill((5.0, 0.5, 5.6, 2.5), -1)
    assert only(plan).ids.tolist() == [1]
    half_seen = FloorPlan(9.5, 6.5).rooms((0.5, 0.5, 9.0, 6.0)).fill((0.4, 3.2, 6.0, 6.1), -1)
    assert only(half_seen).count == 1


def test_a_wide_opening_is_no_door_nor_is_a_gap_too_narrow_to_pass() -> None:
    two = FloorPlan(9.5, 6.5).rooms(LEFT, RIGHT)
    assert only(two.fill((4.5, 3.0, 4.6, 4.6), 0)).count == 1  # 1.6 m
    narrow = only(FloorPlan(9.5, 6.5).rooms(LEFT, RIGHT).fill((4.5, 3.0, 4.6, 3.3), 0))  # 0.3 m
    assert (narrow.count, len(narrow.doors)) == (2, 0)


def test_two_doors_between_the_same_rooms_are_two() -> None:
    plan = FloorPlan(9.5, 6.5).rooms(LEFT, RIGHT).fill((4.5, 2.5, 4.6, 3.3), 0).fill((4.5, 4.8, 4.6, 5.7), 0)
    rooms = only(plan)
    assert rooms.doors.tolist() == [[0, 1], [0, 1]]
    np.testing.assert_allclose(np.sort(rooms.door_positions[:, 1]), [2.9, 5.25], atol=0.06)


def test_free_standing_objects_are_no_walls() -> None:
    """Chairs in the middle leave passages as narrow as doors."""
    plan = FloorPlan(4.5, 6.5).rooms((0.5, 0.5, 3.5, 6.0))
    for x in (0.9, 1.8, 2.7):
        plan.fill((x, 3.0, x + 0.4, 3.4), 100)
    assert only(plan).count == 1
    assert only(plan).areas[0] == pytest.approx(3.0 * 5.5, rel=0.02)
    assert only(plan, island=0.0).areas[0] < 3.0 * 5.5 - 0.4


def test_a_niche_is_part_of_its_room_and_a_patch_seen_through_a_window_is_no_room() -> None:
    plan = FloorPlan(9.5, 6.5).rooms(LEFT, (4.6, 3.0, 5.6, 4.0)).fill((4.5, 3.1, 4.6, 3.8), 0)
    plan.fill((7.0, 1.0, 8.0, 2.0), 0)
    rooms = only(plan)
    assert rooms.ids.tolist() == [1]
    assert at(rooms, 5.2, 3.5) == 1
    assert at(rooms, 7.5, 1.5) == 0


def test_rooms_keep_their_ids_while_the_map_grows() -> None:
    """At first only the right room was seen; then the map grows to the left and down."""
    first = FloorPlan(5.0, 4.5, corner=(4.5, 1.9)).rooms(RIGHT)
    before, after = segmented([first.at(0), flat().at(3)])
    assert before.ids.tolist() == [1]
    assert at(after, 7, 4) == 1
    assert {at(after, 2.5, 4), at(after, 5, 1.3)} == {2, 3}


def test_merged_rooms_keep_the_id_of_the_larger_and_retire_the_other() -> None:
    one = FloorPlan(9.5, 6.5).rooms((0.5, 0.7, 9.0, 6.0))
    before, after, again = segmented([flat().at(0), one.at(3), flat().at(6)])
    assert after.ids.tolist() == [at(before, 7, 4)]
    assert max(before.ids) < max(again.ids)
    assert len({*before.ids.tolist(), *again.ids.tolist()}) == 5


def test_maps_that_come_soon_after_another_are_passed_over() -> None:
    assert len(segmented([flat().at(0.5 * k) for k in range(9)])) == 3


def test_a_turned_map_gives_doors_in_its_frame() -> None:
    quarter = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
    (rooms,) = segmented([flat().at(0, position=[10.0, 0.0, 0.2], orientation=quarter)])
    straight = only(flat())
    turned = np.column_stack([10 - straight.door_positions[:, 1], straight.door_positions[:, 0], np.full(3, 0.2)])
    np.testing.assert_allclose(rooms.door_positions, turned, atol=1e-9)


@pytest.mark.parametrize("cells", [np.zeros((0, 0)), np.full((40, 40), -1), np.full((40, 40), 100)])
def test_a_map_without_free_floor_has_no_rooms_and_is_warned_of(cells: np.ndarray) -> None:
    grid = OccupancyGrid(stamp=1, frame="map", resolution=SIDE, cells=cells.astype(np.int8), position=[0, 0, 0])
    played = play(RoomSegmenter(), {"map": [grid]})
    (rooms,), (status,) = played["rooms"], played["status"]
    assert rooms.count == 0
    assert (status.levels.tolist(), status.messages) == ([1], ("the map has no room: no free floor is known",))


def test_a_narrowest_door_above_the_widest_is_refused() -> None:
    with pytest.raises(OperatorFailure, match=r"narrowest 1\.5 m must be below widest 1\.2 m"):
        only(flat(), narrowest=1.5)


def test_restored_operator_resumes_alike() -> None:
    maps = [FloorPlan(5.0, 4.5, corner=(4.5, 1.9)).rooms(RIGHT).at(0), flat().at(3), flat().at(6)]
    assert_resumes_alike(RoomSegmenter, [(each,) for each in maps], 1)


@pytest.mark.parametrize("clear", [0.7, 0.83, 1.0])
def test_door_width_is_unbiased_by_the_grid(clear: float) -> None:
    """A cell is taken where a jamb lies in it: in the mean over places the width is neither too small nor too large."""
    widths = []
    for start in np.arange(1.5, 1.5 + SIDE, SIDE / 10):
        plan = flat()
        plan.fill((LEFT[0], 1.9, LEFT[2], 2.0), 100)
        first, last = int(np.floor(start / SIDE + 1e-9)) + 1, int(np.floor((start + clear) / SIDE + 1e-9))
        plan.cells[38:40, first:last] = 0
        (rooms,) = segmented([plan.at(0.0)])
        away = np.abs(rooms.door_positions[:, :2] - [start + clear / 2, 1.95]).sum(axis=1)
        door = int(np.argmin(away))
        widths.append(float(rooms.door_widths[door]))
    assert abs(np.mean(widths) - clear) < 0.01
