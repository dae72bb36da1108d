"""The robot's own body leaves clouds and depth images; everything else stays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from operator_runs import assert_resumes_alike

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import CameraInfo, DepthImage, Diagnostics, PointCloud, Transforms
from dataflow.messages.geometry import invert, transform_points
from dataflow.testing import play
from operators.frames import DepthSelfFilter, SelfFilter
from operators.geometry import se3
from operators.geometry.body import BodyPart, in_body

BOX: Any = {"shape": "box", "size": (0.6, 0.4, 0.2), "position": (0.0, 0.0, 0.1)}
MAST: Any = {"shape": "cylinder", "size": (0.1, 0.1, 1.0), "position": (-0.2, 0.0, 0.7)}
T_base_lidar = se3.exp(np.array([0.1, 0.05, 0.6, 0.1, -0.2, 0.5]))
INFO = CameraInfo.from_intrinsics(stamp=0, frame="camera", width=64, height=48, fx=40, fy=40, cx=31.5, cy=23.5)
DOWN = np.array([[0, -1, 0, 0.4], [-1, 0, 0, 0], [0, 0, -1, 1.2], [0, 0, 0, 1.0]])  # a camera that looks at the floor


def mounts(*told: tuple[str, str, np.ndarray]) -> dict[str, list[Transforms]]:
    return {
        f"{frame}_{child}": [Transforms.from_matrix(T, stamp=0, frame=frame, child_frame=child)]
        for frame, child, T in told
    }


def filtered(points: np.ndarray, **params: Any) -> tuple[PointCloud, Diagnostics]:
    """Points are in the base; the cloud is the LiDAR's."""
    seen = transform_points(invert(T_base_lidar), points).astype(np.float32)
    cloud = PointCloud(stamp=5, frame="lidar", points=seen, intensities=np.arange(len(points), dtype=np.float32))
    transforms = mounts(("base_link", "lidar", T_base_lidar))
    operator = SelfFilter(**({"body": (BOX, MAST), "padding": 0.02} | params))
    played = play(operator, {"cloud": [cloud], "transforms": transforms}, static=["transforms"])
    (out,), (status,) = played["filtered"], played["status"]
    return out, status


OWN = [[0, 0, 0.1], [0.31, 0.2, 0.2], [-0.2, 0.04, 1.1], [-0.16, 0.03, 0.4]]
OTHERS = [[0.33, 0, 0.1], [0, 0.23, 0.1], [0, 0, 0.24], [-0.2, 0.08, 1.0], [2, 1, 0.3], [np.nan, 0, 0]]


def test_points_of_the_body_leave_with_all_their_fields() -> None:
    cloud, status = filtered(np.array(OWN + OTHERS))
    assert cloud.intensities.tolist() == [4, 5, 6, 7, 8, 9]
    assert cloud.count == 6
    assert status.pairs(0) == {"points": "10", "removed": "4"}
    assert status.levels.tolist() == [0]


def test_a_cloud_that_is_all_robot_is_a_warning_and_an_empty_cloud_none() -> None:
    cloud, status = filtered(np.array(OWN))
    assert (cloud.count, status.levels.tolist()) == (0, [1])
    cloud, status = filtered(np.zeros((0, 3)))
    assert (cloud.count, status.messages, status.levels.tolist()) == (0, ("0 of 0 points are the robot's own",), [0])


parts = st.builds(
    BodyPart,
    shape=st.just("box"),
    size=st.tuples(*[st.floats(0.1, 2)] * 3),
    position=st.tuples(*[st.floats(-1, 1)] * 3),
    rotation=st.tuples(*[st.floats(-3, 3)] * 3),
)


@given(parts, st.integers(0, 1000), st.floats(0, 0.2))
def test_box_contains_points_by_its_axes(part: BodyPart, seed: int, padding: float) -> None:
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.uniform(-1, 1, 6)) @ part.pose()
    own = rng.uniform(-2, 2, (50, 3))
    inside = (np.abs(own) <= np.array(part.size) / 2 + padding).all(axis=1)
    np.testing.assert_array_equal(in_body(transform_points(T, own), [(part, T)], padding), inside)


def test_a_part_that_moves_is_found_where_it_is() -> None:
    hand = {"shape": "cylinder", "size": (0.2, 0.2, 0.2), "frame": "hand"}
    clouds = [PointCloud(stamp=k, frame="base_link", points=np.array([[1, 0, 0], [2, 0, 0]])) for k in (10, 20)]
    arm = [
        Transforms.from_matrix(se3.exp(np.array([x, 0, 0, 0, 0, 0])), stamp=k, frame="base_link", child_frame="hand")
        for k, x in ((10, 1.0), (20, 2.0))
    ]
    played = play(SelfFilter(body=(hand,)), {"cloud": clouds, "transforms": {"arm": arm}})
    assert [cloud.points[:, 0].tolist() for cloud in played["filtered"]] == [[2], [1]]


def depth_of_floor_and_box() -> np.ndarray:
    """What the camera that looks down sees of the floor and of the robot's box, by its own rays."""
    v, u = np.mgrid[:48, :64]
    rays = np.stack([(u - 31.5) / 40, (v - 23.5) / 40, np.ones(u.shape)], axis=-1) @ DOWN[:3, :3].T
    top = DOWN[:3, 3] + rays * ((0.3 - DOWN[2, 3]) / rays[..., 2])[..., None]
    on_top = (np.abs(top[..., 0]) <= 0.3) & (np.abs(top[..., 1]) <= 0.2)
    return np.where(on_top, 0.9, 1.2).astype(np.float32)


def test_depths_of_the_body_become_no_returns() -> None:
    data = depth_of_floor_and_box()
    data[0, 0], data[0, 1] = np.nan, 0
    streams: Any = {
        "depth": [DepthImage(stamp=1, frame="camera", data=data)],
        "depth_info": [INFO],
        "transforms": mounts(("base_link", "camera", DOWN)),
    }
    raised = BOX | {"position": (0.0, 0.0, 0.2)}
    played = play(DepthSelfFilter(body=(raised,)), streams, static=["depth_info", "transforms"])
    (out,), (status,) = played["filtered"], played["status"]
    expected = np.where(data > 1.0, data, 0).astype(np.float32)
    expected[0, 0] = 0
    np.testing.assert_array_equal(out.data, expected)
    assert status.pairs(0) == {"returns": str(48 * 64 - 2), "removed": str(int((data < 1.0).sum()) - 1)}
    assert (data < 1.0).sum() > 50


def test_a_missing_transform_is_named() -> None:
    cloud = PointCloud(stamp=1, frame="lidar", points=np.zeros((1, 3)))
    with pytest.raises(OperatorFailure, match="no frame 'base_link'; there are none"):
        play(SelfFilter(body=(BOX,)), {"cloud": [cloud]})
    apart = mounts(("base_link", "imu", np.eye(4)), ("mast", "lidar", np.eye(4)))
    with pytest.raises(OperatorFailure, match="'base_link' hangs on 'base_link', but 'lidar' on 'mast'"):
        play(SelfFilter(body=(BOX,)), {"cloud": [cloud], "transforms": apart}, static=["transforms"])


@pytest.mark.parametrize(
    ("part", "text"),
    [
        ({"shape": "box", "size": (1, 0, 1)}, "size must be above 0"),
        ({"shape": "cylinder", "size": (1, 0.9, 1)}, "one diameter"),
        ({"shape": "ball", "size": (1, 1, 1)}, "'box' or 'cylinder'"),
        ({"shape": "box"}, r"SelfFilter\.body\.0\.size: Field required, got {'shape': 'box'}"),
        ({"shape": "box", "size": (1, 1, 1), "box": 1}, r"SelfFilter\.body\.0\.box: Extra inputs are not permitted"),
    ],
)
def test_a_part_that_is_no_body_is_named(part: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        SelfFilter(body=(part,))


def test_a_body_without_parts_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one part"):
        SelfFilter(body=()).setup()


def test_restored_operator_sums_up_alike() -> None:
    cloud = PointCloud(stamp=1, frame="base_link", points=np.array(OWN + OTHERS))
    one = assert_resumes_alike(lambda: SelfFilter(body=(BOX, MAST), padding=0.02), [(cloud,)] * 2, 1)
    assert one.summary() == {"points": 20, "removed": 8, "clouds": 2}
