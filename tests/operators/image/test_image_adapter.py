"""Images follow noise and light: what is measured is what was put in, and good images are left alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.messages import Diagnostics, Image
from dataflow.testing import Played, play
from operators.image import ImageAdapter
from operators.image.image_adapter import Adaptation, Measured, exposed_longer, measure

WIDTH, HEIGHT = 160, 120


def scene(brightness: float = 110.0, *, color: bool = True) -> np.ndarray:
    """Surfaces with edges and a soft pattern, without noise (float, grey levels)."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    values = brightness * (0.75 + 0.2 * np.sin(u / 17) + 0.15 * np.cos(v / 11) + 0.3 * ((u // 40 + v // 30) % 2))
    return np.repeat(values[..., None], 3, axis=2) * [1.0, 0.95, 0.85] if color else values


def noisy(values: np.ndarray, sigma: float, seed: int = 1) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, sigma, values.shape)
    return np.clip(np.rint(values + noise), 0, 255).astype(np.uint8)


def image(pixels: np.ndarray, stamp: int = 0) -> Image:
    return Image(stamp=stamp, frame="camera", data=pixels)


def adapted(*pixels: np.ndarray, **params: float | bool) -> Played:
    return play(ImageAdapter(**params), {"image": [image(p, k) for k, p in enumerate(pixels)]})


def pixels_of(played: Played, k: int = 0) -> np.ndarray:
    message = played["adapted"][k]
    assert isinstance(message, Image)
    return message.data


@pytest.mark.parametrize("sigma", [2.0, 6.0, 15.0])
def test_the_measured_noise_is_the_noise_that_was_added(sigma: float) -> None:
    assert measure(noisy(scene(color=False), sigma)).noise == pytest.approx(sigma, rel=0.12)


@pytest.mark.parametrize("color", [True, False], ids=["colour", "grey"])
def test_an_image_that_is_neither_dark_nor_noisy_passes_bit_for_bit(color: bool) -> None:
    given = image(noisy(scene(color=color), 1.5))
    (passed,) = play(ImageAdapter(), {"image": [given]})["adapted"]
    assert passed.digest() == given.digest()


@pytest.mark.parametrize("color", [True, False], ids=["colour", "grey"])
def test_a_noisy_image_comes_nearer_to_the_scene(color: bool) -> None:
    truth = scene(color=color)
    given = noisy(truth, 15)
    error = np.abs(pixels_of(adapted(given)) - truth)[8:-8, 8:-8].mean()
    assert error < 0.6 * np.abs(given - truth)[8:-8, 8:-8].mean()


def test_edges_stay_where_noise_is_removed() -> None:
    step = np.full((HEIGHT, WIDTH), 40.0)
    step[:, WIDTH // 2 :] = 200.0
    found = pixels_of(adapted(noisy(step, 10))).astype(float)
    assert found[:, WIDTH // 2].mean() - found[:, WIDTH // 2 - 1].mean() > 0.85 * 160


def test_a_dark_image_is_raised_to_the_brightness_asked_for() -> None:
    given = noisy(scene(25), 0.5)
    found = pixels_of(adapted(given, brightness=70.0))
    assert cv2.cvtColor(found, cv2.COLOR_RGB2GRAY).mean() == pytest.approx(70, abs=8)


def test_dark_and_noisy_images_are_not_made_brighter_than_their_noise_allows() -> None:
    adaptation = Adaptation()
    assert adaptation.gain(Measured(noise=1.0, brightness=25)) > 3
    assert adaptation.gain(Measured(noise=4.0, brightness=25)) == pytest.approx(2)
    assert adaptation.gain(Measured(noise=12.0, brightness=25)) == 1


@given(st.floats(0.0, 40.0), st.floats(0.0, 255.0), st.floats(0.0, 0.5))
def test_adaptation_is_continuous_and_bounded(noise: float, brightness: float, step: float) -> None:
    adaptation, here = Adaptation(), Measured(noise, brightness)
    assert 1 <= adaptation.gain(here) <= adaptation.most_gain
    assert adaptation.gain(here) * noise <= max(adaptation.most_noise, noise) + 1e-9
    brighter = adaptation.gain(Measured(noise, brightness + step))
    assert brighter <= adaptation.gain(here)
    assert adaptation.excess(Measured(noise + step, brightness)) <= adaptation.excess(here) + step + np.sqrt(
        2 * step * adaptation.usual_noise
    )


@given(st.floats(1.0, 8.0))
def test_a_longer_exposure_keeps_black_white_and_the_order_of_values(gain: float) -> None:
    levels = exposed_longer(np.arange(256, dtype=np.uint8)[None], gain)[0].astype(int)
    assert (levels[0], levels[255]) == (0, 255)
    assert (np.diff(levels) >= 0).all()
    assert (levels >= np.arange(256)).all()


def test_switched_off_every_image_passes_as_it_is() -> None:
    given = image(noisy(scene(20), 15))
    (passed,) = play(ImageAdapter(adapt=False), {"image": [given]})["adapted"]
    assert passed.digest() == given.digest()


def test_an_image_is_adapted_alike_whatever_came_before() -> None:
    dark, loud = noisy(scene(20), 1), noisy(scene(), 15)
    alone = [play(ImageAdapter(), {"image": [image(p, 1)]})["adapted"][0] for p in (dark, loud)]
    after = [adapted(scene().clip(0, 255).astype(np.uint8), p)["adapted"][1] for p in (dark, loud)]
    assert [m.digest() for m in alone] == [m.digest() for m in after]


def test_status_reports_measurements_and_corrections() -> None:
    played = adapted(noisy(scene(25), 1.0), noisy(scene(), 12.0))
    first, second = (s for s in played["status"] if isinstance(s, Diagnostics))
    assert "times as long" in first.messages[0]
    assert "removed" in second.messages[0]
    assert second.pairs(0) == {"images": "2", "made brighter": "1", "noise removed": "1"}


def test_restored_adapter_continues_counting() -> None:
    first, second = ImageAdapter(), ImageAdapter()
    first.setup()
    second.setup()
    given = image(noisy(scene(25), 1.0))
    first.process(given)
    second.restore(first.snapshot())
    assert first.process(given)["status"].digest() == second.process(given)["status"].digest()
