"""Calibration boards, and their inner corners in images.

A board's frame has its origin at an inner corner, x along its rows, y along its columns, z away from the viewer.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.geometry.pinhole import Pixels, Points

Grey = NDArray[np.uint8]
Numbers = NDArray[np.intp]

FEWEST = 8
"""Corners of a view."""
INNER, OUTER = 0.5, 0.35
"""Half of the window in which a corner is refined, as a share of the distance to the next edges. On the margin of a
board less: printers cut its outer squares, to half of their width on many boards."""


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """The corners of a board in one image.

    `stamp` in ns, `ids` (N,) numbers of corners, row by row, `pixels` (N, 2) their places. `blur` is the width in
    pixels of the edges between squares: about 2 in a sharp image, the larger of those across rows and columns.
    """

    stamp: int
    ids: Numbers
    pixels: Pixels
    blur: float


class Board(ABC):
    """A plane with `columns` by `rows` inner corners, `square` metres apart."""

    columns: int
    rows: int
    square: float

    @property
    def points(self) -> Points:
        """Corners (columns * rows, 3), row by row, in the board's frame, metres."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * self.square

    @property
    @abstractmethod
    def clear(self) -> float:
        """Share of a square on either side of an edge that is plain."""

    @abstractmethod
    def corners(self, grey: Grey) -> tuple[Numbers, Pixels] | None:
        """Returns numbers (N,) and pixels (N, 2) of the corners in an image (H, W); None where there is no board."""

    def find(self, stamp: int, grey: Grey) -> View | None:
        """Returns what an image (H, W) shows of the board; None where that is fewer than 8 corners, or all in a row."""
        found = self.corners(grey)
        if found is None or len(found[0]) < FEWEST:
            return None
        ids, pixels = found
        if len(set(ids // self.columns)) < 2 or len(set(ids % self.columns)) < 2:
            return None
        return View(stamp, ids, pixels, self._blur(grey, ids, pixels))

    def _blur(self, grey: Grey, ids: Numbers, pixels: Pixels) -> float:
        place = np.full((self.rows * self.columns, 2), np.nan)
        place[ids] = pixels
        grid = place.reshape(self.rows, self.columns, 2)
        widths = [self._edge_width(grey, grid[:, :-1], grid[:, 1:]), self._edge_width(grey, grid[:-1], grid[1:])]
        known = [width for width in widths if np.isfinite(width)]
        return max(known, default=0.0)

    def _edge_width(self, grey: Grey, begin: Pixels, end: Pixels) -> float:
        """The median width of edges from corners `begin` to `end` (N, M, 2), NaN where there are none: contrast
        divided by the steepest slope, across the middle of each."""
        begin, end = begin.reshape(-1, 2), end.reshape(-1, 2)
        there = np.isfinite(begin).all(axis=1) & np.isfinite(end).all(axis=1)
        begin, end = begin[there], end[there]
        along = end - begin
        reach = 0.8 * self.clear * np.linalg.norm(along, axis=1)
        if not len(along) or np.median(reach) < 2:
            return float("nan")
        across = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
        steps = np.arange(-int(np.median(reach)), int(np.median(reach)) + 1)
        places = ((begin + end) / 2)[:, None] + across[:, None] * steps[:, None]
        x, y = (np.ascontiguousarray(places[..., k], np.float32) for k in (0, 1))
        profiles = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
        slopes = np.abs(np.diff(profiles, axis=1)).max(axis=1)
        return float(np.median(np.ptp(profiles, axis=1) / np.maximum(slopes, 1.0)))


def _room(grid: Pixels) -> NDArray[np.float64]:
    """Returns for each corner (R, C) of a grid (R, C, 2) the distance in pixels to the nearest edge that does not meet
    there: the least height of the squares around it."""
    across, down = np.diff(grid, axis=1), np.diff(grid, axis=0)
    sides = np.stack([across[:-1], down[:, 1:], across[1:], down[:, :-1]])  # (4, R - 1, C - 1, 2), around each square
    turned = np.roll(sides, -1, axis=0)
    areas = np.abs(sides[..., 0] * turned[..., 1] - sides[..., 1] * turned[..., 0])
    heights = areas.min(axis=0) / np.linalg.norm(sides, axis=-1).max(axis=0)
    padded = np.pad(heights, 1, constant_values=np.inf)
    least: NDArray[np.float64] = np.minimum.reduce([padded[:-1, :-1], padded[1:, :-1], padded[:-1, 1:], padded[1:, 1:]])
    return least


@dataclass(frozen=True, slots=True)
class Chessboard(Board):
    """A plain chessboard, all of whose inner corners must be in the image.

    They are detected by Duda and Frese's method ("Accurate detection and localization of checkerboard corners for
    calibration", 2018), and refined where the gradients around them meet (Förstner), which noise and blur move less.

    One whose numbers of inner corners are both even or both odd looks the same upside down.
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise ValueError(f"a chessboard has 3x3 inner corners at least, got {self.columns}x{self.rows}")
        if self.square <= 0:
            raise ValueError(f"squares have a length above zero, got {self.square:g} m")

    @property
    def clear(self) -> float:
        """Half of a square."""
        return 0.5

    @property
    def ambiguous(self) -> bool:
        """True where it looks the same upside down."""
        return (self.columns + self.rows) % 2 == 0

    def corners(self, grey: Grey) -> tuple[Numbers, Pixels] | None:
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        found, corners = cv2.findChessboardCornersSB(grey, (self.columns, self.rows), flags=flags)
        if not found:
            return None
        pixels = self._refined(grey, np.asarray(corners, np.float64).reshape(-1, 2))
        if not self.ambiguous and self._upside_down(grey, pixels):
            pixels = pixels[::-1].copy()
        return np.arange(len(pixels)), pixels

    def _refined(self, grey: Grey, pixels: Pixels) -> Pixels:
        """The corners (N, 2), each in a window that no edge but its own four crosses."""
        room = _room(pixels.reshape(self.rows, self.columns, 2))
        shares = np.full(room.shape, OUTER)
        shares[1:-1, 1:-1] = INNER
        halves = np.maximum(np.floor(shares * room), 2).ravel()
        found = pixels.astype(np.float32)
        for half in np.unique(halves):
            chosen = np.flatnonzero(halves == half)
            window, stop = (int(half), int(half)), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
            found[chosen] = cv2.cornerSubPix(grey, found[chosen].copy(), window, (-1, -1), stop)
        return np.asarray(found, np.float64)

    def _upside_down(self, grey: Grey, pixels: Pixels) -> bool:
        """True where the first square within the corners is brighter than its neighbour in the row."""
        grid = pixels.reshape(self.rows, self.columns, 2)
        first, second = (
            cv2.getRectSubPix(grey, (3, 3), tuple(grid[:2, k : k + 2].reshape(4, 2).mean(axis=0))).mean()
            for k in (0, 1)
        )
        return bool(first > second)


@dataclass(frozen=True, slots=True)
class Charuco(Board):
    """A chessboard with ArUco markers in its white squares, any part of which may be in the image.

    `columns` and `rows` are those of inner corners: one less than its squares. `marker` is a marker's side in metres,
    `dictionary` the name of OpenCV's, such as `5X5_100`.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str = "5X5_100"

    def __post_init__(self) -> None:
        known = {n.removeprefix("DICT_") for n in dir(cv2.aruco) if n.startswith("DICT_")}
        if self.dictionary not in known:
            raise ValueError(f"no set {self.dictionary!r} of ArUco markers; there are {', '.join(sorted(known))}")
        if min(self.columns, self.rows) < 2:
            raise ValueError(f"a ChArUco board has 3x3 squares at least, got {self.columns + 1}x{self.rows + 1}")
        if not 0 < self.marker < self.square:
            raise ValueError(f"markers of {self.marker:g} m do not fit into squares of {self.square:g} m")

    @property
    def clear(self) -> float:
        """The margin around a marker, as a share of its square."""
        return (1 - self.marker / self.square) / 2

    def corners(self, grey: Grey) -> tuple[Numbers, Pixels] | None:
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(self.drawn()).detectBoard(grey)
        if ids is None or pixels is None:
            return None
        return np.asarray(ids).ravel().astype(np.intp), np.asarray(pixels, np.float64).reshape(-1, 2)

    def drawn(self) -> cv2.aruco.CharucoBoard:
        """Returns the board as OpenCV has it."""
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        return cv2.aruco.CharucoBoard((self.columns + 1, self.rows + 1), self.square, self.marker, markers)
