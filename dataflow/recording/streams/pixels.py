"""Pixels of raw images, in the encodings that ROS and Foxglove name, as images and depth. Pure."""

from __future__ import annotations

import re
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
_PATTERNS = {"rggb": (0, 0), "bggr": (1, 1), "gbrg": (1, 0), "grbg": (0, 1)}
"""Of Bayer mosaics: row and column of the first red pixel."""
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
    "8UC4": ("u1", 4),
    "rgba16": ("u2", 4),
    "bgra16": ("u2", 4),
    "16UC4": ("u2", 4),
    **{f"bayer_{pattern}8": ("u1", 1) for pattern in _PATTERNS},
    **{f"bayer_{pattern}16": ("u2", 1) for pattern in _PATTERNS},
    "yuv422": ("u1", 2),
    "uyvy": ("u1", 2),
    "yuv422_yuy2": ("u1", 2),
    "yuyv": ("u1", 2),
    "nv12": ("u1", 1),
    "nv21": ("u1", 1),
    "nv24": ("u1", 1),
    "32FC1": ("f4", 1),
    "64FC1": ("f8", 1),
    "16UC1": ("u2", 1),
}
"""Element and number of channels of a pixel as it is stored."""
_PLANES = {"nv12": (3, 2), "nv21": (3, 2), "nv24": (3, 1)}
"""Of encodings whose colours lie behind the greys: rows that are stored, as a fraction of the image's."""


def is_depth(encoding: str) -> bool:
    """Returns whether an encoding holds distances: floats in metres, or 16-bit millimetres (REP 118)."""
    return encoding in DEPTH_ENCODINGS


def is_16_bit(encoding: str) -> bool:
    """Returns whether an encoding holds colours or greys of 16 bits; `16UC1` is depth (REP 118)."""
    return encoding in _IMAGES_16


def as_image16(encoding: str, rows: Pixels) -> npt.NDArray[np.uint16]:
    """Returns (H, W, 3) RGB or (H, W) grey pixels of rows as they are stored; raises `RecordingError`."""
    convert = _IMAGES_16.get(encoding)
    if convert is None:
        raise RecordingError(f"image encoding {encoding!r} is no Image16; those known are {', '.join(_IMAGES_16)}")
    return np.ascontiguousarray(convert(rows), np.uint16)


def as_image(encoding: str, rows: Pixels) -> npt.NDArray[np.uint8]:
    """Returns (H, W, 3) RGB or (H, W) grey pixels of rows as they are stored; raises `RecordingError`.

    16-bit colours and greys are `as_image16`. An alpha channel is left out; a Bayer mosaic is interpolated bilinearly,
    and YUV of BT.601's limited range converted, both to the bits that OpenCV gives.
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
    with np.errstate(over="ignore"):  # of 64 bits, infinitely far
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

    `data`: the bytes, flat. `step`: bytes of a row, 0 for those that the pixels take. Of encodings whose colours lie
    behind the greys, the rows of these follow (`stored_height`).
    """
    if encoding not in _LAYOUTS:
        raise RecordingError(_unknown(encoding))
    element, channels = _LAYOUTS[encoding]
    dtype = np.dtype(element).newbyteorder(">" if big_endian else "<")
    used = row_bytes(encoding, width)
    step = step or used
    if not height * width:
        raise RecordingError(f"an image of {width}x{height} pixels")
    height = stored_height(encoding, height)
    if step < used or len(data) < step * (height - 1) + used:
        raise RecordingError(
            f"an image of {width}x{height} {encoding} needs rows of {used} bytes, got step {step} and {len(data)} bytes"
        )
    flat = rows_without_padding(np.asarray(data, np.uint8), height, step, used)
    pixels = flat.view(dtype).reshape((height, width) if channels == 1 else (height, width, channels))
    return pixels.astype(dtype.newbyteorder("=")) if big_endian else pixels


def _unknown(encoding: str) -> str:
    """The error text for an encoding that is not known, with those that are."""
    if found := re.fullmatch(r"(8|16|32|64)(U|S|F)C(\d+)", encoding):
        bits, kind, channels = found.groups()
        kinds = {"U": "unsigned numbers", "S": "signed numbers", "F": "floats"}
        named = "16UC1, 32FC1 or 64FC1 is depth, 8UC1, 8UC3 and 8UC4 are grey and colours"
        what = f"{channels} channels of {bits}-bit {kinds[kind]}"
        return f"image encoding {encoding!r} ({what}) is no image or depth here: {named}"
    return f"image encoding {encoding!r} is not known; those known are {', '.join(_LAYOUTS)}"


def stored_height(encoding: str, height: int) -> int:
    """Rows that are stored of an image of `height`; raises `RecordingError` where its encoding does not have them."""
    times, by = _PLANES.get(encoding, (1, 1))
    if height * times % by:
        raise RecordingError(f"an image of {encoding} has an even height, got {height}")
    return height * times // by


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
    """Interpolates bilinearly; the outermost pixels are those beside them, as OpenCV has it."""

    def convert(rows: Pixels) -> Pixels:
        height, width = rows.shape
        if min(height, width) < 3:
            raise RecordingError(f"a Bayer mosaic of {width}x{height} pixels; 3x3 are the least")
        wide = rows.astype(np.uint32)
        here = wide[1:-1, 1:-1]
        beside, above = wide[1:-1, :-2] + wide[1:-1, 2:], wide[:-2, 1:-1] + wide[2:, 1:-1]
        corners = wide[:-2, :-2] + wide[:-2, 2:] + wide[2:, :-2] + wide[2:, 2:]
        of_row = (np.arange(1, height - 1) % 2 == red_row)[:, None]
        of_column = (np.arange(1, width - 1) % 2 == red_column)[None, :]
        across, upright, cornered = (beside + 1) >> 1, (above + 1) >> 1, (corners + 2) >> 2
        red = np.where(of_row, np.where(of_column, here, across), np.where(of_column, upright, cornered))
        blue = np.where(of_row, np.where(of_column, cornered, upright), np.where(of_column, across, here))
        green = np.where(of_row == of_column, (beside + above + 2) >> 2, here)
        inner = np.stack([red, green, blue], axis=-1).astype(rows.dtype)
        return np.pad(inner, ((1, 1), (1, 1), (0, 0)), mode="edge")

    return convert


def _packed(luma: int) -> Callable[[Pixels], Pixels]:
    """Packed YUV 4:2:2; `luma`: which byte of each pair is Y."""

    def convert(rows: Pixels) -> Pixels:
        if rows.shape[1] % 2:
            raise RecordingError(f"a 4:2:2 image has an even width, got {rows.shape[1]}")
        chroma = rows[..., 1 - luma]
        return _yuv(rows[..., luma], np.repeat(chroma[:, 0::2], 2, axis=1), np.repeat(chroma[:, 1::2], 2, axis=1))

    return convert


def _planar(u: int, halved: bool) -> Callable[[Pixels], Pixels]:
    """YUV whose colours lie in rows behind the greys, as pairs; `u`: which of each pair is U; `halved`: 4:2:0."""

    def convert(rows: Pixels) -> Pixels:
        width = rows.shape[1]
        height = rows.shape[0] * (2 if halved else 1) // 3
        if halved and width % 2:
            raise RecordingError(f"a 4:2:0 image has an even width, got {width}")
        pairs = rows[height:].reshape(height // 2 if halved else height, -1, 2)
        if halved:
            pairs = pairs.repeat(2, axis=0).repeat(2, axis=1)
        return _yuv(rows[:height], pairs[..., u], pairs[..., 1 - u])

    return convert


def _yuv(y: Pixels, u: Pixels, v: Pixels) -> Pixels:
    """RGB (H, W, 3) of YUV by BT.601, limited range, in OpenCV's fixed point of 20 bits."""
    grey = np.maximum(y.astype(np.int32) - 16, 0) * 1220542 + (1 << 19)
    u, v = u.astype(np.int32) - 128, v.astype(np.int32) - 128
    rgb = np.stack([grey + 1673527 * v, grey - 852492 * v - 409993 * u, grey + 2116026 * u], axis=-1) >> 20
    pixels: Pixels = np.clip(rgb, 0, 255).astype(np.uint8)
    return pixels


_IMAGES: dict[str, Callable[[Pixels], Pixels]] = {
    "mono8": _plain,
    "8UC1": _plain,
    "rgb8": _plain,
    "8UC3": _reversed,
    "bgr8": _reversed,
    "rgba8": _without_alpha,
    "bgra8": _reversed,
    "8UC4": _reversed,
    **{f"bayer_{pattern}8": _bayer(*red) for pattern, red in _PATTERNS.items()},
    "yuv422": _packed(1),
    "uyvy": _packed(1),
    "yuv422_yuy2": _packed(0),
    "yuyv": _packed(0),
    "nv12": _planar(0, True),
    "nv21": _planar(1, True),
    "nv24": _planar(0, False),
}
_IMAGES_16: dict[str, Callable[[Pixels], Pixels]] = {
    "mono16": _plain,
    "rgb16": _plain,
    "bgr16": _reversed,
    "16UC3": _reversed,
    "rgba16": _without_alpha,
    "bgra16": _reversed,
    "16UC4": _reversed,
    **{f"bayer_{pattern}16": _bayer(*red) for pattern, red in _PATTERNS.items()},
}
