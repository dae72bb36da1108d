"""Terms of the alignment against the same sums written point by point, in double precision."""

import numpy as np
import pytest

from operators.geometry import se3
from operators.odometry.rgbd.alignment import CAUCHY, NOTHING, Freedom, Normal, PixelTerm, PlaneTerm, drawn_apart
from operators.odometry.rgbd.surface import DepthNoise, Surface

K = np.array([[290.0, 0.0, 160.0], [0.0, 290.0, 120.0], [0.0, 0.0, 1.0]])
T = se3.exp(np.array([0.01, -0.02, 0.01, 0.01, 0.02, -0.01]))


def test_plane_term_sums_over_the_points_that_meet_a_patch() -> None:
    v, u = np.mgrid[:240, :320]
    depth = np.where(u > 100, 2.2 + 0.001 * u, 1.8 + 0.001 * v).astype(np.float32)
    surface = Surface.from_depth(depth, K, 0.3, 6.0, 2)
    points = np.vstack([surface.points(4), [[0.0, 0.0, -1.0], [9.0, 0.0, 1.0], [0.0, 0.0, 0.01], [0.02, 0.0, 1.0]]])
    noise, freedom, gate, strength = DepthNoise(), Freedom(0.02, 0.02), 0.15, 0.1
    found = PlaneTerm(points, surface, np.eye(4), noise, 1.5, freedom, gate, strength).linearise(T)

    h, w = surface.inverse_depth.shape
    planes = surface.bordered_planes.reshape(h + 2, w + 2, 4)[1:-1, 1:-1].astype(np.float64)
    H, b, seen, inliers = np.zeros((6, 6)), np.zeros(6), 0, 0
    for p in points:
        q = T[:3, :3] @ p + T[:3, 3]
        column, row = (int(np.rint(x)) for x in (surface.K @ q)[:2] / max(q[2], 0.05))
        if q[2] < 0.05 or not (0 <= column < w and 0 <= row < h) or planes[row, column, 3] == 0:
            continue
        normal, offset = planes[row, column, :3], planes[row, column, 3]
        seen += 1
        r = normal @ q - offset
        variance = 2.0 * (1.5 * (noise.floor + noise.quadratic * q[2] ** 2) * (normal @ q) / q[2]) ** 2
        allowed = 9.0 * (variance + freedom.translation**2 + (freedom.rotation * q[2]) ** 2)
        if r * r < min(allowed, gate**2):
            m = normal @ T[:3, :3]
            J = np.concatenate([m, np.cross(p, m)])
            weight = strength / (variance * (1.0 + r * r / variance / CAUCHY**2))
            H, b, inliers = H + weight * np.outer(J, J), b + weight * r * J, inliers + (r * r < 9.0 * variance)
    assert seen > 500
    assert (found.seen, found.inliers) == (seen, inliers)
    assert np.allclose(found.H, H, rtol=0, atol=1e-4 * np.abs(H).max())
    assert np.allclose(found.b, b, rtol=0, atol=1e-4 * np.abs(b).max())


def test_pixel_term_is_the_weighted_normal_equation_of_reprojections() -> None:
    random = np.random.default_rng(0)
    T_color_depth = se3.exp(np.array([0.05, 0.01, 0.02, 0.1, 0.2, -0.1]))
    points = random.uniform(-1, 1, (40, 3)) + np.array([0, 0, 2.5])

    def pixels(pose: se3.Matrix) -> np.ndarray:
        p = (T_color_depth @ np.linalg.inv(pose) @ np.column_stack([points, np.ones(len(points))]).T)[:3]
        return ((K @ p)[:2] / p[2]).T

    seen = pixels(T) + random.normal(0, 1, (40, 2))
    behind = np.array([[0.0, 0.0, -3.0]])  # weighs nothing
    found = PixelTerm(
        np.vstack([points, behind]), np.vstack([seen, [[5.0, 5.0]]]), K, T_color_depth, 0.7, 0.2
    ).linearise(T)

    r = pixels(T) - seen
    steps = 1e-6 * np.eye(6)
    J = np.stack([(pixels(T @ se3.exp(x)) - pixels(T @ se3.exp(-x))) / 2e-6 for x in steps], axis=-1)
    squared = (r * r).sum(axis=1) / 0.7**2
    weight = 0.2 / (0.7**2 * (1.0 + squared / CAUCHY**2))
    H = np.einsum("n,nia,nib->ab", weight, J, J)
    b = np.einsum("n,nia,ni->a", weight, J, r)
    assert np.allclose(found.H, H, rtol=0, atol=1e-6 * np.abs(H).max())
    assert np.allclose(found.b, b, rtol=0, atol=1e-6 * np.abs(b).max())
    assert found.inliers == np.count_nonzero(squared < 9.0)


def test_disagreement_is_how_far_apart_two_terms_would_put_the_pose() -> None:
    """The one errs by 0.2 along each axis, the other by 0.1; along some axes it tells nothing."""
    rng = np.random.default_rng(1)
    some = np.diag([100.0, 100, 100, 0, 0, 0])
    every, none = [], []
    for _ in range(2000):
        x, y = rng.normal(0, 0.2, 6), rng.normal(0, 0.1, 6)
        one = Normal(25 * np.eye(6), -25 * x, 1, NOTHING)
        every.append(drawn_apart(one, Normal(100 * np.eye(6), -100 * y, 1, NOTHING)))
        none.append(drawn_apart(one, Normal(some, -some @ y, 1, NOTHING)))
    assert np.square(every).mean() == pytest.approx(1.0, rel=0.05)
    assert np.square(none).mean() == pytest.approx(0.5, rel=0.05)
    np.testing.assert_allclose(every[-1], (x - y) / np.hypot(0.2, 0.1), rtol=1e-3)


def test_negative_information_by_rounding_counts_as_none() -> None:
    """A wall says nothing of motion along it; rounding may have it say less than nothing."""
    wall = np.diag([-0.2, -0.1, 5e7, 5e6, 9e6, -0.05])
    tracks = Normal(1e6 * np.eye(6), np.full(6, -1e3), 1, NOTHING)
    apart = drawn_apart(tracks, Normal(wall, np.zeros(6), 1, NOTHING))
    assert abs(apart[0]) < 0.01
    assert apart[2] == pytest.approx(1e-3 / np.sqrt(1e-6 + 2e-8), rel=0.02)
