"""Local bundle adjustment: the newest keyframes of a map and the points that they share, the others held fixed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from operators.odometry.rgbd.fitting import Fitter, systematic
from operators.slam.keyframe_graph import KeyframeGraph
from operators.slam.visual.bundle import Observations, adjusted
from operators.slam.visual.map_points import MapPoints
from operators.slam.visual.view import View, astray

FEWEST = 3  # views of a point; points of two views are covered by the sight between them
MOST = 400  # points
ITERATIONS = 3
PIXEL = 0.5  # working pixels, at least, by which a described feature errs
DEPTH = 0.002  # metres by which its depth errs besides the noise, since it is its patch's
# Of the observations' information, which is believed: features err together from view to view, and the sights and the
# odometry that tie the same keyframes rest on many of the same pixels.
STRENGTH = 0.05
WRONG = 25.0  # squared sigmas of a pixel beyond which a sighting is of something else


def adjust_newest(graph: KeyframeGraph[View], points: MapPoints, fitter: Fitter, newest: int) -> None:
    """Moves the newest free nodes and the points that they see to where sightings and edges have them together.

    Older nodes that see the same points, or that edges tie to, hold them. Sightings that fit nothing are forgotten.
    """
    free = [k for k in graph.nodes if k not in graph.fixed][-newest:]
    chosen = set(free)
    rows = points.shared(np.array(free, np.int64), FEWEST, MOST)
    of_rows = np.isin(points.sightings.points, rows)
    seen = points.sightings[of_rows]
    edges = [edge for edge in graph.edges if edge.first in chosen or edge.last in chosen]
    ends = {end for edge in edges for end in (edge.first, edge.last)}
    held = sorted((ends | set(seen.nodes.tolist())) - chosen)
    if not len(rows) or not held:
        return
    place = {k: i for i, k in enumerate([*held, *free])}
    known, noise = np.where(np.isfinite(seen.depths), seen.depths, 1.0), fitter.noise
    observed = Observations(
        np.array([place[k] for k in seen.nodes.tolist()], np.int64), np.searchsorted(rows, seen.points),
        seen.pixels, seen.depths, max(PIXEL, noise.pixel),
        np.asarray(noise.depth * fitter.config.depth_noise.sigma(known) + DEPTH, np.float64),
    )  # fmt: skip
    bundle = adjusted(
        fitter.camera, np.array([graph.nodes[k].T for k in place]), points.world(rows, graph.nodes), observed,
        [replace(edge, first=place[edge.first], last=place[edge.last]) for edge in edges], len(held),
        STRENGTH / (systematic(noise.pixel, noise.disagreement) * astray(noise)), ITERATIONS,
    )  # fmt: skip
    for k in free:
        graph.nodes[k].T = bundle.poses[place[k]]
    points.move(rows, bundle.points, graph.nodes)
    wrong = of_rows.copy()
    wrong[of_rows] = bundle.squared[:, 0] > WRONG
    points.sightings = points.sightings[~wrong]
