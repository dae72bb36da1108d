"""Messages for people: a field as a line of text, a message as HTML with a picture, for terminals and notebooks."""

from __future__ import annotations

import base64
from collections.abc import Callable
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.messages.base import Message
from dataflow.messages.clouds import PointCloud
from dataflow.messages.images import CompressedDepth, CompressedImage, DepthImage, Image, RelativeDepth
from dataflow.messages.mapping import OccupancyGrid
from dataflow.messages.png import png, turbo
from dataflow.messages.segmentation import SegmentationMap

SHOWN_ELEMENTS = 16
"""Arrays and lists up to this length are shown whole."""
SHOWN_PIXELS = 960
"""Pictures are thinned to at most this width and height."""
_CLOUD_PIXELS = 360
_CELL = "text-align:left;font-family:monospace;white-space:pre-wrap"
Pixels = npt.NDArray[np.uint8]


def field_text(value: Any, *, whole: bool = False) -> str:
    """A field's value: six digits, long arrays by their shape and range, long lists by their beginning.

    `whole`: nothing is left out.
    """
    if isinstance(value, np.ndarray):
        if whole or value.size <= SHOWN_ELEMENTS:
            limit = value.size + 1 if whole else SHOWN_ELEMENTS
            text = np.array2string(value, precision=6, suppress_small=True, threshold=limit, separator=", ")
            return " ".join(text.split())
        shape = " × ".join(map(str, value.shape))
        return f"{value.dtype} {shape}{_range(value)}"
    if isinstance(value, tuple):
        shown = value if whole or len(value) <= SHOWN_ELEMENTS else value[:5]
        more = f", … {len(value)} in all" if len(shown) < len(value) else ""
        return ", ".join(map(str, shown)) + more if value else "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str):
        return value if whole or len(value) <= 200 else f"{value[:200]}… {len(value):,} characters in all"
    return str(value)


def _range(value: npt.NDArray[Any]) -> str:
    """The smallest and the largest finite element, in words."""
    if value.dtype.kind not in "iuf" or not value.size:
        return ""
    finite = value[np.isfinite(value)] if value.dtype.kind == "f" else value
    return f"  from {finite.min():.4g} to {finite.max():.4g}" if finite.size else "  nothing finite"


def message_html(message: Message) -> str:
    """A message as HTML: its picture, if there is one of its type, and a table of its fields."""
    rows = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="{_CELL}">{escape(field_text(value))}</td></tr>'
        for name, value in message.items()
        if value is not None
    )
    found = image_file(message)
    picture = ""
    if found is not None:
        kind, data = found
        picture = f'<img src="data:image/{kind};base64,{base64.b64encode(data).decode()}" style="max-width:100%"/>'
    return f"<div><b>{escape(message.SCHEMA)}</b><br/>{picture}<table>{rows}</table></div>"


def image_file(message: Message) -> tuple[str, bytes] | None:
    """The picture of a message as (format, file); None for types that have none."""
    if isinstance(message, CompressedImage):
        return message.format, message.data.tobytes()
    if isinstance(message, CompressedDepth):
        return "png", message.data.tobytes()
    drawn = picture(message)
    return None if drawn is None else ("png", png(drawn))


def picture(message: Message) -> Pixels | None:
    """The pixels (H, W) or (H, W, 3) of a message that can be drawn, thinned to a size for people."""
    for kind, draw in _PICTURES.items():
        if isinstance(message, kind):
            return np.ascontiguousarray(draw(message))
    return None


def _thin(data: npt.NDArray[Any]) -> npt.NDArray[Any]:
    step = max(1, -(-max(data.shape[:2]) // SHOWN_PIXELS))
    return data[::step, ::step]


def _image(message: Image) -> Pixels:
    return _thin(message.data)


def _depth(message: DepthImage) -> Pixels:
    """Near is red and far is blue, as far as depths go; black where there was no return."""
    depth = _thin(message.data).astype(np.float64)
    return turbo(1.0 - _scaled(np.where(depth > 0, depth, np.nan)))


def _nearness(message: RelativeDepth) -> Pixels:
    """Near is red and far is blue, as DepthImage has it."""
    return turbo(_scaled(_thin(message.data).astype(np.float64)))


def _scaled(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Values from 0.05 to 0.95, between which colours are bright, from their first to their last percent; NaN stays."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.full(values.shape, np.nan)
    low, high = np.percentile(finite, (1, 99))
    share: npt.NDArray[np.float64] = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)
    return 0.05 + 0.9 * share


def _classes(message: SegmentationMap) -> Pixels:
    """Each class in a colour of its own, the same everywhere: hues a golden angle apart."""
    ids = _thin(message.classes).astype(np.float64)
    phase = 2 * np.pi * ((ids * 0.6180339887) % 1.0)[..., None] + np.array([0.0, 2.0943951, 4.1887902])
    colors: Pixels = (127.5 + 110.0 * np.cos(phase)).astype(np.uint8)
    return colors


def _grid(message: OccupancyGrid) -> Pixels:
    """Free is white, occupied black, unknown grey; y points up."""
    cells = _thin(message.cells)[::-1]
    return np.where(cells < 0, 128, 255 - np.clip(cells, 0, 100) * 2.55).astype(np.uint8)


def _cloud(message: PointCloud) -> Pixels:
    """The points from above, x up and y to the left, coloured by height."""
    points = message.points[np.isfinite(message.points).all(axis=1)].astype(np.float64)
    canvas = np.zeros((_CLOUD_PIXELS, _CLOUD_PIXELS, 3), np.uint8)
    if not len(points):
        return canvas
    lower, upper = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    extent = max(float((upper - lower).max()), 1e-6)
    at = ((points[:, :2] - (lower + upper) / 2) / extent * 0.98 + 0.5) * (_CLOUD_PIXELS - 1)
    order = np.argsort(points[:, 2], kind="stable")
    rows, columns = (_CLOUD_PIXELS - 1 - at[order]).astype(np.int64).T
    canvas[rows, columns] = turbo(_scaled(points[order, 2]))
    return canvas


_PICTURES: dict[type[Message], Callable[[Any], Pixels]] = {
    Image: _image,
    DepthImage: _depth,
    RelativeDepth: _nearness,
    SegmentationMap: _classes,
    OccupancyGrid: _grid,
    PointCloud: _cloud,
}
