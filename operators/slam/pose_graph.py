"""Poses that agree best with measured motions between them, by sparse least squares on SE(3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from dataflow.messages.geometry import invert
from operators.estimation.kernels import geman_mcclure
from operators.geometry import se3
from operators.geometry.se3 import Matrix
from operators.slam import motions

Array = NDArray[np.float64]

ITERATIONS = 40
_NARROWS = 0.6  # the kernel, with each iteration
_STILL = 1e-5  # metres and radians: a step less than this ends the iterations


@dataclass(frozen=True, eq=False)
class Edge:
    """The measured pose (4, 4) of node `last` in node `first`, with the information (6, 6) of its right perturbation.

    A `loop` may be wrong: its weight falls with its residual.
    """

    first: int
    last: int
    T: Matrix
    information: Matrix
    loop: bool


@dataclass(frozen=True, eq=False)
class Optimum:
    """Poses (4, 4) of the nodes, and the weight in 0 to 1 that each edge has in them: that of a wrong loop is small."""

    poses: list[Matrix]
    weights: Array


def optimised(poses: Sequence[Matrix], edges: Sequence[Edge], fixed: int = 1, width: float = 4.0) -> Optimum:
    """Returns the poses that fit the edges best; the first `fixed` nodes stay as they are.

    Gauss-Newton as in Grisetti et al., "A tutorial on graph-based SLAM", 2010. Loops have Geman and McClure's kernel,
    which begins wide and narrows to `width` standard deviations: Yang et al., "Graduated non-convexity", 2020. A node
    that no chain of edges ties to a fixed one stays where it is.
    """
    count = 6 * (len(poses) - fixed)
    if count <= 0 or not edges:
        return Optimum([T.copy() for T in poses], np.ones(len(edges)))
    graph = _Graph(edges, fixed, len(poses))
    T = np.array(poses, np.float64)
    errors = graph.errors(T)
    square = graph.squares(errors)
    kernel = max(width, float(np.sqrt(square[graph.loop].max(initial=0.0))))
    for _ in range(ITERATIONS):
        weights = np.where(graph.loop, geman_mcclure(square / kernel**2), 1.0)
        step = graph.step(T, errors, weights).reshape(-1, 6)
        T[fixed:] = T[fixed:] @ motions.exps(step)
        errors = graph.errors(T)
        square = graph.squares(errors)
        if kernel == width and np.abs(step).max() < _STILL:
            break
        kernel = max(width, kernel * _NARROWS)
    weights = np.where(graph.loop, geman_mcclure(square / width**2), 1.0)
    T[fixed:] = se3.orthonormalised(T[fixed:])
    return Optimum(list(T), weights)


class _Graph:
    """The edges as arrays, and where their blocks lie in the normal equations."""

    def __init__(self, edges: Sequence[Edge], fixed: int, nodes: int) -> None:
        self.first = np.array([e.first for e in edges])
        self.last = np.array([e.last for e in edges])
        self.loop = np.array([e.loop for e in edges])
        self.inverse = invert(np.array([e.T for e in edges]))
        self.information = np.array([e.information for e in edges])
        self.size = 6 * (nodes - fixed)
        self.ends = (self.first - fixed, self.last - fixed)  # below 0: held fixed
        self.pairs = [(a, b, np.flatnonzero((self.ends[a] >= 0) & (self.ends[b] >= 0))) for a in (0, 1) for b in (0, 1)]
        rows, columns = [], []
        at = np.arange(6)
        for a, b, chosen in self.pairs:
            shape = (len(chosen), 6, 6)
            rows.append(np.broadcast_to((6 * self.ends[a][chosen])[:, None, None] + at[:, None], shape).ravel())
            columns.append(np.broadcast_to((6 * self.ends[b][chosen])[:, None, None] + at, shape).ravel())
        diagonal = np.arange(self.size)
        self.rows, self.columns = np.concatenate([*rows, diagonal]), np.concatenate([*columns, diagonal])

    def errors(self, T: Array) -> Array:
        """Returns log(measured^-1 first^-1 last), (E, 6)."""
        return motions.logs(self.inverse @ (invert(T[self.first]) @ T[self.last]))

    def squares(self, errors: Array) -> Array:
        """Returns the squared errors in units of their standard deviations, (E,)."""
        return np.asarray(np.einsum("ni,nij,nj->n", errors, self.information, errors))

    def step(self, T: Array, errors: Array, weights: Array) -> Array:
        """Returns one step of Gauss-Newton, in right perturbations of the nodes that are not fixed."""
        H, gradient = self.normal(T, errors, weights)
        solve = splu(H, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0).solve
        return -np.asarray(solve(gradient), np.float64)

    def normal(self, T: Array, errors: Array, weights: Array) -> tuple[scipy.sparse.csc_matrix, Array]:
        """Returns the normal equations' matrix and gradient."""
        J_last = motions.right_jacobians_inverse(errors)
        J_first = -J_last @ motions.adjoints(invert(T[self.last]) @ T[self.first])
        J = (J_first, J_last)
        weighted = weights[:, None, None] * self.information
        WJ = (weighted @ J_first, weighted @ J_last)
        gradient = np.zeros(self.size + 6)
        for a in (0, 1):
            into = np.where(self.ends[a] >= 0, 6 * self.ends[a], self.size)
            part = np.einsum("nij,ni->nj", WJ[a], errors)
            np.add.at(gradient, into[:, None] + np.arange(6), part)
        blocks = [(J[a][chosen].transpose(0, 2, 1) @ WJ[b][chosen]).ravel() for a, b, chosen in self.pairs]
        values = np.concatenate([*blocks, np.full(self.size, 1e-6)])
        H = scipy.sparse.csc_matrix((values, (self.rows, self.columns)), (self.size, self.size))
        return H, gradient[: self.size]


class DenseEdges:
    """Edges beside other measurements of few poses, whose normal equations are dense; loops have the narrow kernel."""

    def __init__(self, edges: Sequence[Edge], fixed: int, nodes: int, width: float = 4.0) -> None:
        self._graph = _Graph(edges, fixed, nodes) if edges else None
        self._size, self._width = 6 * (nodes - fixed), width

    def normal(self, T: Array) -> tuple[Array, Array]:
        """Returns the matrix (6F, 6F) and gradient (6F,) of the normal equations at poses (N, 4, 4), F of them free."""
        graph, width = self._graph, self._width
        if graph is None:
            return 1e-6 * np.eye(self._size), np.zeros(self._size)
        errors = graph.errors(T)
        weights = np.where(graph.loop, geman_mcclure(graph.squares(errors) / width**2), 1.0)
        H, gradient = graph.normal(T, errors, weights)
        return H.toarray(), gradient
