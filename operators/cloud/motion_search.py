"""Motions between two clouds, from matches of their features that agree with each other about distances and normals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dataflow.messages.geometry import transform_points
from operators.geometry.rigid import distances, fitted_motions

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

MOST_MATCHES = 2_500  # more are drawn from: work and memory grow with the square
_AROUND = 12  # matches beside its own that a motion is of
_FEWEST_VOTES = 4
_NORMALS = 0.3  # by which cosines between the normals of two matches may differ
_MODES = 60  # motions that are returned
_SAME_TURN = 0.98  # cosine of the turn within which motions are like each other


def matches(source: Array, target: Array) -> Indices:
    """Returns pairs (M, 2) of features (V, F) that are each other's nearest."""
    forward = cKDTree(target).query(source)[1]
    backward = cKDTree(source).query(target)[1]
    own = np.arange(len(source))
    mutual = backward[forward] == own
    return np.column_stack([own[mutual], forward[mutual]])


def motions(
    source: tuple[Array, Array], target: tuple[Array, Array], voxel: float, trials: int, rng: np.random.Generator
) -> list[Array]:
    """Returns motions (4, 4) from source to target that are apart, the one that most matches agree with first.

    `source` and `target` are points and normals (M, 3) of the matches. Each match gives a motion, together with those
    that agree with it and with most of what agrees with it, the second-order compatibility of Chen, Sun, Yang and Tao,
    "SC2-PCR", CVPR 2022; here matches agree where both clouds have the same distance and the same angles between the
    normals and the line. The `trials` motions of most compatible matches are put to the vote of all.
    """
    if len(source[0]) > MOST_MATCHES:
        drawn = np.sort(rng.permutation(len(source[0]))[:MOST_MATCHES])
        source, target = ((points[drawn], normals[drawn]) for points, normals in (source, target))
    if len(source[0]) < _FEWEST_VOTES:
        return []
    agree = _compatible(source, target, voxel).astype(np.float32)
    second = agree * (agree @ agree)
    around = np.argsort(-second, axis=1, kind="stable")[:, :_AROUND]
    weights = np.take_along_axis(second, around, axis=1).astype(np.float64)
    seeds = np.argsort(-weights.sum(axis=1), kind="stable")[:trials]
    seeds = seeds[weights[seeds, 1] > 0]  # three matches, with its own, are a motion
    members = np.column_stack([seeds, around[seeds]])
    weights = np.column_stack([weights[seeds, :1], weights[seeds]])
    found = fitted_motions(source[0][members], target[0][members], weights / weights.sum(axis=1, keepdims=True))
    votes = np.zeros(len(found), np.int64)
    for k, T in enumerate(found):
        votes[k] = (np.linalg.norm(transform_points(T, source[0]) - target[0], axis=1) <= 2.5 * voxel).sum()
    order = np.argsort(-votes, kind="stable")
    return _modes(found[order[votes[order] >= _FEWEST_VOTES]], 5 * voxel)


def _compatible(source: tuple[Array, Array], target: tuple[Array, Array], voxel: float) -> NDArray[np.bool_]:
    """Returns which matches (M, M) one rigid motion can be of, by distances and angles that it leaves as they are."""
    (length, facing, along), (other_length, other_facing, other_along) = (_invariants(*one) for one in (source, target))
    agree = (np.abs(length - other_length) <= 2 * voxel) & (length > 4 * voxel)
    agree &= np.abs(facing - other_facing) < _NORMALS
    same = np.abs(along - other_along) < _NORMALS
    return np.asarray(agree & same & same.T)


def _invariants(points: Array, normals: Array) -> tuple[Array, Array, Array]:
    """Returns (M, M) each: distances, cosines between normals, and cosines between a normal and the line to another."""
    length = distances(points)
    along = normals @ points.T - (normals * points).sum(axis=1)[:, None]
    return length, normals @ normals.T, along / np.maximum(length, 1e-9)


def _modes(found: Array, near: float) -> list[Array]:
    """Returns motions (4, 4) that are apart, of (K, 4, 4) in their order: each stands for all that are like it.

    A room that looks alike from both ends has many matches for one of two motions, and both are to be tried.
    """
    apart: list[Array] = []
    while len(found) and len(apart) < _MODES:
        best = found[0]
        apart.append(best)
        cosine = (np.einsum("kij,ij->k", found[:, :3, :3], best[:3, :3]) - 1) / 2
        away = np.linalg.norm(found[:, :3, 3] - best[:3, 3], axis=1)
        found = found[(away > near) | (cosine < _SAME_TURN)]
    return apart
