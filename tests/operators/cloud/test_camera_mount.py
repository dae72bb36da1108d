"""The camera on a base that is level and on the ground, from what it sees first."""

from __future__ import annotations

import numpy as np
import pytest
from made_view import HEIGHT, Array, room, turned
from repeated import assert_repeats

from dataflow.messages import Imu, Odometry, PointCloud, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.testing import play
from operators.cloud import CameraMount, camera_mount
from operators.cloud.vertical import Vertical
from operators.geometry.extrinsics import transform_between


def cloud(points: Array, stamp: int = 0) -> PointCloud:
    return PointCloud(stamp=stamp, frame="depth", points=points.astype(np.float32))


def mounted(down: float, roll: float = 0) -> Transforms:
    """The extrinsics of an optical frame on a level base that looks down and is rolled, degrees."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ turned(down, 0).T @ turned(0, roll).T
    return Transforms.from_matrix(T, stamp=0, frame="base_link", child_frame="depth")


def related(parent: str, child: str, x: float = 0.0, stamp: int = 0) -> Transforms:
    T = np.eye(4)
    T[0, 3] = x
    return Transforms.from_matrix(T, stamp=stamp, frame=parent, child_frame=child)


NOTHING = np.zeros((0, 3))
EMPTY = [cloud(NOTHING, stamp * 1_000_000_000) for stamp in range(4)]
COLOR, GIVEN = related("depth", "color"), related("base_link", "depth")


def test_base_is_level_on_the_ground_below_the_camera() -> None:
    played = play(CameraMount(), {"cloud": [cloud(room(28, 5)), cloud(room(28, 5), 1)], "extrinsics": [COLOR]})
    (made,) = played["base_extrinsics"]
    assert made.frames == ("depth", "base_link")
    T = made.matrix("depth")
    assert T[:3, 3] == pytest.approx([0, 0, HEIGHT], abs=0.03)
    assert T[:3, :3] @ turned(28, 5) @ [0, -1, 0] == pytest.approx([0, 0, 1], abs=0.02)
    ahead = T[:3, 2]
    assert ahead[1] == pytest.approx(0, abs=1e-9)
    assert ahead[0] > 0.8
    assert "looks 28° down" in played["status"][0].messages[0]


def test_a_view_that_decides_later_counts_from_where_the_odometry_began() -> None:
    first, later = turned(28, 0), turned(10, 0)
    T = np.eye(4)
    T[:3, :3] = first @ later.T
    T[:3, 3] = first @ [0, -0.2, 0]  # 0.2 m higher by now
    moved = Odometry.from_matrix(T, stamp=1, frame="odom", child_frame="depth")
    streams = {"cloud": [cloud(NOTHING), cloud(room(10, 0), 1)], "motion": [moved]}
    (made,) = play(CameraMount(), streams)["base_extrinsics"]
    assert made.stamp == 1
    T_base_camera = made.matrix("depth")
    assert T_base_camera[2, 3] == pytest.approx(HEIGHT - 0.2, abs=0.03)
    assert T_base_camera[:3, :3] @ first @ [0, -1, 0] == pytest.approx([0, 0, 1], abs=0.02)


def test_after_a_while_without_surfaces_a_guess_is_taken_with_a_warning() -> None:
    played = play(CameraMount(patience="2s"), {"cloud": EMPTY[:3]})
    assert [m.stamp for m in played["base_extrinsics"]] == [2_000_000_000]
    assert played["status"][0].levels.tolist() == [Level.WARN]


def test_a_base_that_is_given_is_kept_and_passed_on_when_it_changes() -> None:
    mount, then = CameraMount(), related("base_link", "depth", 0.1)
    made = mount.process(cloud(room(28, 5)), GIVEN)
    assert made["base_extrinsics"].digest() == GIVEN.digest()
    again = mount.process(cloud(room(0, 0), 3), then)
    assert again["base_extrinsics"].digest() == then.replace(stamp=3).digest()


@pytest.mark.parametrize(("down", "wrong"), [(0, True), (28, False), (33, False)])
def test_a_given_base_is_compared_with_the_first_view_that_shows_the_vertical(down: float, wrong: bool) -> None:
    mount = CameraMount()
    clouds = [cloud(NOTHING), *(cloud(room(28, 0), stamp) for stamp in (1, 2))]
    played = play(mount, {"cloud": clouds, "extrinsics": [mounted(down)]})
    assert len(played["base_extrinsics"]) == 1
    (status,) = played["status"]
    assert (status.stamp, status.levels.tolist()) == (1, [Level.WARN if wrong else Level.OK])
    said = "looks 0° down, turned by 0°, by the surfaces in sight 28° down"
    assert (said in status.messages[0]) is wrong
    assert (said in mount.finding()) is wrong


@pytest.mark.parametrize(("roll", "perhaps"), [(0, False), (90, True), (180, True), (-90, True), (45, False)])
def test_a_camera_that_is_given_as_on_its_side_or_upside_down_may_be_so(roll: float, perhaps: bool) -> None:
    mount = CameraMount()
    play(mount, {"cloud": [cloud(room(0 if roll else 28, 0))], "extrinsics": [mounted(0, roll)]})
    assert mount.finding()
    assert ("if it is not mounted on its side or upside down, the extrinsics are wrong" in mount.finding()) is perhaps


def test_a_given_base_is_not_called_wrong_where_no_surface_shows_the_vertical() -> None:
    (status,) = play(CameraMount(patience="2s"), {"cloud": EMPTY, "extrinsics": [mounted(0)]})["status"]
    assert (status.stamp, status.levels.tolist()) == (2_000_000_000, [Level.OK])


def test_imu_of_a_frame_that_is_not_related_is_an_error() -> None:
    sample = Imu(stamp=0, frame="imu", angular_velocity=np.zeros(3), linear_acceleration=np.array([0, 0, 9.81]))
    with pytest.raises(Exception, match="no transform between 'imu' and 'depth'"):
        play(CameraMount(), {"cloud": [cloud(room(0, 0))], "imu": [sample], "extrinsics": [COLOR]})


def at_rest(down: float, roll: float, frame: str = "depth") -> Imu:
    """Returns what an accelerometer of that frame measures in a camera that looks down and is rolled, degrees."""
    force = turned(down, roll) @ [0, -9.81, 0]
    return Imu(stamp=0, frame=frame, angular_velocity=np.zeros(3), linear_acceleration=force)


def test_imu_without_extrinsics_must_be_of_the_same_frame() -> None:
    with pytest.raises(ValueError, match="imu is in frame 'imu' and cloud in 'depth': extrinsics must relate them"):
        CameraMount().process(cloud(room(0, 0)), None, at_rest(0, 0, "imu"))
    assert CameraMount().process(cloud(room(0, 0)), None, at_rest(0, 0)) is not None


def test_an_accelerometer_decides_where_surfaces_do_not() -> None:
    wall = room(40, 0, floor=False)
    told, unsure = CameraMount(), CameraMount()
    assert unsure.process(cloud(NOTHING)) is None
    made = told.process(cloud(wall), None, at_rest(40, 0))
    assert "looks 40° down" in made["status"].messages[0]
    assert made["base_extrinsics"].matrix("depth")[:3, :3] @ turned(40, 0) @ [0, -1, 0] == pytest.approx(
        [0, 0, 1], abs=0.02
    )


def test_an_acceleration_that_is_not_finite_is_counted_and_not_used() -> None:
    broken = at_rest(0, 0).replace(linear_acceleration=np.full(3, np.nan))
    with_it, without = CameraMount(), CameraMount()
    made, expected = with_it.process(cloud(room(28, 5)), None, broken), without.process(cloud(room(28, 5)))
    assert made["base_extrinsics"].digest() == expected["base_extrinsics"].digest()
    assert with_it.summary()["accelerations_not_finite"] == 1


def test_a_view_of_a_lost_odometry_does_not_decide() -> None:
    lost = Odometry.from_matrix(np.eye(4), stamp=0, frame="odom", child_frame="depth")
    lost = lost.replace(position=np.full(3, np.nan))
    mount = CameraMount()
    assert mount.process(cloud(room(28, 0)), None, None, lost) is None
    assert mount.process(cloud(room(28, 0), 1)) is not None


def test_ground_of_an_earlier_view_counts_if_the_last_shows_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    up, sure = np.array([0.0, -1.0, 0.0]), np.eye(3) * np.radians(0.5) ** 2
    views = [Vertical(up, sure, 0.9, 1.2), Vertical(up, sure, 0.3, 1.4), Vertical(up, sure, 0.01, None)]
    found = iter(views)
    monkeypatch.setattr(camera_mount, "find_vertical", lambda *_: next(found))
    mount = CameraMount()
    assert mount.process(cloud(NOTHING)) is None
    assert mount.process(cloud(NOTHING, 1)) is None
    made = mount.process(cloud(NOTHING, 2))
    assert made["base_extrinsics"].matrix("depth")[2, 3] == pytest.approx(1.4)
    assert "1.40 m above the ground" in made["status"].messages[0]


def test_extrinsics_that_change_later_are_completed_again_with_the_same_mount() -> None:
    mount = CameraMount()
    made = mount.process(cloud(room(28, 0)), COLOR)
    assert mount.process(cloud(room(10, 0), 1), COLOR) is None
    again = mount.process(cloud(room(10, 0), 9), related("depth", "color", 0.025, 5))
    assert set(again) == {"base_extrinsics"}
    assert again["base_extrinsics"].stamp == 9
    assert again["base_extrinsics"].matrix("color")[:3, 3] == pytest.approx([0.025, 0, 0])
    np.testing.assert_array_equal(again["base_extrinsics"].matrix("depth"), made["base_extrinsics"].matrix("depth"))


@pytest.mark.parametrize("pair", [pytest.param(("depth", "color"), marks=pytest.mark.long), ("color", "depth")])
def test_the_base_holds_all_cameras_whichever_is_the_parent(pair: tuple[str, str]) -> None:
    known = related(*pair, 0.05)
    made, alone = (CameraMount().process(cloud(room(28, 5)), given)["base_extrinsics"] for given in (known, None))
    expected = alone.matrix("depth")
    np.testing.assert_allclose(transform_between(made, "depth", "base_link"), expected, rtol=0, atol=1e-9)
    assert transform_between(made, pair[1], pair[0])[:3, 3] == pytest.approx([0.05, 0, 0], abs=1e-9)


@pytest.mark.parametrize("at", [1, 2], ids=["before it is decided", "after"])
@pytest.mark.parametrize("first", [NOTHING, room(28, 5, floor=False)[:6000]], ids=["nothing", "a single wall"])
def test_restored_mount_repeats_with_its_period_and_best_view(first: Array, at: int) -> None:
    calls = [(cloud(first),), (cloud(NOTHING, 2_000_000_000),), (cloud(room(28, 5), 3_000_000_000),)]
    made = assert_repeats(CameraMount, calls, at)
    assert [sorted(each) for each in made] == [[], ["base_extrinsics", "status"], []]


def test_clock_reset_restarts_the_mount_estimate() -> None:
    mount = CameraMount()
    before = mount.process(cloud(room(28, 0), 9))
    mount.on_reset("cloud")
    after = mount.process(cloud(room(10, 0), 1))
    assert "looks 28° down" in before["status"].messages[0]
    assert "looks 10° down" in after["status"].messages[0]
    assert mount.summary()["views"] == 2
