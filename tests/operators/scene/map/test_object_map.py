"""ObjectMap on observations made by hand: what is one thing, and what are two."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.labels import SizePrior
from operators.scene.map.class_priors import ClassPriors
from operators.scene.map.cuboid import ImageView, image_boxes
from operators.scene.map.map_object import MapObject
from operators.scene.map.matching import MapSettings, Observation
from operators.scene.map.merging import merge
from operators.scene.map.object_map import ObjectMap
from operators.scene.map.range_view import RangeView

BOX, MUG, BALL = 0, 1, 2
SECOND = 1_000_000_000
BALL_SIZE = {BALL: (SizePrior((0.12, 0.12, 0.12), (0.4, 0.4, 0.4), True),)}
PERSON = SizePrior((0.5, 0.59, 1.6), (0.2, 0.2, 0.2), foot=1.0)
K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
WALL = np.stack(np.meshgrid([4.0], np.linspace(-2, 2, 120), np.linspace(-1, 2, 112)), axis=-1).reshape(-1, 3)
Solid = tuple[Sequence[float], Sequence[float]]
"""Centre and full size of a box along the axes."""


def looking(y: float) -> NDArray[np.float64]:
    """The pose of a camera at the origin, moved sideways, that looks along x."""
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = [0, y, 0.2]
    return T


def surface(solid: Solid) -> NDArray[np.float64]:
    """Points on the side that faces the camera."""
    center, size = np.array(solid[0]), np.array(solid[1])
    grid = np.stack(np.meshgrid(np.linspace(-0.45, 0.45, 7), np.linspace(-0.45, 0.45, 7)), axis=-1).reshape(-1, 2)
    return np.asarray(center + np.column_stack([np.full(len(grid), -0.5), grid]) * size)


def observation(solid: Solid, class_id: int, T: NDArray[np.float64]) -> Observation:
    P = K @ invert(T)[:3]
    box = image_boxes(np.array([[*solid[0], *solid[1], 0.0]]), P, np.array([False]))[0]
    return Observation(surface(solid), class_id, 0.8, None, ImageView(P, box, np.ones(4, np.bool_), T[:3, 3]))


def after(scenes: Sequence[Sequence[tuple[Solid, int]]], tracks: Sequence[int] = ()) -> ObjectMap:
    """The map after views of things, each said to be of a class and perhaps a track, a quarter of a second apart."""
    known = ObjectMap(3, ClassPriors([BALL], BALL_SIZE), MapSettings())
    for k, scene in enumerate(scenes):
        T = looking(0.4 * np.sin(k))
        hidden = np.zeros(len(WALL), np.bool_)
        way = WALL - T[:3, 3]
        for solid, _ in scene:
            center, size = np.array(solid[0]), np.array(solid[1])
            at = T[:3, 3] + way * ((center[0] - T[0, 3]) / way[:, :1])
            hidden |= (np.abs(at - center)[:, 1:] < size[1:] / 2).all(axis=1)
        points = np.concatenate([WALL[~hidden], *(surface(solid) for solid, _ in scene)])
        seen = [observation(solid, class_id, T) for solid, class_id in scene]
        seen = [replace(each, track=track) for each, track in zip(seen, tracks or [-1] * len(seen), strict=True)]
        in_sensor = (points - T[:3, 3]) @ T[:3, :3]
        known.update((k + 1) * SECOND // 4, seen, RangeView(in_sensor, T, 0.012))
    return known


THING: Solid = ((2.0, 0.0, 0.1), (0.12, 0.12, 0.12))
BESIDE: Solid = ((2.0, 0.13, 0.1), THING[1])
NOTHING = RangeView(np.zeros((0, 3)), looking(0.0), 0.012)


def only(known: ObjectMap) -> MapObject:
    (object,) = known.confirmed()
    return object


def mapping(sizes: Mapping[int, Sequence[SizePrior]] = {}, **roles: Sequence[int]) -> ObjectMap:
    """An empty map of three classes with usual sizes, and `movers`, `carriers`, `portable` among them."""
    return ObjectMap(3, ClassPriors(**{"movers": [], "usual": sizes} | roles), MapSettings())


def watched(
    known: ObjectMap, views: Iterable[tuple[NDArray[np.float64], Sequence[Observation]]], *, behind: bool = False
) -> ObjectMap:
    """The map after views, a quarter of a second apart, that show things and, where asked, a wall behind them."""
    for T, seen in views:
        points = np.concatenate([WALL, *(each.points for each in seen)]) if behind else np.zeros((0, 3))
        stamp = SECOND // 4 + (known.snapshot()["stamp"] or 0)
        known.update(stamp, seen, RangeView((points - T[:3, 3]) @ T[:3, :3], T, 0.012))
    return known


def around(solid: Solid, class_id: int, count: int, score: float = 0.8) -> list[tuple[NDArray[np.float64], Any]]:
    """Views of a thing from changing places."""
    places = [looking(0.4 * np.sin(k)) for k in range(count)]
    return [(T, [replace(observation(solid, class_id, T), score=score)]) for T in places]


def test_a_thing_that_is_called_by_turns_a_mover_and_not_is_one_object() -> None:
    scenes = [[(THING, BALL if k % 3 == 0 else MUG)] for k in range(12)]
    object = only(after(scenes))
    assert object.class_id == MUG
    assert object.views == 12


@pytest.mark.parametrize(
    ("prior", "bottom", "height", "reaches_down"),
    [
        (PERSON, 0.3, 0.8, True),  # whose feet are hidden
        (PERSON, 1.2, 0.8, False),
        (SizePrior((0.5, 0.5, 0.8), (0.3, 0.3, 0.3), foot=0.2), -0.28, 0.8, True),
        (SizePrior((0.5, 0.5, 0.8), (0.3, 0.3, 0.3)), -0.28, 0.8, False),  # of a class that does not stand there
    ],
)
def test_object_near_the_floor_is_extended_down_to_it(
    prior: SizePrior, bottom: float, height: float, reaches_down: bool
) -> None:
    known = mapping({BOX: (prior,)}, movers=[BOX] if prior is PERSON else [])
    known.floor = -0.4
    watched(known, around(((2.5, 0.0, bottom + height / 2), (0.5, 0.5, height)), BOX, 6))
    center, box, _ = only(known).box
    assert float(center[2] + box[2] / 2) == pytest.approx(bottom + height, abs=0.1)
    assert (abs(float(center[2] - box[2] / 2) + 0.4) < 1e-9) == reaches_down


@pytest.mark.parametrize("along", [0.0, 0.4])
def test_a_person_whom_the_image_cuts_off_keeps_the_size_and_goes_on(along: float) -> None:
    views, T = [], looking(0.0)
    for k in range(6):
        cut = k >= 3  # the image ends at the chest
        low, high = -0.4, 0.4 if cut else 1.0
        seen = observation(((2.0, along * k / 5, (low + high) / 2), (0.5, 0.5, high - low)), BOX, T)
        views.append((T, [replace(seen, image=replace(seen.image, edges=np.array([True, not cut, True, True])))]))
    center, size, _ = only(watched(mapping({BOX: (replace(PERSON, foot=0.0),)}, movers=[BOX]), views)).box
    assert [size[2], *center[1:]] == pytest.approx([1.4, along, 0.3], abs=0.15)


def test_part_never_seen_beside_its_whole_is_no_separate_object() -> None:
    """The foot of a thing, detected as something else where its top is hidden."""
    foot: Solid = ((2.0, 0.0, 0.07), (0.12, 0.12, 0.06))
    scenes: list[list[tuple[Solid, int]]] = [[(THING, BOX)]] * 6 + [[(foot, MUG)]] * 4 + [[(THING, BOX)]] * 2
    assert only(after(scenes)).class_id == BOX


@pytest.mark.parametrize("gap", [0.0, 0.03])
def test_neighbours_that_are_seen_beside_each_other_are_two(gap: float) -> None:
    beside: Solid = ((2.0, 0.12 + gap, 0.1), THING[1])
    assert len(after([[(THING, BOX), (beside, MUG)]] * 8).confirmed()) == 2


@pytest.mark.parametrize(("track", "id"), [(3, 1), (4, 2), (9, 1), (-1, 1)], ids=["first", "second", "new", "none"])
def test_of_two_things_that_a_view_may_show_it_is_the_one_of_its_track(track: int, id: int) -> None:
    behind: Solid = ((2.22, 0.0, 0.1), THING[1])
    known = after([[(THING, MUG), (behind, MUG)]] * 6, tracks=[3, 4])
    T = looking(0.0)
    between = replace(observation(((2.1, 0.0, 0.1), THING[1]), MUG, T), track=track)
    assert known.update(2 * SECOND, [between], RangeView((between.points - T[:3, 3]) @ T[:3, :3], T, 0.012)) == [id]
    assert track in (-1, known.objects[id].tracks[-1])


def test_a_merged_object_has_the_tracks_of_both_and_the_last_ones_are_kept() -> None:
    first, second = (after([[(THING, MUG)]] * 3, tracks=[track]).objects[1] for track in (5, 8))
    first.follow(range(10, 30))
    second.seen += 1
    both = merge(first, second, ClassPriors([], {}))
    assert both.tracks == [*range(15, 30), 8]
    assert MapObject.restored(both.snapshot(), 0.03).tracks == both.tracks


def test_ball_at_rest_is_remembered_and_one_that_is_moved_keeps_its_id() -> None:
    assert only(after([[(THING, BALL)]] * 6 + [[]] * 2)).id == 1
    moved = [[(((2.0, 0.08 * k, 0.1), THING[1]), BALL)] for k in range(1, 9)]
    object = only(after([[(THING, BALL)]] * 6 + moved))
    assert object.id == 1
    assert abs(object.center[1] - 0.64) < 0.1


def test_background_that_shows_through_a_small_thing_is_not_taken_for_a_large_one() -> None:
    small, large = SizePrior((0.12, 0.12, 0.2), (0.3, 0.3, 0.2)), SizePrior((0.4, 0.45, 0.9), (0.3, 0.3, 0.2))
    plant: Solid = ((2.0, 0.0, 0.1), (0.12, 0.12, 0.2))
    behind = surface(plant)[::4] + np.array([0.6, 0.0, 0.0])
    views = [(T, [replace(seen, points=np.concatenate([seen.points, behind]))]) for T, (seen,) in around(plant, BOX, 6)]
    assert only(watched(mapping({BOX: (small, large)}), views)).size.max() < 0.3


def held(places: Sequence[Sequence[float]], *, portable: bool = True, behind: bool = True) -> list[MapObject]:
    """The mugs of the map after one stood beside a person, then was at other places, with the person or without."""
    mug = SizePrior((0.1, 0.1, 0.1), (0.2, 0.2, 0.2), True)
    roles = {"movers": [BOX], "carriers": [BOX], "portable": [MUG] if portable else []}
    known = mapping({BOX: (SizePrior((0.4, 0.5, 1.6), (0.2, 0.2, 0.2), foot=1.0),), MUG: (mug,)}, **roles)
    T = looking(0.0)
    person = observation(((2.0, 0.0, 0.4), (0.4, 0.5, 1.6)), BOX, T)
    mugs = [observation((place, (0.1, 0.1, 0.1)), MUG, T) for place in [(1.7, 0.45, 0.1)] * 8 + list(places)]
    watched(known, [(T, [person, each]) for each in mugs], behind=behind)
    return [o for o in known.confirmed() if o.class_id == MUG]


IN_HAND = (1.7, 0.1, 0.85)


def test_a_mug_in_a_hand_is_the_mug_that_stood_there() -> None:
    (carried,), (left,) = (held([IN_HAND] * 2, portable=portable) for portable in (True, False))
    assert carried.center[2] > 0.75
    assert carried.views == 10
    assert left.center[2] < 0.2  # what is in a hand is new, and not yet sure


def test_a_mug_that_is_put_down_elsewhere_is_still_that_mug() -> None:
    (mug,) = held([IN_HAND] * 5 + [(1.7, 0.85, 0.1)] * 4)
    assert mug.center[1] > 0.75
    assert not mug.held


def test_a_mug_farther_away_than_an_arm_reaches_is_another() -> None:
    assert len(held([(1.7, -1.4, 0.3)] * 5, behind=False)) == 2


def test_height_of_a_person_over_the_floor_decides_the_depth_of_the_box() -> None:
    standing = SizePrior((0.4, 0.57, 1.64), (0.3, 0.2, 0.1), True, foot=1.0)
    sitting = SizePrior((0.56, 0.7, 1.38), (0.2, 0.2, 0.1), True, foot=1.0)
    depths = []
    for top in (1.3, 0.95):
        known, T = mapping({BOX: (standing, sitting)}, movers=[BOX]), looking(0.0)
        known.floor = -0.4
        watched(known, [(T, [observation(((2.0, 0.0, top - 0.35), (0.3, 0.5, 0.7)), BOX, T)])] * 4)
        depths.append(float(only(known).size[:2].max()))
    assert depths[0] < 0.6 < depths[1]


@pytest.mark.parametrize("lacks", [(), ("beside",), ("told",)], ids=["", "without neighbours", "without times"])
def test_a_snapshot_is_taken_up_also_from_before_something_was_counted(lacks: Sequence[str]) -> None:
    known = after([[(THING, BOX), (BESIDE, MUG)]] * 5)
    earlier = known.snapshot()
    for entry in earlier["objects"]:
        for name in lacks:
            del entry[name]
    again = ObjectMap(3, ClassPriors([BALL], BALL_SIZE), MapSettings())
    again.restore(earlier)
    assert [o.sightings for o in again.objects.values()] == [5, 5]
    counted = {} if "beside" in lacks else known.objects[1].beside
    assert again.objects[1].beside == counted
    assert known.objects[1].beside[2] > 0


def test_evidence_beside_a_removed_object_is_forgotten() -> None:
    both = [[(THING, BOX), (BESIDE, BOX)]] * 3
    assert sum(len(o.beside) for o in after(both).objects.values()) == 2
    known = after([*both[:2], *[[(THING, BOX)]] * 10])
    assert len(known.objects) == 1
    assert not only(known).beside


@pytest.mark.parametrize("rate", [10, 20, 50])
def test_evidence_is_independent_of_the_rate_of_images(rate: int) -> None:
    known = mapping()
    T = looking(0.0)
    for k in range(rate * 2 // 5 + 1):
        known.update(SECOND + k * SECOND // rate, [replace(observation(THING, BOX, T), score=0.6)], NOTHING)
    object = only(known)
    assert object.sightings == 5
    assert object.evidence == pytest.approx(5 * np.log(0.6 / 0.4))


@pytest.mark.parametrize(("seconds", "given"), [(0.1, 0), (0.3, 1)])
def test_objects_seen_for_too_short_a_time_are_unconfirmed(seconds: float, given: int) -> None:
    known = mapping()
    for k in range(4):
        stamp = SECOND + round(k * seconds / 3 * SECOND)
        known.update(stamp, [observation(THING, BOX, looking(0.0))], NOTHING)
    assert len(known.confirmed()) == given


@pytest.mark.parametrize("rate", [10, 50])
def test_an_empty_place_is_given_up_as_soon_at_any_rate_of_images(rate: int) -> None:
    known, T = after([[(THING, BOX)]] * 8), looking(0.0)
    empty = RangeView((WALL - T[:3, 3]) @ T[:3, :3], T, 0.012)
    only(known).voxels.hits[:] = 1000  # so that its voxels are not what goes first
    for k in range(1, 3 * rate + 1):
        known.update(2 * SECOND + k * SECOND // rate, [], empty)
        if not known.objects:
            break
    assert k / rate == pytest.approx(0.7, abs=0.1)


@pytest.mark.parametrize(("length", "doubt"), [(0.14, 0.0), (0.8, 0.5)])
def test_a_thing_larger_than_any_of_its_class_is_given_with_its_doubt(length: float, doubt: float) -> None:
    known = mapping({BOX: (SizePrior((0.12, 0.12, 0.12), (0.2, 0.2, 0.2)),)})
    watched(known, around(((2.0, 0.0, 0.1), (0.12, length, 0.12)), BOX, 6))
    assert known.doubt(only(known)) == doubt


@pytest.mark.parametrize(
    ("labels", "score", "doubt"),
    [
        ([MUG] * 12, 0.28, 0.2),
        ([MUG] * 12, 0.4, 0.0),
        ([BOX] * 12, 0.28, 0.0),  # nothing that is taken away
        ([MUG] * 12, 0.6, 0.0),
        ([MUG, BALL] * 6, 0.6, 1 / 7),  # a mean of 0.3 for each class
        ([MUG, BALL] * 3 + [BALL] * 6, 0.6, 0.0),
    ],
)
def test_a_weak_or_divided_label_of_a_small_thing_is_doubted(labels: list[int], score: float, doubt: float) -> None:
    known = mapping(BALL_SIZE, movers=[BALL], portable=[MUG])
    for k, label in enumerate(labels):
        watched(known, around(THING, label, k + 1, score)[-1:])
    assert known.doubt(only(known)) == pytest.approx(doubt)


def test_views_from_afar_are_dropped_for_near_ones_and_a_snapshot_holds_those_kept() -> None:
    known = mapping({BOX: (SizePrior((0.12, 0.12, 0.12), (0.2, 0.2, 0.2)),)})
    for k, back in enumerate([3.0, 2.8, 2.6, 2.4, 0.6, 0.5, 0.4, 0.3]):
        T = looking(0.1 * k)
        T[0, 3] = -back
        watched(known, [(T, [observation(THING, BOX, T)])])
    object = only(known)
    assert len(object.images) == 4
    assert max(float(np.linalg.norm(v.eye - object.center)) for v in object.images) < 3.0
    again = MapObject.restored(object.snapshot(), 0.03)
    assert again.fresh == object.fresh
    for one, other in zip(object.images, again.images, strict=True):
        assert len(one.points) > 0
        assert (one.points == other.points).all()


def test_a_chair_before_a_desk_whose_masks_hold_both_does_not_move_the_desk() -> None:
    desk: Solid = ((2.5, 0.0, 0.0), (0.7, 1.5, 0.75))
    chair: Solid = ((1.8, 0.4, 0.0), (0.1, 0.45, 0.7))
    sizes = {
        BOX: (SizePrior((0.6, 1.5, 0.75), (0.4, 0.4, 0.16)),), MUG: (SizePrior((0.1, 0.45, 0.7), (0.2, 0.2, 0.2)),),
    }  # fmt: skip
    views = []
    for (T, (whole,)), (_, (front,)) in zip(around(desk, BOX, 12), around(chair, MUG, 12), strict=True):
        views.append((T, [replace(whole, points=np.concatenate([whole.points, front.points[::2]])), front]))
    found = {o.class_id: o for o in watched(mapping(sizes), views).confirmed()}[BOX]
    deep = abs(np.cos(found.yaw)) * found.size[0] + abs(np.sin(found.yaw)) * found.size[1]
    assert float(found.center[0] - deep / 2) > 2.0  # the desk's front is at 2.15, the chair's at 1.75
