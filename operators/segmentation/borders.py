"""A second look at the borders of a segmenter's classes: which pixels of the image are on which side.

A segmenter answers in cells of several pixels. Where two classes meet, the image is gone through in blocks of 4x4
pixels; for each, a small network sees the pixels around it and by how much the cells prefer one class to the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from operators.image.letterbox import ImageFit
from operators.weights import Network, SecondNetwork, open_second

KIND = "borders"
BLOCK, AROUND = 4, 4
"""Pixels along a side of a block, and how far beyond it the network sees."""
SEEN = BLOCK + 2 * AROUND
GRAIN = 2
"""Pixels between two samples of the preferences."""
_FINEST = 2.0  # pixels of the image to one of the network's input; finer images are gone through at this
_TOGETHER = 4  # planes of scores that are enlarged as the channels of one image, in half the time
Pixels = NDArray[np.uint8]


def scored(network: Network) -> bool:
    """Returns whether a segmenter's file answers with its scores in 8 bits."""
    outputs = network.session.get_outputs()
    return [(each.name, each.type) for each in outputs] == [("scores", "tensor(uint8)")]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Blocks in which two classes meet, N of them, at columns and rows `at` (N, 2) of the grid of blocks.

    `pixels` (N, 12, 12, 3) are those around each, `preferences` (N, 6, 6) by how much the scores there prefer `first`
    (N,) to `second` (N,), which is the class that is surest of the others in the next cells.
    """

    at: NDArray[np.intp]
    first: Pixels
    second: Pixels
    pixels: Pixels
    preferences: NDArray[np.float32]


class Borders:
    """The network that looks again. Raises NetworkFileError where it has other inputs.

    Method: decide again only where the answer is unsure, at the image's resolution: Kirillov et al., "PointRend:
    Image segmentation as rendering", 2020; here for blocks, and between two classes.
    """

    def __init__(self, second: SecondNetwork) -> None:
        count = SEEN // GRAIN
        second.expect(
            {
                "pixels": ("tensor(uint8)", [SEEN, SEEN, 3]),
                "preferences": ("tensor(float)", [count, count]),
                "first": ("tensor(int64)", []),
                "second": ("tensor(int64)", []),
            }
        )
        self._second = second

    @classmethod
    def within(cls, network: Network) -> Borders | None:
        """The second network in a segmenter's file; None where it has none. Raises NetworkFileError."""
        second = open_second(network, KIND)
        return None if second is None else cls(second)

    def classes(self, scores: Pixels, step: float, pixels: Pixels, fit: ImageFit) -> Pixels:
        """The class (H, W) of each pixel of an image (H, W, 3), RGB, by the scores (C, h, w), of so much each, that the
        first network gave for the input into which the image was fitted."""
        return look_again(self._answer, scores, step, pixels, fit)

    def _answer(self, blocks: Blocks) -> NDArray[np.float32]:
        return self._second.sides(
            {
                "pixels": blocks.pixels,
                "preferences": blocks.preferences,
                "first": blocks.first.astype(np.int64),
                "second": blocks.second.astype(np.int64),
            }
        )


def look_again(
    answer: Callable[[Blocks], NDArray[np.float32]], scores: Pixels, step: float, pixels: Pixels, fit: ImageFit
) -> Pixels:
    """`Borders.classes`, by what `answer` gives for blocks: (N, 16), above 0 where a pixel is of the first class."""
    shown, placed = worked(pixels, fit)
    labels, best = best_cells(scores)
    coarse, blocks = found_blocks(scores, step, labels, best, shown, placed)
    if len(blocks.at):
        first = (answer(blocks) > 0).reshape(-1, BLOCK, BLOCK)
        _settle(coarse, blocks, first)
    height, width = shown.shape[:2]
    classes = np.ascontiguousarray(coarse[:height, :width])
    if (width, height) == fit.image:
        return classes
    return cv2.resize(classes, fit.image, interpolation=cv2.INTER_NEAREST).astype(np.uint8, copy=False)


@dataclass(frozen=True)
class PixelMapping:
    """Places pixels among the cells: pixel x of the image lies at the cell x * scale + offset, along both axes."""

    scale: tuple[float, float]
    offset: tuple[float, float]


def worked(pixels: Pixels, fit: ImageFit) -> tuple[Pixels, PixelMapping]:
    """The image as it is gone through, and where its pixels lie among the cells."""
    limit = (round(_FINEST * fit.inner[0]), round(_FINEST * fit.inner[1]))
    if fit.image[0] > limit[0]:
        pixels = cv2.resize(pixels, limit, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    size = (pixels.shape[1], pixels.shape[0])
    scale = [inner / extent / 2 for inner, extent in zip(fit.inner, size, strict=True)]
    # Pixel 2i of the input has the scores of cell i; pixels are counted from their middle.
    offset = [share / 2 + before / 2 - 0.25 for share, before in zip(scale, fit.offset, strict=True)]
    return pixels, PixelMapping((scale[0], scale[1]), (offset[0], offset[1]))


def best_cells(scores: Pixels) -> tuple[Pixels, Pixels]:
    """The best class (h, w) of each cell, of equal ones the first, and its score."""
    labels, best = np.zeros(scores.shape[1:], np.uint8), scores[0].copy()
    for k in range(1, len(scores)):
        better = scores[k] > best
        labels[better] = k
        np.maximum(best, scores[k], out=best)
    return labels, best


def found_blocks(
    scores: Pixels, step: float, labels: Pixels, best: Pixels, pixels: Pixels, placed: PixelMapping
) -> tuple[Pixels, Blocks]:
    """The class of the nearest cell for each pixel, up to the end of the last block, and the blocks to look at."""
    height, width = pixels.shape[:2]
    columns, rows = -(-width // BLOCK), -(-height // BLOCK)
    along = list(zip((columns, rows), placed.scale, placed.offset, labels.shape[::-1], strict=True))
    cells, middles = (
        [
            np.clip(np.rint((np.arange(count * per) * step + first) * scale + offset), 0, limit - 1).astype(np.intp)
            for count, scale, offset, limit in along
        ]
        for per, step, first in ((BLOCK, 1, 0), (1, BLOCK, (BLOCK - 1) / 2))
    )
    coarse = labels.take(cells[0], axis=1).take(cells[1], axis=0)
    reach = [int(np.ceil(BLOCK / 2 * scale)) for scale in placed.scale]
    kernel = np.ones((2 * reach[1] + 1, 2 * reach[0] + 1), np.uint8)
    mixed = cv2.erode(labels, kernel) != cv2.dilate(labels, kernel)
    row, column = np.nonzero(mixed[middles[1][:, None], middles[0]])
    y, x = middles[1][row], middles[0][column]
    first, second = labels[y, x], _others(scores, labels, best, y, x, reach)
    there = np.unique(np.concatenate([first, second]))
    number = np.zeros(len(scores), np.intp)
    number[there] = np.arange(len(there))
    planes = _spread(scores[there], placed, columns, rows)
    near = sliding_window_view(planes, (SEEN // GRAIN, SEEN // GRAIN), axis=(1, 2))
    j, i = row * (BLOCK // GRAIN), column * (BLOCK // GRAIN)
    preferences = (near[number[first], j, i].astype(np.float32) - near[number[second], j, i]) * np.float32(step)
    beyond = cv2.copyMakeBorder(
        pixels, AROUND, AROUND + rows * BLOCK - height, AROUND, AROUND + columns * BLOCK - width, cv2.BORDER_REPLICATE
    )
    seen = sliding_window_view(beyond, (SEEN, SEEN, 3))[row * BLOCK, column * BLOCK, 0]
    return coarse, Blocks(np.stack([column, row], axis=1), first, second, seen, preferences)


def _others(
    scores: Pixels, labels: Pixels, best: Pixels, y: NDArray[np.intp], x: NDArray[np.intp], reach: list[int]
) -> Pixels:
    """The class that the cells around each cell (y, x) prefer most to that cell's own."""
    height, width = labels.shape
    own = labels[y, x]
    found, most = own.copy(), np.zeros(len(y), np.int16)
    flat, all_labels, sure = scores.reshape(-1), labels.reshape(-1), best.reshape(-1)
    plane = own.astype(np.intp) * (height * width)
    columns = [np.clip(x + dx, 0, width - 1) for dx in range(-reach[0], reach[0] + 1)]
    for dy in range(-reach[1], reach[1] + 1):
        first = np.clip(y + dy, 0, height - 1) * width
        for column in columns:
            at = first + column
            lead = sure.take(at).astype(np.int16) - flat.take(plane + at)
            label = all_labels.take(at)
            more = (label != own) & (lead >= most)
            np.copyto(found, label, where=more)
            np.copyto(most, lead, where=more)
    return found


def _spread(scores: Pixels, placed: PixelMapping, columns: int, rows: int) -> Pixels:
    """Scores (K, h, w) at every `GRAIN` pixels of the image, beginning `AROUND` pixels before it."""
    size = ((columns * BLOCK + 2 * AROUND) // GRAIN, (rows * BLOCK + 2 * AROUND) // GRAIN)
    first = [
        offset + ((GRAIN - 1) / 2 - AROUND) * scale for scale, offset in zip(placed.scale, placed.offset, strict=True)
    ]
    affine = np.array([[placed.scale[0] * GRAIN, 0, first[0]], [0, placed.scale[1] * GRAIN, first[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    spread = np.empty((-(-len(scores) // _TOGETHER) * _TOGETHER, size[1], size[0]), np.uint8)
    for k in range(0, len(scores), _TOGETHER):
        some = [scores[min(j, len(scores) - 1)] for j in range(k, k + _TOGETHER)]
        warped = cv2.warpAffine(cv2.merge(some), affine, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        cv2.split(warped, list(spread[k : k + _TOGETHER]))
    return spread[: len(scores)]


def _settle(coarse: Pixels, blocks: Blocks, first: NDArray[np.bool_]) -> None:
    """Gives the pixels of blocks the class that was decided for; those of a third class keep theirs."""
    rows, columns = coarse.shape[0] // BLOCK, coarse.shape[1] // BLOCK
    tiles = coarse.reshape(rows, BLOCK, columns, BLOCK).transpose(0, 2, 1, 3)
    column, row = blocks.at.T
    before = tiles[row, column]
    a, b = blocks.first[:, None, None], blocks.second[:, None, None]
    tiles[row, column] = np.where((before == a) | (before == b), np.where(first, a, b), before)
