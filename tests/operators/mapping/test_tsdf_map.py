"""TsdfMap on made depth images of surfaces that are known."""

from __future__ import annotations

import numpy as np
import pytest
from operator_runs import assert_resumes_alike

from dataflow.messages import CameraInfo, DepthImage, Image, Mesh, Message, Pose
from dataflow.testing import play
from operators.mapping import TsdfMap

K = np.array([[80.0, 0, 39.5], [0, 80.0, 29.5], [0, 0, 1]])
INFO = CameraInfo(stamp=0, frame="camera", width=80, height=60, K=K)
LEVEL = [0.0, 0.0, 0.0, 1.0]


def sphere(center: tuple[float, float, float] = (0, 0, 1.5), radius: float = 0.5, wall: float = 2.5) -> np.ndarray:
    """Depth (60, 80) of a ball before a wall, seen from the origin along z."""
    v, u = np.mgrid[:60, :80]
    ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1)
    a, b = (ray * ray).sum(axis=-1), ray @ np.array(center)
    root = b * b - a * (np.dot(center, center) - radius**2)
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, wall).astype(np.float32)


def depth(data: np.ndarray, stamp: int = 1) -> DepthImage:
    return DepthImage(stamp=stamp, frame="camera", data=data)


def pose(position: object = (0.0, 0.0, 0.0), stamp: int = 1) -> Pose:
    return Pose(stamp=stamp, frame="world", child_frame="camera", position=position, orientation=LEVEL)


def mapped(depths: list[DepthImage], poses: list[Pose], **more: object) -> dict[str, list[Message]]:
    images = more.pop("images", [])
    streams = {"depth": depths, "pose": poses, "depth_info": [INFO]} | ({"image": images} if images else {})
    return play(TsdfMap(**{"period": 1} | more), streams).outputs


def last_mesh(outputs: dict[str, list[Message]]) -> Mesh:
    return outputs["mesh"][-1]


def test_the_mesh_lies_on_the_ball_and_the_wall_and_faces_the_camera() -> None:
    mesh = last_mesh(mapped([depth(sphere())], [pose()]))
    distance = np.abs(np.linalg.norm(mesh.vertices - [0, 0, 1.5], axis=1) - 0.5)
    wall = np.abs(mesh.vertices[:, 2] - 2.5)
    ball = distance < 0.04
    assert (np.minimum(distance, wall) < 0.02).mean() > 0.95
    assert ball.sum() > 300
    assert (wall < 0.02).sum() > 1000
    assert (mesh.normals[wall < 0.005][:, 2] < -0.99).mean() > 0.95
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    facing = np.einsum("ij,ij->i", np.cross(b - a, c - a), mesh.normals[mesh.triangles[:, 0]])
    assert (facing > 0).mean() > 0.97


def test_views_from_several_places_make_one_surface() -> None:
    depths, poses = [], []
    for k, x in enumerate((-0.2, 0.0, 0.2)):
        depths.append(depth(sphere((-x, 0, 1.5)), k + 1))
        poses.append(pose((x, 0, 0), k + 1))
    mesh = last_mesh(mapped(depths, poses))
    off = np.linalg.norm(mesh.vertices - [0, 0, 1.5], axis=1) - 0.5
    ball = np.abs(off) < 0.06
    assert np.sqrt(np.square(off[ball]).mean()) < 0.01


def test_noise_is_averaged() -> None:
    rng = np.random.default_rng(0)
    flat = np.full((60, 80), 1.5)
    depths = [depth((flat + rng.normal(0, 0.02, flat.shape)).astype(np.float32), k) for k in range(1, 31)]
    outputs = mapped(depths, [pose(stamp=k) for k in range(1, 31)], period=30)
    off = last_mesh(outputs).vertices[:, 2] - 1.5
    assert np.sqrt(np.square(off).mean()) < 0.008


def test_removed_object_is_carved_away() -> None:
    empty = np.full((60, 80), 2.5, np.float32)
    depths = [depth(sphere()), *(depth(empty, k) for k in range(2, 14))]
    outputs = mapped(depths, [pose(stamp=k) for k in range(1, 14)])
    ball = [np.abs(np.linalg.norm(m.vertices - [0, 0, 1.5], axis=1) - 0.5) < 0.04 for m in outputs["mesh"]]
    assert ball[0].sum() > 300
    assert ball[-1].sum() == 0


def test_colours_come_from_the_image_of_the_same_stamp() -> None:
    image = np.zeros((60, 80, 3), np.uint8)
    image[:, :40], image[:, 40:] = (200, 10, 10), (10, 200, 10)
    outputs = mapped([depth(sphere())], [pose()], images=[Image(stamp=1, frame="camera", data=image)])
    mesh, cloud = last_mesh(outputs), outputs["cloud"][-1]
    assert (mesh.colors[mesh.vertices[:, 0] < -0.1] == [200, 10, 10]).all()
    assert (mesh.colors[mesh.vertices[:, 0] > 0.1] == [10, 200, 10]).all()
    assert cloud.points.tobytes() == mesh.vertices.tobytes()


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf, 9.0])
def test_an_image_without_usable_depth_is_named_and_survived(bad: float) -> None:
    nothing = np.full((60, 80), bad, np.float32)
    outputs = mapped([depth(nothing), depth(sphere(), 2)], [pose(), pose(stamp=2)])
    first, second = outputs["status"]
    assert (first.levels[0], first.messages[0]) == (1, "no depth is usable")
    assert second.levels[0] == 0
    assert len(last_mesh(outputs).vertices) > 1000


def test_a_pose_that_is_not_finite_is_named_and_left_out() -> None:
    outputs = mapped([depth(sphere())], [pose((np.nan, 0, 0))])
    status = outputs["status"][0]
    assert status.messages == ("the pose is not finite",)
    assert len(last_mesh(outputs).vertices) == 0


def test_mismatched_input_is_an_error() -> None:
    operator = TsdfMap(most_blocks=3)
    operator.setup()
    with pytest.raises(ValueError, match="depth has 10x10 pixels"):
        operator.process(depth(np.ones((10, 10), np.float32)), pose(), INFO)
    small = Image(stamp=1, frame="camera", data=np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(ValueError, match="registered to the depth"):
        operator.process(depth(sphere()), pose(), INFO, small)
    for far in (1e6, 1e30):
        with pytest.raises(ValueError, match="farther than a million blocks"):
            operator.process(depth(sphere()), pose((far, 0.0, 0.0)), INFO)
    with pytest.raises(ValueError, match="more than most_blocks"):
        operator.process(depth(sphere()), pose(), INFO)
    with pytest.raises(ValueError, match="must be below far"):
        TsdfMap(near=5.0).setup()


def test_restored_operator_resumes_alike() -> None:
    firings = [(depth(sphere((0.05 * k, 0, 1.5)), k + 1), pose((-0.05 * k, 0, 0), k + 1), INFO) for k in range(4)]
    assert_resumes_alike(lambda: TsdfMap(period=1), firings, 2)
