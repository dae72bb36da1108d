"""The simulator's truth agrees with itself: boxes, masks, depth, relations and shapes, each worked out another way."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import combinations, product
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dataflow.messages import Boxes3D, Detections2D, SceneGraph, SegmentationMap
from dataflow.messages.geometry import invert, quaternion_to_matrix, transform_points
from operators.simulator import SimulatedRobot
from operators.simulator.classes import ACTIVITIES, THINGS
from operators.simulator.people.movers import CarriedObject
from operators.simulator.people.persons import Person
from operators.simulator.relations import PLACEMENT, SPATIAL
from operators.simulator.rendering.optics import Optics
from operators.simulator.rendering.renderer import Renderer
from operators.simulator.scene import Builder, Light, Stationary, World
from operators.simulator.shapes import Material, bounds, box, pose
from operators.simulator.things.furnishing import FLOOR
from operators.simulator.things.furniture import rover
from operators.simulator.trajectory import Trajectory
from operators.simulator.truth import masks, velocity
from operators.simulator.worlds.make import NAMES, make_world

WORLDS = ("office", pytest.param("table_top", marks=pytest.mark.long))
CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))


@pytest.fixture(scope="module", params=WORLDS)
def robot(request: pytest.FixtureRequest) -> SimulatedRobot:
    made = SimulatedRobot(
        world=request.param,
        seed=2,
        duration="8s",
        color_camera={"rate": 0.5, "width": 160, "height": 120},
        depth_camera={"rate": 0},
        truth={"masks": True, "relations": 0.5, "poses": 0.5, "activities": 5},
    )
    made.setup()
    return made


@pytest.fixture(scope="module")
def steps(robot: SimulatedRobot) -> list[dict[str, Any]]:
    return [dict(step) for step in robot.stream()]


def frames(steps: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [step for step in steps if "objects" in step]


@pytest.mark.long
def test_masks_and_boxes_in_the_image_count_the_same_pixels(steps: list[dict[str, Any]]) -> None:
    for step in frames(steps):
        found, mask = step["objects"], step["masks"]
        assert isinstance(found, Detections2D)
        assert isinstance(mask, SegmentationMap)
        assert mask.instances is not None
        assert found.ids is not None
        assert found.count > 2
        large = {int(i) for i in np.unique(mask.instances) if i and (mask.instances == i).sum() >= 12}
        assert large == set(found.ids.tolist())
        for id, count, corners, class_id in zip(
            found.ids, found.pixel_counts, found.boxes, found.class_ids, strict=True
        ):
            rows, columns = np.nonzero(mask.instances == id)
            assert len(rows) == count
            assert corners.tolist() == [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            assert set(mask.classes[rows, columns]) == {class_id}


def test_boxes_move_as_fast_as_their_middles_do(robot: SimulatedRobot) -> None:
    """Against the way of the middles over 20 ms: limbs that swing move a person's box too."""
    world, apart, moving = robot._stage.world, [], 0
    for thing in world.objects():
        if thing.still:
            continue
        for t in np.arange(0.1, 12, 0.61):
            ends = [thing.box(t + dt)[0][:3, 3] for dt in (-0.01, 0.01)]
            apart.append(np.linalg.norm(velocity(thing, t) - (ends[1] - ends[0]) / 0.02))
            moving += bool(np.linalg.norm(ends[1] - ends[0]) > 0.002)
    assert moving > 10
    assert np.median(apart) < 0.01
    assert np.percentile(apart, 95) < 0.1


def test_boxes_in_space_enclose_the_boxes_in_the_image(robot: SimulatedRobot, steps: list[dict[str, Any]]) -> None:
    info = robot.static_outputs()["image_info"]
    for step in frames(steps):
        flat, solid = step["objects"], step["boxes"]
        assert isinstance(solid, Boxes3D)
        assert solid.ids.tolist() == flat.ids.tolist()
        T_camera_world = invert(step["ground_truth"].matrix())
        for k in range(solid.count):
            R = quaternion_to_matrix(solid.orientations[k])
            corners = (CORNERS * solid.sizes[k]) @ R.T + solid.centers[k]
            p = transform_points(T_camera_world, corners)
            if p[:, 2].min() < 0.1:
                continue
            uv = p[:, :2] / p[:, 2:] * [info.fx, info.fy] + [info.cx, info.cy]
            low, high = uv.min(axis=0), uv.max(axis=0)
            assert (flat.boxes[k, :2] >= low - 1).all()
            assert (flat.boxes[k, 2:] <= high + 2).all()
            if flat.visible[k] > 0.97:  # nothing hides it: the box must not be too large either
                cover = np.prod(flat.boxes[k, 2:] - flat.boxes[k, :2]) / np.prod(
                    np.minimum(high, [160, 120]) - np.maximum(low, 0)
                )
                assert cover > 0.3, flat.labels()[k]


def test_depth_is_where_the_triangles_are(robot: SimulatedRobot) -> None:
    """A second implementation (Möller and Trumbore, 1997) on all triangles, for a few pixels."""
    world, t = robot._stage.world, 3.0
    optics = Optics(40, 30, 34, 34, 19.5, 14.5)
    T = robot._stage.T_world_base(t) @ robot._rig.T_base_depth
    view = robot._stage.at(t).view(T, optics, color=False)
    corners, ids = [], []
    for thing in world.things:
        v, first = thing.vertices(t), 0
        for patch in (p for part in thing.parts for p in part):
            corners.append(v[first + patch.triangles])
            ids += [thing.id] * len(patch.triangles)
            first += len(patch.vertices)
    a, b, c = np.concatenate(corners).transpose(1, 0, 2)
    for row, column in np.random.default_rng(0).integers(0, (30, 40), (40, 2)):
        d = T[:3, :3] @ [(column - 19.5) / 34, (row - 14.5) / 34, 1.0]
        h = np.cross(d, c - a)
        det = ((b - a) * h).sum(axis=1)
        f = 1 / np.where(np.abs(det) < 1e-14, np.inf, det)
        s = T[:3, 3] - a
        u = f * (s * h).sum(axis=1)
        q = np.cross(s, b - a)
        v, z = f * (q @ d), f * ((c - a) * q).sum(axis=1)
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (z > 1e-6) & (det != 0)
        nearest = z[hit].min()
        if abs(view.depth[row, column] - nearest) > 1e-3 * nearest:  # only on a seam, where rounding may miss it
            assert view.cosine[row, column] < 0.2 or np.sort(np.abs(z[hit] - view.depth[row, column]))[0] < 1e-3
        else:
            assert ids[np.flatnonzero(hit)[z[hit].argmin()]] == view.instances[row, column]


def simple_world(*places: tuple[float, float]) -> World:
    """Cubes of 0.4 m at (x, y) before a camera at the origin that looks along x; walls far away."""
    builder = Builder()
    stuff = Material("plain")
    builder.surface("wall", box((8, 8, 8), stuff, center=(0, 0, 1)))
    for x, y in places:
        builder.put("box", box((0.4, 0.4, 0.4), stuff, center=(0, 0, 0)), pose(x, y, 1.0), on=FLOOR)
    angle = np.arange(8) * np.pi / 4
    path = Trajectory(np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return World("test", tuple(builder.things), (Light((0, 0, 2), 1.0),), 0.5, path, np.zeros((0, 3)), (0,) * 6, ())


LOOKING = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.0], [0, 0, 0, 1.0]])
WIDE = Optics(160, 120, 130.0, 130.0, 79.5, 59.5)


@pytest.mark.parametrize(
    ("places", "share"),
    [
        ([(2.0, 0.0)], 1.0),  # alone
        ([(2.0, 0.0), (3.2, 0.0)], 1.0),  # the first, before another
        ([(3.2, 0.0), (2.0, 0.0)], 0.0),  # the first, quite hidden
        # Half of its front is hidden, up to y / x = 0.15 / 1.8 of 0.05 / 3 ... 0.45 / 3, and its thin right side too.
        ([(3.2, 0.25), (2.0, -0.05)], 0.49),
        # The image ends at y / x = 80 / 130: half of its front and all of its right side are inside.
        ([(2.0, 1.107)], 0.64),
    ],
)
def test_the_visible_share_is_that_of_the_whole_object(places: list[tuple[float, float]], share: float) -> None:
    renderer = Renderer(simple_world(*places), 0)
    seen = (renderer.view(LOOKING, WIDE, color=False).instances == 1).sum()
    (alone,) = renderer.silhouette([1], LOOKING, WIDE)
    assert seen / alone == pytest.approx(share, abs=0.06)


def test_a_pixel_that_shows_nothing_is_void() -> None:
    builder = Builder()
    builder.surface("floor", box((1, 1, 0.1), Material("plain"), center=(0, 0, -5)))
    builder.put("box", box((0.4, 0.4, 0.4), Material("plain")), pose(2.0, 0, 0.8), on=FLOOR)
    world = replace(simple_world(), things=tuple(builder.things))
    view = Renderer(world, 0).view(LOOKING, WIDE, color=False)
    message = masks(view, 0, "camera")
    assert message.instances is not None
    nothing = ~np.isfinite(view.depth)
    assert 0 < nothing.sum() < nothing.size
    assert (message.classes[nothing] == message.void).all()
    assert (message.instances[nothing] == 0).all()
    assert (message.classes[~nothing] == THINGS.index("box")).all()


@pytest.mark.parametrize("seed", range(6))
def test_a_robot_stands_on_the_floor(seed: int) -> None:
    low, _ = bounds(rover(np.random.default_rng(seed)))
    assert low[2] == pytest.approx(0, abs=1e-3)


def test_relations_use_known_words_and_objects(steps: list[dict[str, Any]]) -> None:
    for graph in (step["scene"] for step in steps if "scene" in step):
        assert isinstance(graph, SceneGraph)
        assert set(graph.predicates) <= {*PLACEMENT, *SPATIAL}
        assert {graph.class_names[i] for i in graph.class_ids} <= {*THINGS, "floor"}


def test_degrees_of_nearness_follow_their_written_thresholds(
    robot: SimulatedRobot, steps: list[dict[str, Any]]
) -> None:
    """Near, left and in front, worked out from all pairs of vertices and each pair's middles in the robot's frame."""
    graph = next(step["scene"] for step in steps if "scene" in step)
    world, t = robot._stage.world, graph.stamp * 1e-9
    things = {thing.id: thing for thing in world.objects()}
    found: dict[str, set[tuple[int, int]]] = {word: set() for word in SPATIAL}
    for subject, word, object in zip(graph.subjects, graph.predicates, graph.objects, strict=True):
        if word in found:
            found[word].add((int(graph.ids[subject]), int(graph.ids[object])))
    near = set()
    trees = {id: cKDTree(thing.vertices(t)) for id, thing in things.items()}
    for a, b in combinations(sorted(things), 2):
        if trees[a].sparse_distance_matrix(trees[b], 0.5, output_type="ndarray").size:
            near.add((a, b))
    assert found["near"] == near
    T = invert(world.path.at([t]).T_world_base()[0])
    middle = {id: transform_points(T, thing.box(t)[0][:3, 3]) for id, thing in things.items()}
    for a, b in sorted(near):
        x, y, _ = middle[a] - middle[b]
        words = {
            (word, p == (a, b)) for word in ("left_of", "in_front_of") for p in ((a, b), (b, a)) if p in found[word]
        }
        if max(abs(x), abs(y)) < 0.15:
            assert not words
        elif abs(y) >= abs(x):
            assert words == {("left_of", y > 0)}
        else:
            assert words == {("in_front_of", x < 0)}


def test_placement_does_not_depend_on_where_things_are(robot: SimulatedRobot) -> None:
    """Objects set far apart keep their relations of placement: no distance decides them."""
    world = robot._stage.world
    away = [replace(thing, mover=Stationary(pose(50.0 * k, 0, 0))) for k, thing in enumerate(world.things)]
    assert replace(world, things=tuple(away)).relations(0.0) == world.relations(0.0)


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_every_world_has_many_classes_movers_and_goals(name: str) -> None:
    world = make_world(name, 5, speed=0.5, hold=0.0, movers=True)
    assert len({thing.label for thing in world.objects()}) >= 10
    assert {thing.id for thing in world.objects()} == set(range(1, len(world.objects()) + 1))
    movers = {thing.id for thing in world.objects() if not thing.still and not isinstance(thing.mover, CarriedObject)}
    assert movers
    for t in np.arange(0, 60, 1.5):
        doings = world.doings(float(t))
        assert {doing.thing for doing in doings} == movers
        for doing in doings:
            assert doing.activity in ACTIVITIES
            assert doing.goal
            assert doing.object == -1 or world.thing(doing.object)
            for number in re.findall(r"(\w+) (\d+)", doing.goal):
                assert world.thing(int(number[1])).label == number[0]


def test_a_goal_that_is_given_is_reached(robot: SimulatedRobot) -> None:
    """Who is to drink from a mug ends up holding that mug, and who is to sit down ends up sitting."""
    world = robot._stage.world
    reached = set()
    for person in (t for t in world.objects() if isinstance(t.mover, Person)):
        goals = {}
        for t in np.arange(0, person.mover.timeline.period, 0.2):
            (doing,) = (d for d in world.doings(t) if d.thing == person.id)
            goals.setdefault(doing.goal, set()).update(
                (r.predicate, r.object) for r in world.relations(t) if r.subject == person.id
            )
            goals[doing.goal].add((doing.activity, doing.object))
        for goal, state in goals.items():
            if goal.startswith("drink from mug"):
                assert ("holding", int(goal.split()[-1])) in state
            elif goal.startswith("sit down"):
                assert ("sitting_down", -1) in state
            elif goal.startswith("walk"):
                assert ("walking", -1) in state
            reached.add(goal.split()[0])
    assert "drink" in reached


def test_objects_touch_the_surface_of_their_carrier(robot: SimulatedRobot) -> None:
    """A ray downwards from just inside an object's bottom meets its carrier within a centimetre."""
    world = robot._stage.world
    checked = 0
    for relation in world.relations(0.0):
        if relation.predicate not in ("on", "in"):
            continue
        thing = world.thing(relation.subject)
        if not thing.still or thing.label == "door":
            continue
        v = thing.vertices(0.0)
        bottom = float(v[:, 2].min())
        if relation.object == FLOOR:
            assert abs(bottom) < 0.01, thing.label
            checked += 1
            continue
        carrier = world.thing(relation.object)
        x, y = v[v[:, 2] < bottom + 0.002, :2].mean(axis=0)
        heights = _surface_heights(carrier.vertices(0.0), carrier, x, y)
        assert np.abs(heights - bottom).min() < 0.01, f"{thing.label} on {carrier.label}"
        checked += 1
    assert checked > 20


def _surface_heights(vertices: np.ndarray, thing: Any, x: float, y: float) -> np.ndarray:
    """Heights of a thing's triangles over a point (x, y)."""
    heights, first = [], 0
    for patch in (p for part in thing.parts for p in part):
        a, b, c = vertices[first + patch.triangles].transpose(1, 0, 2)
        first += len(patch.vertices)
        area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
        level = np.abs(area) > 1e-9
        a, b, c, area = a[level], b[level], c[level], area[level]
        u = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])) / area
        v = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])) / area
        inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
        heights.append((a[:, 2] + u * (b[:, 2] - a[:, 2]) + v * (c[:, 2] - a[:, 2]))[inside])
    return np.concatenate(heights)


def grasp_of(person: Person) -> Any:
    """A place that the person grips, if there is one."""
    return next((act.grasp for act in person.timeline.acts if act.grasp is not None), None)


def test_contacts_follow_the_activities_of_persons(robot: SimulatedRobot) -> None:
    world = robot._stage.world
    drinkers = [t for t in world.objects() if isinstance(t.mover, Person) and grasp_of(t.mover) is not None]
    assert drinkers
    for person in drinkers:
        mover = person.mover
        assert isinstance(mover, Person)
        seen = set()
        for t in np.arange(0, mover.timeline.period, 0.1):
            here = {(r.predicate, r.object) for r in world.relations(t) if r.subject == person.id}
            (doing,) = (d for d in world.doings(t) if d.thing == person.id)
            assert doing.activity in ACTIVITIES
            seen.add(doing.activity)
            words = {word for word, _ in here}
            assert ("sitting_on" in words) != ("on" in words)
            assert ("sitting_on" in words) == (doing.activity in ("sitting", "reaching", "drinking"))
            assert ("holding" in words) == (doing.activity == "drinking")
            mug = next(
                (r.subject for r in world.relations(t) if r.predicate == "on" and r.subject == doing.object), None
            )
            if "holding" in words:
                (held,) = (o for word, o in here if word == "holding")
                assert mug is None
                T, _ = world.thing(held).box(t)
                assert np.linalg.norm(T[:3, 3] - mover.grip(t)) < 0.12
            if "sitting_on" in words:
                (chair,) = (o for word, o in here if word == "sitting_on")
                pelvis = mover.posture(t).pelvis
                T, _ = world.thing(chair).box(t)
                assert np.linalg.norm(pelvis[:2] - T[:2, 3]) < 0.2
                assert 0.45 < pelvis[2] < 0.65
        assert {"sitting", "reaching", "drinking"} <= seen


def test_activities_begin_when_they_say(steps: list[dict[str, Any]]) -> None:
    previous: dict[int, tuple[int, int]] = {}
    for message in (step["activities"] for step in steps if "activities" in step):
        for subject, class_id, since in zip(message.subjects, message.class_ids, message.since, strict=True):
            assert since <= message.stamp + 1
            known = previous.get(int(subject))
            if known is not None and known[0] != class_id:
                assert since > known[1]  # a new activity began after the last message
            previous[int(subject)] = int(class_id), message.stamp
