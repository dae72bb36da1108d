"""Tests that what a view and the map have in common is of one place, and not of all places along a floor or a wall.

A surface slides over itself: where all that agrees lies on one plane, or on walls along a corridor, its shape fits at
any place along it, and only its pattern is of one place. Patterns of tiles, carpets, bricks and shelves fit again a
period farther on. So the pattern is laid on itself shifted, by the correlation of what both show (Padfield, "Masked
object registration in the Fourier domain", 2012).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.facing import free_directions
from operators.geometry.pinhole import Points
from operators.geometry.se3 import Matrix
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.evidence import ALIKE, NEAR, STRIDE, SUPPORTERS, compared, levelled, sampled, slack_of
from operators.odometry.rgbd.frame import Frame
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.surface import DepthNoise, Surface

Array = NDArray[np.float64]

TELLING = 0.015  # share of what agrees that must face along a direction (see the benchmark)
CELL = 0.025  # metres, of the grid on which a pattern is laid out
HALF = 2.0  # metres, half the side of that grid at most
SHIFTS = (0.3, 2.0)  # metres: the least and the largest period that is looked for; what repeats at others passes
ASIDE = 0.1  # metres by which a shift may leave the free directions
SHARED = 0.1  # of the pattern that must still lie on the map for a shift to be judged
JUDGED = 1 / 3  # share of the shifts that must be
REPEATS = 0.6  # of the likeness where the pose is: a shift that reaches it fits as well
THICK = 0.05  # metres by which points of a plane may be off it


@dataclass(frozen=True, eq=False)
class _Plane:
    """A plane by two axes (2, 3), its normal (3,) and an origin (3,) on it."""

    axes: Array
    normal: Array
    origin: Array


def unique(
    frame: Frame, T_world_camera: Matrix, keyframes: Sequence[Keyframe], camera: RgbdCamera, noise: DepthNoise
) -> bool:
    """Returns whether a pose is distinguished from its neighbours by shape in every direction, or else by a pattern."""
    points, normals = _common(frame.surface, T_world_camera, keyframes, slack_of(noise))
    free = free_directions(normals, TELLING)
    if not len(free):
        return True
    if len(free) == 3:
        return False
    plane = _fullest(points, normals)
    return _told_by_pattern(plane, free, frame, T_world_camera, keyframes, camera, slack_of(noise))


def _common(
    surface: Surface, T_world_camera: Matrix, keyframes: Sequence[Keyframe], slack: float
) -> tuple[Points, Array]:
    """Returns the world points (N, 3) that lie on the map's surfaces and face as these do, and their normals."""
    points = surface.points(STRIDE)
    own = surface.planes_at(points)[:, :3] @ T_world_camera[:3, :3].T
    found, facing = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for keyframe in keyframes:
        moved, on, _ = compared(points, T_world_camera, keyframe, slack)
        there = keyframe.surface.planes_at(moved[on])[:, :3] @ keyframe.T_world_camera[:3, :3].T
        alike = np.einsum("ij,ij->i", own[on], there) > ALIKE
        found.append(transform_points(T_world_camera, points[on][alike]))
        facing.append(there[alike])
    return np.concatenate(found), np.concatenate(facing).astype(np.float64)


def _fullest(points: Points, normals: Array) -> _Plane:
    """Returns the plane, through one of the points (N, 3) across its normal, that holds the most of them."""
    chosen = np.linspace(0, len(points) - 1, min(len(points), SUPPORTERS)).astype(np.int64)
    some, across = points[chosen], normals[chosen]
    heights = some @ across.T - np.einsum("ij,ij->i", some, across)
    on = (np.abs(heights) < THICK) & (across @ across.T > ALIKE)
    best = int(np.argmax(on.sum(axis=0)))
    normal = across[on[:, best]].mean(axis=0)
    normal /= np.linalg.norm(normal)
    aside = np.eye(3)[np.argmin(np.abs(normal))]
    first = np.cross(normal, aside)
    first /= np.linalg.norm(first)
    axes = np.array([first, np.cross(normal, first)])
    return _Plane(axes, normal, np.median(some[on[:, best]], axis=0))


def _told_by_pattern(
    plane: _Plane, free: Array, frame: Frame, T_world_camera: Matrix, keyframes: Sequence[Keyframe],
    camera: RgbdCamera, slack: float,
) -> bool:  # fmt: skip
    """Returns whether a plane's pattern fits nowhere else along the free directions (K, 3), as far as it is seen."""
    seen = transform_points(T_world_camera, frame.surface.points(STRIDE)) - plane.origin
    half = np.minimum(np.abs(seen[np.abs(seen @ plane.normal) < THICK] @ plane.axes.T).max(axis=0), HALF)
    a, b = (np.arange(-h, h + CELL, CELL) for h in half.tolist())
    grid = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2) @ plane.axes + plane.origin
    shape = len(a), len(b)
    here = _laid_out(grid, shape, frame.surface, levelled(frame.gray), T_world_camera, camera, slack)
    there = [_laid_out(grid, shape, k.surface, levelled(k.gray), k.T_world_camera, camera, slack) for k in keyframes]
    fits, seen_by_both = _unshifted(here, there)
    likeness, shared = _shifted(here, [*there, here])  # on itself, too: the map may hold little around what both show
    steps = [CELL * ((np.arange(n) + n // 2) % n - n // 2) for n in likeness.shape]
    shifts = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1) @ plane.axes
    length = np.linalg.norm(shifts, axis=-1)
    aside = np.linalg.norm(shifts - shifts @ free.T @ free, axis=-1)
    asked = (length > SHIFTS[0]) & (length < SHIFTS[1]) & (aside < ASIDE)
    judged = asked & (shared > SHARED * seen_by_both)
    if np.count_nonzero(judged) < JUDGED * np.count_nonzero(asked):
        return False
    return bool(likeness[judged].max(initial=0.0) < REPEATS * fits)


def _laid_out(
    grid: Points, shape: tuple[int, int], surface: Surface, gray: NDArray[np.float32], T_world_camera: Matrix,
    camera: RgbdCamera, slack: float,
) -> tuple[Array, Array]:  # fmt: skip
    """Returns the brightness that a camera sees at world points (N, 3) of a grid, and 1 where it sees these, else 0."""
    points = transform_points(invert(T_world_camera), grid)
    z, inverse, brightness = points[:, 2], surface.inverse_at(points), sampled(gray, points, camera)
    seen = (inverse > 0) & np.isfinite(brightness)
    seen &= np.abs(1.0 / np.where(inverse > 0, inverse, 1.0) - z) < NEAR + slack * z * z
    return np.where(seen, brightness, 0.0).reshape(shape), seen.astype(np.float64).reshape(shape)


def _unshifted(one: tuple[Array, Array], others: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Returns what `_shifted` does for no shift."""
    product = sum(float((one[0] * values).sum()) for values, _ in others)
    here = sum(float((one[0] ** 2 * seen).sum()) for _, seen in others)
    there = sum(float((values**2 * one[1]).sum()) for values, _ in others)
    return product / float(np.sqrt(max(here * there, 1e-6))), sum(float((one[1] * seen).sum()) for _, seen in others)


def _shifted(one: tuple[Array, Array], others: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Returns the correlation of a pattern with others at every shift, and how many cells both show there.

    Patterns come with masks, (H, W) each; shifts wrap round, negative ones last, as frequencies do.
    """
    most = int(SHIFTS[1] / CELL)
    room = [next_fast_len(max(n, most) + most + 1, True) for n in one[0].shape]

    def spectrum(values: Array) -> NDArray[np.complex128]:
        return np.asarray(rfft2(values, room), np.complex128)

    value, square, mask = (np.conj(spectrum(x)) for x in (one[0], one[0] ** 2, one[1]))
    product, here, there, shared = (np.zeros(room) for _ in range(4))
    for values, seen in others:
        known, of_mask = spectrum(values), spectrum(seen)
        product += irfft2(known * value, room)
        here += irfft2(of_mask * square, room)
        there += irfft2(spectrum(values**2) * mask, room)
        shared += irfft2(of_mask * mask, room)
    return product / np.sqrt(np.maximum(here * there, 1e-6)), shared
