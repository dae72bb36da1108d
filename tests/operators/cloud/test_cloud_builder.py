"""CloudBuilder on surfaces whose points and colours are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.messages import CameraInfo, DepthImage, Image, PointCloud, Transforms
from operators.cloud import CloudBuilder
from operators.sources import SyntheticRgbd

WIDTH, HEIGHT = 64, 48


def info(frame: str, focal: float = 50.0) -> CameraInfo:
    return CameraInfo.from_intrinsics(
        stamp=0, frame=frame, width=WIDTH, height=HEIGHT, fx=focal, fy=focal + 1, cx=31.5, cy=23.5
    )


def depth_image(data: np.ndarray) -> DepthImage:
    return DepthImage(stamp=5, frame="depth", data=data.astype(np.float32))


def position_image() -> Image:
    """Red is the column, green the row: a colour says which pixel it was read from."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    return Image(stamp=5, frame="color", data=np.stack([column, row, 0 * row], axis=-1).astype(np.uint8))


def build(
    depth: np.ndarray, extrinsics: Transforms | None = None, image_focal: float = 50.0, **params: object
) -> PointCloud:
    builder = CloudBuilder(**({"stride": 1, "min_range": 0.0, "max_range": 10.0} | params))
    given = (depth_image(depth), position_image(), info("depth"), info("color", image_focal), extrinsics)
    return builder.process(*given)["cloud"]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 7))
def test_points_project_back_to_their_pixels_and_depths(seed: int, stride: int) -> None:
    depth = np.random.default_rng(seed).uniform(0.5, 5, (HEIGHT, WIDTH))
    cloud = build(depth, stride=stride, edge_ratio=0)
    u = np.rint(cloud.points[:, 0] / cloud.points[:, 2] * 50 + 31.5).astype(int)
    v = np.rint(cloud.points[:, 1] / cloud.points[:, 2] * 51 + 23.5).astype(int)
    rows, columns = np.mgrid[:HEIGHT:stride, :WIDTH:stride]
    assert u.tolist() == columns.ravel().tolist()
    assert v.tolist() == rows.ravel().tolist()
    np.testing.assert_array_equal(cloud.points[:, 2], depth.astype(np.float32)[v, u])
    np.testing.assert_array_equal(cloud.colors[:, :2], np.stack([u, v], axis=1))
    assert (cloud.stamp, cloud.frame) == (5, "depth")


def test_missing_and_out_of_range_depths_make_no_points() -> None:
    depth = np.full((HEIGHT, WIDTH), 2.0)
    depth[0, :5] = 0, np.nan, 0.99, 3.01, np.inf
    cloud = build(depth, min_range=1.0, max_range=3.0, edge_ratio=0)
    assert len(cloud.points) == WIDTH * HEIGHT - 5
    assert build(np.zeros((HEIGHT, WIDTH))).points.shape == (0, 3)


@pytest.mark.parametrize("nothing", [0.0, np.nan, np.inf])
def test_missing_return_makes_no_depth_edge(nothing: float) -> None:
    depth = np.full((HEIGHT, WIDTH), 2.0)
    depth[20, 30] = nothing
    assert len(build(depth).points) == WIDTH * HEIGHT - 1


def test_the_colour_cameras_own_focal_length_is_used() -> None:
    cloud = build(np.full((HEIGHT, WIDTH), 2.0), image_focal=25.0, edge_ratio=0)
    expected = np.rint(cloud.points[:, 0] / cloud.points[:, 2] * np.float32(25) + np.float32(31.5))
    np.testing.assert_array_equal(cloud.colors[:, 0], expected)


@pytest.mark.parametrize("inverse", [False, True])
def test_extrinsics_shift_the_colours_by_the_parallax(inverse: bool) -> None:
    T_depth_image = np.eye(4)
    T_depth_image[0, 3] = 0.4  # the colour camera is 0.4 m to the right: at 2 m that is 10 pixels
    if inverse:
        given_transform = Transforms.from_matrix(
            np.linalg.inv(T_depth_image), stamp=0, frame="color", child_frame="depth"
        )
    else:
        given_transform = Transforms.from_matrix(T_depth_image, stamp=0, frame="depth", child_frame="color")
    cloud = build(np.full((HEIGHT, WIDTH), 2.0), given_transform, edge_ratio=0)
    colors = cloud.colors.reshape(HEIGHT, WIDTH, 3)
    assert colors[7, 10:].tolist() == [[u - 10, 7, 0] for u in range(10, WIDTH)]
    assert not colors[:, :10].any()  # not seen by the colour camera: black


def test_flying_pixels_at_edges_are_dropped_and_slopes_kept() -> None:
    depth = np.full((HEIGHT, WIDTH), 1.0)
    depth[:, 30], depth[:, 31:] = 1.5, 2.0  # one column flies between two walls
    columns = np.unique(np.rint(build(depth).points[:, :1] / build(depth).points[:, 2:] * 50 + 31.5))
    assert 30 not in columns
    assert len(columns) == WIDTH - 3  # with the edges themselves
    slope = np.broadcast_to(np.linspace(1, 2, WIDTH), (HEIGHT, WIDTH))
    assert len(build(slope).points) == WIDTH * HEIGHT
    assert len(build(depth, edge_ratio=0).points) == WIDTH * HEIGHT


def test_grey_images_colour_in_grey() -> None:
    grey = Image(stamp=5, frame="color", data=np.full((HEIGHT, WIDTH), 77, np.uint8))
    depth = depth_image(np.full((HEIGHT, WIDTH), 2.0))
    cloud = CloudBuilder(stride=8).process(depth, grey, info("depth"), info("color"))["cloud"]
    assert (cloud.colors == 77).all()


def test_a_new_calibration_replaces_the_ray_table() -> None:
    builder = CloudBuilder(stride=4, edge_ratio=0)
    depth, image = depth_image(np.full((HEIGHT, WIDTH), 2.0)), position_image()
    narrow = builder.process(depth, image, info("depth", 100.0), info("color"))["cloud"]
    wide = builder.process(depth, image, info("depth", 50.0), info("color"))["cloud"]
    np.testing.assert_allclose(wide.points[:, 0], 2 * narrow.points[:, 0], rtol=1e-6)


def test_clouds_of_a_sequence_agree_in_the_world() -> None:
    """Points of one frame, moved by the true poses, lie on the depth image of the next frame."""
    source = SyntheticRgbd(frames=2, rate=5, depth_noise=0, image_noise=0)
    source.setup()
    statics, frames = source.static_outputs(), [dict(m) for m in source.stream()]
    K_info = statics["depth_info"]
    builder = CloudBuilder(stride=3)
    made = builder.process(
        frames[0]["depth"], frames[0]["image"], K_info, statics["image_info"], statics["extrinsics"]
    )  # fmt: skip
    cloud = made["cloud"]
    first, second, depth, image = *(f["ground_truth"] for f in frames), frames[1]["depth"], frames[1]["image"]
    T = np.linalg.inv(second.matrix()) @ first.matrix()
    x, y, z = (cloud.points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]).T
    u = (K_info.fx * x / z + K_info.cx).astype(np.float32)
    v = (K_info.fy * y / z + K_info.cy).astype(np.float32)
    inside = (u > 1) & (v > 1) & (u < K_info.width - 2) & (v < K_info.height - 2)
    seen = cv2.remap(depth.data, u, v, cv2.INTER_LINEAR).ravel()
    assert np.median(np.abs(seen - z)[inside]) < 2e-3
    looks = cv2.remap(image.data, u, v, cv2.INTER_LINEAR).reshape(-1, 3)
    assert np.median(np.abs(looks.astype(float) - cloud.colors)[inside]) < 8


@pytest.mark.parametrize(
    ("depth", "focal", "text"),
    [
        (0.0, 50.0, "no depth in range"),
        (np.nan, 50.0, "no depth in range"),
        (np.inf, 50.0, "no depth in range"),
        (2.0, 50.0, "3072 points of 3072 pixels"),
        (2.0, 5000.0, "3072 points of 3072 pixels; the colour camera sees none of them"),
    ],
)
def test_status_counts_pixels_and_points(depth: float, focal: float, text: str) -> None:
    builder = CloudBuilder(stride=1)
    given = depth_image(np.full((HEIGHT, WIDTH), depth))
    aside = Transforms.from_matrix(np.eye(4) + np.eye(4, k=3), stamp=0, frame="color", child_frame="depth")
    status = builder.process(given, position_image(), info("depth"), info("color", focal), aside)["status"]
    assert status.messages == (text,)
    assert int(status.levels[0]) == (0 if text.endswith("pixels") else 1)


def test_mismatched_input_is_refused_with_the_mismatch() -> None:
    builder, image, depth = CloudBuilder(), position_image(), depth_image(np.ones((HEIGHT, WIDTH)))
    with pytest.raises(ValueError, match="depth has 10x10 pixels, but depth_info describes 64x48"):
        builder.process(depth_image(np.ones((10, 10))), image, info("depth"), info("color"))
    with pytest.raises(ValueError, match="image is in frame 'color', but image_info in 'depth'"):
        builder.process(depth, image, info("depth"), info("depth"))
    stranger = Transforms.from_matrix(np.eye(4), stamp=0, frame="base", child_frame="color")
    with pytest.raises(ValueError, match="no transform between 'depth' and 'color'; they hold color in base"):
        builder.process(depth, image, info("depth"), info("color"), stranger)
    bent = info("depth").replace(distortion_model="plumb_bob", distortion=np.array([0.1, 0, 0, 0]))
    with pytest.raises(ValueError, match="depth_info has lens distortion"):
        builder.process(depth, image, bent, info("color"))
