"""DepthFilter on depth images whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from played_twice import counted_twice

from dataflow.messages import DepthImage, Diagnostics
from dataflow.testing import play
from operators.depth import DepthFilter

HEIGHT, WIDTH = 48, 64


def image(data: np.ndarray, stamp: int = 1) -> DepthImage:
    return DepthImage(stamp=stamp, frame="camera", data=data.astype(np.float32))


def filtered(data: np.ndarray, **params: object) -> tuple[np.ndarray, dict[str, int]]:
    played = play(DepthFilter(**params), {"depth": [image(data)]})
    (out,), (status,) = played["filtered"], played["status"]
    assert isinstance(out, DepthImage)
    assert isinstance(status, Diagnostics)
    return out.data, {key: int(value) for key, value in status.pairs(0).items()}


def step(near: float = 1.5, far: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """A near disc in front of a far wall: the scene, and the image of it whose edge pixels see both."""
    fine_rows, fine_columns = np.mgrid[: 2 * HEIGHT, : 2 * WIDTH]
    disc = (fine_rows - HEIGHT) ** 2 + (fine_columns - WIDTH) ** 2 < 30**2
    fine = np.where(disc, near, far)
    mixed = fine.reshape(HEIGHT, 2, WIDTH, 2).mean(axis=(1, 3))
    return fine[::2, ::2], mixed


def slanted(slope: float = 0.6) -> np.ndarray:
    """A plane seen at a slant: inverse depth is linear over the image."""
    columns = np.arange(WIDTH)[None] / WIDTH
    return 1 / (1.0 - slope * columns) * np.ones((HEIGHT, 1))


def test_flying_pixels_land_on_one_of_the_two_surfaces() -> None:
    _, mixed = step()
    hanging = (mixed > 1.6) & (mixed < 2.9)
    out, counts = filtered(mixed)
    off = np.minimum(np.abs(out - 1.5), np.abs(out - 3.0))
    assert hanging.sum() > 50
    assert (off[hanging] < 0.01).mean() > 0.9
    assert (out[~hanging] == mixed.astype(np.float32)[~hanging]).mean() > 0.995
    assert counts["flying"] == pytest.approx(hanging.sum(), abs=12)
    assert counts["replaced"] + counts["removed"] == counts["flying"] + counts["outliers"]


def test_a_slanted_plane_has_hardly_a_wrong_pixel_even_with_noise() -> None:
    rng = np.random.default_rng(3)
    noisy = 1 / (1 / slanted(0.7) + rng.normal(0, 0.0015, (HEIGHT, WIDTH)))
    _, counts = filtered(noisy)
    assert counts["flying"] + counts["outliers"] <= 1


def test_salt_is_replaced_by_the_local_median_and_counted() -> None:
    truth = slanted()
    rng = np.random.default_rng(5)
    salt = rng.choice(HEIGHT * WIDTH, 60, replace=False)
    data = truth.copy()
    data.ravel()[salt] *= rng.choice([0.5, 1.7], 60)
    out, counts = filtered(data)
    assert counts["flying"] + counts["outliers"] == pytest.approx(60, abs=4)
    np.testing.assert_allclose(out, truth, rtol=0.03)


def test_thin_things_and_edges_stay() -> None:
    data = np.full((HEIGHT, WIDTH), 3.0)
    data[10:40, 20] = 1.0  # a pole, one pixel wide
    data[:, 40:] = 2.0
    out, counts = filtered(data)
    changed = np.argwhere(out != data.astype(np.float32)).tolist()
    assert changed == [[10, 20], [39, 20]]  # the ends of the pole, with one neighbour each
    assert counts["replaced"] == 2


def test_missing_returns_stay_missing_and_ranges_are_kept() -> None:
    data = np.full((HEIGHT, WIDTH), 2.0)
    data[5:9, 5:9], data[0, 0], data[0, 1], data[20:, 30:] = 0, np.nan, np.inf, 7.0
    for smoothing in ("none", "median", "bilateral"):
        out, counts = filtered(data, max_range=5.0, smoothing=smoothing)
        assert not out[5:9, 5:9].any()
        assert not out[0, :2].any()
        assert not out[20:, 30:].any()
        assert counts["out of range"] == 28 * 34
        np.testing.assert_allclose(out[out > 0], 2.0, rtol=1e-6)


def test_a_pixel_alone_loses_its_return() -> None:
    data = np.zeros((HEIGHT, WIDTH))
    data[20, 20] = 2.0
    out, counts = filtered(data)
    assert not out.any()
    assert (counts["removed"], counts["replaced"]) == (1, 0)


@pytest.mark.parametrize("smoothing", ["median", "bilateral"])
def test_smoothing_lowers_noise_and_leaves_edges(smoothing: str) -> None:
    rng = np.random.default_rng(9)
    truth = np.where(np.arange(WIDTH) < 32, 1.5, 3.0) * np.ones((HEIGHT, 1))
    noisy = 1 / (1 / truth + rng.normal(0, 0.0015, truth.shape))
    out, _ = filtered(noisy, smoothing=smoothing, smoothing_sigma=0.01)
    assert np.abs(out - truth).mean() < 0.6 * np.abs(noisy - truth).mean()
    assert np.abs(out - truth).max() < 0.1


@pytest.mark.parametrize(("value", "text"), [(0.0, "the image has no return"), (9.0, "no return in range")])
def test_an_image_without_returns_is_a_warning(value: float, text: str) -> None:
    played = play(DepthFilter(max_range=5.0, smoothing="median"), {"depth": [image(np.full((3, 4), value))]})
    (out,), (status,) = played["filtered"], played["status"]
    assert isinstance(out, DepthImage)
    assert isinstance(status, Diagnostics)
    assert not out.data.any()
    assert status.messages == (text,)
    assert status.levels.tolist() == [1]


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (2, 2)])
def test_images_smaller_than_the_window_pass(shape: tuple[int, int]) -> None:
    for smoothing in ("none", "median", "bilateral"):
        out, _ = filtered(np.full(shape, 2.0), smoothing=smoothing, support=1)
        assert out.shape == shape


def test_parameters_that_contradict_each_other_are_named() -> None:
    with pytest.raises(ValueError, match=r"min_range .* must be below max_range"):
        DepthFilter(min_range=5.0, max_range=2.0).setup()
    with pytest.raises(ValueError, match="a window of 3 or 5 pixels, not 7"):
        DepthFilter(window=7, smoothing="median").setup()


def test_two_plays_are_equal_and_a_restored_operator_sums_up_alike() -> None:
    rng = np.random.default_rng(2)
    images = [image(step()[1] + rng.normal(0, 0.004, (HEIGHT, WIDTH)), stamp=k + 1) for k in range(2)]
    assert counted_twice(lambda: DepthFilter(smoothing="bilateral"), {"depth": images})["images"] == 2
