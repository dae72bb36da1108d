"""LidarOdometry in made rooms, whose walls are known, and on the scans of a car."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_beams import CORRIDOR, beams, cast
from numpy.typing import NDArray
from operator_runs import assert_resumes_alike, texts

from dataflow.messages import Odometry, PointCloud, Transforms
from dataflow.messages.geometry import invert
from dataflow.testing import Played, play
from operators.cloud.deskewing import deskewed
from operators.geometry import se3
from operators.odometry import LidarOdometry
from operators.odometry.lidar import tracker
from operators.odometry.lidar.fit import Fit
from operators.odometry.lidar.map import thinned
from operators.odometry.lidar.odometry import Sweep
from operators.odometry.lidar.search import around

Array = NDArray[np.float64]
STEP = 100_000_000  # ns

ROOM = [  # axis, place, and what the rectangle spans of the other two axes
    (2, -0.6, (-4, 5), (-3, 4)), (2, 2.0, (-4, 5), (-3, 4)), (0, -4, (-3, 4), (-1, 2)), (0, 5, (-3, 4), (-1, 2)),
    (1, -3, (-4, 5), (-1, 2)), (1, 4, (-4, 5), (-1, 2)), (0, 2.5, (1.5, 4), (-1, 1.2)), (1, -1.8, (0, 1.5), (-1, 0.9)),
]  # fmt: skip


def scan(
    world: list[Any], pose: Callable[[float], Array], k: int, timed: bool = False, noise: float = 0.01
) -> PointCloud:
    """One turn that ends at k tenths of a second; without `timed` the sensor stands still during it."""
    rays = beams()
    offsets = np.repeat(np.arange(240) / 240 - 1 + 1 / 240, 24) * 0.1 if timed else np.zeros(len(rays))
    poses = {float(t): pose(k * 0.1 + float(t)) for t in np.unique(offsets)}
    T = np.array([poses[float(t)] for t in offsets])
    distance = cast(world, T[:, :3, 3], np.einsum("nij,nj->ni", T[:, :3, :3], rays))
    distance = distance + np.random.default_rng(k).normal(0, noise, len(rays))
    kept = np.isfinite(distance)
    return PointCloud(
        stamp=k * STEP,
        frame="lidar",
        points=(rays[kept] * distance[kept, None]).astype(np.float32),
        time_offsets=offsets[kept].astype(np.float32) if timed else None,
    )


def circling(t: float) -> Array:
    """A way through the room: 0.8 m/s, turning at 0.8 rad/s."""
    return se3.exp(np.array([0.8 * t, 0, 0, 0, 0, 0.8 * t]))


def along(t: float) -> Array:
    """A way along the corridor: 1 m/s."""
    return se3.exp(np.array([t, 0, 0, 0, 0, 0.0]))


def errors(played: Played, pose: Callable[[float], Array], body: Array | None = None) -> Array:
    """Twists (N, 6) from the true poses to those given."""
    B = np.eye(4) if body is None else body
    found = []
    for odometry in played["odometry"]:
        T = B @ invert(pose(0)) @ pose(odometry.stamp * 1e-9) @ invert(B)
        found.append(se3.log(invert(T) @ odometry.matrix()))
    return np.array(found)


def test_a_way_through_a_room_is_followed_within_its_covariance() -> None:
    played = play(LidarOdometry(), {"cloud": [scan(ROOM, circling, k) for k in range(25)]})
    off = errors(played, circling)
    assert len(off) == 25
    assert np.linalg.norm(off[:, :3], axis=1).max() < 0.02
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.005
    last = played["odometry"][-1]
    assert last.linear == pytest.approx([0.8, 0, 0], abs=0.15)
    assert 1e-4 < np.sqrt(last.pose_covariance[0, 0]) < 0.05
    assert texts(played) == ["tracking: the map begins here", *["tracking"] * 24]


@pytest.mark.long
def test_points_with_times_are_deskewed() -> None:
    clouds = [scan(ROOM, circling, k, timed=True) for k in range(20)]
    off = errors(play(LidarOdometry(), {"cloud": clouds}), circling)
    skewed = errors(play(LidarOdometry(), {"cloud": [c.replace(time_offsets=None) for c in clouds]}), circling)
    assert np.linalg.norm(off[:, :3], axis=1).max() < 0.03
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.01
    assert np.linalg.norm(off[-1, :3]) < np.linalg.norm(skewed[-1, :3])


@pytest.mark.long
def test_points_without_times_are_deskewed_by_azimuth() -> None:
    clouds = [scan(ROOM, circling, k, timed=True) for k in range(20)]
    plain = [c.replace(time_offsets=None) for c in clouds]
    timed = errors(play(LidarOdometry(), {"cloud": clouds}), circling)
    swept = errors(play(LidarOdometry(sweep={"period": 0.1}), {"cloud": plain}), circling)
    assert np.linalg.norm(swept - timed, axis=1).max() < 0.005
    told = play(LidarOdometry(sweep={"period": 5.0, "clockwise": True}), {"cloud": clouds})
    assert told.digests() == play(LidarOdometry(), {"cloud": clouds}).digests()  # what messages say counts


@pytest.mark.parametrize(
    ("sweep", "expected"),
    [
        (Sweep(period=0.1), [-0.1, -0.075, -0.05, -0.025]),
        (Sweep(period=0.1, clockwise=True), [-0.1, -0.025, -0.05, -0.075]),
        (Sweep(period=0.2, begins=np.pi, stamped="begin"), [0.1, 0.15, 0.0, 0.05]),
        (Sweep(period=0.1, stamped="middle"), [-0.05, -0.025, 0.0, 0.025]),
    ],
    ids=["ends at the stamp", "clockwise", "begins behind, at the stamp", "stamped in the middle"],
)
def test_azimuth_of_a_point_gives_its_time_offset(sweep: Sweep, expected: list[float]) -> None:
    around = np.array([[2, 0, 1], [0, 3, 0], [-1, 0, 0], [0, -4, 2]], np.float32)
    np.testing.assert_allclose(sweep.offsets(around), expected, atol=1e-7)
    assert np.isnan(sweep.offsets(np.full((1, 3), np.nan, np.float32))).all()


def test_deskewing_undoes_a_motion_during_the_scan() -> None:
    rng = np.random.default_rng(3)
    points, offsets = rng.uniform(-5, 5, (50, 3)), rng.uniform(-0.1, 0.1, 50)
    for velocity in (np.array([1.0, -2, 0.5, 0.3, 1.0, -2.0]), np.array([1.0, 0, 0, 0, 0, 0])):
        T = np.array([se3.exp(velocity * t) for t in offsets])
        expected = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
        np.testing.assert_allclose(deskewed(points, offsets, velocity), expected, atol=1e-12)


def test_the_pose_of_another_body_is_given_where_it_is_asked_for() -> None:
    T_base_lidar = se3.exp(np.array([0.3, 0.1, 0.5, 0.1, -0.2, 0.7]))
    mount = Transforms.from_matrix(T_base_lidar, stamp=0, frame="base", child_frame="lidar")
    clouds = [scan(ROOM, circling, k) for k in range(8)]
    played = play(LidarOdometry(body_frame="base"), {"cloud": clouds, "extrinsics": [mount]})
    off = errors(played, circling, T_base_lidar)
    assert np.linalg.norm(off[:, :3], axis=1).max() < 0.03
    assert {o.child_frame for o in played["odometry"] if isinstance(o, Odometry)} == {"base"}


def test_a_body_without_extrinsics_is_refused() -> None:
    with pytest.raises(Exception, match="extrinsics that relate it to 'base' are missing"):
        play(LidarOdometry(body_frame="base"), {"cloud": [scan(ROOM, circling, 0)]})


def test_position_along_a_bare_corridor_is_unconstrained_and_its_covariance_grows() -> None:
    played = play(LidarOdometry(), {"cloud": [scan(CORRIDOR, along, k) for k in range(12)]})
    assert all("nothing constrains motion along (1.00, 0.00" in text for text in texts(played)[2:])
    last = played["odometry"][-1]
    assert last.pose_covariance is not None
    deviation = np.sqrt(np.diag(last.pose_covariance))
    assert deviation[0] > 10 * deviation[1]
    off = errors(played, along)[-1]
    assert abs(off[0]) < 3 * deviation[0]
    assert np.abs(off[1:3]).max() < 0.03


def test_map_epoch_begins_when_the_pose_moved_or_lost_certainty() -> None:
    """What is seen first then is as unsure as the pose, what was seen before stays as it was."""
    operator = LidarOdometry()
    operator.setup()
    for k in range(3):
        operator.process(scan(ROOM, lambda _: np.eye(4), k))
    grown = operator.state.tracker
    motion, epochs = grown._motion, grown._epochs
    seen, last = len(epochs), epochs[-1]
    much, little = tracker._UNSURER * last + 1.1 * tracker._SURE, tracker._UNSURER * last + 0.9 * tracker._SURE
    away = np.asarray(motion.T @ se3.exp(np.array([1.1, 0, 0, 0, 0, 0])))
    steps = ((motion.T, little, False), (motion.T, much, True), (motion.T, much, False), (away, much, True))
    rng, old = np.random.default_rng(1), np.column_stack([np.full(9, 5.0), np.linspace(-2, 3, 9), np.full(9, 1.0)])
    for k, (T, covariance, begins) in enumerate(steps):
        wall = np.column_stack([rng.normal(12.5 + 4 * k, 0.005, 400), rng.uniform(-1.9, 1.9, (400, 2))])
        grown._motion = replace(motion, T=T, covariance=covariance)
        grown._grow((wall - T[:3, 3]) @ T[:3, :3])
        seen += begins
        assert len(epochs) == seen
        assert set(grown._map.pairs(wall).births.tolist()) == {seen - 1}
    assert (epochs[-1] == much).all()
    assert set(grown._map.pairs(old).births.tolist()) == {0}


def test_pose_after_a_missed_first_step_requires_half_of_the_scan_mapped() -> None:
    """The velocity is not known, so the sensor may be beyond all that was searched."""
    operator = LidarOdometry()
    operator.setup()
    operator.process(scan(ROOM, circling, 0))
    begun = operator.state.tracker
    some = np.zeros((0, 6)), 400, 0.9, 0.4, 0.01, np.zeros(400, np.int64), np.ones(400)
    found = Fit(np.eye(4), np.eye(6), *some)
    assert begun._doubt(found, 7 * STEP, lost=False, far=True) == ""
    begun._missed = 1
    assert begun._doubt(found, 7 * STEP, lost=False, far=True) == "40% of the scan lie in mapped places"
    assert begun._doubt(replace(found, known=0.6), 7 * STEP, lost=False, far=True) == ""


def test_a_robot_that_nods_on_a_field_is_not_carried_away_by_it() -> None:
    """The ground holds height, roll and pitch. Of the rest nothing is known but that it began at rest, or not."""
    field = [(2, -1.0, (-60, 60), (-60, 60))]

    def nodding(t: float) -> Array:
        return along(t) @ se3.exp(np.array([0, 0, 0, 0.02 * np.sin(5 * t), 0.02 * (np.sin(3 * t + 1) - np.sin(1)), 0]))

    played = play(LidarOdometry(), {"cloud": [scan(field, nodding, k) for k in range(9)]})
    off, last = errors(played, nodding), played["odometry"][-1]
    assert np.abs(off[:, 2:5]).max() < 0.05
    assert np.abs(off[:, 5]).max() < 0.05
    assert np.linalg.norm(off[:, :2], axis=1).max() < 0.9  # it went 0.8 m
    assert np.sqrt(last.pose_covariance[0, 0]) > 1.0


def test_bad_scans_are_bridged_and_named() -> None:
    clouds = [scan(ROOM, circling, k) for k in range(12)]
    clouds[6] = clouds[6].replace(points=np.zeros((0, 3), np.float32))
    clouds[7] = clouds[7].replace(points=np.full((300, 3), np.nan, np.float32))
    clouds[8] = clouds[8].replace(points=np.full((300, 3), 1e30, np.float32))
    played = play(LidarOdometry(), {"cloud": clouds})
    assert texts(played)[6:10] == [*["predicted: 0 usable points"] * 3, "tracking"]
    spreads = [
        o.pose_covariance[0, 0] for o in played["odometry"] if isinstance(o, Odometry) and o.pose_covariance is not None
    ]
    assert spreads[8] > spreads[7] > spreads[6] > spreads[5]
    assert spreads[9] < spreads[8]
    assert np.linalg.norm(errors(played, circling)[-1, :3]) < 0.03


def test_no_pose_is_given_before_the_first_usable_scan() -> None:
    nothing = PointCloud(stamp=0, frame="lidar", points=np.zeros((0, 3), np.float32))
    played = play(LidarOdometry(), {"cloud": [nothing, scan(ROOM, circling, 1)]})
    assert texts(played) == ["lost: 0 usable points, and there is no map yet", "tracking: the map begins here"]
    assert [o.stamp for o in played["odometry"]] == [STEP]


def test_a_lidar_that_was_covered_is_found_again_near_by() -> None:
    def moved(t: float) -> Array:
        return circling(t if t < 0.65 else t + 0.8)

    clouds = [scan(ROOM, moved, k) for k in range(20)]
    for k in range(7, 15):
        clouds[k] = clouds[k].replace(points=np.zeros((0, 3), np.float32))
    played = play(LidarOdometry(), {"cloud": clouds})
    states = [text.split(":")[0] for text in texts(played)]
    assert states == ["tracking"] * 7 + ["predicted"] * 5 + ["lost"] * 3 + ["relocalised"] + ["tracking"] * 4
    assert [o.stamp // STEP for o in played["odometry"]] == [*range(12), *range(15, 20)]
    assert np.linalg.norm(errors(played, moved)[-4:, :3], axis=1).max() < 0.03


SQUARE = [
    (2, -0.6, (-4, 4), (-4, 4)), (2, 2.0, (-4, 4), (-4, 4)), (0, -4, (-4, 4), (-1, 2)), (0, 4, (-4, 4), (-1, 2)),
    (1, -4, (-4, 4), (-1, 2)), (1, 4, (-4, 4), (-1, 2)),
]  # fmt: skip

CUPBOARD = [(0, 3.0, (-1, -0.4), (-1, 1.2)), (0, 3.6, (-1, -0.4), (-1, 1.2)), (1, -0.4, (3.0, 3.6), (-1, 1.2))]


@pytest.mark.parametrize(
    ("world", "way", "state"),
    [
        (ROOM, circling, "relocalised"),
        (CORRIDOR, along, "lost: nothing constrains motion along (1.00, 0.00"),
        (SQUARE, along, "lost: ambiguous"),
        (CORRIDOR + CUPBOARD, along, "lost: nothing constrains motion along (1.00, 0.00"),
    ],
    ids=["a room", "a bare corridor", "a room that looks alike in four headings", "a corridor with one thing in it"],
)
def test_a_lidar_that_was_carried_blindly_is_found_again_only_where_one_place_fits(
    world: list[Any], way: Callable[[float], Array], state: str
) -> None:
    """It was covered for 0.3 s, and went on by a metre meanwhile."""

    def moved(t: float) -> Array:
        return way(t if t < 0.35 else t + 0.9)

    clouds = [scan(world, moved, k) for k in range(8)]
    for k in range(4, 7):
        clouds[k] = clouds[k].replace(points=np.zeros((0, 3), np.float32))
    played = play(LidarOdometry(patience=0.15), {"cloud": clouds})
    assert [text.split(":")[0] for text in texts(played)[4:7]] == ["predicted", "lost", "lost"]
    assert texts(played)[7].startswith(state)
    assert state != "relocalised" or np.linalg.norm(errors(played, moved)[-1, :3]) < 0.03


def cabinet(x: float, height: float) -> list[Any]:
    """A box of 0.6 m on the right side of the corridor, open at its top."""
    return [
        (0, x, (-1, -0.4), (-1, height)),
        (0, x + 0.6, (-1, -0.4), (-1, height)),
        (1, -0.4, (x, x + 0.6), (-1, height)),
    ]


def aslant(t: float) -> Array:
    """A way along the corridor by a LiDAR that is mounted 5 degrees off, so that its columns meet no wall squarely."""
    T = se3.exp(np.array([0, 0, 0, 0, 0, 0.09]))
    T[:3, 3] = t, 0.1, 0
    return T


@pytest.mark.parametrize("x", [3.4, *(pytest.param(x, marks=pytest.mark.long) for x in (2.6, 4.3, 5.7))])
@pytest.mark.parametrize("height", [0.3, 1.2])
def test_error_along_a_corridor_with_one_object_is_within_its_covariance(x: float, height: float) -> None:
    world = CORRIDOR + cabinet(x, height)
    played = play(LidarOdometry(), {"cloud": [scan(world, aslant, k) for k in range(12)]})
    off = errors(played, aslant)
    claimed = [
        np.sqrt(o.pose_covariance[0, 0])
        for o in played["odometry"]
        if isinstance(o, Odometry) and o.pose_covariance is not None
    ]
    assert len(claimed) == len(off) == 12
    assert (np.abs(off[1:, 0]) < 3 * np.array(claimed)[1:]).all()


def test_a_first_step_of_metres_is_found_and_not_believed_where_nothing_holds_it() -> None:
    """Nothing is known of the velocity yet. Once it is, the prediction stands in for what a corridor does not show."""
    quick = play(LidarOdometry(), {"cloud": [scan(ROOM, lambda t: along(4 * t), k) for k in (0, 4)]})
    assert texts(quick) == ["tracking: the map begins here", "tracking"]
    assert np.linalg.norm(errors(quick, lambda t: along(4 * t))[-1, :3]) < 0.03
    bare = play(LidarOdometry(), {"cloud": [scan(CORRIDOR, along, k) for k in (0, 4)]})
    assert texts(bare)[1].startswith("predicted: nothing constrains motion along (1.00, 0.00")
    later = play(LidarOdometry(), {"cloud": [scan(CORRIDOR, along, k) for k in (0, 1, 2, 8)]})
    assert texts(later)[3].startswith("tracking: nothing constrains motion along (1.00, 0.00")


def street(seed: int) -> list[Any]:
    """A road between facades that stand back by different lengths, with walls between them."""
    rng = np.random.default_rng(seed)
    world: list[Any] = [(2, -1.8, (-60, 160), (-12, 12))]
    for side in (-1, 1):
        x, before = -60.0, 8.0
        while x < 150:
            end, back = x + rng.uniform(3, 12), rng.uniform(5, 11)
            world.append((1, side * back, (x, end), (-2, 6)))
            world.append((0, x, tuple(sorted((side * before, side * back))), (-2, 6)))
            x, before = end, back
    return world


def car(t: float) -> Array:
    """A car of 12 m/s that speeds up and brakes."""
    return se3.exp(np.array([12 * t + 2 * np.sin(t), 0.2 * np.sin(t), 0, 0, 0, 0.03 * np.sin(t)]))


def driven(seed: int) -> Played:
    """Plays a drive whose first scans show the velocity; then 7 m lie between two scans."""
    return play(LidarOdometry(near=1.0), {"cloud": [scan(street(seed), car, k) for k in (0, 1, 2, *range(8, 50, 6))]})


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 4, 5])
def test_a_car_that_moves_metres_between_scans_is_followed(seed: int) -> None:
    played = driven(seed)
    assert texts(played) == ["tracking: the map begins here", *["tracking"] * 9]
    assert np.linalg.norm(errors(played, car)[:, :3], axis=1).max() < 0.05


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_a_step_of_metres_that_is_wrong_comes_with_a_doubt(seed: int) -> None:
    played = driven(seed)
    doubted = [text != "tracking" for text in texts(played)[1:]]
    wrong = [bool(off > 0.3) for off in np.linalg.norm(errors(played, car)[1:, :3], axis=1)]
    first = wrong.index(True) if True in wrong else len(wrong)
    assert True not in wrong or any(doubted[: first + 1])


@pytest.mark.long
def test_a_fast_sensor_that_is_lost_is_searched_for_in_bounded_work(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []

    def counted(*given: Any) -> Any:
        found = around(*given)
        searched.append(len(found[0]))
        return found

    monkeypatch.setattr(tracker, "around", counted)
    covered = [scan(street(3), car, k).replace(points=np.zeros((0, 3), np.float32)) for k in range(3, 12)]
    elsewhere = [scan(street(9), car, k) for k in range(12, 30, 3)]
    played = play(LidarOdometry(near=1.0), {"cloud": [scan(street(3), car, k) for k in range(3)] + covered + elsewhere})
    assert texts(played)[-1].startswith("lost")
    assert len(searched) > 5
    assert max(searched) < 6000


def test_another_place_is_not_taken_for_the_mapped_one_and_a_new_map_begins() -> None:
    elsewhere = [(axis, 3 * place, *spans) if axis == 2 else (axis, place, *spans) for axis, place, *spans in CORRIDOR]
    clouds = [scan(ROOM, circling, k) for k in range(6)] + [scan(elsewhere, along, k) for k in range(6, 18)]
    played = play(LidarOdometry(patience=0.35, give_up=0.4), {"cloud": clouds})
    states = [text.split(":")[0] for text in texts(played)]
    assert states[6:10] == ["predicted"] * 3 + ["lost"]
    assert "relocalised" not in states
    assert any("a new map begins here" in text for text in texts(played)[6:])
    last = played["odometry"][-1]
    assert np.sqrt(last.pose_covariance[0, 0]) > 1.0  # it may be anywhere by now, and says so


def test_restored_operator_resumes_alike() -> None:
    assert_resumes_alike(LidarOdometry, [(scan(ROOM, circling, k, timed=True),) for k in range(8)], 5)


def test_near_must_be_less_than_far() -> None:
    with pytest.raises(ValueError, match="near must be less than far"):
        LidarOdometry(near=5.0, far=4.0).setup()


def test_thinning_keeps_the_first_point_of_a_cube() -> None:
    points = np.array([[0.1, 0, 0], [0.2, 0.1, 0], [1.1, 0, 0], [0.3, 0, 0], [-0.1, 0, 0]])
    assert thinned(points, 0.5).tolist() == [0, 2, 4]
    others = np.random.default_rng(0).uniform(-2, 2, (2000, 3))  # written where those before were, in part
    assert len(thinned(others, 0.5)) <= 8**3
    assert thinned(points, 0.5).tolist() == [0, 2, 4]
    each = np.stack(np.meshgrid(*[np.arange(20)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5
    assert len(thinned(each, 1.0)) > 0.97 * len(each)


@pytest.mark.long
@pytest.mark.data
def test_the_end_of_a_drive_is_that_of_direct_registration(data_dir: Path) -> None:
    import small_gicp

    files = sorted((data_dir / "kitti_lidar_camera" / "velodyne").glob("*.bin"))[:13]
    scans = [np.fromfile(file, np.float32).reshape(-1, 4)[:, :3].copy() for file in files]
    guess = se3.exp(np.array([2.7, 0, 0, 0, 0, 0.0]))
    direct = small_gicp.align(
        scans[0].astype(float), scans[-1].astype(float), init_T_target_source=guess, downsampling_resolution=0.25,
        max_correspondence_distance=1.0, num_threads=1, max_iterations=100,
    ).T_target_source  # fmt: skip
    clouds = [PointCloud(stamp=k * STEP, frame="velodyne", points=points) for k, points in enumerate(scans)]
    played = play(LidarOdometry(near=2.0), {"cloud": clouds})
    last = played["odometry"][-1]
    off = se3.log(invert(direct) @ last.matrix())
    assert np.linalg.norm(off[:3]) < 0.1
    assert np.degrees(np.linalg.norm(off[3:])) < 0.2
