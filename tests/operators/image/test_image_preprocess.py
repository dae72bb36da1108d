"""ImagePreprocess on images of a scene that is a formula: every pixel's value is known from its ray."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from played_twice import counted_twice
from scipy.optimize import brentq

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import CameraInfo, Diagnostics, Image
from dataflow.testing import Played, play
from operators.geometry import se3
from operators.geometry.lens import distorted, undistorted
from operators.image import ImagePreprocess, image_preprocess
from operators.image.preparation import Preparation, toned
from operators.image.view import Window

WIDTH, HEIGHT = 160, 120
BARREL = {"distortion_model": "plumb_bob", "distortion": np.array([-0.28, 0.09, 0.001, -0.0008, 0.0])}
RATIONAL = {"distortion_model": "rational_polynomial", "distortion": np.array([0.3, 0.1, 0, 0, 0.01, 0.5, 0.1, 0.0])}
FISHEYE = {"distortion_model": "equidistant", "distortion": np.array([-0.02, 0.004, -0.001, 0.0])}
LENSES = {"barrel": BARREL, "rational": RATIONAL, "fisheye": FISHEYE}


def camera(**changes: Any) -> CameraInfo:
    info = CameraInfo.from_intrinsics(
        stamp=0, frame="camera", width=WIDTH, height=HEIGHT, fx=100, fy=98, cx=81.0, cy=58.5
    )
    return info.replace(**changes)


def scene(rays: np.ndarray) -> np.ndarray:
    """Brightness seen along rays (..., 3), a smooth pattern on the sphere of directions."""
    x, y, z = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    return 127 + 50 * np.sin(9 * x + 2 * z) + 50 * np.cos(8 * y - x)


def grid(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    v, u = np.mgrid[:height, :width]
    return np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)


def raw_image(info: CameraInfo) -> np.ndarray:
    """What the distorted camera sees."""
    rays = np.column_stack([undistorted(grid(), info), np.ones(WIDTH * HEIGHT)])
    return np.rint(scene(rays)).reshape(HEIGHT, WIDTH).astype(np.uint8)


def expected(info: CameraInfo, R: np.ndarray) -> np.ndarray:
    """What a pinhole camera turned by R sees: R maps the raw camera's axes to its own."""
    pixels = grid(info.width, info.height)
    rays = np.column_stack([(pixels - info.K[:2, 2]) / [info.K[0, 0], info.K[1, 1]], np.ones(len(pixels))])
    return scene(rays @ R).reshape(info.height, info.width)


def prepared(pixels: np.ndarray, info: CameraInfo, **params: Any) -> Played:
    streams = {"image": [Image(stamp=7, frame="camera", data=pixels)], "image_info": [info]}
    return play(ImagePreprocess(**params), streams, static=["image_info"])


def outcome(played: Played) -> tuple[np.ndarray, CameraInfo, dict[str, int]]:
    (image,), (info,), (status,) = played["prepared"], played["prepared_info"], played["status"]
    assert isinstance(image, Image)
    assert isinstance(info, CameraInfo)
    assert isinstance(status, Diagnostics)
    assert image.frame == info.frame
    assert (image.width, image.height) == (info.width, info.height)
    assert image.stamp == info.stamp == 7
    return image.data, info, {k: int(v) for k, v in status.pairs(0).items()}


@pytest.mark.parametrize("lens", LENSES)
def test_rays_and_pixels_are_inverse_to_each_other(lens: str) -> None:
    info = camera(**LENSES[lens])
    np.testing.assert_allclose(distorted(undistorted(grid(), info), info), grid(), atol=1e-3)


def test_the_fisheye_is_that_of_its_paper() -> None:
    k1, k2, k3, k4 = FISHEYE["distortion"]
    radius = 60.0 / 100.0
    angle = brentq(lambda t: t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8) - radius, 0, 1.5)
    (ray,) = undistorted(np.array([[81.0 + 60.0, 58.5]]), camera(**FISHEYE))
    assert ray.tolist() == pytest.approx([np.tan(angle), 0.0], abs=1e-6)


@pytest.mark.parametrize("lens", LENSES)
def test_undistorted_image_matches_its_calibration(lens: str) -> None:
    raw = camera(**LENSES[lens])
    image, info, counts = outcome(prepared(raw_image(raw), raw))
    assert (info.distortion, info.distortion_model, info.frame) == (None, "none", "camera")
    assert info.K[0, 0] == info.K[1, 1]
    assert counts["without image"] == 0
    assert np.abs(image - expected(info, np.eye(3))).max() < 4


def test_all_of_the_raw_image_is_shown_where_that_is_asked_for() -> None:
    raw = camera(**BARREL)
    _, info, counts = outcome(prepared(raw_image(raw), raw, keep=1.0))
    sides = grid()[(grid()[:, 0] % (WIDTH - 1) == 0) | (grid()[:, 1] % (HEIGHT - 1) == 0)]
    shown = undistorted(sides, raw) * info.K[0, 0] + info.K[:2, 2]
    assert (shown > -0.6).all()
    assert (shown < [WIDTH - 0.4, HEIGHT - 0.4]).all()
    assert 0 < counts["without image"] < 0.4 * counts["pixels"]


def test_rectification_is_by_the_calibrations_rotation_and_projection() -> None:
    R = se3.exp(np.array([0, 0, 0, 0.03, -0.05, 0.02]))[:3, :3]
    P = np.array([[90, 0, 80.0, -9.0], [0, 90, 60.0, 0], [0, 0, 1, 0]])
    raw = camera(**BARREL, R=R, P=P)
    image, info, counts = outcome(prepared(raw_image(raw), raw, lens="rectify"))
    assert info.frame == "camera_rectified"
    assert info.R is None
    np.testing.assert_array_equal(info.P, P)
    np.testing.assert_array_equal(info.K, P[:, :3])
    shows = np.abs(image - expected(info, R)) < 4
    assert (~shows).sum() <= counts["without image"] + 300  # and pixels beside them, mixed with black
    assert shows.mean() > 0.85


@pytest.mark.parametrize("size", [{"width": 80}, {"height": 60}, {"width": 240, "height": 100}, {}])
def test_cropped_and_scaled_images_keep_their_rays(size: dict[str, int]) -> None:
    raw = camera()
    image, info, _ = outcome(prepared(raw_image(raw), raw, crop=(10, 20, 120, 90), **size))
    assert (info.width, info.height) == {80: (80, 60), 240: (240, 100)}.get(
        size.get("width", 0), (80, 60) if size else (120, 90)
    )
    inner = (slice(2, -2), slice(2, -2))
    assert np.abs(image - expected(info, np.eye(3)))[inner].max() < 3


@given(
    st.tuples(st.integers(0, 60), st.integers(0, 50), st.integers(1, 100), st.integers(1, 70)),
    st.integers(1, 300),
    st.integers(1, 300),
)
def test_a_window_maps_its_corners_to_corners(crop: tuple[int, int, int, int], columns: int, rows: int) -> None:
    info = Window.of((WIDTH, HEIGHT), crop, columns, rows).seen_through(camera())
    x, y, width, height = crop
    for u, v, there in (
        (-0.5, -0.5, (x - 0.5, y - 0.5)),
        (columns - 0.5, rows - 0.5, (x + width - 0.5, y + height - 0.5)),
    ):
        ray = np.linalg.inv(info.K) @ [u, v, 1]
        np.testing.assert_allclose((camera().K @ ray)[:2], there, atol=1e-9)


def test_coefficients_stay_where_the_lens_is_kept() -> None:
    raw = camera(**BARREL)
    pixels = raw_image(raw)
    image, info, _ = outcome(prepared(pixels, raw, lens="keep", crop=(8, 4, 140, 100)))
    np.testing.assert_array_equal(image, pixels[4:104, 8:148])
    np.testing.assert_array_equal(info.distortion, raw.distortion)
    np.testing.assert_allclose(undistorted(np.array([[20.0, 30]]), info), undistorted(np.array([[28.0, 34]]), raw))


def test_image_without_preprocessing_passes_bit_for_bit() -> None:
    color = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    for lens in ("keep", "undistort"):
        image, info, _ = outcome(prepared(color, camera(), lens=lens))
        np.testing.assert_array_equal(image, color)
        assert info.replace(stamp=0) == camera()


def test_grey_is_one_channel() -> None:
    color = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    color[..., 1] = 100
    image, _, _ = outcome(prepared(color, camera(), grey=True))
    assert image.shape == (HEIGHT, WIDTH)
    assert np.unique(image).tolist() == [59]


def test_brightness_is_made_even() -> None:
    dim = np.random.default_rng(1).normal(60, 8, (HEIGHT, WIDTH)).clip(0, 255).astype(np.uint8)
    stretched = toned(dim, "stretch")
    assert (stretched.min(), stretched.max()) == (0, 255)
    assert 0.005 < (stretched == 255).mean() < 0.03
    assert toned(dim, "equalize").std() > 60
    assert toned(dim, "clahe").std() > 1.5 * dim.std()
    assert np.unique(toned(np.full((9, 9), 50, np.uint8), "stretch")).size == 1


def test_hue_stays_where_brightness_changes() -> None:
    color = np.repeat(np.linspace(20, 120, 60)[None, :, None], 40, axis=0).repeat(3, axis=2).astype(np.uint8)
    color[10:20, 20:40] = [90, 30, 30]
    out = toned(color, "stretch").astype(int)
    red, green, blue = out[15, 30]
    assert red - green > 40
    assert abs(green - blue) < 15
    assert np.ptp(out[5, 5]) <= 2
    assert out[5].max() == 255


@pytest.mark.parametrize(
    ("info", "params", "text"),
    [
        (camera(distortion_model="poly", distortion=np.ones(3)), {}, "'poly'; known here are none, plumb_bob"),
        (camera(), {"lens": "rectify"}, "must hold P"),
        (camera(P=np.zeros((3, 4))), {"lens": "rectify"}, "must hold P with focal lengths above zero"),
        (camera(), {"crop": (100, 0, 100, 10)}, r"crop \[100, 0, 100, 10\] reaches outside the image of 160x120"),
        (camera(width=WIDTH + 1), {}, "image has 160x120 pixels"),
        (camera(frame="other"), {}, "image is in frame 'camera'"),
        (camera(distortion_model="plumb_bob", distortion=np.array([-1.5, 0, 0, 0.0])), {}, "only a part of the image"),
        (camera(distortion_model="equidistant", K=np.diag([40.0, 40, 1]), distortion=np.zeros(4)), {}, "no ray before"),
    ],
)  # fmt: skip
def test_impossible_preprocessing_is_refused(info: CameraInfo, params: dict[str, Any], text: str) -> None:
    with pytest.raises(OperatorFailure, match=text):
        prepared(np.zeros((HEIGHT, WIDTH), np.uint8), info, **params)


def test_a_calibration_that_comes_with_every_image_is_worked_out_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made = list[Preparation]()

    def making(*given: Any, **more: Any) -> Preparation:
        made.append(Preparation(*given, **more))
        return made[-1]

    monkeypatch.setattr(image_preprocess, "Preparation", making)
    info = camera(**LENSES["fisheye"])
    images = [Image(stamp=k, frame="camera", data=raw_image(info)) for k in (1, 2, 3)]
    streams = {"image": images, "image_info": [info.replace(stamp=k) for k in (1, 2)]}
    play(ImagePreprocess(), streams)
    assert len(made) == 1
    play(
        ImagePreprocess(),
        {"image": images, "image_info": [info, info.replace(stamp=2, K=np.diag([1.01, 1.01, 1.0]) @ info.K)]},
    )
    assert len(made) == 3


def test_two_plays_are_equal_and_a_restored_operator_sums_up_alike() -> None:
    raw = camera(**BARREL)
    image = Image(stamp=7, frame="camera", data=raw_image(raw))
    streams: dict[str, Any] = {"image": [image, image.replace(stamp=8)], "image_info": [raw]}
    counts = counted_twice(lambda: ImagePreprocess(width=100, normalize="clahe"), streams, ["image_info"])
    assert counts == {"images": 2, "pixels without image": 0}


def test_undistortion_agrees_with_opencvs() -> None:
    raw = camera(**BARREL)
    pixels = raw_image(raw)
    image, info, _ = outcome(prepared(pixels, raw))
    theirs = cv2.undistort(pixels, raw.K, raw.distortion, None, info.K)
    assert np.abs(image.astype(int) - theirs).max() <= 1
