"""Saved occupancy maps: the YAML and image pair of ROS's map_server, read and written."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from dataflow.messages import OccupancyGrid
from dataflow.messages.geometry import quaternion_from_yaw, yaw_of

_UNKNOWN_PIXEL = 205
_MODES = ("trinary", "scale", "raw")


def read_map(path: Path, frame: str, stamp: int = 0) -> OccupancyGrid:
    """Reads a map: the YAML file names the image, its resolution (m), origin (x, y, yaw) and thresholds.

    A pixel's darkness is its occupancy. `mode` selects its interpretation: `trinary` (the default) taken above
    `occupied_thresh`, free below `free_thresh`, unknown between them; `scale` the same with shares of 100 between them,
    unknown where the image is transparent; `raw` the pixel itself, unknown above 100. Raises ValueError for a file that
    is no such map, FileNotFoundError where file or image is missing.
    """
    try:
        content = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
        image, resolution = str(content["image"]), float(content["resolution"])
        x, y, yaw = (float(value) for value in content["origin"])
        negate = bool(int(content.get("negate", 0)))
        taken, free = float(content.get("occupied_thresh", 0.65)), float(content.get("free_thresh", 0.196))
        mode = str(content.get("mode", "trinary"))
    except (YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} is no map: it must give image, resolution and origin (x, y, yaw) as ROS's map_server has them "
            f"({type(error).__name__}: {error})"
        ) from None
    if not resolution > 0:
        raise ValueError(f"{path}: resolution must be above 0, got {resolution}")
    for name, value in (("resolution", resolution), ("origin", x), ("origin", y), ("origin", yaw)):
        if not math.isfinite(value):
            raise ValueError(f"{path}: {name} holds {value}, and a number is wanted")
    if mode not in _MODES:
        raise ValueError(f"{path}: mode is {mode!r}; known are {', '.join(_MODES)}")
    file = path.parent / image
    if not file.is_file():
        raise FileNotFoundError(f"{path} names the image {image!r}, but there is no {file}")
    pixels = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    whole = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if pixels is None or whole is None:
        raise ValueError(f"{file} is no image that OpenCV reads: PGM and PNG are")
    clear = whole[..., 3] < 255 if whole.ndim == 3 and whole.shape[2] == 4 else np.zeros(pixels.shape, bool)
    cells = _cells(pixels, clear, mode, negate, taken, free)
    return OccupancyGrid(
        stamp=stamp,
        frame=frame,
        resolution=resolution,
        cells=cells[::-1],
        position=np.array([x, y, 0.0]),
        orientation=None if yaw == 0 else quaternion_from_yaw(yaw),
    )


def _cells(
    pixels: NDArray[Any], clear: NDArray[np.bool_], mode: str, negate: bool, taken: float, free: float
) -> NDArray[np.int8]:
    """Occupancy of pixels in per cent, -1 unknown; `clear`: those that are transparent."""
    if mode == "raw":
        return np.where(pixels <= 100, pixels, -1).astype(np.int8)
    darkness = pixels / 255.0 if negate else (255.0 - pixels) / 255.0
    between = np.full(pixels.shape, -1.0)
    if mode == "scale":
        between = np.where(clear, -1.0, np.rint(100 * (darkness - free) / max(taken - free, 1e-9)))
    cells = np.where(darkness > taken, 100, np.where(darkness < free, 0, between))
    return np.where(clear & (mode == "scale"), -1, cells).astype(np.int8)


def write_map(grid: OccupancyGrid, path: Path) -> None:
    """Writes a map as a YAML file and a PNG image of the same name beside it."""
    cells = grid.cells[::-1]
    pixels = np.where(cells < 0, _UNKNOWN_PIXEL, np.where(cells >= 65, 0, 254)).astype(np.uint8)
    image = path.with_suffix(".png")
    if not cv2.imwrite(str(image), pixels):
        raise OSError(f"could not write {image}")
    yaw = 0.0 if grid.orientation is None else float(yaw_of(grid.orientation))
    x, y = (float(value) for value in grid.position[:2])
    assert math.isfinite(x + y + yaw)
    path.write_text(
        f"image: {image.name}\nresolution: {grid.resolution!r}\norigin: [{x!r}, {y!r}, {yaw!r}]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
        encoding="utf-8",
    )
