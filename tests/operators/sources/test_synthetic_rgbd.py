"""The made-up sequence: its depth, colour, poses and boxes agree with one another."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from dataflow.messages import CameraInfo, DepthImage, Detections2D, Image, Message, Pose
from operators.sources import SyntheticRgbd
from operators.sources.room import CENTRE, HALF_SIZE, OBJECTS, Ball, camera_path


def play(**params: object) -> tuple[CameraInfo, list[dict[str, Message]]]:
    source = SyntheticRgbd(**({"width": 160, "height": 120, "frames": 3} | params))
    source.setup()
    info = source.static_outputs()["depth_info"]
    assert isinstance(info, CameraInfo)
    frames = [dict(messages) for messages in source.stream()]
    assert source.length() == len(frames)
    return info, frames


def world_points(info: CameraInfo, depth: DepthImage, pose: Pose) -> np.ndarray:
    """(H, W, 3) points of a depth image in the world."""
    v, u = np.mgrid[: depth.data.shape[0], : depth.data.shape[1]]
    rays = np.stack([(u - info.cx) / info.fx, (v - info.cy) / info.fy, np.ones(u.shape)], axis=-1)
    T = pose.matrix()
    return (rays * depth.data[..., None].astype(np.float64)) @ T[:3, :3].T + T[:3, 3]


def surface_distance(points: np.ndarray) -> np.ndarray:
    """Distance (N,) of points (N, 3) from the nearest surface of the room, by signed distances."""
    walls = np.abs(np.abs(points - CENTRE) - HALF_SIZE).min(axis=1)
    distances = [walls]
    for thing in OBJECTS:
        if isinstance(thing, Ball):
            distances.append(np.abs(np.linalg.norm(points - np.array(thing.center), axis=1) - thing.radius))
        else:
            middle, half = (np.array(thing.low) + thing.high) / 2, (np.array(thing.high) - thing.low) / 2
            q = np.abs(points - middle) - half
            distances.append(np.abs(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)))
    return np.min(distances, axis=0)


def test_every_depth_pixel_lies_on_a_surface() -> None:
    info, frames = play(depth_noise=0, rate=1)
    for messages in frames:
        points = world_points(info, messages["depth"], messages["ground_truth"])
        assert surface_distance(points.reshape(-1, 3)).max() < 1e-5


def test_colour_follows_the_surface_from_frame_to_frame() -> None:
    """A frame warped by true depth and poses into the other looks like it, and not when the pose is wrong."""
    info, frames = play(image_noise=0, depth_noise=0, rate=10, width=320, height=240)
    first, second = frames[0]["image"], frames[1]["image"]
    assert isinstance(first, Image)
    assert isinstance(second, Image)
    points = world_points(info, frames[1]["depth"], frames[1]["ground_truth"])

    def difference(T_world_camera: np.ndarray) -> float:
        T = np.linalg.inv(T_world_camera)
        x, y, z = np.moveaxis(points @ T[:3, :3].T + T[:3, 3], -1, 0)
        u, v = info.fx * x / z + info.cx, info.fy * y / z + info.cy
        warped = cv2.remap(first.data, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
        inside = (u > 0) & (v > 0) & (u < first.data.shape[1] - 1) & (v < first.data.shape[0] - 1)
        return float(np.median(np.abs(warped.astype(float) - second.data)[inside]))

    assert difference(frames[0]["ground_truth"].matrix()) < 3
    assert difference(frames[1]["ground_truth"].matrix()) > 6


def test_there_are_corners_to_track() -> None:
    _, frames = play(width=320, height=240, rate=1, frames=4)
    for messages in frames:
        gray = cv2.cvtColor(messages["image"].data, cv2.COLOR_RGB2GRAY)
        assert len(cv2.goodFeaturesToTrack(gray, 300, 0.01, 8)) > 150


def test_boxes_hold_the_projections_of_the_balls() -> None:
    info, frames = play(rate=0.5, frames=6, width=320, height=240)
    balls = [i for i, thing in enumerate(OBJECTS) if isinstance(thing, Ball)]
    seen = 0
    for messages in frames:
        found, pose = messages["objects"], messages["ground_truth"]
        assert isinstance(found, Detections2D)
        assert isinstance(pose, Pose)
        T = np.linalg.inv(pose.matrix())
        for row, identity in enumerate(found.ids.tolist() if found.ids is not None else []):
            assert found.labels()[row] == OBJECTS[identity].label
            if identity not in balls:
                continue
            ball = OBJECTS[identity]
            assert isinstance(ball, Ball)
            x, y, z = T[:3, :3] @ ball.center + T[:3, 3]
            radius = info.fx * ball.radius / z
            assert found.pixel_counts is not None
            if found.pixel_counts[row] < 0.99 * np.pi * radius**2:
                continue  # partly hidden
            # Pixel centres are whole numbers, box edges lie half a pixel out; off the axis a ball is drawn larger.
            center = np.array([info.fx * x / z + info.cx, info.fy * y / z + info.cy]) + 0.5
            low, high = found.boxes[row, :2], found.boxes[row, 2:]
            assert ((center - 1.15 * radius - 1 <= low) & (low <= center - radius + 1)).all()
            assert ((center + radius - 1 <= high) & (high <= center + 1.15 * radius + 1)).all()
            seen += 1
    assert seen >= 3


def test_the_path_is_smooth_and_closes() -> None:
    poses = [camera_path(t / 30, 16.0) for t in range(481)]
    np.testing.assert_allclose(poses[0], poses[-1], atol=1e-9)
    for before, after in pairwise(poses):
        step = np.linalg.inv(before) @ after
        assert np.linalg.norm(step[:3, 3]) < 0.04
        assert np.degrees(np.arccos((np.trace(step[:3, :3]) - 1) / 2)) < 2.5
    for T in poses[::40]:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert T[2, 1] < 0  # the image's down is the world's down


def test_the_noise_is_as_strong_as_asked() -> None:
    _, clean = play(frames=1, image_noise=0, depth_noise=0)
    _, noisy = play(frames=1, image_noise=3, depth_noise=0.002)
    z = clean[0]["depth"].data
    error = (noisy[0]["depth"].data - z) / z**2
    assert error.std() == pytest.approx(0.002, rel=0.05)
    pixels = clean[0]["image"].data
    middling = (pixels > 20) & (pixels < 235)
    error = noisy[0]["image"].data.astype(float) - pixels
    assert error[middling].std() == pytest.approx(3, rel=0.05)


def test_a_seed_repeats_and_another_differs() -> None:
    def digests(**params: object) -> list[bytes]:
        return [m.digest() for messages in play(**params)[1] for m in messages.values()]

    assert digests(seed=3) == digests(seed=3)
    assert digests(seed=3)[0] != digests(seed=4)[0]
    assert digests(seed=3) == digests(seed=3, frames=5)[: 3 * 4]  # a frame does not depend on how many follow


def test_one_frame_name_for_both_cameras_is_refused() -> None:
    with pytest.raises(ValueError, match="must differ, both are 'camera'"):
        play(image_frame="camera", depth_frame="camera")
