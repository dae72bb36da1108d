"""Pixels of raw images, in the encodings that ROS and Foxglove name, as images and depth. Pure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.recording.errors import RecordingError

Pixels = npt.NDArray[Any]

MILLIMETRES = np.float32(1000)
"""In a metre."""
_PROBED_ROWS = 8
"""Of a depth image, looked at before all of it is."""
DEPTH_ENCODINGS = ("32FC1", "64FC1", "16UC1")
_COLORS_16 = ("mono16", "rgb16", "bgr16", "16UC3")
_LAYOUTS: dict[str, tuple[str, int]] = {
    "mono8": ("u1", 1),
    "8UC1": ("u1", 1),
    "mono16": ("u2", 1),
    "rgb8": ("u1", 3),
    "8UC3": ("u1", 3),
    "bgr8": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
    "rgb16": ("u2", 3),
    "bgr16": ("u2", 3),
    "16UC3": ("u2", 3),
    "bayer_rggb8": ("u1", 1),
    "bayer_bggr8": ("u1", 1),
    "bayer_gbrg8": ("u1", 1),
    "bayer_grbg8": ("u1", 1),
    "yuv422": ("u1", 2),
    "uyvy": ("u1", 2),
    "yuv422_yuy2": ("u1", 2),
    "yuyv": ("u1", 2),
    "32FC1": ("f4", 1),
    "64FC1": ("f8", 1),
    "16UC1": ("u2", 1),
}
"""Element and number of channels of a pixel as it is stored."""


def is_depth(encoding: str) -> bool:
    """Tells whether an encoding holds distances: floats in metres, or 16-bit millimetres (REP 118)."""
    return encoding in DEPTH_ENCODINGS


def is_16_bit(encoding: str) -> bool:
    """Tells whether an encoding holds colours or greys of 16 bits; `16UC1` is depth (REP 118)."""
    return encoding in _COLORS_16


def as_image16(encoding: str, rows: Pixels) -> npt.NDArray[np.uint16]:
    """Returns (H, W, 3) RGB or (H, W) grey pixels of rows as they are stored; raises `RecordingError`."""
    if not is_16_bit(encoding):
        raise RecordingError(f"image encoding {encoding!r} is no Image16; those known are {', '.join(_COLORS_16)}")
    return np.ascontiguousarray(rows[..., 2::-1] if encoding in ("bgr16", "16UC3") else rows, np.uint16)


def as_image(encoding: str, rows: Pixels) -> npt.NDArray[np.uint8]:
    """Returns (H, W, 3) RGB or (H, W) grey pixels of rows as they are stored; raises `RecordingError`.

    16-bit colours and greys are `as_image16`. An alpha channel is left out, a Bayer mosaic is interpolated
    bilinearly, YUV is converted by BT.601.
    """
    convert = _IMAGES.get(encoding)
    if convert is None:
        raise RecordingError(
            f"image encoding {encoding!r} is no Image; those known are {', '.join(_IMAGES)}"
            + ("; it is a DepthImage" if is_depth(encoding) else "")
        )
    return np.ascontiguousarray(convert(rows))


def as_depth(encoding: str, rows: Pixels) -> npt.NDArray[np.float32]:
    """Returns metres (H, W) of rows as they are stored: 16-bit ones count millimetres. Raises `RecordingError`."""
    if not is_depth(encoding):
        raise RecordingError(
            f"image encoding {encoding!r} is no DepthImage; those known are {', '.join(DEPTH_ENCODINGS)}"
        )
    if encoding == "16UC1":
        return rows.astype(np.float32) / MILLIMETRES
    return np.ascontiguousarray(rows, np.float32)


def as_millimetres(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16] | None:
    """Returns whole millimetres (H, W) that `as_depth` turns back into the same bits; None where there are none.

    Most depth cameras measure in whole millimetres; half the bytes hold them.
    """
    if _in_millimetres(depth[:: max(1, len(depth) // _PROBED_ROWS)]) is None:
        return None
    return _in_millimetres(depth)


def _in_millimetres(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16] | None:
    with np.errstate(all="ignore"):  # what is no distance differs below
        scaled = np.multiply(depth, MILLIMETRES, dtype=np.float32)
        np.rint(scaled, out=scaled)
        whole = scaled.astype(np.uint16)
        np.divide(whole, MILLIMETRES, out=scaled, dtype=np.float32)
    same = np.array_equal(scaled.view(np.uint32), np.ascontiguousarray(depth, np.float32).view(np.uint32))
    return whole if same else None


def stored_rows(encoding: str, width: int, height: int, step: int, data: Pixels, *, big_endian: bool = False) -> Pixels:
    """The pixels (H, W) or (H, W, C) of a raw image, its row padding removed; raises `RecordingError`.

    `data`: the bytes, flat. `step`: bytes of a row, 0 for those that the pixels take.
    """
    if encoding not in _LAYOUTS:
        raise RecordingError(f"image encoding {encoding!r} is not known; those known are {', '.join(_LAYOUTS)}")
    element, channels = _LAYOUTS[encoding]
    dtype = np.dtype(element).newbyteorder(">" if big_endian else "<")
    used = row_bytes(encoding, width)
    step = step or used
    if step < used or len(data) < step * (height - 1) + used or not height * width:
        raise RecordingError(
            f"an image of {width}x{height} {encoding} needs rows of {used} bytes, got step {step} and {len(data)} bytes"
        )
    flat = rows_without_padding(np.asarray(data, np.uint8), height, step, used)
    pixels = flat.view(dtype).reshape((height, width) if channels == 1 else (height, width, channels))
    return pixels.astype(dtype.newbyteorder("=")) if big_endian else pixels


def row_bytes(encoding: str, width: int) -> int:
    """Bytes that the pixels of a row take; 0 for an encoding that is not known."""
    element, channels = _LAYOUTS.get(encoding, ("u1", 0))
    return width * channels * np.dtype(element).itemsize


def rows_without_padding(data: Pixels, height: int, step: int, used: int) -> Pixels:
    """The first `used` of each `step` bytes, flat, for `height` rows; the last row may lack its padding."""
    if step == used:
        return data[: step * height]
    rows = np.ndarray((height, used), np.uint8, np.ascontiguousarray(data), strides=(step, 1))  # raises beyond its end
    return np.ascontiguousarray(rows).reshape(-1)


def _plain(rows: Pixels) -> Pixels:
    return rows


def _reversed(rows: Pixels) -> Pixels:
    return rows[..., 2::-1]


def _without_alpha(rows: Pixels) -> Pixels:
    return rows[..., :3]


def _bayer(red_row: int, red_column: int) -> Callable[[Pixels], Pixels]:
    def convert(rows: Pixels) -> Pixels:
        height, width = rows.shape
        masks = np.zeros((height, width, 3), np.float32)
        masks[red_row::2, red_column::2, 0] = 1
        masks[1 - red_row :: 2, 1 - red_column :: 2, 2] = 1
        masks[..., 1] = 1 - masks[..., 0] - masks[..., 2]
        values = masks * rows[..., None].astype(np.float32)
        total, weight = _blurred(values), _blurred(masks)
        found = np.where(masks > 0, values, total / np.maximum(weight, 1e-6))
        return np.clip(np.rint(found), 0, 255).astype(np.uint8)

    return convert


def _blurred(planes: Pixels) -> Pixels:
    """Sums of each pixel's 3x3 neighbours, weighed 4 (itself), 2 (beside) and 1 (diagonal)."""
    padded = np.pad(planes, ((1, 1), (1, 1), (0, 0)))
    across = padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]
    summed: Pixels = across[:-2] + 2 * across[1:-1] + across[2:]
    return summed


def _yuv(luma: int) -> Callable[[Pixels], Pixels]:
    """Packed 4:2:2; `luma`: which byte of each pair is Y."""

    def convert(rows: Pixels) -> Pixels:
        if rows.shape[1] % 2:
            raise RecordingError(f"a 4:2:2 image has an even width, got {rows.shape[1]}")
        y = rows[..., luma].astype(np.float32)
        chroma = rows[..., 1 - luma].astype(np.float32) - 128
        u, v = np.repeat(chroma[:, 0::2], 2, axis=1), np.repeat(chroma[:, 1::2], 2, axis=1)
        rgb = np.stack([y + 1.402 * v, y - 0.344136 * u - 0.714136 * v, y + 1.772 * u], axis=-1)
        pixels: Pixels = np.clip(np.rint(rgb), 0, 255).astype(np.uint8)
        return pixels

    return convert


_IMAGES: dict[str, Callable[[Pixels], Pixels]] = {
    "mono8": _plain,
    "8UC1": _plain,
    "rgb8": _plain,
    "8UC3": _reversed,
    "bgr8": _reversed,
    "rgba8": _without_alpha,
    "bgra8": _reversed,
    "bayer_rggb8": _bayer(0, 0),
    "bayer_bggr8": _bayer(1, 1),
    "bayer_gbrg8": _bayer(1, 0),
    "bayer_grbg8": _bayer(0, 1),
    "yuv422": _yuv(1),
    "uyvy": _yuv(1),
    "yuv422_yuy2": _yuv(0),
    "yuyv": _yuv(0),
}
