"""Saved maps: what `mode` makes of pixels, and what is named where a file is none."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from operators.localization.map_file import read_map

PIXELS = np.array([[0, 100, 205, 254]], np.uint8)


def write(folder: Path, *lines: str, origin: str = "[0, 0, 0]", pixels: np.ndarray = PIXELS) -> Path:
    cv2.imwrite(str(folder / "m.png"), pixels)
    text = f"image: m.png\nresolution: 0.05\norigin: {origin}\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    (folder / "m.yaml").write_text(text + "\n".join(lines))
    return folder / "m.yaml"


@pytest.mark.parametrize(
    ("mode", "cells"),
    [
        ("", [100, -1, -1, 0]),
        ("mode: trinary", [100, -1, -1, 0]),
        ("mode: scale", [100, 91, 0, 0]),
        ("mode: raw", [0, 100, -1, -1]),
    ],
)
def test_mode_decides_the_meaning_of_a_pixel(tmp_path: Path, mode: str, cells: list[int]) -> None:
    assert read_map(write(tmp_path, mode), "map").cells.tolist() == [cells]


def test_transparent_pixels_are_unknown_in_scale_mode(tmp_path: Path) -> None:
    pixels = np.dstack([PIXELS, PIXELS, PIXELS, np.array([[255, 0, 255, 0]], np.uint8)])

    assert read_map(write(tmp_path, "mode: scale", pixels=pixels), "map").cells.tolist() == [[100, -1, 0, -1]]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"origin": "[0.0, 0.0, -nan]"}, r"m\.yaml: origin holds nan"),
        ({"origin": "[.inf, 0.0, 0.0]"}, r"m\.yaml: origin holds inf"),
    ],
)
def test_a_number_that_is_none_is_named_with_the_file(tmp_path: Path, changes: dict[str, str], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        read_map(write(tmp_path, **changes), "map")


def test_an_unknown_mode_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="mode is 'grey'; known are trinary, scale, raw"):
        read_map(write(tmp_path, "mode: grey"), "map")
