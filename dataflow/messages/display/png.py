"""Encodes pixels as PNG files (ISO/IEC 15948), without a library for images. Pure."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

_GREY, _RGB = 0, 2
_LEVEL = 4


def png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """The PNG file of (H, W) grey or (H, W, 3) RGB pixels. Raises `ValueError` for other arrays."""
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3):
        raise ValueError(f"a PNG takes uint8 (H, W) or (H, W, 3), got {pixels.dtype} {pixels.shape}")
    height, width = pixels.shape[:2]
    rows = np.zeros((height, 1 + pixels[0].size), np.uint8)  # each row begins with its filter: 0, none
    rows[:, 1:] = pixels.reshape(height, -1)
    head = struct.pack(">IIBBBBB", width, height, 8, _GREY if pixels.ndim == 2 else _RGB, 0, 0, 0)
    body = zlib.compress(rows.data, _LEVEL)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def turbo(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """RGB (..., 3) of values from 0 to 1 in the Turbo colours, by Mikhailov's polynomial; NaN is black."""
    x = np.clip(np.nan_to_num(values, nan=0.0), 0.0, 1.0).astype(np.float64)
    powers = np.stack([np.ones_like(x), x, x**2, x**3, x**4, x**5], axis=-1)
    colors: npt.NDArray[np.uint8] = (np.clip(powers @ _TURBO, 0.0, 1.0) * 255).astype(np.uint8)
    colors[np.isnan(values)] = 0
    return colors


_TURBO = np.array(
    [
        [0.13572138, 0.09140261, 0.10667330],
        [4.61539260, 2.19418839, 12.64194608],
        [-42.66032258, 4.84296658, -60.58204836],
        [132.13108234, -14.18503333, 110.36276771],
        [-152.94239396, 4.27729857, -89.90310912],
        [59.28637943, 2.82956604, 27.34824973],
    ]
)
