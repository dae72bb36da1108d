"""The surface of what stands still, from depth images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dataflow.messages import (
    CameraInfo,
    DepthImage,
    Diagnostics,
    Image,
    Mesh,
    Message,
    Odometry,
    PointCloud,
    Pose,
    Transforms,
)
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry.calibration import check_calibration
from operators.mapping.placing import sensor_pose
from operators.mapping.surface_nets import extract
from operators.mapping.tsdf import DistanceField, FieldSettings
from operators.status import counted_status


@dataclass(kw_only=True)
class State(Counts):
    """Holds the map, its frame, empty before the first pose, and whether it has colours."""

    field: DistanceField
    frame: str = ""
    colored: bool = False


class TsdfMap(Operator):
    """Integrates depth images and their poses into a truncated signed distance field; gives its surface as a mesh.

    Each voxel near a surface holds its mean distance from it, weighted by the inverse square of the depth; what the
    camera looks through is carved away. The map has the frame of the poses and does not follow later corrections of
    them. Images must be free of lens distortion.

    Method: Curless and Levoy, "A volumetric method for building complex models from range images", 1996; the mesh by
    Gibson, "Constrained elastic surface nets", 1998.
    """

    depth: In[DepthImage] = In(doc="depth, metres; 0 and NaN are no return")
    pose: In[Pose | Odometry] = In(doc="the camera or its robot, at the depth's stamp")
    depth_info: Sampled[CameraInfo] = Sampled(doc="calibration of the depth camera")
    image: Sampled[Image] = Sampled(
        required=False, doc="colours of the same pixels; used where it has the depth's stamp"
    )
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the camera's frame and that of the pose, where they differ"
    )
    mesh: Out[Mesh] = Out(doc="the surface so far, with normals and, where images came, colours")
    cloud: Out[PointCloud] = Out(doc="the vertices of the mesh")
    status: Out[Diagnostics] = Out(doc="observed voxels, and blocks; a warning for an unusable image")

    voxel: float = Param(0.03, gt=0.002, doc="side of a voxel", unit="m")
    truncation: float = Param(3.0, ge=1, doc="voxels before and behind a surface that are updated")
    near: float = Param(0.3, ge=0, doc="nearer depths are left out", unit="m")
    far: float = Param(4.0, gt=0, doc="farther depths are left out", unit="m")
    min_weight: float = Param(
        0.05,
        ge=0,
        tunable=True,
        doc="a voxel that weighs less has no surface; an image at 1 m adds 1, at 2 m a quarter",
    )
    most_weight: float = Param(20.0, gt=0, doc="most that a voxel remembers: less follows changes faster")
    period: int = Param(50, ge=1, tunable=True, doc="mesh and cloud come with every so many images")
    most_blocks: int = Param(200_000, ge=1, doc="blocks of 512 voxels; a larger map ends the run")
    state: State

    def setup(self) -> None:
        """Raises ValueError for a range that holds no depth."""
        if self.near >= self.far:
            raise ValueError(f"near {self.near} m must be below far {self.far} m")

    def initial_state(self) -> State:
        settings = FieldSettings(
            voxel=self.voxel,
            truncation=self.truncation * self.voxel,
            near=self.near,
            far=self.far,
            most_weight=self.most_weight,
            most_blocks=self.most_blocks,
        )
        return State(field=DistanceField(settings))

    def process(
        self,
        depth: DepthImage,
        pose: Pose | Odometry,
        depth_info: CameraInfo,
        image: Image | None = None,
        extrinsics: Transforms | None = None,
    ) -> dict[str, Message]:
        """Raises ValueError where depth, image and calibration do not fit, no transform relates camera and pose, the
        poses' frame changes, or the map would have more than `most_blocks`."""
        check_calibration("depth", depth, depth_info)
        if self.state.frame and pose.frame != self.state.frame:
            raise ValueError(f"the map is in frame {self.state.frame!r}, but the pose in {pose.frame!r}")
        self.state.frame = pose.frame
        placed = sensor_pose(depth.frame, pose, extrinsics)
        told = 0
        if placed is not None:
            told = self.state.field.integrate(depth.data, self._colors(depth, image), depth_info.K, placed[0])
        reason = ""
        if placed is None:
            reason = "the pose is not finite"
        elif not told:
            reason = "no depth is usable"
        self.state.counts.update({"images": 1, "images left out": bool(reason)})
        counts = {"voxels": told, "blocks": len(self.state.field)}
        level = Level.WARN if reason else Level.OK
        text = reason or f"{told} voxels"
        messages: dict[str, Message] = {"status": counted_status("tsdf_map", depth.stamp, text, level, counts)}
        if self.state.counts["images"] % self.period == 0:
            messages |= self._surface(depth.stamp)
        return messages

    def summary(self) -> Mapping[str, int]:
        return dict(self.state.counts) | {"blocks": len(self.state.field)}

    def _colors(self, depth: DepthImage, image: Image | None) -> np.ndarray[Any, np.dtype[np.uint8]] | None:
        if image is None or image.stamp != depth.stamp:
            return None
        if (image.width, image.height) != (depth.width, depth.height):
            raise ValueError(
                f"image has {image.width}x{image.height} pixels, depth {depth.width}x{depth.height}: "
                f"colours must be registered to the depth"
            )
        self.state.colored = True
        return image.data if image.data.ndim == 3 else np.repeat(image.data[..., None], 3, axis=2)

    def _surface(self, stamp: int) -> dict[str, Message]:
        surface = extract(self.state.field, self.voxel, self.min_weight)
        colors = surface.colors if self.state.colored else None
        mesh = Mesh(
            stamp=stamp,
            frame=self.state.frame,
            vertices=surface.vertices,
            triangles=surface.triangles,
            normals=surface.normals,
            colors=colors,
        )
        cloud = PointCloud(
            stamp=stamp, frame=self.state.frame, points=surface.vertices, normals=surface.normals, colors=colors
        )
        return {"mesh": mesh, "cloud": cloud}
