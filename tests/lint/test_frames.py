"""The frame tree: two parents, circles, and frames that hang on nothing."""

from __future__ import annotations

import numpy as np

from dataflow.lint.frames import FrameTree, check_frames
from dataflow.messages import Imu, Message, Odometry, Pose, Transforms


def transforms(*pairs: tuple[str, str]) -> Transforms:
    return Transforms(
        stamp=0,
        frames=tuple(parent for parent, _ in pairs),
        child_frames=tuple(child for _, child in pairs),
        translations=np.zeros((len(pairs), 3)),
        rotations=np.tile([0.0, 0.0, 0.0, 1.0], (len(pairs), 1)),
    )


def imu(frame: str) -> Imu:
    return Imu(stamp=0, frame=frame, angular_velocity=np.zeros(3), linear_acceleration=np.zeros(3))


def tree(**messages: Message) -> FrameTree:
    made = FrameTree()
    for stream, message in messages.items():
        made.see(stream, message)
    return made


def texts(made: FrameTree, root: str | None = None, wanted: tuple[str, ...] = ()) -> list[str]:
    return [finding.text for finding in check_frames(made, root, wanted)]


def test_a_whole_tree_is_sound() -> None:
    pose = Pose(stamp=0, frame="map", child_frame="base", position=np.zeros(3), orientation=np.array([0, 0, 0, 1.0]))
    assert texts(tree(tf=transforms(("base", "imu"), ("base", "lidar")), imu=imu("imu"), pose=pose), "map") == []


def test_a_sensor_without_a_place_is_named() -> None:
    (text,) = texts(tree(tf=transforms(("base", "lidar")), imu=imu("imu_link"), points=imu("lidar")))
    assert text.startswith("frame 'imu_link' is not connected to 'base'")


def test_two_parents_and_a_circle_are_errors() -> None:
    twice = texts(tree(a=transforms(("base", "camera")), b=transforms(("head", "camera"), ("base", "head"))))
    assert twice == ["frame 'camera' has 2 parents: 'base' (a), 'head' (b)"]
    (circle,) = texts(tree(a=transforms(("x", "y"), ("y", "z"), ("z", "x"))))
    assert circle.startswith("frames lie within each other: ")


def test_odometry_that_places_its_own_frame_or_none_is_named() -> None:
    def odometry(child: str) -> Odometry:
        still = np.array([0, 0, 0, 1.0])
        return Odometry(stamp=0, frame="odom", child_frame=child, position=np.zeros(3), orientation=still)

    assert texts(tree(o=odometry("odom"))) == ["it places frame 'odom' in itself: child_frame is that of the robot"]
    assert texts(tree(o=odometry(""))) == ["it places no frame: child_frame is that of the robot"]
    assert texts(tree(o=odometry("base"))) == []


def test_frames_of_the_contract_must_be_there() -> None:
    made = tree(tf=transforms(("base", "imu")))
    assert texts(made, None, ("imu", "gps")) == ["frame 'gps' is in the contract and in no message"]
    assert texts(made, "map") == ["the root 'map' is in no message"]


def test_frames_without_transforms_are_not_judged() -> None:
    assert texts(tree(imu=imu("imu"), other=imu("other"))) == []
