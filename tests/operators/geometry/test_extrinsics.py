"""Extrinsics are found in either direction; images must fit their calibration."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.messages import CameraInfo, Image, Transforms
from dataflow.messages.geometry import invert, split_matrix, transform_points
from operators.geometry import se3
from operators.geometry.calibration import check_calibration
from operators.geometry.extrinsics import transform_between, with_transform

T_depth_color = se3.exp(np.array([0.02, -0.01, 0.03, 0.05, -0.02, 0.1]))


def transforms(parent: str, child: str, T: np.ndarray) -> Transforms:
    position, orientation = split_matrix(T)
    return Transforms(
        stamp=0, frames=(parent,), child_frames=(child,), translations=position[None], rotations=orientation[None]
    )


def test_frames_may_be_related_over_others() -> None:
    poses = [split_matrix(T) for T in (T_depth_color, T_depth_color @ T_depth_color)]
    chain = Transforms(
        stamp=0,
        frames=("base", "base"),
        child_frames=("camera", "lidar"),
        translations=np.array([p for p, _ in poses]),
        rotations=np.array([q for _, q in poses]),
    )
    np.testing.assert_allclose(transform_between(chain, "lidar", "camera"), T_depth_color, atol=1e-9)


def tree(*pairs: tuple[str, str]) -> Transforms:
    """Returns a transform of each (parent, child), all different."""
    Ts = [se3.exp(np.array([0.1, 0.02, -0.05, 0.3, 0.1, -0.2]) * (k + 1)) for k in range(len(pairs))]
    return Transforms(
        stamp=0,
        frames=tuple(parent for parent, _ in pairs),
        child_frames=tuple(child for _, child in pairs),
        translations=np.array([T[:3, 3] for T in Ts]),
        rotations=np.array([split_matrix(T)[1] for T in Ts]),
    )


@pytest.mark.parametrize(
    ("pairs", "frame", "child", "kept"),
    [
        ([], "depth", "color", []),
        ([("depth", "color")], "depth", "color", []),
        ([("color", "depth")], "depth", "color", []),
        ([("base", "depth"), ("base", "color")], "depth", "color", [("base", "depth")]),
        ([("base", "depth"), ("depth", "color")], "depth", "color", [("base", "depth")]),
        ([("base", "color"), ("color", "depth")], "depth", "color", [("base", "color")]),
        ([("base", "color"), ("color", "m"), ("m", "depth")], "depth", "color", [("base", "color"), ("color", "m")]),
        ([("base", "m"), ("m", "color"), ("base", "depth")], "depth", "color", [("base", "m"), ("base", "depth")]),
        ([("depth", "color")], "base", "depth", [("depth", "color")]),
        ([("color", "depth")], "base", "depth", [("color", "depth")]),
        ([("rig", "color"), ("rig", "depth")], "base", "depth", [("rig", "color"), ("rig", "depth")]),
    ],
)
def test_a_transform_is_put_into_a_tree_that_stays_one(
    pairs: list[tuple[str, str]], frame: str, child: str, kept: list[tuple[str, str]]
) -> None:
    given = tree(*pairs) if pairs else None
    T = se3.exp(np.array([0.4, -0.3, 0.2, 1.0, 2.0, 3.0]))
    made = with_transform(given, 7, frame, child, T)
    assert made.stamp == 7
    np.testing.assert_allclose(transform_between(made, child, frame), T, atol=1e-12)
    for parent, below in kept:
        expected = transform_between(given, below, parent)
        np.testing.assert_allclose(transform_between(made, below, parent), expected, atol=1e-12)
    everyone = {each for pair in pairs for each in pair} | {frame, child}
    assert made.count == len(everyone) - 1
    for each in everyone:
        transform_between(made, each, frame)  # related to all


def test_frames_of_two_trees_have_no_place_for_a_transform() -> None:
    with pytest.raises(ValueError, match="no transform between 'depth' and 'rig'"):
        with_transform(tree(("base", "depth"), ("rig", "color")), 0, "depth", "color", np.eye(4))


@given(st.integers(0, 100))
def test_both_directions_map_the_same_point(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(5, 3))
    expected = transform_points(T_depth_color, points)
    for extrinsics in (
        transforms("depth", "color", T_depth_color),
        transforms("color", "depth", invert(T_depth_color)),
    ):
        found = transform_between(extrinsics, "color", "depth")
        np.testing.assert_allclose(transform_points(found, points), expected, atol=1e-12)


def test_one_frame_needs_no_extrinsics() -> None:
    np.testing.assert_array_equal(transform_between(None, "a", "b"), np.eye(4))
    np.testing.assert_array_equal(transform_between(transforms("x", "y", T_depth_color), "a", "a"), np.eye(4))


def test_frames_that_are_not_related_are_named() -> None:
    with pytest.raises(ValueError, match="no transform between 'depth' and 'lidar'; they hold color in depth"):
        transform_between(transforms("depth", "color", T_depth_color), "depth", "lidar")


def info(**changes: object) -> CameraInfo:
    given = {"stamp": 0, "frame": "camera", "width": 4, "height": 3, "K": np.diag([5.0, 5.0, 1.0])}
    return CameraInfo(**given | changes)


@pytest.mark.parametrize(
    ("calibration", "words"),
    [
        (info(width=5), "image has 4x3 pixels, but image_info describes 5x3"),
        (info(frame="other"), "image is in frame 'camera', but image_info in 'other'"),
        (info(distortion_model="plumb_bob", distortion=np.array([0.1, 0, 0, 0, 0])), "has lens distortion"),
    ],
)
def test_an_image_that_does_not_fit_its_calibration_is_refused(calibration: CameraInfo, words: str) -> None:
    image = Image(stamp=0, frame="camera", data=np.zeros((3, 4, 3), np.uint8))
    with pytest.raises(ValueError, match=words):
        check_calibration("image", image, calibration)


def test_an_image_that_fits_is_taken() -> None:
    image = Image(stamp=0, frame="camera", data=np.zeros((3, 4, 3), np.uint8))
    check_calibration("image", image, info())
    check_calibration("image", image, info(distortion_model="plumb_bob", distortion=np.zeros(5)))


def test_a_transform_that_is_not_finite_is_named() -> None:
    broken = transforms("depth", "color", T_depth_color).replace(translations=np.full((1, 3), np.nan))
    for source, target in (("color", "depth"), ("depth", "color")):
        with pytest.raises(ValueError, match=f"transform between '{source}' and '{target}' that is not finite"):
            transform_between(broken, source, target)


def test_writing_into_a_returned_transform_does_not_change_the_cached_one() -> None:
    extrinsics = transforms("depth", "color", T_depth_color)
    transform_between(extrinsics, "color", "depth")[:] = 0
    again = transforms("depth", "color", T_depth_color)  # another message of the same value
    for told in (extrinsics, again):
        np.testing.assert_allclose(transform_between(told, "color", "depth"), T_depth_color, atol=1e-12)
    other = transforms("depth", "color", np.eye(4))
    np.testing.assert_allclose(transform_between(other, "color", "depth"), np.eye(4), atol=1e-12)
