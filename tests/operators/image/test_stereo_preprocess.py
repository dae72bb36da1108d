"""StereoPreprocess on two crooked cameras that see known points and a known wall."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from played_twice import counted_twice

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image, Transforms
from dataflow.messages.geometry import invert, transform_points
from dataflow.testing import Played, play
from operators.depth import StereoDepth
from operators.geometry import se3
from operators.geometry.lens import undistorted
from operators.image import StereoPreprocess, stereo_preprocess
from operators.image.stereo_preprocess import Rectification, rectify

WIDTH, HEIGHT = 200, 150
# the right camera, 0.2 m to the right, a little below, turned about all axes
T_left_right = se3.exp(np.array([0.2, 0.01, -0.005, 0.02, -0.04, 0.03]))
STATIC = ["left_info", "right_info", "extrinsics"]


def infos() -> tuple[CameraInfo, CameraInfo]:
    left = CameraInfo.from_intrinsics(
        stamp=0, frame="left", width=WIDTH, height=HEIGHT, fx=130, fy=131, cx=101, cy=73,
        distortion_model="plumb_bob", distortion=[-0.2, 0.05, 0.001, 0, 0],
    )  # fmt: skip
    right = CameraInfo.from_intrinsics(
        stamp=0, frame="right", width=WIDTH, height=HEIGHT, fx=128, fy=128, cx=97, cy=76,
        distortion_model="equidistant", distortion=[0.01, -0.002, 0, 0],
    )  # fmt: skip
    return left, right


def mount(T: np.ndarray = T_left_right) -> Transforms:
    return Transforms.from_matrix(T, stamp=0, frame="left", child_frame="right")


def wall_pattern(points: np.ndarray) -> np.ndarray:
    """Brightness of places (N, 3) in the left camera's frame: waves of many lengths over x and y."""
    rng = np.random.default_rng(4)
    value = np.zeros(len(points))
    for _ in range(40):
        kx, ky, phase = rng.uniform(-35, 35), rng.uniform(-35, 35), rng.uniform(0, 6.3)
        value += np.sin(kx * points[:, 0] + ky * points[:, 1] + phase)
    return 127 + 14 * value


def views(distance: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """What both raw cameras see of a wall at z = distance before the left one."""
    seen = []
    for info, T in zip(infos(), (np.eye(4), T_left_right), strict=True):
        v, u = np.mgrid[:HEIGHT, :WIDTH]
        rays = np.column_stack(
            [undistorted(np.column_stack([u.ravel(), v.ravel()]).astype(float), info), np.ones(u.size)]
        )
        rays = rays @ T[:3, :3].T
        points = T[:3, 3] + rays * ((distance - T[2, 3]) / rays[:, 2])[:, None]
        seen.append(wall_pattern(points).clip(0, 255).reshape(HEIGHT, WIDTH).astype(np.uint8))
    return seen[0], seen[1]


def streams(left: np.ndarray, right: np.ndarray, given: Any = None, extrinsics: Any = "mount") -> dict[str, Any]:
    left_info, right_info = given or infos()
    found = mount() if isinstance(extrinsics, str) else extrinsics
    return {
        "left": [Image(stamp=3, frame="left", data=left)],
        "right": [Image(stamp=3, frame="right", data=right)],
        "left_info": [left_info],
        "right_info": [right_info],
    } | ({} if found is None else {"extrinsics": [found]})


def prepared(*args: Any, params: Any = None, **kwargs: Any) -> Played:
    given = streams(*args, **kwargs)
    return play(StereoPreprocess(**(params or {})), given, static=[name for name in STATIC if name in given])


def only(played: Played, port: str) -> Any:
    (message,) = played[port]
    return message


motions = st.tuples(
    st.floats(0.05, 1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), *[st.floats(-0.15, 0.15) for _ in range(3)]
)


@given(motions, st.integers(0, 100))
def test_rectified_points_share_a_row_and_disparity_gives_depth(motion: tuple[float, ...], seed: int) -> None:
    T = se3.exp(np.array([motion[0], motion[1] * motion[0], motion[2] * motion[0], *motion[3:]]))
    ideal = [info.replace(distortion=None, distortion_model="none") for info in infos()]
    found = rectify(ideal[0], ideal[1], T, 1.0)
    points = np.random.default_rng(seed).uniform([-2, -2, 3], [2, 2, 8], (20, 3))  # in the left camera's frame
    left, right = (
        (points_there @ R.T) @ found.K.T
        for points_there, R in ((points, found.R_left), (transform_points(invert(T), points), found.R_right))
    )
    z = left[:, 2]
    left, right = left[:, :2] / left[:, 2:], right[:, :2] / right[:, 2:]
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-6)
    np.testing.assert_allclose(left[:, 0] - right[:, 0], found.K[0, 0] * found.baseline / z, atol=1e-6)
    assert found.baseline == pytest.approx(np.linalg.norm(T[:3, 3]))


def test_depth_of_the_rectified_pair_is_that_of_the_wall() -> None:
    ready = prepared(*views(2.0))
    left, right = only(ready, "prepared_left"), only(ready, "prepared_right")
    left_info, right_info = only(ready, "prepared_left_info"), only(ready, "prepared_right_info")
    assert left.frame == left_info.frame == "left_rectified"
    given = {"left": [left], "right": [right], "left_info": [left_info], "right_info": [right_info]}
    depth = only(play(StereoDepth(disparities=48), given), "depth")
    assert isinstance(depth, DepthImage)
    T_raw_rectified = only(ready, "frames").matrix("left_rectified")
    v, u = np.nonzero(depth.data > 0)
    z = depth.data[v, u].astype(float)
    K = left_info.K
    points = np.column_stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z])
    distance = transform_points(T_raw_rectified, points)[:, 2]
    assert len(z) > 0.7 * depth.data.size
    assert np.median(np.abs(distance - 2.0)) < 0.03
    status = only(ready, "status")
    assert isinstance(status, Diagnostics)
    assert status.messages == (f"baseline {np.linalg.norm(T_left_right[:3, 3]):.4f} m",)
    assert status.pairs(0)["left without image"] == status.pairs(0)["right without image"] == "0"


def test_calibrations_that_hold_the_rectification_are_obeyed() -> None:
    by_mount = prepared(*views())
    raw = infos()
    found = rectify(raw[0], raw[1], T_left_right, 0.0)
    given = tuple(
        info.replace(R=R, P=only(by_mount, f"prepared_{side}_info").P)
        for side, info, R in (("left", raw[0], found.R_left), ("right", raw[1], found.R_right))
    )
    by_calibration = prepared(*views(), given=given, extrinsics=None)
    assert by_calibration.digests()["prepared_right"] == by_mount.digests()["prepared_right"]


def test_a_rectified_pair_passes_bit_for_bit() -> None:
    base = CameraInfo.from_intrinsics(stamp=0, frame="left", width=WIDTH, height=HEIGHT, fx=90, fy=90, cx=99.5, cy=74.5)
    P = np.hstack([base.K, [[-18.0], [0], [0]]])
    given = base.replace(P=P * [1, 1, 1, 0]), base.replace(frame="right", P=P)
    left, right = views()
    ready = prepared(left, right, given=given, extrinsics=None)
    np.testing.assert_array_equal(only(ready, "prepared_left").data, left)
    np.testing.assert_array_equal(only(ready, "prepared_right").data, right)


def test_both_images_are_cropped_and_scaled_alike() -> None:
    ready = prepared(*views(), params={"crop": (20, 10, 160, 120), "width": 80})
    left, right = only(ready, "prepared_left_info"), only(ready, "prepared_right_info")
    assert (left.width, left.height, right.width, right.height) == (80, 60, 80, 60)
    np.testing.assert_array_equal(left.K, right.K)
    whole = only(prepared(*views()), "prepared_right_info")
    assert right.P[0, 3] == pytest.approx(whole.P[0, 3] / 2)


@pytest.mark.parametrize(
    ("T", "text"),
    [
        (np.eye(4), "at one place: no baseline"),
        (se3.exp(np.array([-0.2, 0, 0, 0, 0, 0])), "must lie to the right of 'left'"),
        (se3.exp(np.array([0.0, 0.2, 0, 0, 0, 0])), "must lie to the right of 'left'"),
        (se3.exp(np.array([0.2, 0, 0, 0, 2.4, 0])), "behind the camera|to the right"),
    ],
)
def test_cameras_that_are_no_pair_are_named(T: np.ndarray, text: str) -> None:
    with pytest.raises(OperatorFailure, match=text):
        prepared(*views(), extrinsics=mount(T))


def test_missing_and_mismatched_calibrations_are_named() -> None:
    left, right = views()
    with pytest.raises(OperatorFailure, match="hold no P to rectify by, and there are no extrinsics"):
        prepared(left, right, extrinsics=None)
    small = infos()[1].replace(width=100)
    with pytest.raises(OperatorFailure, match="a pair that is rectified must have one size"):
        prepared(left, right[:, :100], given=(infos()[0], small))


def test_calibrations_that_come_with_every_pair_are_worked_out_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made = list[Rectification]()

    def rectifying(*given: Any) -> Rectification:
        made.append(rectify(*given))
        return made[-1]

    monkeypatch.setattr(stereo_preprocess, "rectify", rectifying)
    given = streams(*views())
    pairs = {name: [given[name][0].replace(stamp=k) for k in (1, 2, 3)] for name in ("left", "right")}
    infos = {name: [given[name][0].replace(stamp=k) for k in (1, 2)] for name in ("left_info", "right_info")}
    mounts = [mount().replace(stamp=k) for k in (1, 2, 3)]
    play(StereoPreprocess(), pairs | infos | {"extrinsics": mounts})
    assert len(made) == 1


def test_two_plays_are_equal_and_a_restored_operator_sums_up_alike() -> None:
    counts = counted_twice(StereoPreprocess, streams(*views()), STATIC)
    assert counts == {"pairs": 1, "pixels without image": 0}
