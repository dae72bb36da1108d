"""OccupancyMapper in made rooms whose plan is known."""

from __future__ import annotations

import numpy as np
import pytest
from operator_runs import assert_resumes_alike

from dataflow.messages import Message, OccupancyGrid, Odometry, PointCloud, Pose, Transforms
from dataflow.testing import play
from operators.mapping import OccupancyMapper

LEVEL = [0.0, 0.0, 0.0, 1.0]


def cloud(points: np.ndarray, stamp: int = 1, **fields: object) -> PointCloud:
    return PointCloud(stamp=stamp, frame="lidar", points=np.asarray(points, np.float32).reshape(-1, 3), **fields)


def pose(position: object = (0.0, 0.0, 0.6), stamp: int = 1, **fields: object) -> Pose:
    return Pose(stamp=stamp, frame="world", child_frame="lidar", position=position, orientation=LEVEL, **fields)


def walls(sensor: tuple[float, float] = (0.0, 0.0), side: float = 4.02) -> np.ndarray:
    """What a LiDAR at 0.6 m sees of a square room of walls about the origin, in its own frame."""
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 720), np.linspace(-0.25, 0.25, 8))
    d = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1)
    d = d.reshape(-1, 3)
    with np.errstate(divide="ignore"):
        wall = ((np.sign(d[:, :2]) * side / 2 - sensor) / d[:, :2]).min(axis=1)
        floor = np.where(d[:, 2] < 0, -0.6 / d[:, 2], np.inf)
    return d * np.minimum(wall, floor)[:, None]


def mapped(clouds: list[PointCloud], poses: list[Pose | Odometry], **params: object) -> dict[str, list[Message]]:
    return play(OccupancyMapper(period=1, **params), {"cloud": clouds, "pose": poses}).outputs


def cell(grid: OccupancyGrid, x: float, y: float) -> int:
    column, row = np.floor((np.array([x, y]) - grid.position[:2]) / grid.resolution).astype(int)
    inside = 0 <= row < grid.cells.shape[0] and 0 <= column < grid.cells.shape[1]
    return int(grid.cells[row, column]) if inside else -1


def last_map(played: dict[str, list[Message]]) -> OccupancyGrid:
    return played["map"][-1]


def test_a_room_is_free_within_its_walls_and_unknown_beyond() -> None:
    grid = last_map(mapped([cloud(walls(), k) for k in (1, 2)], [pose(stamp=k) for k in (1, 2)]))
    rows, columns = np.mgrid[: grid.cells.shape[0], : grid.cells.shape[1]]
    x, y = (grid.position[k] + (c + 0.5) * grid.resolution for k, c in enumerate((columns, rows)))
    reach = np.maximum(np.abs(x), np.abs(y))
    assert grid.frame == "world"
    assert (grid.cells[(reach < 1.9) & (np.hypot(x, y) > 0.4)] < 50).all()
    assert (grid.cells[(reach < 1.9) & (np.hypot(x, y) > 0.4)] >= 0).mean() > 0.99
    assert (grid.cells[(reach > 2.0) & (reach < 2.05)] > 50).mean() > 0.95
    assert (grid.cells[reach > 2.1] == -1).all()


def test_a_table_stays_taken_though_it_is_seen_over_and_under() -> None:
    top = np.stack(np.meshgrid(np.arange(0.8, 1.3, 0.01), np.arange(-0.3, 0.3, 0.01)), axis=-1).reshape(-1, 2)
    table = np.column_stack([top, np.full(len(top), 0.74)])
    behind = np.column_stack([np.full(400, 3.0), np.linspace(-1, 1, 400), np.tile(np.linspace(0.1, 1.4, 20), 20)])
    high, low = np.array([0, 0, 1.3]), np.array([0, 0, 0.4])
    clouds, poses = [], []
    for k in range(10):
        clouds += [cloud(np.concatenate([table, behind]) - high, 2 * k + 1), cloud(behind - low, 2 * k + 2)]
        poses += [pose(high, 2 * k + 1), pose(low, 2 * k + 2)]
    grid = last_map(mapped(clouds, poses))
    assert cell(grid, 1.02, 0.02) > 50
    assert 0 <= cell(grid, 0.6, 0.02) < 50


def test_cells_of_a_removed_object_become_free() -> None:
    post = np.column_stack([np.full(8, 1.02), np.zeros(8), 1.02 * np.tan(np.linspace(-0.25, 0.25, 8))])
    clouds = [cloud(np.concatenate([post, walls()])), *(cloud(walls(), k) for k in range(2, 15))]
    played = mapped(clouds, [pose(stamp=k) for k in range(1, 15)])
    first, last = played["map"][0], played["map"][-1]
    assert cell(first, 1.02, 0.0) > 50
    assert 0 <= cell(last, 1.02, 0.0) < 50


def test_floor_is_free_and_a_low_step_is_taken() -> None:
    floor = np.column_stack([np.linspace(1, 2, 200), np.full(200, 0.01), np.full(200, -0.6)])
    step = np.column_stack([np.full(50, 1.52), np.full(50, 0.51), np.linspace(-0.6, -0.5, 50)])
    grid = last_map(mapped([cloud(np.concatenate([floor, step]))], [pose()]))
    assert 0 <= cell(grid, 1.8, 0.01) < 50
    assert cell(grid, 1.52, 0.51) > 50


def test_the_cloud_may_come_from_a_sensor_on_the_posed_robot() -> None:
    mount = Transforms.from_matrix(
        np.block([[np.eye(3), np.array([[0.2], [0], [0.6]])], [np.zeros((1, 3)), 1]]),
        stamp=1, frame="base", child_frame="lidar",
    )  # fmt: skip
    base = Pose(stamp=1, frame="world", child_frame="base", position=[-0.2, 0, 0], orientation=LEVEL)
    played = play(OccupancyMapper(period=1), {"cloud": [cloud(walls())], "pose": [base], "extrinsics": [mount]})
    direct = mapped([cloud(walls())], [pose()])
    assert last_map(played.outputs).cells.tobytes() == last_map(direct).cells.tobytes()
    operator = OccupancyMapper()
    operator.setup()
    with pytest.raises(ValueError, match="there are no extrinsics"):
        operator.process(cloud(walls()), base)


def test_a_moving_sensor_is_deskewed() -> None:
    points = walls()
    offsets = np.linspace(-0.1, 0, len(points)).astype(np.float32)
    moved = points - np.outer(offsets, [2.0, 0, 0])  # from where the sensor was then, at 2 m/s ahead
    at = Odometry(
        stamp=1, frame="world", child_frame="lidar", position=[0, 0, 0.6], orientation=LEVEL,
        linear=[2.0, 0, 0], angular=[0, 0, 0],
    )  # fmt: skip
    grid = last_map(mapped([cloud(moved, time_offsets=offsets)], [at]))
    assert abs(grid.cells.shape[1] * grid.resolution - 4.05) < 0.11


def test_a_table_top_that_few_scans_hit_at_its_edge_stays_though_all_pass_below_it() -> None:
    z = np.linspace(0.55, 0.68, 40) - 0.6  # under the top
    below = np.stack([np.full(40, 3.0), np.zeros(40), 3.0 * z], axis=1)
    edge = np.array([[1.0, 0.0, 0.11]])  # of a top at 0.70 to 0.72 m
    scans = [cloud(np.concatenate([below, edge]) if k % 4 == 0 else below, k + 1) for k in range(12)]
    poses: list[Pose | Odometry] = [pose(stamp=k + 1) for k in range(12)]
    assert cell(last_map(mapped(scans, poses)), 1.01, 0.01) > 50
    assert cell(last_map(mapped(scans, poses, layer=0.2)), 1.01, 0.01) < 50


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((5, 3), np.nan), np.zeros((9, 3))])
def test_uninformative_cloud_is_reported_and_survived(points: np.ndarray) -> None:
    played = mapped([cloud(points), cloud(walls(), 2)], [pose(), pose(stamp=2)])
    first, second = played["status"]
    assert first.levels.tolist() == [1]
    assert second.levels.tolist() == [0]
    assert cell(last_map(played), 1.0, 0.0) >= 0


def test_a_pose_that_is_not_finite_is_named_and_another_frame_is_an_error() -> None:
    played = mapped([cloud(walls())], [pose([np.nan, 0, 0])])
    status = played["status"][0]
    assert status.messages == ("the pose is not finite",)
    operator = OccupancyMapper()
    operator.setup()
    operator.process(cloud(walls()), pose())
    with pytest.raises(ValueError, match="the map is in frame 'world'"):
        operator.process(cloud(walls(), 2), pose(stamp=2).replace(frame="odom"))


def test_a_map_that_grows_beyond_bounds_is_an_error() -> None:
    operator = OccupancyMapper(most_cubes=1000)
    operator.setup()
    with pytest.raises(ValueError, match="more than 1000 cubes"):
        operator.process(cloud(walls()), pose())


@pytest.mark.parametrize("params", [{"lower": 2.0}, {"near": 9.0}])
def test_a_band_or_range_that_holds_nothing_is_refused(params: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be below"):
        OccupancyMapper(**params).setup()


def test_restored_operator_resumes_alike() -> None:
    firings = [(cloud(walls((0.1 * k, 0.0)), k + 1), pose([0.1 * k, 0, 0.6], k + 1)) for k in range(6)]
    assert_resumes_alike(lambda: OccupancyMapper(period=1), firings, 3)
