"""ObjectMap on observations made by hand: what is one thing, and what are two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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
K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
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
        wall = np.stack(np.meshgrid([4.0], np.linspace(-2, 2, 120), np.linspace(-1, 1.4, 90)), axis=-1).reshape(-1, 3)
        hidden = np.zeros(len(wall), np.bool_)
        way = wall - T[:3, 3]
        for solid, _ in scene:
            center, size = np.array(solid[0]), np.array(solid[1])
            at = T[:3, 3] + way * ((center[0] - T[0, 3]) / way[:, :1])
            hidden |= (np.abs(at - center)[:, 1:] < size[1:] / 2).all(axis=1)
        points = np.concatenate([wall[~hidden], *(surface(solid) for solid, _ in scene)])
        seen = [observation(solid, class_id, T) for solid, class_id in scene]
        seen = [replace(each, track=track) for each, track in zip(seen, tracks or [-1] * len(seen), strict=True)]
        in_sensor = (points - T[:3, 3]) @ T[:3, :3]
        known.update((k + 1) * SECOND // 4, seen, RangeView(in_sensor, T, 0.012))
    return known


THING: Solid = ((2.0, 0.0, 0.1), (0.12, 0.12, 0.12))


def only(known: ObjectMap) -> MapObject:
    (object,) = known.confirmed()
    return object


def test_a_thing_that_is_called_by_turns_a_mover_and_not_is_one_object() -> None:
    scenes = [[(THING, BALL if k % 3 == 0 else MUG)] for k in range(12)]
    object = only(after(scenes))
    assert object.class_id == MUG
    assert object.views == 12


@pytest.mark.parametrize(("bottom", "reaches_down"), [(0.7, True), (1.6, False)])
def test_a_person_whose_feet_are_hidden_stands_on_the_floor(bottom: float, reaches_down: bool) -> None:
    size = {BOX: (SizePrior((0.5, 0.59, 1.6), (0.2, 0.2, 0.2), foot=1.0),)}
    known = ObjectMap(3, ClassPriors([BOX], size), MapSettings())
    known.floor = -0.4
    T = looking(0.0)
    half: Solid = ((2.0, 0.0, bottom - 0.4 + 0.4), (0.5, 0.5, 0.8))
    for k in range(4):
        known.update((k + 1) * SECOND // 4, [observation(half, BOX, T)], RangeView(np.zeros((0, 3)), T, 0.012))
    center, box, _ = only(known).box
    top = float(center[2] + box[2] / 2)
    assert abs(top - (bottom + 0.4)) < 0.1
    assert (abs(float(center[2] - box[2] / 2) + 0.4) < 1e-9) == reaches_down


@pytest.mark.parametrize("along", [0.0, 0.4])
def test_a_person_whom_the_image_cuts_off_keeps_the_size_and_goes_on(along: float) -> None:
    known = ObjectMap(3, ClassPriors([BOX], {BOX: (SizePrior((0.5, 0.59, 1.6), (0.2, 0.2, 0.2)),)}), MapSettings())
    T = looking(0.0)
    for k in range(6):
        y = along * k / 5
        cut = k >= 3  # the image ends at the chest
        low, high = -0.4, 0.4 if cut else 1.0
        person: Solid = ((2.0, y, (low + high) / 2), (0.5, 0.5, high - low))
        seen = observation(person, BOX, T)
        edges = np.array([True, not cut, True, True])
        seen = replace(seen, image=replace(seen.image, edges=edges))
        known.update((k + 1) * SECOND // 4, [seen], RangeView(np.zeros((0, 3)), T, 0.012))
    center, size, _ = only(known).box
    assert abs(size[2] - 1.4) < 0.2
    assert abs(center[2] - 0.3) < 0.1
    assert abs(center[1] - along) < 0.1


def test_a_part_that_is_never_seen_beside_its_whole_is_no_object_of_its_own() -> None:
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


def test_a_ball_that_lies_still_is_remembered_and_one_that_is_moved_keeps_its_id() -> None:
    lying = after([[(THING, BALL)]] * 6 + [[]] * 2)
    assert only(lying).id == 1
    moved = [[(((2.0, 0.08 * k, 0.1), THING[1]), BALL)] for k in range(1, 9)]
    object = only(after([[(THING, BALL)]] * 6 + moved))
    assert object.id == 1
    assert abs(object.center[1] - 0.64) < 0.1


def test_background_that_shows_through_a_small_thing_is_not_taken_for_a_large_one() -> None:
    small, large = SizePrior((0.12, 0.12, 0.2), (0.3, 0.3, 0.2)), SizePrior((0.4, 0.45, 0.9), (0.3, 0.3, 0.2))
    known = ObjectMap(1, ClassPriors([], {BOX: (small, large)}), MapSettings())
    plant: Solid = ((2.0, 0.0, 0.1), (0.12, 0.12, 0.2))
    for k in range(6):
        T = looking(0.4 * np.sin(k))
        seen = observation(plant, BOX, T)
        behind = surface(plant)[::4] + np.array([0.6, 0.0, 0.0])
        each = Observation(np.concatenate([seen.points, behind]), BOX, 0.8, None, seen.image)
        known.update((k + 1) * SECOND // 4, [each], RangeView((each.points - T[:3, 3]) @ T[:3, :3], T, 0.012))
    assert only(known).size.max() < 0.3


def carrying(*, portable: bool, lifted: int = 5) -> ObjectMap:
    """The map after a mug stood beside somebody, who then has it before the mouth."""
    body = SizePrior((0.4, 0.5, 1.6), (0.2, 0.2, 0.2), foot=1.0)
    mug = SizePrior((0.1, 0.1, 0.1), (0.2, 0.2, 0.2), True)
    known = ObjectMap(
        3, ClassPriors([BOX], {BOX: (body,), MUG: (mug,)}, [BOX], [MUG] if portable else []), MapSettings()
    )
    somebody: Solid = ((2.0, 0.0, 0.4), (0.4, 0.5, 1.6))
    T = looking(0.0)
    wall = np.stack(np.meshgrid([4.0], np.linspace(-2, 2, 120), np.linspace(-1, 2, 90)), axis=-1).reshape(-1, 3)
    for k in range(8 + lifted):
        held: Solid = ((1.7, 0.45, 0.1) if k < 8 else (1.7, 0.1, 0.85), (0.1, 0.1, 0.1))
        seen = [observation(somebody, BOX, T), observation(held, MUG, T)]
        points = np.concatenate([wall, *(each.points for each in seen)])
        known.update((k + 1) * SECOND // 4, seen, RangeView((points - T[:3, 3]) @ T[:3, :3], T, 0.012))
    return known


def test_a_mug_in_a_hand_is_the_mug_that_stood_there() -> None:
    (held,), (left,) = (
        [o for o in carrying(portable=portable, lifted=2).confirmed() if o.class_id == MUG]
        for portable in (True, False)
    )
    assert held.center[2] > 0.75
    assert held.views == 10
    assert left.center[2] < 0.2  # what is in a hand is new, and not yet sure


def test_a_mug_that_is_put_down_elsewhere_is_still_that_mug() -> None:
    known = carrying(portable=True)
    T = looking(0.0)
    wall = np.stack(np.meshgrid([4.0], np.linspace(-2, 2, 120), np.linspace(-1, 2, 90)), axis=-1).reshape(-1, 3)
    for k in range(13, 17):
        each = observation(((1.7, 0.85, 0.1), (0.1, 0.1, 0.1)), MUG, T)
        points = np.concatenate([wall, each.points])
        known.update((k + 1) * SECOND // 4, [each], RangeView((points - T[:3, 3]) @ T[:3, :3], T, 0.012))
    (mug,) = [o for o in known.confirmed() if o.class_id == MUG]
    assert mug.center[1] > 0.75
    assert not mug.held


def test_a_mug_farther_away_than_an_arm_reaches_is_another() -> None:
    known = carrying(portable=True, lifted=0)
    T = looking(0.0)
    other: Solid = ((1.7, -1.4, 0.3), (0.1, 0.1, 0.1))
    for k in range(9, 14):
        each = observation(other, MUG, T)
        known.update((k + 1) * SECOND // 4, [each], RangeView((each.points - T[:3, 3]) @ T[:3, :3], T, 0.012))
    assert len([o for o in known.confirmed() if o.class_id == MUG]) == 2


def test_how_high_somebody_is_over_the_floor_tells_how_deep() -> None:
    standing = SizePrior((0.4, 0.57, 1.64), (0.3, 0.2, 0.1), True, foot=1.0)
    sitting = SizePrior((0.56, 0.7, 1.38), (0.2, 0.2, 0.1), True, foot=1.0)

    def depth(top: float) -> float:
        known = ObjectMap(1, ClassPriors([BOX], {BOX: (standing, sitting)}), MapSettings())
        known.floor = -0.4
        T = looking(0.0)
        trunk: Solid = ((2.0, 0.0, top - 0.35), (0.3, 0.5, 0.7))
        for k in range(4):
            known.update((k + 1) * SECOND // 4, [observation(trunk, BOX, T)], RangeView(np.zeros((0, 3)), T, 0.012))
        return float(only(known).size[:2].max())

    assert depth(1.3) < 0.6 < depth(0.95)


def test_what_was_seen_beside_what_is_in_the_snapshot() -> None:
    beside: Solid = ((2.0, 0.13, 0.1), THING[1])
    known = after([[(THING, BOX), (beside, MUG)]] * 5)
    again = ObjectMap(3, ClassPriors([BALL], BALL_SIZE), MapSettings())
    again.restore(known.snapshot())
    assert [o.beside for o in again.objects.values()] == [o.beside for o in known.objects.values()]
    assert known.objects[1].beside[2] > 0


def test_what_was_seen_beside_a_thing_that_is_no_more_is_forgotten() -> None:
    beside: Solid = ((2.0, 0.13, 0.1), (0.12, 0.12, 0.12))
    both = [[(THING, BOX), (beside, BOX)]] * 3

    assert sum(len(o.beside) for o in after(both).objects.values()) == 2
    known = after([*both[:2], *[[(THING, BOX)]] * 10])
    assert len(known.objects) == 1
    assert not only(known).beside


def test_a_snapshot_from_before_that_was_counted_is_taken_up() -> None:
    known = after([[(THING, BOX)]] * 5)
    earlier = known.snapshot()
    for entry in earlier["objects"]:
        del entry["beside"]
    again = ObjectMap(3, ClassPriors([BALL], BALL_SIZE), MapSettings())
    again.restore(earlier)
    assert list(again.objects) == list(known.objects)


@pytest.mark.parametrize("rate", [10, 20, 50])
def test_what_is_seen_for_a_while_tells_the_same_at_any_rate_of_images(rate: int) -> None:
    known = ObjectMap(3, ClassPriors([], {}), MapSettings())
    T, nothing = looking(0.0), RangeView(np.zeros((0, 3)), looking(0.0), 0.012)
    for k in range(rate * 2 // 5 + 1):
        known.update(SECOND + k * SECOND // rate, [replace(observation(THING, BOX, T), score=0.6)], nothing)
    object = only(known)
    assert object.sightings == 5
    assert object.evidence == pytest.approx(5 * np.log(0.6 / 0.4))


@pytest.mark.parametrize(("seconds", "given"), [(0.1, 0), (0.3, 1)])
def test_what_images_in_a_flash_show_is_not_yet_there(seconds: float, given: int) -> None:
    known = ObjectMap(3, ClassPriors([], {}), MapSettings())
    nothing = RangeView(np.zeros((0, 3)), looking(0.0), 0.012)
    for k in range(4):
        stamp = SECOND + round(k * seconds / 3 * SECOND)
        known.update(stamp, [observation(THING, BOX, looking(0.0))], nothing)
    assert len(known.confirmed()) == given


@pytest.mark.parametrize("rate", [10, 50])
def test_an_empty_place_is_given_up_as_soon_at_any_rate_of_images(rate: int) -> None:
    known = after([[(THING, BOX)]] * 8)
    T = looking(0.0)
    wall = np.stack(np.meshgrid([4.0], np.linspace(-2, 2, 120), np.linspace(-1, 1.4, 90)), axis=-1).reshape(-1, 3)
    empty = RangeView((wall - T[:3, 3]) @ T[:3, :3], T, 0.012)
    only(known).voxels.hits[:] = 1000  # so that its voxels are not what goes first
    for k in range(1, 3 * rate + 1):
        known.update(2 * SECOND + k * SECOND // rate, [], empty)
        if not known.objects:
            break
    assert k / rate == pytest.approx(0.7, abs=0.1)


def test_a_snapshot_from_before_times_of_views_were_summed_is_taken_up() -> None:
    known = after([[(THING, BOX)]] * 5)
    earlier = known.snapshot()
    for entry in earlier["objects"]:
        del entry["told"]
    again = ObjectMap(3, ClassPriors([BALL], BALL_SIZE), MapSettings())
    again.restore(earlier)
    assert [o.sightings for o in again.objects.values()] == [5]


@pytest.mark.parametrize(("length", "doubt"), [(0.14, 0.0), (0.8, 0.5)])
def test_a_thing_larger_than_any_of_its_class_is_given_with_its_doubt(length: float, doubt: float) -> None:
    size = {BOX: (SizePrior((0.12, 0.12, 0.12), (0.2, 0.2, 0.2)),)}
    known = ObjectMap(3, ClassPriors([], size), MapSettings())
    for k in range(6):
        eye = looking(0.2 * k)
        seen = [observation(((2.0, 0.0, 0.1), (0.12, length, 0.12)), BOX, eye)]
        known.update((k + 1) * SECOND // 4, seen, RangeView(np.zeros((0, 3)), looking(0.0), 0.012))
    assert known.doubt(only(known)) == doubt


@pytest.mark.parametrize(
    ("class_id", "score", "doubt"), [(MUG, 0.28, 0.2), (MUG, 0.4, 0.0), (BOX, 0.28, 0.0)], ids=["weak", "sure", "a box"]
)
def test_a_weak_label_of_a_small_thing_is_doubted(class_id: int, score: float, doubt: float) -> None:
    known = ObjectMap(3, ClassPriors([BALL], BALL_SIZE, portable=[MUG]), MapSettings())
    for k in range(12):
        T = looking(0.4 * np.sin(k))
        seen = [replace(observation(THING, class_id, T), score=score)]
        known.update((k + 1) * SECOND // 4, seen, RangeView(np.zeros((0, 3)), T, 0.012))
    assert known.doubt(only(known)) == pytest.approx(doubt)


@pytest.mark.parametrize(("mugs", "balls", "doubt"), [(12, 0, 0.0), (6, 6, 1 / 7), (3, 9, 0.0)])
def test_a_thing_called_a_mug_and_a_ball_alike_is_given_with_its_doubt(mugs: int, balls: int, doubt: float) -> None:
    """Labels of 0.6: by turns, that is a mean of 0.3 for each class."""
    known = ObjectMap(3, ClassPriors([BALL], BALL_SIZE, portable=[MUG]), MapSettings())
    labels = [MUG, BALL] * min(mugs, balls) + [MUG if mugs > balls else BALL] * abs(mugs - balls)
    for k, label in enumerate(labels):
        T = looking(0.4 * np.sin(k))
        seen = [replace(observation(THING, label, T), score=0.6)]
        known.update((k + 1) * SECOND // 4, seen, RangeView(np.zeros((0, 3)), T, 0.012))
    assert known.doubt(only(known)) == pytest.approx(doubt)


@pytest.mark.parametrize(("foot", "reaches_down"), [(0.2, True), (0.0, False)])
def test_furniture_reaches_down_to_the_floor_where_its_class_stands_there(foot: float, reaches_down: bool) -> None:
    known = ObjectMap(
        3, ClassPriors([], {BOX: (SizePrior((0.5, 0.5, 0.8), (0.3, 0.3, 0.3), foot=foot),)}), MapSettings()
    )
    known.floor = -0.4
    for k in range(6):
        seen = [observation(((2.5, 0.0, 0.12), (0.5, 0.5, 0.8)), BOX, looking(0.3 * np.sin(k)))]
        known.update((k + 1) * SECOND // 4, seen, RangeView(np.zeros((0, 3)), looking(0.0), 0.012))
    center, box, _ = only(known).box
    assert (abs(float(center[2] - box[2] / 2) + 0.4) < 1e-9) == reaches_down


def test_views_from_afar_are_dropped_for_near_ones_and_a_snapshot_holds_those_kept() -> None:
    known = ObjectMap(3, ClassPriors([], {BOX: (SizePrior((0.12, 0.12, 0.12), (0.2, 0.2, 0.2)),)}), MapSettings())
    for k, back in enumerate([3.0, 2.8, 2.6, 2.4, 0.6, 0.5, 0.4, 0.3]):
        T = looking(0.1 * k)
        T[0, 3] = -back
        known.update((k + 1) * SECOND // 4, [observation(THING, BOX, T)], RangeView(np.zeros((0, 3)), T, 0.012))
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
        BOX: (SizePrior((0.6, 1.5, 0.75), (0.4, 0.4, 0.16)),),
        MUG: (SizePrior((0.1, 0.45, 0.7), (0.2, 0.2, 0.2)),),
    }
    known = ObjectMap(3, ClassPriors([], sizes), MapSettings())
    for k in range(12):
        T = looking(0.4 * np.sin(k))
        whole, front = observation(desk, BOX, T), observation(chair, MUG, T)
        bled = replace(whole, points=np.concatenate([whole.points, front.points[::2]]))
        known.update((k + 1) * SECOND // 4, [bled, front], RangeView(np.zeros((0, 3)), T, 0.012))
    found = {o.class_id: o for o in known.confirmed()}[BOX]
    deep = abs(np.cos(found.yaw)) * found.size[0] + abs(np.sin(found.yaw)) * found.size[1]
    assert float(found.center[0] - deep / 2) > 2.0  # the desk's front is at 2.15, the chair's at 1.75
