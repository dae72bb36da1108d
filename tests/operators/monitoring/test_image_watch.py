"""Images that hang or show nothing are held back and named."""

from __future__ import annotations

import numpy as np
import pytest
from repeated import assert_repeats

from dataflow import play
from dataflow.messages import DepthImage, Image
from operators.monitoring import DepthWatch, ImageWatch


def images(*levels: int, seed: int = 1) -> list[Image]:
    rng = np.random.default_rng(seed)
    grain = rng.integers(0, 40, (24, 32, 3))
    data = [np.clip((grain + level) * (level > 0), 0, 255).astype(np.uint8) for level in levels]
    return [Image(stamp=k, frame="camera", data=each) for k, each in enumerate(data)]


def test_new_images_pass_as_they_are() -> None:
    given = images(50, 51, 50)
    played = play(ImageWatch(), {"image": given})
    assert [m.digest() for m in played["checked"]] == [m.digest() for m in given]


def test_repeated_or_black_images_are_held_back() -> None:
    played = play(ImageWatch(), {"image": images(50, 50, 50, 60, 0, 70)})
    assert [m.stamp for m in played["checked"]] == [0, 3, 5]
    said = [status.messages[0] for status in played["status"]]
    assert said[1:3] == [f"the image repeats the last one, {n} in a row" for n in (1, 2)]
    assert "is black" in said[4]
    assert [int(s.levels[0]) for s in played["status"]] == [0, 1, 1, 0, 1, 0]


@pytest.mark.parametrize("kept", [0.0, 1.0, np.inf], ids=["empty", "frozen", "all infinite"])
def test_a_depth_image_without_news_is_held_back(kept: float) -> None:
    rng = np.random.default_rng(2)
    data = [rng.uniform(1, 3, (24, 32)).astype(np.float32) for _ in range(3)]
    data[1] = data[0] * np.float32(kept)
    played = play(DepthWatch(), {"depth": [DepthImage(stamp=k, frame="depth", data=d) for k, d in enumerate(data)]})
    assert [m.stamp for m in played["checked"]] == [0, 2]


def test_restored_watch_repeats_with_its_last_image() -> None:
    first, second = assert_repeats(ImageWatch, [(each,) for each in images(50, 50)], 1)
    assert "checked" in first
    assert "checked" not in second
