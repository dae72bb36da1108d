"""Points of a map that several of its views see, and what each saw of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import transform_points
from dataflow.operator import Remembered
from operators.geometry.se3 import Matrix
from operators.odometry.rgbd.camera import RgbdCamera
from operators.slam.keyframe_graph import Node
from operators.slam.visual.guided import guided_pairs
from operators.slam.visual.view import View

WINDOW = 6.0  # working pixels around where a pose has a point, in which it is looked for
LONE = 12  # keyframes after which a point that no other view shows is forgotten

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Nodes = Mapping[int, Node[View]]


@dataclass(frozen=True, eq=False)
class Sightings:
    """Holds which nodes (S,) saw which points (S,), by row, at what pixels (S, 2) of the working image and with what
    depths (S,), metres, NaN where unknown or beside an edge."""

    nodes: Indices
    points: Indices
    pixels: Array
    depths: Array

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Sightings:
        return Sightings(self.nodes[chosen], self.points[chosen], self.pixels[chosen], self.depths[chosen])

    def joined(self, other: Sightings) -> Sightings:
        return Sightings(
            *(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self))
        )  # fmt: skip


class MapPoints(Remembered):
    """Points by row and their sightings.

    `anchors` (M,) are the nodes that saw them first, which keep their views, and `features` (M,) which of their
    features they are. `local` (M, 3) has them in those nodes' depth cameras, so that they move with them.
    """

    anchors: Indices
    features: Indices
    local: Array
    sightings: Sightings

    def __init__(self) -> None:
        none = np.zeros(0, np.int64)
        self.anchors, self.features, self.local = none, none, np.zeros((0, 3))
        self.sightings = Sightings(none, none, np.zeros((0, 2)), np.zeros(0))

    def see(self, number: int, view: View, nodes: Nodes, around: Sequence[int], camera: RgbdCamera) -> None:
        """Takes what the view of a new node shows of points that the nodes `around` saw first, and new points.

        A node that keeps no view adds no points. `camera` has the K_color of the working image.
        """
        self.forget(nodes, number)
        rows = np.flatnonzero(np.isin(self.anchors, np.array(around, np.int64)))
        matched = np.zeros(len(view.pixels), np.bool_)
        if len(rows):
            points = self.world(rows, nodes).astype(np.float32)
            rooted = self._rooted(rows, nodes)
            pairs = guided_pairs(points, rooted, view.pixels, view.rooted, nodes[number].T, camera, WINDOW)
            self._add(number, rows[pairs[:, 0]], pairs[:, 1], view)
            matched[pairs[:, 1]] = True
        if nodes[number].view is None:
            return
        fresh = np.flatnonzero(~matched & view.steady)
        first = len(self.anchors)
        self.anchors = np.concatenate([self.anchors, np.full(len(fresh), number, np.int64)])
        self.features = np.concatenate([self.features, fresh])
        self.local = np.concatenate([self.local, view.points[fresh].astype(np.float64)])
        self._add(number, first + np.arange(len(fresh)), fresh, view)

    def shared(self, views: Indices, fewest: int, most: int) -> Indices:
        """Returns the rows of points that any of some nodes saw and at least `fewest` did in all: at most `most`, those
        with the most sightings, the older of equals."""
        seen, counts = self.sightings, np.bincount(self.sightings.points, minlength=len(self.anchors))
        rows = np.unique(seen.points[np.isin(seen.nodes, views)])
        rows = rows[counts[rows] >= fewest]
        return np.sort(rows[np.argsort(-counts[rows], kind="stable")[:most]])

    def world(self, rows: Indices, nodes: Nodes) -> Array:
        """Returns where points (N,) lie in the map, (N, 3)."""
        out = np.empty((len(rows), 3))
        for here, k in self._by_anchor(rows):
            out[here] = transform_points(nodes[k].T, self.local[rows[here]])
        return out

    def move(self, rows: Indices, world: Array, nodes: Nodes) -> None:
        """Puts points (N,) to where they lie in the map, (N, 3)."""
        for here, k in self._by_anchor(rows):
            T: Matrix = nodes[k].T
            self.local[rows[here]] = (world[here] - T[:3, 3]) @ T[:3, :3]

    def _by_anchor(self, rows: Indices) -> list[tuple[Indices, int]]:
        anchors = self.anchors[rows]
        return [(np.flatnonzero(anchors == k), k) for k in np.unique(anchors).tolist()]

    def _rooted(self, rows: Indices, nodes: Nodes) -> NDArray[np.float32]:
        out = np.empty((len(rows), 128), np.float32)
        for here, k in self._by_anchor(rows):
            view = nodes[k].view
            assert view is not None
            out[here] = view.rooted[self.features[rows[here]]]
        return out

    def _add(self, number: int, rows: Indices, features: Indices, view: View) -> None:
        depths = np.where(view.steady[features], view.points[features, 2], np.nan).astype(np.float64)
        here = np.full(len(rows), number, np.int64)
        self.sightings = self.sightings.joined(
            Sightings(here, rows, view.pixels[features].astype(np.float64), depths)
        )  # fmt: skip

    def forget(self, nodes: Nodes, newest: int) -> None:
        """Drops the sightings and points of nodes that are gone, and points that one view alone showed and long ago."""
        seen, here = self.sightings, np.fromiter(nodes, np.int64)
        there = np.isin(seen.nodes, here)
        counts = np.bincount(seen.points[there], minlength=len(self.anchors))
        wanted = ((counts > 1) | (self.anchors > newest - LONE)) & np.isin(self.anchors, here)
        there &= wanted[seen.points]
        kept = seen[there]
        self.sightings = replace(kept, points=(np.cumsum(wanted) - 1)[kept.points])
        self.anchors, self.features, self.local = self.anchors[wanted], self.features[wanted], self.local[wanted]
