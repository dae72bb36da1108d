"""A small made-up RGB-D sequence with exact ground truth, for tests and for a first look without any data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.messages import CameraInfo, DepthImage, Detections2D, Image, Message, Pose, Transforms
from dataflow.operator import Out, Param, Source
from operators.sources.pacing import frame_stamp
from operators.sources.room import OBJECTS, Room, View, camera_path, to_pixels

_CLASS_NAMES = tuple(sorted({thing.label for thing in OBJECTS}))


class SyntheticRgbd(Source):
    """A hand-held camera circling a table in a textured room: ray-cast colour and depth, with sensor noise from a seed.

    Colour and depth are registered: both cameras have the same calibration and pose. Frame k depends on the parameters
    and k alone.
    """

    simulated = True

    image: Out[Image] = Out(doc="colour")
    depth: Out[DepthImage] = Out(doc="depth, metres; 0 beyond max_depth")
    image_info: Out[CameraInfo] = Out(static=True, doc="calibration of the colour camera")
    depth_info: Out[CameraInfo] = Out(static=True, doc="calibration of the depth camera")
    extrinsics: Out[Transforms] = Out(static=True, doc="the colour camera in the depth camera's frame: the identity")
    ground_truth: Out[Pose] = Out(doc="T_world_camera, exact")
    objects: Out[Detections2D] = Out(doc="true boxes of the visible parts of the objects, with their identities")

    frames: int = Param(120, ge=1, doc="how many frames")
    rate: float = Param(30.0, gt=0, doc="frames a second", unit="Hz")
    first_stamp: int = Param(0, ge=0, doc="stamp of the first frame", unit="ns")
    width: int = Param(320, ge=16, doc="columns", unit="px")
    height: int = Param(240, ge=16, doc="rows", unit="px")
    focal: float = Param(0.82, gt=0.1, doc="focal length as a share of the width; 0.82 is a Kinect's")
    period: float = Param(16.0, gt=0, doc="time of one round; the path closes after it", unit="s")
    image_noise: float = Param(2.0, ge=0, doc="standard deviation of each colour channel, of 255")
    depth_noise: float = Param(
        0.0015, ge=0, doc="standard deviation of depth at 1 m; it grows with its square", unit="m"
    )
    max_depth: float = Param(6.0, gt=0, doc="depths beyond are no return", unit="m")
    min_pixels: int = Param(20, ge=1, doc="objects with fewer visible pixels have no box")
    seed: int = Param(0, ge=0, doc="of textures and noise")
    world_frame: str = Param("world", min_length=1, doc="frame of the ground truth")
    image_frame: str = Param("camera_color_optical", min_length=1, doc="optical frame of the colour camera")
    depth_frame: str = Param("camera_depth_optical", min_length=1, doc="optical frame of the depth camera")

    def setup(self) -> None:
        """Raises ValueError where both cameras are given one frame name."""
        if self.image_frame == self.depth_frame:
            raise ValueError(f"image_frame and depth_frame must differ, both are {self.image_frame!r}")
        self._room = Room(self.seed)

    def static_outputs(self) -> Mapping[str, Message]:
        return {
            "image_info": self._info(self.image_frame),
            "depth_info": self._info(self.depth_frame),
            "extrinsics": Transforms.from_matrix(
                np.eye(4), stamp=self.first_stamp, frame=self.depth_frame, child_frame=self.image_frame
            ),
        }

    def stream(self) -> Iterator[Mapping[str, Message]]:
        K = self._info(self.depth_frame).K
        for k in range(self.frames):
            stamp = frame_stamp(k, self.rate, self.first_stamp)
            T_world_camera = camera_path((stamp - self.first_stamp) * 1e-9, self.period)
            view = self._room.render(T_world_camera, K, (self.width, self.height))
            rng = np.random.default_rng([self.seed, k])
            image = view.image + rng.normal(0, self.image_noise, view.image.shape)
            depth = view.depth + rng.normal(0, self.depth_noise, view.depth.shape) * view.depth**2
            depth[depth > self.max_depth] = 0
            yield {
                "image": Image(stamp=stamp, frame=self.image_frame, data=to_pixels(image)),
                "depth": DepthImage(stamp=stamp, frame=self.depth_frame, data=depth.astype(np.float32)),
                "ground_truth": Pose.from_matrix(
                    T_world_camera, stamp=stamp, frame=self.world_frame, child_frame=self.depth_frame
                ),
                "objects": self._boxes(view, stamp),
            }

    def length(self) -> int | None:
        return self.frames

    def _info(self, frame: str) -> CameraInfo:
        focal = self.focal * self.width
        return CameraInfo.from_intrinsics(
            stamp=self.first_stamp, frame=frame, width=self.width, height=self.height,
            fx=focal, fy=focal, cx=(self.width - 1) / 2, cy=(self.height - 1) / 2,
        )  # fmt: skip

    def _boxes(self, view: View, stamp: int) -> Detections2D:
        boxes, ids, counts = [], [], []
        for i in range(len(OBJECTS)):
            rows, columns = np.nonzero(view.surface == 6 + i)
            if len(rows) >= self.min_pixels:
                boxes.append((columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))
                ids.append(i)
                counts.append(len(rows))
        return Detections2D(
            stamp=stamp,
            frame=self.image_frame,
            width=self.width,
            height=self.height,
            class_names=_CLASS_NAMES,
            boxes=np.array(boxes, np.float32).reshape(-1, 4),
            scores=np.ones(len(ids), np.float32),
            class_ids=np.array([_CLASS_NAMES.index(OBJECTS[i].label) for i in ids], np.int32),
            ids=np.array(ids, np.int64),
            pixel_counts=np.array(counts, np.int64),
        )
