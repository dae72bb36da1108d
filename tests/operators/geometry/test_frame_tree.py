"""The tree of frames: composition, interpolation on SE(3), and every way a lookup can fail."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from dataflow.messages import Odometry, Pose, Transforms
from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.frame_tree import FrameTree, TransformError, told_by

S = 1_000_000_000
twists = st.lists(st.floats(-2, 2), min_size=6, max_size=6).map(lambda v: np.array([*v[:3], *np.array(v[3:]) * 0.7]))
A, B = (se3.exp(np.array(v)) for v in ([1, 2, 3, 0.1, -0.2, 0.3], [-1, 0.5, 0, 0.4, 0.2, -0.9]))


def moving(T_at: dict[int, np.ndarray], **settings: int) -> FrameTree:
    tree = FrameTree(**settings)
    for stamp, T in T_at.items():
        tree.add(stamp, "odom", "base", T)
    return tree


def reason(tree: FrameTree, frame: str, child: str, stamp: int) -> str:
    with pytest.raises(TransformError) as caught:
        tree.lookup(frame, child, stamp)
    return caught.value.reason


@given(st.lists(twists, min_size=5, max_size=5), st.permutations(range(6)), st.integers(0, 5), st.integers(0, 5))
def test_lookup_is_the_product_of_the_transforms_between(
    steps: list[np.ndarray], order: list[int], a: int, b: int
) -> None:
    parents = [0, 0, 1, 1, 3]  # frame k + 1 is in frame parents[k]: a tree with two branches
    T_root = [np.eye(4)]
    for parent, step in zip(parents, steps, strict=True):
        T_root.append(T_root[parent] @ se3.exp(step))
    tree = FrameTree()
    for k in (k for k in order if k < 5):
        tree.fix(f"f{parents[k]}", f"f{k + 1}", se3.exp(steps[k]))
    found = tree.lookup(f"f{a}", f"f{b}", 0)
    np.testing.assert_allclose(found, invert(T_root[a]) @ T_root[b], atol=1e-9)
    np.testing.assert_allclose(tree.lookup(f"f{b}", f"f{a}", 0), invert(found), atol=1e-9)


@given(twists, twists, st.floats(0, 1))
def test_between_two_stamps_the_frame_moves_at_a_constant_twist(
    start: np.ndarray, twist: np.ndarray, share: float
) -> None:
    T = se3.exp(start)
    tree = moving({0: T, S: T @ se3.exp(twist)})
    np.testing.assert_allclose(tree.lookup("odom", "base", round(share * S)), T @ se3.exp(share * twist), atol=1e-7)


@given(twists, twists, st.floats(0, 1))
def test_rotations_between_are_those_of_slerp(first: np.ndarray, second: np.ndarray, share: float) -> None:
    between = se3.interpolated(se3.exp(first), se3.exp(second), share)[:3, :3]
    ends = Rotation.from_matrix([se3.exp(first)[:3, :3], se3.exp(second)[:3, :3]])
    np.testing.assert_allclose(between, Slerp([0, 1], ends)(share).as_matrix(), atol=1e-6)


def test_a_stamp_that_is_known_gives_its_transform_exactly() -> None:
    tree = moving({0: A, S: B})
    np.testing.assert_array_equal(tree.lookup("odom", "base", S), B)


def test_fixed_and_moving_transforms_chain() -> None:
    tree = moving({0: A, S: B})
    tree.fix("base", "lidar", A)
    tree.fix("map", "odom", B)
    np.testing.assert_allclose(tree.lookup("map", "lidar", S), B @ B @ A, atol=1e-12)


def test_each_reason_has_its_name() -> None:
    tree = moving({S: A, 2 * S: B, 9 * S: A}, gap=2 * S)
    tree.fix("world", "table", A)
    assert reason(tree, "odom", "camera", S) == "unknown frame"
    assert reason(tree, "odom", "table", S) == "not connected"
    assert reason(tree, "odom", "base", S - 1) == "too early"
    assert reason(tree, "odom", "base", 9 * S + 1) == "too late"
    assert reason(tree, "odom", "base", 5 * S) == "gap"
    with pytest.raises(TransformError, match=r"'base' in 'odom' is known up to 9000000000, 0.500 s before 9500000000"):
        tree.lookup("odom", "base", 9 * S + S // 2)
    with pytest.raises(TransformError, match="there are base, odom, table, world"):
        tree.lookup("odom", "camera", S)


def test_loops_second_parents_and_repeated_stamps_are_refused() -> None:
    tree = moving({0: A})
    tree.fix("base", "lidar", A)
    for frame, child, told in (("lidar", "odom", "loop"), ("base", "base", "loop"), ("map", "lidar", "second parent")):
        with pytest.raises(TransformError) as caught:
            tree.fix(frame, child, A)
        assert caught.value.reason == told
    with pytest.raises(TransformError, match="told again at 0"):
        tree.add(0, "odom", "base", B)
    np.testing.assert_array_equal(tree.lookup("odom", "base", 0), A)


def test_extrapolation_is_only_as_far_as_allowed() -> None:
    step = se3.exp(np.array([0.1, 0, 0, 0, 0, 0.1]))
    tree = moving({0: A, S: A @ step}, reach=S)
    np.testing.assert_allclose(tree.lookup("odom", "base", 2 * S), A @ step @ step, atol=1e-9)
    assert reason(tree, "odom", "base", 2 * S + 1) == "too late"
    assert reason(moving({0: A}, reach=S), "odom", "base", 1) == "too late"  # one stamp tells no motion


def test_only_the_horizon_is_remembered() -> None:
    tree = moving({k * S: A for k in range(6)}, horizon=2 * S)
    assert reason(tree, "odom", "base", 2 * S) == "too early"
    np.testing.assert_array_equal(tree.lookup("odom", "base", 3 * S), A)


def test_a_restored_tree_answers_alike() -> None:
    tree, again = moving({0: A, S: B}), FrameTree()
    again.restore(tree.snapshot())
    np.testing.assert_array_equal(again.lookup("odom", "base", S // 3), tree.lookup("odom", "base", S // 3))


def test_messages_tell_their_transforms() -> None:
    one = Transforms.from_matrix(A, stamp=0, frame="a", child_frame="b")
    pose = Pose.from_matrix(A, stamp=0, frame="a", child_frame="b")
    odometry = Odometry.from_matrix(A, stamp=0, frame="a", child_frame="b")
    for message in (one, pose, odometry):
        ((frame, child, T),) = told_by(message)
        assert (frame, child) == ("a", "b")
        np.testing.assert_allclose(T, A, atol=1e-12)
    assert told_by(pose.replace(child_frame="")) == []
