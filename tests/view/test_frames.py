"""The frame tree draws everything, whatever arrives first."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.messages.geometry import invert, quaternion_from_yaw, transform_matrix
from dataflow.view.frames import Attach, Detach, FrameCycleError, FramePriority, FrameTree, NewRoot


def T(x: float, y: float, yaw: float = 0.0) -> np.ndarray:
    return transform_matrix([x, y, 0.0], quaternion_from_yaw(yaw))


def place(
    tree: FrameTree,
    parent: str,
    child: str,
    pose: np.ndarray,
    owner: str = "tf",
    rank: FramePriority = FramePriority.TREE,
    t: int = 0,
):
    return tree.place(parent, child, pose, owner=owner, rank=rank, stamp=t)


def test_poses_compose_along_the_tree() -> None:
    tree = FrameTree()
    place(tree, "base", "camera", T(0.2, 0.0))
    place(tree, "map", "odom", T(1.0, 2.0, np.pi / 2))
    place(tree, "odom", "base", T(3.0, 0.0))
    assert tree.root == "map"
    np.testing.assert_allclose(tree.pose("camera"), T(1.0, 2.0, np.pi / 2) @ T(3.0, 0.0) @ T(0.2, 0.0), atol=1e-12)
    assert tree.assumed() == {}


def test_unplaced_frames_hang_under_the_root_and_are_marked() -> None:
    tree = FrameTree()
    assert tree.see("camera") == [NewRoot("camera")]
    assert tree.see("camera") == []
    changes = tree.see("map")
    assert NewRoot("map") in changes
    assert tree.assumed() == {"camera": "map"}
    (attached,) = place(tree, "map", "camera", T(1, 0))
    assert isinstance(attached, Attach)
    assert not attached.assumed
    assert tree.assumed() == {}


def test_a_pose_that_is_given_breaks_an_assumed_link_the_other_way_round() -> None:
    tree = FrameTree()
    tree.see("odom")
    tree.see("map")  # odom is now assumed to lie at the origin of map
    changes = place(tree, "odom", "map", T(1, 0))
    assert Detach("odom") in changes
    assert tree.root == "odom"
    np.testing.assert_allclose(tree.pose("map"), T(1, 0))


def test_a_cycle_of_given_poses_is_refused_with_its_frames() -> None:
    tree = FrameTree()
    place(tree, "a", "b", T(0, 0))
    place(tree, "b", "c", T(0, 0))
    with pytest.raises(FrameCycleError, match=r"'a' in 'c'.*'c' in 'b' in 'a'"):
        place(tree, "c", "a", T(0, 0))
    with pytest.raises(FrameCycleError, match="in itself"):
        place(tree, "a", "a", T(0, 0))


@pytest.mark.parametrize("truth_first", [True, False])
def test_an_estimate_places_the_camera_and_the_truth_is_aligned_with_it(truth_first: bool) -> None:
    tree = FrameTree()
    T_world_camera, T_odom_camera = T(5.0, -1.0, 0.7), T(0.1, 0.0, 0.1)
    poses = [
        ("world", T_world_camera, "truth", FramePriority.TRUTH),
        ("odom", T_odom_camera, "vo", FramePriority.ESTIMATE),
    ]
    for parent, pose, owner, rank in poses if truth_first else poses[::-1]:
        place(tree, parent, "camera", pose, owner, rank)
    assert tree.root == "world"
    np.testing.assert_allclose(tree.pose("odom"), T_world_camera @ invert(T_odom_camera), atol=1e-12)
    place(tree, "world", "camera", T(9, 9), "truth", FramePriority.TRUTH, 1)
    place(tree, "odom", "camera", T(1, 0), "vo", FramePriority.ESTIMATE, 1)
    expected = T_world_camera @ invert(T_odom_camera) @ T(1, 0)
    np.testing.assert_allclose(tree.pose("camera"), expected, atol=1e-12)  # aligned once, then the estimate alone


def test_streams_are_aligned_at_equal_stamps() -> None:
    tree = FrameTree()
    for t in range(5):
        place(tree, "world", "camera", T(t, 0.0), "truth", FramePriority.TRUTH, t)
    place(tree, "odom", "camera", T(0.0, 0.0), "vo", FramePriority.ESTIMATE, 2)
    np.testing.assert_allclose(tree.pose("odom"), T(2.0, 0.0), atol=1e-12)


FRAMES = st.sampled_from(["map", "odom", "base", "camera", "lidar", "imu"])


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(FRAMES, FRAMES, st.integers(-3, 3), st.sampled_from(list(FramePriority)), st.sampled_from("xyz")),
        max_size=25,
    )
)
def test_everything_hangs_under_one_root_and_the_changes_rebuild_the_tree(events: list) -> None:
    tree, drawn, root, seen = FrameTree(), {}, None, set()
    for t, (parent, child, x, rank, owner) in enumerate(events):
        try:
            changes = place(tree, parent, child, T(x, 1.0), owner, rank, t)
        except FrameCycleError:
            continue
        seen |= {parent, child}
        for change in changes:
            match change:
                case Attach():
                    drawn[change.child] = (change.parent, change.T_parent_child)
                case Detach():
                    del drawn[change.child]
                case NewRoot():
                    root = change.frame
    for frame in seen:
        pose, at, steps = np.eye(4), frame, 0
        while at in drawn:
            at, step = drawn[at][0], drawn[at][1]
            pose, steps = step @ pose, steps + 1
            assert steps <= len(seen)
        assert at == root == tree.root
        np.testing.assert_allclose(pose, tree.pose(frame), atol=1e-9)


def test_a_pose_of_a_stamp_is_that_of_then_and_of_no_other_time() -> None:
    tree = FrameTree()
    place(tree, "base", "camera", T(0.5, 0.0))
    place(tree, "odom", "base", T(1.0, 0.0), owner="odometry", rank=FramePriority.ESTIMATE, t=10)
    place(tree, "odom", "base", T(2.0, 0.0), owner="odometry", rank=FramePriority.ESTIMATE, t=20)
    np.testing.assert_allclose(tree.pose_at("camera", 10), T(1.5, 0.0))
    np.testing.assert_allclose(tree.pose_at("camera", 20), T(2.5, 0.0))
    assert tree.pose_at("camera", 30) is None, "it has moved on, and nobody has said where to"
    assert tree.pose_at("nowhere", 10) is None


def test_unplaced_frame_has_no_pose_at_a_stamp() -> None:
    tree = FrameTree()
    tree.see("map")
    tree.see("camera")
    assert tree.pose("camera") is not None
    assert tree.pose_at("camera", 0) is None
    assert tree.pose_at("map", 0) is not None
