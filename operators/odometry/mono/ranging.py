"""The scale that depth images give a monocular map: metres by each unit of the map, over the points that both see.

Depth may be sparse, in time as in the image: a depth image counts once, whenever it comes, and at its own stamp.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.geometry.pinhole import Points, project
from operators.geometry.se3 import Matrix
from operators.monitoring.image_flaws import Watch
from operators.odometry.mono.scale import Scale
from operators.odometry.mono.settings import RangingConfig
from operators.odometry.motion import Motion
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.relocalizer import lifted
from operators.odometry.rgbd.surface import Surface
from operators.odometry.tracking import MEASURED, TrackResult

AGREE = 0.15  # of the logarithm of a ratio: points farther from the median lie on something else than their depth
DEVIATION = 1.4826  # standard deviations in a median absolute deviation of normal errors
MEDIAN = 1.2533  # standard deviation of a median by that of a mean
GATE = 4.0  # standard deviations beyond which a depth image contradicts a known scale
PERSISTENT = 5  # images in succession that contradict it alike are believed


class RangingUse(StrEnum):
    """Outcomes of a depth image."""

    FOUND = "gives the scale"
    TAKEN = "agrees"
    ANEW = "gives another scale than it was"
    CONTRARY = "contradicts the scale"
    SCATTERED = "disagrees from point to point"
    FEW = "has too few points of the map"
    FLAWED = "is empty or repeats the last one"
    UNPOSED = "has no measured pose at its stamp"


@dataclass(frozen=True, eq=False)
class MetricDepth:
    """A depth image (H, W), metres, 0 or NaN for no return, of a camera whose K_color is that of the tracked images."""

    stamp: int
    depth: NDArray[np.float32]
    camera: RgbdCamera


@dataclass(frozen=True)
class RangingMemory:
    """The last depth image, and how many before it contradicted the scale alike, by which factor."""

    stamp: int = -1
    watch: Watch = field(default_factory=Watch)
    contrary: int = 0
    factor: float = 1.0


@dataclass(frozen=True)
class Ratio:
    """Metres by map unit, the standard deviation of its logarithm that points alone say, and how many these are."""

    factor: float
    sigma: float
    points: int


@dataclass(frozen=True)
class Ranged:
    """The use of a depth image: the factor that brings the map to metres, the scale then, and one line about it."""

    use: RangingUse
    factor: float
    scale: Scale
    memory: RangingMemory
    text: str


def ranged(
    given: MetricDepth,
    points_world: Points,
    T_world_camera: Matrix | None,
    scale: Scale,
    memory: RangingMemory,
    config: RangingConfig,
) -> Ranged:
    """Returns the scale, by a depth image, of points (N, 3) that the camera sees from a pose in their unit.

    Without a pose, or where the image shows nothing, the scale stays what it is, as it does where the depth disagrees
    with itself, or with a known scale; but several in succession that contradict that alike are believed.
    """
    surface = Surface.from_depth(
        given.depth, given.camera.K_depth, config.near, config.far, max(1, given.depth.shape[1] // config.surface_width)
    )
    watch = Watch().seen(np.zeros((1, 1), np.uint8), given.depth)
    flaw = watch.depth_flaw(memory.watch, surface.coverage)
    memory = replace(memory, stamp=given.stamp, watch=watch)

    def unused(use: RangingUse, detail: str = "", *, remembered: RangingMemory = memory) -> Ranged:
        return Ranged(use, 1.0, scale, remembered, f"depth {use}{detail}")

    if flaw is not None:
        return Ranged(RangingUse.FLAWED, 1.0, scale, memory, f"depth {flaw}")
    if T_world_camera is None:
        return unused(RangingUse.UNPOSED)
    seen = transform_points(invert(T_world_camera), points_world)
    told = ratio(seen[seen[:, 2] > 0], surface, given.camera, config.min_points)
    if isinstance(told, int):
        return unused(RangingUse.FEW, f" ({told})")
    if told is None:
        return unused(RangingUse.SCATTERED)
    sigma = float(np.hypot(told.sigma, config.sigma))
    if not scale.known:
        found = replace(memory, contrary=0)
        text = f"depth of {told.points} points {RangingUse.FOUND}"
        return Ranged(RangingUse.FOUND, told.factor, Scale(sigma), found, text)
    if abs(np.log(told.factor)) > GATE * np.hypot(scale.sigma, sigma):
        alike = memory.contrary > 0 and abs(np.log(told.factor / memory.factor)) < AGREE
        contrary = replace(memory, contrary=memory.contrary + 1 if alike else 1, factor=told.factor)
        if contrary.contrary < PERSISTENT:
            return unused(RangingUse.CONTRARY, f" ({told.factor:.2f} times)", remembered=contrary)
        text = f"depth of {told.points} points {RangingUse.ANEW}: {told.factor:.2f} times"
        past = float(np.hypot(scale.past, np.log(told.factor)))
        return Ranged(RangingUse.ANEW, told.factor, Scale(sigma, past), replace(memory, contrary=0), text)
    factor, better = scale.weighed(told.factor, sigma, config.sigma)
    text = f"depth of {told.points} points {RangingUse.TAKEN}"
    return Ranged(RangingUse.TAKEN, factor, better, replace(memory, contrary=0), text)


def ratio(points: Points, surface: Surface, camera: RgbdCamera, fewest: int) -> Ratio | int | None:
    """Returns metres by unit over points (N, 3) in the colour camera, in the map's unit and before it.

    The depth of each is that of the surface which its pixel sees. Returns how many have one where these are too few,
    and None where no half of them agrees.
    """
    metric, known = lifted(project(points, camera.K_color), surface, camera)
    metres = transform_points(camera.T_color_depth, metric)[:, 2]
    known &= metres > 0
    count = int(np.count_nonzero(known))
    if count < fewest:
        return count
    logs = np.log(metres[known] / points[known, 2])
    centre = float(np.median(logs))
    for _ in range(3):
        near = logs[np.abs(logs - centre) < AGREE]
        if len(near) < max(fewest, 0.5 * count):
            return None
        centre = float(np.median(near))
    spread = DEVIATION * float(np.median(np.abs(near - centre)))
    return Ratio(float(np.exp(centre)), MEDIAN * spread / np.sqrt(len(near)), len(near))


def pose_at(stamp: int, result: TrackResult, last: Motion | None) -> Matrix | None:
    """Returns the camera's pose at a stamp, a result's own or one on the way from the last, if it was measured."""
    if result.status not in MEASURED:
        return None
    if stamp == result.stamp:
        return result.T_world_camera
    if last is None or last.blind_s > 0 or not last.stamp < stamp < result.stamp:
        return None
    share = (stamp - last.stamp) / (result.stamp - last.stamp)
    return se3.interpolated(last.T_world_camera, result.T_world_camera, share)
