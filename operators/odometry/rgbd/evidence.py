"""Evidence for a pose: the shape and the brightness of all that the view and the map both see."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.pinhole import Points, project
from operators.geometry.se3 import Matrix
from operators.odometry.features import Gray
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.frame import Frame
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.surface import DepthNoise, Surface

STRIDE = 2  # patches of the view's surface between points that are compared
NEAR, NEAR_PER_SQUARE = 0.03, 0.01  # metres by which depths may differ, and so much more by the square of the depth;
# where depth is noisier than that, by its standard deviation
FEWEST = 300  # points that a view must have in common with the map
OVERLAP, AGREEMENT, LIKENESS = 0.3, 0.5, 0.45  # the least of a view that is recognised (see the benchmark)
TOGETHER = 1.25  # the least of agreement and likeness in sum
ALIKE = 0.8  # cosine between the normals of one surface
FACET, BESIDE = 0.05, 0.3  # share of what agrees that makes a surface count, and the least likeness on a second such
PLAIN = 0.15  # contrast below which a surface has no pattern
FEW = 50  # points by which no surface is judged
SUPPORTERS = 200  # points by which the surface that holds the most is found
USUAL_NOISE = DepthNoise()


@dataclass(frozen=True, eq=False)
class Evidence:
    """Likeness of a view and the map where a pose lays the one on the other.

    `overlap` is the share of the view that the map saw, of which `agreement` lies on the map's surfaces, at so many
    `points`; `likeness` is the correlation of brightness there, `beside` that on the surface that is second in it: a
    door or a poster that hangs elsewhere, too, is like itself on one. `contrary` is the share of the view
    that stands where the map saw past it, and that of the map that the view sees past: what has moved, or a bookcase
    like another, which leaves what stands around that one.
    """

    points: int
    overlap: float
    agreement: float
    likeness: float
    beside: float
    contrary: float

    @property
    def certain(self) -> bool:
        """Returns whether the view is that of this place: what only looks like it differs in shape or in pattern."""
        return (
            self.points >= FEWEST
            and self.overlap >= OVERLAP
            and self.agreement >= AGREEMENT
            and self.likeness - self.contrary >= LIKENESS
            and self.agreement + self.likeness >= TOGETHER
            and self.beside >= BESIDE
        )


def slack_of(noise: DepthNoise) -> float:
    """Returns by how much depths may differ besides `NEAR`, per square of the depth, 1/m."""
    return max(NEAR_PER_SQUARE, noise.quadratic)


def seeing(points: Points, T_world_camera: Matrix, keyframes: Sequence[Keyframe], count: int) -> list[Keyframe]:
    """Returns the keyframes that saw most of a view's points (N, 3), the most last."""
    seen = [int(np.count_nonzero(compared(points, T_world_camera, k)[2])) for k in keyframes]
    order = np.argsort(seen, kind="stable")[-count:]
    return [keyframes[i] for i in order.tolist() if seen[i]]


def gathered(
    frame: Frame,
    T_world_camera: Matrix,
    keyframes: Sequence[Keyframe],
    camera: RgbdCamera,
    noise: DepthNoise = USUAL_NOISE,
) -> Evidence:
    """Compares a frame at a pose with keyframes, by the colour camera of whose images K_color is."""
    points = frame.surface.points(STRIDE)
    here, facing = sampled(levelled(frame.gray), points, camera), frame.surface.planes_at(points)[:, :3]
    met, same, found, before, after = 0, 0, [np.zeros((0, 5))], np.zeros(2), np.zeros(2)
    for keyframe in keyframes:
        T_there_here = keyframe.T_camera_world @ T_world_camera
        moved, behind, known = laid(points, T_there_here, keyframe.surface, slack_of(noise))
        on = known & (np.abs(behind) < 1.0)
        met += int(np.count_nonzero(known))
        same += int(np.count_nonzero(on))
        before += np.count_nonzero(known & (behind > 1.0)), np.count_nonzero(known)
        _, behind, known = laid(keyframe.surface.points(STRIDE), invert(T_there_here), frame.surface, slack_of(noise))
        after += np.count_nonzero(known & (behind > 1.0)), np.count_nonzero(known)
        there = sampled(levelled(keyframe.gray), moved[on], camera)
        found.append(np.column_stack([here[on], there, facing[on]]))
    both = np.concatenate(found)
    both = both[np.isfinite(both).all(axis=1)]
    overlap, pairs = met / max(len(points) * len(keyframes), 1), both[:, :2]
    likeness, beside = _correlation(pairs), _second(pairs, both[:, 2:])
    contrary = sum(float(seen[0] / max(seen[1], 1)) for seen in (before, after))
    return Evidence(len(both), overlap, same / max(met, 1), likeness, beside, contrary)


def _correlation(pairs: NDArray[np.float64]) -> float:
    """Returns the correlation of pairs (N, 2); 0 where there is none."""
    if len(pairs) < 3 or not (pairs.std(axis=0) > 1e-6).all():
        return 0.0
    return float(np.asarray(np.corrcoef(pairs.T))[0, 1])


def _second(pairs: NDArray[np.float64], normals: NDArray[np.float64]) -> float:
    """Returns the second largest correlation of pairs (N, 2) on surfaces that face alike, by normals (N, 3) or zeros;
    1 where fewer than two surfaces have a pattern."""
    found, left, least = [], np.flatnonzero(normals.any(axis=1)), max(FACET * len(pairs), FEW)
    while len(left) > least:
        some = normals[left[np.linspace(0, len(left) - 1, min(len(left), SUPPORTERS)).astype(np.int64)]]
        facing = some[np.argmax(np.count_nonzero(some @ some.T > ALIKE, axis=0))]
        on = normals[left] @ facing > ALIKE
        if np.count_nonzero(on) > least and (pairs[left[on]].std(axis=0) > PLAIN).all():
            found.append(_correlation(pairs[left[on]]))
        left = left[~on]
    return sorted(found)[-2] if len(found) > 1 else 1.0


def compared(
    points: Points, T_world_camera: Matrix, keyframe: Keyframe, slack: float = NEAR_PER_SQUARE
) -> tuple[Points, NDArray[np.bool_], NDArray[np.bool_]]:
    """Returns points (N, 3) in a keyframe's camera, which lie on its surface, and which are where it has one."""
    moved, behind, known = laid(points, keyframe.T_camera_world @ T_world_camera, keyframe.surface, slack)
    return moved, known & (np.abs(behind) < 1.0), known


def laid(
    points: Points, T_there_here: Matrix, surface: Surface, slack: float
) -> tuple[Points, NDArray[np.float64], NDArray[np.bool_]]:
    """Returns points (N, 3) in another view, how far its surface lies behind each, in units of what they may differ by,
    and which are where it has one."""
    moved = transform_points(T_there_here, points)
    z = moved[:, 2]
    ahead = z > 0.1
    inverse = surface.inverse_at(np.where(ahead[:, None], moved, 1.0))
    known = ahead & (inverse > 0)
    return moved, (1.0 / np.where(known, inverse, 1.0) - z) / (NEAR + slack * z * z), known


def levelled(gray: Gray) -> NDArray[np.float32]:
    """Returns an image without its noise and without its slow changes, whose contrast is 1 wherever there is some."""
    image = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.5)
    side = max(gray.shape[1] // 10, 3) | 1
    mean = cv2.blur(image, (side, side))
    spread = cv2.sqrt(np.maximum(cv2.blur(image * image, (side, side)) - mean * mean, 0.0))
    return np.asarray((image - mean) / (spread + np.float32(5.0)), np.float32)


def sampled(image: NDArray[np.float32], points: Points, camera: RgbdCamera) -> NDArray[np.float64]:
    """Returns what an image has where points (N, 3) of the depth camera are; NaN beside it."""
    if not len(points):
        return np.zeros(0)
    h, w = image.shape
    uv = project(transform_points(camera.T_color_depth, points), camera.K_color).astype(np.float32)
    x, y = (np.ascontiguousarray(part)[:, None] for part in uv.T)
    sampled = cv2.remap(image, x, y, cv2.INTER_LINEAR).ravel()
    inside = (uv >= 0).all(axis=1) & (uv[:, 0] <= w - 1) & (uv[:, 1] <= h - 1)
    return np.where(inside, sampled, np.nan).astype(np.float64)
