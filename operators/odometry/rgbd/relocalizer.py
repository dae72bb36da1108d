"""Finds a lost camera's view among remembered keyframes.

Where depth is seen, points of several keyframes are paired with those of the view, and the motions on which most agree
are refined and judged by all that both see; where two places fit, neither is believed. Without depth, the pixels of one
keyframe's points give the pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import transform_points
from operators.geometry.pinhole import Pixels, Points, unproject
from operators.geometry.se3 import Matrix
from operators.odometry.consensus import consensus
from operators.odometry.motion import Motion
from operators.odometry.recognition import Description, describe, match, match_of_size
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.evidence import gathered, seeing
from operators.odometry.rgbd.fitting import Fit, Fitter, Sighting
from operators.odometry.rgbd.frame import Frame
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.local_map import LocalMap
from operators.odometry.rgbd.standing import standing
from operators.odometry.rgbd.surface import DepthNoise, Surface
from operators.odometry.rgbd.uniqueness import unique

PAIRS = 60  # features of one keyframe that are paired
FEWEST = 8  # different features of a view that must agree on its pose for a look at what else supports it
APART = 0.5  # metres between two places
RIVALS = 2  # poses among keyframes that were not chosen that are looked at before a place is believed
SHARED = 0.15  # of a view that the map must have seen to contradict it
CONTRADICTED = 0.4  # of what a view and the map both see: less of it agrees only at a wrong place, or after a change
VIEWS = 2  # keyframes that a recognised view is compared with
SPARSE = 4  # patches of the view's surface between points by which these are chosen
FEWEST_PIXELS = 7  # features that a pose may be solved from without depth
RECALL_PIXELS = 3.0  # working pixels by which such a feature may be off


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Features with depth: pixels (N, 2), points (N, 3) in the depth camera, sizes (N,) in metres, descriptors."""

    pixels: Pixels
    points: Points
    sizes: NDArray[np.float64]
    descriptors: NDArray[np.uint8]

    @staticmethod
    def of(description: Description, surface: Surface, camera: RgbdCamera) -> Landmarks:
        points, known = lifted(description.pixels, surface, camera)
        sizes = description.sizes[known] * points[known, 2]
        return Landmarks(description.pixels[known], points[known], sizes, description.descriptors[known])


def recognised(
    frame: Frame, chosen: Sequence[Keyframe], fitter: Fitter, motion: Motion, T_predicted: Matrix, known: LocalMap
) -> Iterator[tuple[Fit, Keyframe]]:
    """Yields a frame's poses among chosen keyframes, refined and certain, each with the keyframe that shows most.

    A pose that fits the other keyframes of a segment at another place as well is none.
    """
    if frame.depth_flaw is not None:
        yield from _by_pixels(frame, chosen, fitter, motion, T_predicted, known)
        return
    seen = Landmarks.of(describe(frame.gray), frame.surface, fitter.camera)
    for segment in sorted({k.segment for k in chosen}):
        keyframes = [k for k in chosen if k.segment == segment]
        there = known.of_segment(segment)
        first: tuple[Fit, Keyframe] | None = None
        for sighting in common(seen, keyframes, fitter):
            found = _refined(frame, sighting, fitter, motion, T_predicted, there)
            if found is None and first is None:
                break  # what fewer features say is no better founded
            if found is not None and first is not None and _apart(found[0], first[0]):
                first = None
                break
            first = first or found
        if first is None:
            continue
        others = [k for k in there if not any(k is one for one in keyframes)]
        sightings = common(seen, others, fitter)[:RIVALS]
        rivals = [_refined(frame, sighting, fitter, motion, T_predicted, there) for sighting in sightings]
        if not any(rival is not None and _apart(rival[0], first[0]) for rival in rivals):
            yield first


def _refined(
    frame: Frame, sighting: Sighting, fitter: Fitter, motion: Motion, T_predicted: Matrix, there: Sequence[Keyframe]
) -> tuple[Fit, Keyframe] | None:
    """Returns a sighting's pose among a segment's keyframes, refined, and the one that shows most, if it is certain."""
    views = seeing(frame.surface.points(SPARSE), sighting.T_world_camera, there, VIEWS)
    if not views:
        return None
    compared = LocalMap(VIEWS)
    compared.keyframes = views
    fit = fitter.refine(frame, sighting, motion, T_predicted, compared, views[0].segment)
    view = believed(frame, fit.T_world_camera, there, fitter.camera, fitter.config.depth_noise)
    return None if view is None else (fit, view)


def _apart(a: Fit, b: Fit) -> bool:
    """Returns whether two poses are of two places, and not of one that a map with drift holds twice."""
    return float(np.linalg.norm((a.T_world_camera - b.T_world_camera)[:3, 3])) > APART


def believed(
    frame: Frame, T_world_camera: Matrix, keyframes: Sequence[Keyframe], camera: RgbdCamera, noise: DepthNoise
) -> Keyframe | None:
    """Returns the keyframe that sees most of a view, if shape and brightness make sure of its pose; else nothing."""
    views = seeing(frame.surface.points(SPARSE), T_world_camera, keyframes, VIEWS)
    if not views or not gathered(frame, T_world_camera, views, camera, noise).certain:
        return None
    return views[-1] if unique(frame, T_world_camera, views, camera, noise) else None


def support(
    frame: Frame, T_world_camera: Matrix, keyframes: Sequence[Keyframe], camera: RgbdCamera, noise: DepthNoise
) -> float:
    """Returns how much shape and brightness of what a view and keyframes both see speak for its pose, 0 to 2."""
    views = seeing(frame.surface.points(SPARSE), T_world_camera, keyframes, VIEWS)
    found = gathered(frame, T_world_camera, views, camera, noise)
    return found.agreement + found.likeness


def contradicted(
    frame: Frame, T_world_camera: Matrix, keyframes: Sequence[Keyframe], camera: RgbdCamera, noise: DepthNoise
) -> bool | None:
    """Returns whether most of a view at a pose lies elsewhere than on keyframes; nothing where these saw too little."""
    views = seeing(frame.surface.points(SPARSE), T_world_camera, keyframes, VIEWS)
    found = gathered(frame, T_world_camera, views, camera, noise)
    return found.agreement < CONTRADICTED if found.overlap >= SHARED else None


def common(seen: Landmarks, keyframes: Sequence[Keyframe], fitter: Fitter) -> list[Sighting]:
    """Returns the poses in which a view's features lie where keyframes of one segment have them, most of them first.

    What has moved since between them does not count.
    """
    known, names = [np.zeros((0, 3))], [np.zeros(0, np.int64)]
    for keyframe in keyframes:
        landmarks = Landmarks.of(keyframe.description, keyframe.surface, fitter.camera)
        pairs = match_of_size(landmarks.descriptors, seen.descriptors, landmarks.sizes, seen.sizes, PAIRS)
        known.append(transform_points(keyframe.T_world_camera, landmarks.points[pairs[:, 0]]))
        names.append(pairs[:, 1])
    points, which = np.concatenate(known), np.concatenate(names)
    sightings = []
    for found in consensus(points, seen.points[which], which):
        if found.count >= FEWEST:
            named = which[found.agree]
            ages = np.zeros(len(named), np.int64)
            all_ = Sighting(found.T_a_b, points[found.agree], seen.pixels[named], ages, len(points), recognised=True)
            sightings.append(standing(all_, seen.points[named], fitter, FEWEST))
    return sightings


def _by_pixels(
    frame: Frame, chosen: Sequence[Keyframe], fitter: Fitter, motion: Motion, T_predicted: Matrix, known: LocalMap
) -> Iterator[tuple[Fit, Keyframe]]:
    """Does as `recognised` where the view has no depth: by what it has in common with one keyframe."""
    seen, found = describe(frame.gray), []
    for keyframe in chosen:
        pairs = match(keyframe.description, seen)
        # Many of these points lie on edges, where either depth may do.
        points, there = lifted(keyframe.description.pixels[pairs[:, 0]], keyframe.surface, fitter.camera)
        if np.count_nonzero(there) >= FEWEST_PIXELS:
            world = transform_points(keyframe.T_world_camera, points[there])
            found.append((keyframe, world, seen.pixels[pairs[there, 1]]))
    for keyframe, world, pixels in sorted(found, key=lambda pairs: -len(pairs[1])):
        ages = np.zeros(len(pixels), np.int64)
        sighting = fitter.solve(world, pixels, ages, RECALL_PIXELS, FEWEST_PIXELS)
        if sighting is None:
            continue
        sighting = replace(sighting, recognised=True)
        fit = fitter.refine(frame, sighting, motion, T_predicted, known, keyframe.segment)
        if fit.inliers >= fitter.config.min_inliers:
            yield fit, keyframe


def lifted(pixels: Pixels, surface: Surface, camera: RgbdCamera) -> tuple[Points, NDArray[np.bool_]]:
    """Returns the points (N, 3) of a surface that colour pixels (N, 2) see, depth camera, and which are known."""
    rays = unproject(pixels, camera.K_color) @ camera.T_depth_color[:3, :3].T
    origin = camera.T_depth_color[:3, 3]
    points, known = origin + 2.0 * rays, np.zeros(len(rays), np.bool_)
    for _ in range(3):
        seen = surface.inverse_at(points)
        known = seen > 0
        z = np.where(known, 1.0 / np.where(known, seen, 1.0), points[:, 2]) - origin[2]
        points = origin + rays * (z / rays[:, 2])[:, None]
    return points, known
