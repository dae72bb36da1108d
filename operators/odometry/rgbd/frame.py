"""The working images of one RGB-D frame, and what is wrong with them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.geometry.se3 import Matrix
from operators.monitoring.image_flaws import Flaw, Watch
from operators.odometry.features import Gray
from operators.odometry.images import gray_of, reduced
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import Surface, scaled_intrinsics


@dataclass(frozen=True, eq=False)
class Frame:
    """An image and a depth image, reduced. Pixels that a flaw makes useless are zero."""

    stamp: int
    gray: Gray
    K_color: Matrix  # (3, 3) of gray
    depth: NDArray[np.float32]
    surface: Surface
    image_flaw: Flaw | None
    depth_flaw: Flaw | None
    watch: Watch  # to compare the next frame with

    @property
    def flaws(self) -> str:
        """Returns what is wrong with the images, or nothing."""
        named = (("image", self.image_flaw), ("depth", self.depth_flaw))
        return "; ".join(f"{name} {flaw}" for name, flaw in named if flaw)


def observe(
    image: NDArray[np.uint8], depth: NDArray[np.float32], stamp: int, K_color: Matrix, K_depth: Matrix,
    config: RgbdOdometryConfig, last: Watch,
) -> Frame:  # fmt: skip
    """Reduces the images by whole factors and looks for flaws, such as repeating those last watched."""
    factor = max(1, image.shape[1] // config.image_width)
    gray = reduced(gray_of(image), factor)
    block = max(1, depth.shape[1] // config.surface_width)
    surface = Surface.from_depth(depth, K_depth, config.near, config.far, block)
    watch = Watch().seen(image, depth)
    image_flaw, depth_flaw = watch.image_flaw(last, gray), watch.depth_flaw(last, surface.coverage)
    if depth_flaw is not None:
        surface = Surface(np.zeros_like(surface.inverse_depth), surface.K)
    gray = np.zeros_like(gray) if image_flaw is not None else np.ascontiguousarray(gray)
    K = scaled_intrinsics(K_color, 1.0 / factor)
    return Frame(stamp, gray, K, depth, surface, image_flaw, depth_flaw, watch)
