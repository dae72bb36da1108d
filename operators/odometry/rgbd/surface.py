"""A depth image as a small grid of planar patches: mean points and normals, from its inverse depth.

Inverse depth is affine in the pixel over a plane, n·p = d  =>  1/z = (n/d)·(x, y, 1), so averaging it is
exact on planes, its noise does not grow with range (Nguyen et al., 2012), and its gradient is the normal.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.geometry.depth_sensors import DepthSensor
from operators.geometry.pinhole import project
from operators.geometry.se3 import Matrix

Array32 = NDArray[np.float32]


@dataclass(frozen=True)
class DepthNoise:
    """Standard deviation of a depth: floor + quadratic · z², metres."""

    floor: float = 0.002
    quadratic: float = 0.002

    @classmethod
    def of(cls, sensor: DepthSensor | None, floor: float | None = None, quadratic: float | None = None) -> "DepthNoise":
        """Returns the noise of a sensor, the usual one without; what is given beside it has precedence."""
        usual = cls() if sensor is None else cls(sensor.floor, sensor.quadratic)
        return cls(usual.floor if floor is None else floor, usual.quadratic if quadratic is None else quadratic)

    def sigma(self, z: NDArray[np.floating]) -> NDArray[np.floating]:
        return self.floor + self.quadratic * z * z


@dataclass(frozen=True, eq=False)
class Surface:
    """Patches of one depth image in its own optical frame."""

    inverse_depth: Array32  # (h, w) 1/m, 0 where there is no patch
    K: Matrix  # (3, 3) of the grid

    @staticmethod
    def from_depth(depth: Array32, K: Matrix, near: float, far: float, block: int) -> "Surface":
        """Averages block x block pixels of a (H, W) depth, metres; NaN or outside near..far is no return.

        Where returns are sparse, blocks are wider, so that each holds some: two and a half, or where pixels are blocks,
        five of eight of them.
        """
        valid = cv2.inRange(depth, near, far)  # 255 or 0; a NaN compares false
        # One full-size array, written over at each step: new ones cost as much as the arithmetic.
        full: Array32 = valid / np.float32(255)
        density = _block_mean(full, max(depth.shape[1] // 16, 1), max(depth.shape[0] // 16, 1))
        found = density[density > 0.02]
        per_pixel = float(found.mean()) if found.size else 1.0
        fewest = 0.25
        while per_pixel < min(2.5 / block**2, 0.625):
            block, fewest = 2 * block, 0.02
        h, w = depth.shape[0] // block, depth.shape[1] // block
        whole = np.s_[: h * block, : w * block]
        depth, valid, full = depth[whole], valid[whole], full[whole]
        share = _block_mean(full, w, h)
        cv2.divide(1.0, depth, full)
        inverse: Array32 = np.asarray(cv2.bitwise_and(full, full, mask=valid), np.float32)
        mean = _block_mean(inverse, w, h)
        square = _block_mean(np.multiply(inverse, inverse, out=full), w, h)
        enough = share >= fewest
        share[~enough] = 1.0
        mean /= share
        spread = square / share - mean * mean
        # A block across an edge averages two surfaces into a point of neither; a steep plane spreads less.
        enough &= spread < (0.04 * mean) ** 2
        mean[~enough] = 0.0
        return Surface(mean, scaled_intrinsics(K, 1.0 / block))

    @cached_property
    def rays(self) -> tuple[Array32, Array32]:
        """x/z of each column (w,) and y/z of each row (h,)."""
        h, w = self.inverse_depth.shape
        x = ((np.arange(w) - self.K[0, 2]) / self.K[0, 0]).astype(np.float32)
        y = ((np.arange(h) - self.K[1, 2]) / self.K[1, 1]).astype(np.float32)
        return x, y

    def points(self, stride: int = 1) -> NDArray[np.float64]:
        """The patch centres (N, 3), every stride-th in both directions."""
        inverse = self.inverse_depth[::stride, ::stride]
        x, y = self.rays
        v, u = np.nonzero(inverse)
        z = 1.0 / inverse[v, u].astype(np.float64)
        return np.column_stack([x[::stride][u] * z, y[::stride][v] * z, z])

    @cached_property
    def bordered_planes(self) -> Array32:
        """((h + 2)·(w + 2), 4): unit normal n towards the camera and d = n·p of each patch; zeros where not smooth.

        Around the grid lies a border of zeros, for points that fall beside it.
        """
        q = self.inverse_depth
        h, w = q.shape
        x, y = self.rays
        # q = a·x + b·y + c over a plane; Sobel over 3x3 sums to 8 steps.
        a = cv2.Sobel(q, cv2.CV_32F, 1, 0, ksize=3) * np.float32(self.K[0, 0] / 8.0)
        b = cv2.Sobel(q, cv2.CV_32F, 0, 1, ksize=3) * np.float32(self.K[1, 1] / 8.0)
        smooth_q = cv2.blur(q, (3, 3))
        c = smooth_q - a * x[None, :] - b * y[:, None]
        hole = cv2.dilate(
            (q == 0).astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=(1,)
        )
        rough = np.abs(q - smooth_q) > 0.02 * smooth_q
        scale = 1.0 / np.sqrt(a * a + b * b + c * c + np.float32(1e-12))
        grazing = smooth_q * scale < 0.17 * np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)
        bad = (hole > 0) | rough | grazing
        scale[bad] = 0.0
        planes = np.zeros((h + 2, w + 2, 4), np.float32)
        for i, part in enumerate((a, b, c, 1.0)):
            np.multiply(part, -scale, out=planes[1:-1, 1:-1, i])
        return planes.reshape(-1, 4)

    def planes_at(self, points: NDArray[np.float64]) -> Array32:
        """Returns the planes (N, 4) of the patches that points (N, 3) fall on, as `bordered_planes` has them."""
        return np.asarray(self.bordered_planes.take(self._patches(points), axis=0), np.float32)

    def inverse_at(self, points: NDArray[np.float64]) -> Array32:
        """Returns the inverse depth (N,) of the patches that points (N, 3) fall on; 0 where there is none."""
        return np.asarray(self.bordered.take(self._patches(points)), np.float32)

    def _patches(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Returns which patches of the bordered grid points (N, 3) fall on."""
        h, w = self.inverse_depth.shape
        u, v = np.rint(project(points, self.K)).astype(np.int64).T
        return np.asarray(np.clip(v + 1, 0, h + 1) * (w + 2) + np.clip(u + 1, 0, w + 1), np.int64)

    @cached_property
    def bordered(self) -> Array32:
        """The inverse depth (h + 2, w + 2) with a border of no patches."""
        return np.pad(self.inverse_depth, 1)

    def let_go(self) -> None:
        """Forgets what was made to compare with it; it is made anew when it is asked for."""
        for name in ("bordered_planes", "bordered"):
            self.__dict__.pop(name, None)

    @property
    def depth(self) -> Array32:
        """Depth of the patches (h, w), metres; 0 where there is none."""
        return np.where(self.inverse_depth > 0, 1.0 / np.maximum(self.inverse_depth, 1e-6), 0).astype(np.float32)

    @cached_property
    def typical_depth(self) -> float:
        """Median depth of the patches, metres; 2 m where there is none."""
        known = self.inverse_depth[self.inverse_depth > 0]
        return float(1.0 / np.median(known)) if known.size else 2.0

    @cached_property
    def coverage(self) -> float:
        """Share of the grid that has a patch."""
        return float(np.count_nonzero(self.inverse_depth)) / self.inverse_depth.size


def _block_mean(values: NDArray[np.float32], width: int, height: int) -> Array32:
    return np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def scaled_intrinsics(K: Matrix, scale: float) -> Matrix:
    """K of an image resized by scale; pixel centres have integer coordinates."""
    out = K.copy()
    out[0, 0] *= scale
    out[1, 1] *= scale
    out[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5
    return out
