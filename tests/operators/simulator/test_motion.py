"""How things move in the simulator: smoothly, within limits, and without running into each other."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from operators.simulator.people.movers import STANDING, Driving
from operators.simulator.people.persons import Person
from operators.simulator.rendering.native import open3d
from operators.simulator.scene import Thing, World
from operators.simulator.trajectory import Trajectory
from operators.simulator.worlds import corridor, office, table_top, yard
from operators.simulator.worlds.make import NAMES, make_world

ROBOT_RADIUS, ROBOT_HEIGHT = 0.22, 1.3
OVAL = np.stack([2 * np.cos(np.arange(12) * math.pi / 6), np.sin(np.arange(12) * math.pi / 6)], axis=1)


@functools.lru_cache
def world(name: str, seed: int, people: int = 2) -> World:
    return make_world(name, seed, speed=0.6, hold=0.0, movers=True, people=people)


@settings(max_examples=15, deadline=None)
@given(st.floats(0, 60), st.sampled_from([0.0, 1.0]))
def test_derivatives_of_the_path_are_those_of_its_values(t: float, hold: float) -> None:
    path, h = Trajectory(OVAL, hold=hold), 1e-4
    before, now, after = (path.at([t + 3 + dt]) for dt in (-h, 0.0, h))
    np.testing.assert_allclose(now.velocity, (after.position - before.position) / (2 * h), atol=1e-5)
    np.testing.assert_allclose(now.acceleration, (after.velocity - before.velocity) / (2 * h), atol=1e-4)
    np.testing.assert_allclose(now.yaw_rate, (after.yaw - before.yaw) / (2 * h), atol=1e-5)
    np.testing.assert_allclose(now.yaw_acceleration, (after.yaw_rate - before.yaw_rate) / (2 * h), atol=1e-4)


def test_the_robot_stands_still_at_first_and_starts_without_a_jerk() -> None:
    motion = Trajectory(OVAL, hold=2.0).at(np.arange(0, 5, 0.01))
    assert np.ptp(motion.position[:200], axis=0).max() == 0
    assert np.abs(np.diff(motion.acceleration, axis=0)).max() < 0.05


def test_path_closes_and_heading_accumulates() -> None:
    path = Trajectory(OVAL)
    first, again = path.at([1.0]), path.at([1.0 + path.period])
    np.testing.assert_allclose(again.position, first.position, atol=1e-9)
    np.testing.assert_allclose(again.yaw - first.yaw, 2 * math.pi, atol=1e-9)


def test_too_few_waypoints_are_refused() -> None:
    with pytest.raises(ValueError, match="four waypoints"):
        Trajectory([(0, 0), (1, 0), (0, 1)])


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [0, 3])
def test_robot_touches_no_mover(name: str, seed: int) -> None:
    here = world(name, seed)
    for t in np.arange(0, 60, 0.5):
        p = here.path.at([t]).position[0]
        for thing in here.things:
            if not thing.still:
                v = thing.vertices(t)
                gap = np.hypot(*(v[v[:, 2] < ROBOT_HEIGHT, :2] - p).T).min(initial=9)
                assert gap > ROBOT_RADIUS, f"{thing.label} {thing.id} comes within {gap:.2f} m at {t} s"


@pytest.fixture
def unfurnished(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worlds without what stands along their walls: their movers are as they would be, and they are made quickly."""
    for module in (office, corridor, table_top, yard):
        monkeypatch.setattr(module, "line_wall", lambda *args, **kwargs: None)
        monkeypatch.setattr(module, "decorate", lambda *args, **kwargs: None)


@pytest.mark.long
@pytest.mark.usefixtures("unfurnished")
@pytest.mark.parametrize("people", [2, 4])
@pytest.mark.parametrize(("name", "seeds"), [("office", 15), ("corridor", 4), ("table_top", 4), ("yard", 4)])
def test_lanes_lie_apart_and_off_the_path_of_the_robot(name: str, seeds: int, people: int) -> None:
    for seed in range(seeds):
        here = make_world(name, seed, speed=0.5, hold=0.0, movers=True, people=people)
        assert len(here.lanes) == len(here.scripts)
        for k, lane in enumerate(here.lanes):
            assert lane.gap(here.path.outline()) > ROBOT_RADIUS, (seed, lane.mover)
            assert all(lane.apart(other) > 0 for other in here.lanes[k + 1 :]), (seed, lane.mover)


@pytest.mark.long
@pytest.mark.usefixtures("unfurnished")
@pytest.mark.parametrize(("name", "seeds"), [("office", 12), ("corridor", 4), ("table_top", 4), ("yard", 3)])
def test_a_tour_keeps_off_all_lanes_and_crosses_itself(name: str, seeds: int) -> None:
    for seed in range(seeds):
        here = make_world(name, seed, speed=0.5, hold=0.0, movers=True, people=2 + seed % 3, tour=True)
        outline = here.path.outline(2000)
        assert all(lane.gap(outline) > ROBOT_RADIUS for lane in here.lanes), seed
        motion = here.path.at(np.linspace(0, here.path.period, 1500, endpoint=False))
        apart = np.linalg.norm(motion.position[:, None] - motion.position[None], axis=2)
        turned = np.abs((motion.yaw[:, None] - motion.yaw[None] + math.pi) % (2 * math.pi) - math.pi)
        k = np.arange(1500)
        later = np.abs((k[:, None] - k[None] + 750) % 1500 - 750) > 60
        same = (apart < 0.05) & later
        assert same.any()
        assert turned[same].max() > {"table_top": 0.1}.get(name, 3.0)


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("seed", "people", "tour"), [(0, 2, False), (3, 2, False), (1, 4, True)])
def test_path_touches_no_furniture_and_stays_within_limits(name: str, seed: int, people: int, tour: bool) -> None:
    here = make_world(name, seed, speed=0.5, hold=0.0, movers=True, people=people, tour=tour)
    track = cKDTree(here.path.outline(2000))
    for thing in here.things:
        if thing.still and thing.label not in ("floor", "ceiling"):
            v = thing.vertices(0.0)
            v = v[(v[:, 2] > 0.02) & (v[:, 2] < ROBOT_HEIGHT), :2]
            gap = track.query(v)[0].min(initial=9)
            assert gap > ROBOT_RADIUS, f"{thing.label} {thing.id} stands {gap:.2f} m from the path"
    motion = here.path.at(np.linspace(0, here.path.period, 2000))
    assert motion.speed().max() < 0.55
    assert np.abs(motion.yaw_rate).max() < math.radians(45)
    assert np.linalg.norm(motion.acceleration, axis=1).max() < 1.0


@pytest.mark.long
@pytest.mark.usefixtures("unfurnished")
@pytest.mark.parametrize(("name", "seeds"), [("office", 6), ("corridor", 3), ("table_top", 3), ("yard", 2)])
def test_movers_never_meet(name: str, seeds: int) -> None:
    """Axis to axis, for two minutes."""
    for seed in range(seeds):
        here = make_world(name, seed, speed=0.5, hold=0.0, movers=True)
        movers = [here.thing(lane.mover) for lane in here.lanes]
        tracks = np.array([[thing.mover.frame(t)[:2, 3] for thing in movers] for t in np.arange(0, 120, 0.25)])
        for i, first in enumerate(movers):
            for j, second in enumerate(movers[:i]):
                gap = np.linalg.norm(tracks[:, i] - tracks[:, j], axis=1).min()
                assert gap > (0.7 if {first.label, second.label} <= {"person", "robot"} else 0.4), (seed, first.label)


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [0, 3])
def test_movers_keep_to_their_lanes(name: str, seed: int) -> None:
    here = world(name, seed)
    for lane in here.lanes:
        thing = here.thing(lane.mover)
        for t in np.arange(0, 45, 0.5):
            at_table = isinstance(thing.mover, Person) and thing.mover.timeline.at(t)[0].sit != (0.0, 0.0)
            if not at_table:
                assert lane.holds(thing.vertices(t)[:, :2]), (thing.label, t)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "seed", "people"),
    [("office", 0, 2), ("office", 2, 2), ("office", 5, 2), ("table_top", 1, 2), ("corridor", 0, 2),
     *((name, seed, 4) for name in NAMES for seed in (0, 1, 2))],
)  # fmt: skip
def test_persons_pass_through_no_furniture(name: str, seed: int, people: int) -> None:
    """Not one edge of a body meets a triangle of what stands still, except of the chairs that it sits on."""
    here = world(name, seed, people)
    seats = {p.relation.object for p in here.placements if p.relation.predicate == "sitting_on"}
    obstacles = [thing for thing in here.objects() if thing.still and thing.id not in seats]
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    ids = {}
    for thing in obstacles:
        triangles = o3d.core.Tensor(triangles_of(thing).astype(np.uint32))
        ids[int(scene.add_triangles(o3d.core.Tensor(thing.vertices(0.0).astype(np.float32)), triangles))] = thing
    for person in (thing for thing in here.objects() if thing.label == "person"):
        ends = triangles_of(person)
        edges = np.unique(np.sort(np.concatenate([ends[:, [0, 1]], ends[:, [1, 2]], ends[:, [2, 0]]]), axis=1), axis=0)
        for t in np.arange(0, person.mover.timeline.period, 0.4 if people == 2 else 0.7):
            a, b = person.vertices(t)[edges].transpose(1, 0, 2)
            hits = scene.cast_rays(o3d.core.Tensor(np.concatenate([a, b - a], axis=1).astype(np.float32)), nthreads=1)
            met = hits["geometry_ids"].numpy()[hits["t_hit"].numpy() < 1]
            assert not len(met), (t, {f"{ids[int(k)].label} {ids[int(k)].id}" for k in met})


def triangles_of(thing: Thing) -> np.ndarray:
    """Corners (T, 3) of a thing's triangles as indices into its vertices."""
    patches = [patch for part in thing.parts for patch in part]
    firsts = np.cumsum([0, *(len(patch.vertices) for patch in patches)])
    return np.concatenate([patch.triangles + first for patch, first in zip(patches, firsts, strict=False)])


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_movers_never_jump_and_never_sink_into_the_floor(name: str) -> None:
    for thing in world(name, 0).things:
        if thing.still:
            continue
        times = np.arange(0, 40, 0.04)
        frames = np.array([thing.mover.frame(t)[:3, 3] for t in times])
        assert np.linalg.norm(np.diff(frames, axis=0), axis=1).max() < 2.0 * 0.04
        last = None
        for t in times[::3]:
            poses = thing.mover.parts(t)[:, :3, 3]
            if last is not None:
                assert np.linalg.norm(poses - last, axis=1).max() < 5.0 * 0.12, (thing.label, t)
            last = poses
        assert min(thing.vertices(t)[:, 2].min() for t in times[::25]) > -0.01


@pytest.mark.parametrize("name", ["office", pytest.param("corridor", marks=pytest.mark.long)])
def test_robot_activity_is_driving_in_motion_and_resting_at_standstill(name: str) -> None:
    robot = next(thing for thing in world(name, 0).things if isinstance(thing.mover, Driving))
    seen = set()
    for t in np.arange(0.02, 150, 0.37):
        ends = [robot.mover.frame(t + dt)[:2, 3] for dt in (-0.01, 0.01)]
        speed = np.linalg.norm(ends[1] - ends[0]) / 0.02
        doing = robot.mover.doing(robot.id, t)
        if abs(speed - STANDING) > 0.005:
            assert doing.activity == ("driving" if speed > STANDING else "resting"), t
        before, after = (robot.mover.doing(robot.id, doing.since + dt).activity for dt in (-0.1, 0.1))
        assert (before, after) == ({"driving": "resting", "resting": "driving"}[doing.activity], doing.activity)
        seen.add(doing.activity)
    assert seen == {"driving", "resting"}


def test_bones_keep_their_lengths() -> None:
    person = next(t.mover for t in world("office", 0).things if isinstance(t.mover, Person))
    for t in np.arange(0, 30, 0.7):
        T = person.body.poses(person.posture(t))
        for upper, lower, share in ((3, 4, 0.186), (8, 9, 0.186), (5, 6, 0.245), (10, 11, 0.245)):
            bone = np.linalg.norm(T[upper, :3, 3] - T[lower, :3, 3])
            assert bone == pytest.approx(share * person.body.height, rel=1e-6)
        np.testing.assert_allclose(
            T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (13, 1, 1)), atol=1e-9
        )
