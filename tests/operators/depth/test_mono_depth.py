"""MonoDepth with a network that takes brightness for nearness, so that its truth is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_onnx import node, write_model
from played_twice import counted_twice

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image, RelativeDepth
from dataflow.testing import Played, play
from operators.depth import MonoDepth
from operators.depth.mono_depth import fitted

pytest.importorskip("onnx")

WIDTH, HEIGHT = 64, 48
GAIN, BASE = 100.0, 30.0  # brightness of 1/depth


def network(file: Path, shape: tuple[Any, ...] = (1, 3, HEIGHT, WIDTH), kind: str = "FLOAT") -> Path:
    """Writes a network whose output is the mean of the three channels."""
    mean = node("ReduceMean", "input", "output", axes=[1], keepdims=1)
    return Path(write_model(file, [mean], {"input": (kind, shape)}, {"output": (kind, None)}))


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return network(tmp_path / "mean.onnx")


def scene() -> np.ndarray:
    """Depths of a floor that recedes and a box on it, whose brightness rounds to whole levels."""
    rows = np.linspace(0.25, 1.5, HEIGHT)[:, None] * np.ones((1, WIDTH))
    rows[20:35, 20:40] = 1.8
    return 1 / (np.rint(GAIN * rows) / GAIN)


def photograph(depth: np.ndarray, stamp: int = 1, *, grey: bool = False) -> Image:
    levels = np.rint(GAIN / depth + BASE).astype(np.uint8)
    return Image(stamp=stamp, frame="camera", data=levels if grey else np.repeat(levels[..., None], 3, axis=2))


def sparse_of(depth: np.ndarray, count: int, stamp: int = 1, wrong: int = 0) -> DepthImage:
    rng = np.random.default_rng(8)
    chosen = rng.choice(depth.size, count, replace=False)
    data = np.zeros(depth.size, np.float32)
    data[chosen] = depth.ravel()[chosen]
    data[chosen[:wrong]] *= rng.uniform(1.5, 3.0, wrong).astype(np.float32)
    return DepthImage(stamp=stamp, frame="stereo", data=data.reshape(depth.shape))


def estimated(model: Path, image: Image, sparse: DepthImage | None, **params: Any) -> Played:
    streams: dict[str, Any] = {"image": [image], "sparse": [] if sparse is None else [sparse]}
    return play(MonoDepth(model=str(model), **params), streams)


def status_of(played: Played) -> tuple[str, int]:
    (status,) = played["status"]
    assert isinstance(status, Diagnostics)
    return status.messages[0], int(status.levels[0])


@pytest.mark.parametrize(("level", "text"), [(0, "the image is black"), (150, "the image is without contrast")])
def test_an_image_that_shows_nothing_gives_no_depth_whatever_is_given(model: Path, level: int, text: str) -> None:
    depth = scene()
    blank = photograph(depth).replace(data=np.full((HEIGHT, WIDTH, 3), level, np.uint8))
    played = estimated(model, blank, sparse_of(depth, 200))
    assert not played["relative"]
    assert not played["depth"]
    assert status_of(played) == (text, 1)


def test_without_metric_depth_there_is_only_nearness(model: Path) -> None:
    depth = scene()
    played = estimated(model, photograph(depth), None)
    (relative,) = played["relative"]
    assert isinstance(relative, RelativeDepth)
    np.testing.assert_allclose(relative.data, GAIN / depth + BASE, atol=1e-3)
    assert not played["depth"]
    assert status_of(played) == ("no metric depth is given: relative only", 0)


@pytest.mark.parametrize("wrong", [0, 12])
def test_a_few_metric_depths_make_it_metric_even_if_some_are_wrong(model: Path, wrong: int) -> None:
    depth = scene()
    played = estimated(model, photograph(depth), sparse_of(depth, 40, wrong=wrong), tolerance=0.1)
    (found,) = played["depth"]
    assert isinstance(found, DepthImage)
    np.testing.assert_allclose(found.data, depth, rtol=1e-3)
    text, level = status_of(played)
    assert text == "1/depth is 0.01 of nearness and -0.3 1/m"
    assert level == 0
    (status,) = played["status"]
    assert isinstance(status, Diagnostics)
    assert status.pairs(0) == {"given": "40", "agreeing": str(40 - wrong)}


def test_grey_images_and_images_of_other_sizes_pass(model: Path) -> None:
    depth = scene()
    (found,) = estimated(model, photograph(depth, grey=True), sparse_of(depth, 40))["depth"]
    np.testing.assert_allclose(found.data, depth, rtol=1e-3)
    large = np.repeat(np.repeat(depth, 2, axis=0), 2, axis=1)
    (found,) = estimated(model, photograph(large), sparse_of(depth, 40))["depth"]
    assert found.data.shape == large.shape
    np.testing.assert_allclose(np.median(found.data / large), 1, rtol=0.01)


def test_scale_alone_is_fitted_where_that_is_asked_for(model: Path) -> None:
    depth = scene()
    levels = np.rint(GAIN / depth).astype(np.uint8)
    image = Image(stamp=1, frame="camera", data=levels)
    (found,) = estimated(model, image, sparse_of(depth, 40), align="scale")["depth"]
    np.testing.assert_allclose(found.data, depth, rtol=1e-3)


def test_depths_beyond_the_range_are_no_returns(model: Path) -> None:
    depth = scene()
    (found,) = estimated(model, photograph(depth), sparse_of(depth, 40), max_range=2.0)["depth"]
    np.testing.assert_array_equal(found.data > 0, depth <= 2.0 + 1e-6)


@pytest.mark.parametrize(
    ("sparse", "text"),
    [
        (np.zeros((HEIGHT, WIDTH)), "0 depths are given, 0 agree: no scale"),
        (np.full((HEIGHT, WIDTH), np.nan), "0 depths are given, 0 agree: no scale"),
        (1 / (1.8 - 1 / scene()), "agree: no scale"),  # what is near is said to be far
        (np.random.default_rng(0).uniform(0.3, 30, (HEIGHT, WIDTH)), "agree: no scale"),
    ],
)
def test_depths_that_give_no_scale_are_a_warning_and_no_depth(model: Path, sparse: np.ndarray, text: str) -> None:
    depths = DepthImage(stamp=1, frame="stereo", data=np.where(sparse < 100, sparse, 0).astype(np.float32))
    played = estimated(model, photograph(scene()), depths)
    assert not played["depth"]
    assert len(played["relative"]) == 1
    found, level = status_of(played)
    assert found.endswith(text)
    assert level == 1


def test_old_metric_depth_is_not_used(model: Path) -> None:
    played = estimated(model, photograph(scene(), stamp=10**9), sparse_of(scene(), 40, stamp=1))
    assert not played["depth"]
    assert status_of(played)[1] == 0


def test_metric_depth_of_another_view_is_named(model: Path) -> None:
    with pytest.raises(OperatorFailure, match="sparse has 48x64 pixels, but the image 64x48"):
        estimated(model, photograph(scene()), sparse_of(scene().T, 40))


def test_missing_and_unfit_models_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.onnx"):
        MonoDepth(model=str(tmp_path / "none.onnx")).setup()
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(ValueError, match="cannot be loaded as an ONNX model"):
        MonoDepth(model=str(tmp_path / "text.onnx")).setup()
    with pytest.raises(ValueError, match=r"must have one input tensor\(float\)"):
        MonoDepth(model=str(network(tmp_path / "four.onnx", (1, 4, 8, 8)))).setup()


def test_a_model_that_answers_in_metres_gives_depth_by_itself(model: Path) -> None:
    image = photograph(scene(), grey=True)
    played = estimated(model, image, None, answer="metres", max_range=60.0)
    (depth,) = played["depth"]
    expected = np.asarray(image.data, np.float32)
    np.testing.assert_allclose(depth.data, np.where(expected <= 60, expected, 0), atol=1e-3)
    assert (depth.data > 0).any()
    assert (depth.data == 0).any()
    assert not played["relative"]
    assert status_of(played) == ("the model gives metres", 0)


def test_half_precision_gives_the_same(tmp_path: Path, model: Path) -> None:
    image = photograph(scene())
    half = network(tmp_path / "half.onnx", kind="FLOAT16")
    (found,), (expected,) = (estimated(file, image, None)["relative"] for file in (half, model))
    np.testing.assert_array_equal(found.data, expected.data)  # whole levels below 2048


def canonical(model: Path, fx: float, data: np.ndarray, **params: Any) -> Played:
    height, width = data.shape[:2]
    info = CameraInfo.from_intrinsics(
        stamp=0, frame="camera", width=width, height=height, fx=fx, fy=fx, cx=width / 2, cy=height / 2
    )
    operator = MonoDepth(model=str(model), answer="metres", canonical_focal=1000.0, max_range=1000.0, **params)
    return play(operator, {"image": [Image(stamp=1, frame="camera", data=data)], "image_info": [info]})


def test_metres_of_a_canonical_camera_become_those_of_the_images(model: Path) -> None:
    """As Metric3D's hubconf does: the image keeps its proportions, and depths go by the focal length in the input."""
    data = np.repeat(photograph(scene()).data[:, 16:48], 2, axis=0).repeat(2, axis=1)  # 64x96: half as wide as high
    (depth,) = canonical(model, 800.0, data)["depth"]
    assert depth.data.shape == data.shape[:2]
    scale = min(WIDTH / 64, HEIGHT / 96)
    expected = data[..., 0] * (800.0 * scale / 1000.0)
    inner = np.abs(cv2.Laplacian(data[..., 0].astype(np.float32), cv2.CV_32F, ksize=3)) < 12  # apart from edges
    np.testing.assert_allclose(depth.data[inner], expected[inner], rtol=0.06)
    played = estimated(model, photograph(scene()), None, answer="metres", canonical_focal=1000.0)
    assert not played["depth"]
    assert status_of(played) == ("no image_info: the model's metres are of another camera", 1)


def test_an_open_input_takes_the_given_size_and_pixels_are_normalised(tmp_path: Path) -> None:
    """The model passes the mean of its channels on, here of ImageNet's normalisation."""
    file = network(tmp_path / "open.onnx", (1, 3, "h", "w"))
    image = photograph(scene(), grey=True)
    options = {"normalization": "imagenet", "input_size": (WIDTH, HEIGHT)}
    (plain,) = estimated(file, image, None, input_size=(WIDTH, HEIGHT))["relative"]
    (relative,) = estimated(file, image, None, **options)["relative"]
    mean, scale = (np.array(v) for v in ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375)))
    given = np.repeat(np.asarray(image.data, np.float64)[..., None], 3, axis=2)
    gain = np.polyfit(given.mean(axis=2).ravel(), plain.data.ravel().astype(np.float64), 1)
    expected = np.polyval(gain, ((given - mean) / scale).mean(axis=2))
    np.testing.assert_allclose(relative.data, expected, atol=2e-3)


@given(st.floats(0.01, 5), st.floats(-0.2, 0.5), st.integers(0, 1000), st.floats(0, 0.4))
def test_the_fit_finds_scale_and_shift_among_wrong_depths(scale: float, shift: float, seed: int, wrong: float) -> None:
    rng = np.random.default_rng(seed)
    inverse = rng.uniform(0.1, 2, 200)
    depth = 1 / inverse
    depth[: round(wrong * 200)] *= rng.uniform(1.5, 4, round(wrong * 200))
    found = fitted((inverse - shift) / scale, depth, 0.05, rng, shifted=True)
    assert found is not None
    assert (found.scale, found.shift) == pytest.approx((scale, shift), rel=0.02, abs=0.01)


def test_two_plays_are_equal_and_a_restored_operator_sums_up_alike(model: Path) -> None:
    depth = scene()
    streams: Any = {"image": [photograph(depth, 1), photograph(depth, 2)], "sparse": [sparse_of(depth, 40, 2, wrong=9)]}
    counts = counted_twice(lambda: MonoDepth(model=str(model)), streams)
    assert counts == {"images": 2, "images with a scale": 1, "images without": 0}


@pytest.mark.data
def test_a_real_network_orders_a_real_scene(data_dir: Path) -> None:
    model, folder = data_dir / "models" / "tcmonodepth_small_192x320.onnx", data_dir / "rgbd_7scenes"
    if not (model.is_file() and folder.is_dir()):
        pytest.skip(f"{model.name} or {folder.name} not found in {data_dir}")
    pixels = cv2.imread(str(folder / "frame-000240.color.jpg"), cv2.IMREAD_COLOR_RGB)
    true = cv2.imread(str(folder / "frame-000240.depth.png"), cv2.IMREAD_UNCHANGED) / 1000.0
    true = np.where((true > 0.3) & (true < 6), true, 0)
    image = Image(stamp=1, frame="camera", data=np.asarray(pixels, np.uint8))
    (found,) = estimated(model, image, sparse_of(true, 3000))["depth"]
    known = (true > 0) & (found.data > 0)
    error = np.abs(found.data - true)[known] / true[known]
    assert np.median(error) < 0.12
