"""Proposals by a detector's network: boxes around anything, and a vector that describes each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.detection.custom.decode import decode_grid
from operators.detection.nms import class_wise_nms
from operators.image.letterbox import ImageFit
from operators.inference import open_session
from operators.weights import NetworkFileError, open_network

if TYPE_CHECKING:
    import onnxruntime

F32 = NDArray[np.float32]
COLOR = "color"
"""Names the map of colours among the inner maps."""
_GRID, _SAMPLES = 2, 3  # parts of a box, and points in each, along a side
_HUES, _GREYS, _CELL = 8, 4, 4  # colours, and shades without one; pixels along a side of a cell of their map


@dataclass(frozen=True, eq=False)
class NetworkMaps:
    """An image as the network sees it: the grid's raw maps, the inner maps (C, H, W), how it was fitted in, and the
    maps (1, C, H, W) that a refiner asks for."""

    maps: Sequence[F32]
    trunk: Sequence[F32]
    fit: ImageFit
    more: Sequence[F32] = ()


class Trunk:
    """A detector's network whose inner maps are given as well; on one CPU thread.

    `inner` names the values that come out beside the detector's outputs (`inner_maps` finds them), and `COLOR` for the
    image's colours, of which a trunk keeps little; `more` names what a refiner asks for. Raises FileNotFoundError or
    NetworkFileError.
    """

    def __init__(self, file: Path, inner: Sequence[str], more: Sequence[str] = ()) -> None:
        network = open_network(file, "detector")
        self.classes, self.size, self.inner = network.classes, network.size, tuple(inner)
        self.anchors = np.array(network.facts.get("anchors", []), np.float32)
        self.strides = [int(s) for s in network.facts.get("strides", [])]
        if self.anchors.ndim != 3 or len(self.anchors) != len(self.strides):
            raise NetworkFileError(f"{file}: its metadata must hold anchors (levels, anchors, 2) and their strides")
        self._session: onnxruntime.InferenceSession = open_session(
            file, reveal=[*(name for name in self.inner if name != COLOR), *more]
        )

    def look(self, pixels: NDArray[np.uint8]) -> NetworkMaps:
        """Runs the network on an image (H, W, 3), RGB."""
        fit = ImageFit.plan("letterbox", (pixels.shape[1], pixels.shape[0]), self.size)
        fitted = fit.apply(pixels)
        tensor = np.ascontiguousarray(fitted.transpose(2, 0, 1)[None], np.float32)
        tensor /= np.float32(255)
        found = self._session.run(None, {self._session.get_inputs()[0].name: tensor})
        known = len(self.strides)
        shown = [name for name in self.inner if name != COLOR]
        maps = dict(zip(shown, found[known : known + len(shown)], strict=True))
        inner = [color_map(fitted) if name == COLOR else maps[name][0] for name in self.inner]
        return NetworkMaps(found[:known], inner, fit, found[known + len(shown) :])

    def propose(self, glance: NetworkMaps, threshold: float, most: int) -> F32:
        """Returns boxes (N, 4) in the network's pixels around anything, whatever its class, by falling score."""
        found = decode_grid(glance.maps, self.anchors, self.strides, len(self.classes), threshold)
        found = found.select(np.argsort(-found.scores, kind="stable")[: 20 * most])
        kept = class_wise_nms(found.boxes, found.scores, np.zeros_like(found.classes), 0.7)[:most]
        return found.boxes[kept]

    def describe(self, glance: NetworkMaps, boxes: F32) -> F32:
        """Returns (N, D): each inner map averaged over the four quarters of each box (N, 4), of length 1 a map."""
        parts = [_pooled(each, boxes, self.size) for each in glance.trunk]
        return np.concatenate(
            [part / np.maximum(np.linalg.norm(part, axis=1, keepdims=True), 1e-6) for part in parts], 1
        )


def color_map(pixels: NDArray[np.uint8]) -> F32:
    """Returns (12, H/4, W/4): shares of eight hues and of four shades of grey in an image (H, W, 3), RGB.

    Neighbouring hues and shades share a pixel that lies between them, as in the soft histograms of van de Weijer and
    Schmid, "Coloring local feature extraction", 2006; the less colour a pixel has, the more it counts as grey.
    """
    hsv = cv2.cvtColor(np.ascontiguousarray(pixels, np.uint8), cv2.COLOR_RGB2HSV_FULL).astype(np.float32)
    hue, value = hsv[..., 0] * np.float32(_HUES / 256), hsv[..., 2] / np.float32(255)
    chroma = np.clip(2 * (hsv[..., 1] / np.float32(255)) * value, 0, 1)
    around = np.abs((hue[None] - np.arange(_HUES, dtype=np.float32)[:, None, None] + _HUES / 2) % _HUES - _HUES / 2)
    shades = np.arange(_GREYS, dtype=np.float32)[:, None, None]
    apart = np.abs(value[None] * np.float32(_GREYS - 1) - shades)
    shares = np.concatenate([np.clip(1 - around, 0, 1) * chroma, np.clip(1 - apart, 0, 1) * (1 - chroma)])
    height, width = shares.shape[1] // _CELL, shares.shape[2] // _CELL
    cells = shares[:, : height * _CELL, : width * _CELL].reshape(len(shares), height, _CELL, width, _CELL)
    return np.asarray(cells.mean(axis=(2, 4)), np.float32)


def inner_maps(file: Path) -> tuple[str, ...]:
    """Names the trunk's maps of strides 4, 8 and 16 in a network of `dataflow train detector` or `pair`.

    Needs the package onnx. Raises NetworkFileError where the network has none.
    """
    import onnx

    own = [int(s) for s in open_network(file, "detector").facts.get("strides", [])]
    model = onnx.load(str(file))
    names = []
    for stride in (s for s in (4, 8, 16) if s in own):
        lateral = [n for n in model.graph.node if n.op_type == "Conv" and f"/lateral.{own.index(stride)}/" in n.name]
        if lateral:
            names.append(lateral[0].input[0])
    if not names:
        raise NetworkFileError(f"{file} has no feature pyramid; take a network of `dataflow train detector` or `pair`")
    return tuple(names)


def _pooled(map: F32, boxes: F32, size: tuple[int, int]) -> F32:
    """Returns (N, C · 4): means over the quarters of boxes in the network's pixels, by bilinear samples."""
    channels, height, width = map.shape
    count = _GRID * _SAMPLES
    shares = ((np.arange(count) + 0.5) / count).astype(np.float32)
    x = (boxes[:, :1] + shares * (boxes[:, 2:3] - boxes[:, :1])) * (width / size[0]) - 0.5
    y = (boxes[:, 1:2] + shares * (boxes[:, 3:4] - boxes[:, 1:2])) * (height / size[1]) - 0.5
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    u, v = (x - left)[:, None, :, None], (y - top)[:, :, None, None]
    cells = map.transpose(1, 2, 0)
    rows, columns = top[:, :, None], left[:, None, :]
    upper = (1 - u) * cells[rows, columns] + u * cells[rows, columns + 1]
    lower = (1 - u) * cells[rows + 1, columns] + u * cells[rows + 1, columns + 1]
    sampled = (1 - v) * upper + v * lower
    quarters = sampled.reshape(len(boxes), _GRID, _SAMPLES, _GRID, _SAMPLES, channels).mean(axis=(2, 4))
    return np.asarray(quarters.reshape(len(boxes), _GRID * _GRID * channels), np.float32)
