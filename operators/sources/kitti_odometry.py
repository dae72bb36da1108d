"""Sequences of the KITTI odometry benchmark as a source: a rectified stereo pair, and where the left camera was."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo, Image, Message, Pose
from dataflow.operator import Out, Param, Source, SourceError
from operators.geometry.se3 import orthonormalised
from operators.passed_over import PassedOver
from operators.sources.pacing import frame_stamp

Array = NDArray[np.float64]
FOLDERS = (("image_l", "image_r"), ("image_0", "image_1"), ("image_2", "image_3"))


class KittiOdometry(Source):
    """Reads the stereo pairs of a KITTI odometry sequence and its true poses.

    The folder holds two folders of images (image_0 and image_1, or image_2 and image_3, or image_l and image_r),
    `calib.txt` with the projection of each (3, 4), and where they are known `poses.txt`, twelve numbers a line. Images
    are numbered; frame N is at first_stamp + N / rate. A pair of which an image is missing, cannot be decoded or has
    another size than the first is passed over with a warning. Geiger et al., "Are we ready for autonomous driving?",
    2012.
    """

    left: Out[Image] = Out(doc="left image, grey or colour")
    right: Out[Image] = Out(doc="right image")
    left_info: Out[CameraInfo] = Out(static=True, doc="calibration of the left camera")
    right_info: Out[CameraInfo] = Out(static=True, doc="calibration of the right camera; P holds the baseline")
    ground_truth: Out[Pose] = Out(doc="T_world_camera of the left camera's optical frame")

    path: str = Param(doc="the folder")
    rate: float = Param(10.0, gt=0, doc="pairs a second", unit="Hz")
    first_stamp: int = Param(0, ge=0, doc="stamp of the first pair", unit="ns")
    start: int = Param(0, ge=0, doc="first pair read")
    stop: int | None = Param(None, ge=1, doc="pair to stop before; none reads to the end")
    color: bool = Param(False, doc="RGB instead of grey")
    strict: bool = Param(False, doc="what cannot be read is an error, instead of being passed over and counted")
    world_frame: str = Param("world", min_length=1, doc="frame of the ground truth: the first left camera")
    left_frame: str = Param("stereo_left_optical", min_length=1, doc="optical frame of the left camera")
    right_frame: str = Param("stereo_right_optical", min_length=1, doc="optical frame of the right camera")

    def setup(self) -> None:
        """Raises SourceError."""
        folder = Path(self.path).expanduser()
        pair = next((p for p in FOLDERS if (folder / p[0]).is_dir() and (folder / p[1]).is_dir()), None)
        if pair is None:
            raise SourceError(f"{folder} holds no pair of folders: {', '.join('/'.join(p) for p in FOLDERS)}")
        lefts = sorted((folder / pair[0]).glob("*.png"))[self.start : self.stop]
        if not lefts:
            raise SourceError(f"{folder / pair[0]} holds no image *.png from {self.start} to {self.stop}")
        self._pairs = [(left, folder / pair[1] / left.name) for left in lefts]
        self._passed = PassedOver(self.log, strict=self.strict)
        cameras = (2, 3) if pair[0] == "image_2" else (0, 1)
        self._P = read_projections(self.use_file(folder / "calib.txt"), cameras)
        truth = folder / "poses.txt"
        poses = read_poses(self.use_file(truth)) if truth.is_file() else []
        self._poses = poses[self.start : self.stop]
        if poses and len(self._poses) < len(self._pairs):
            raise SourceError(f"{truth} has {len(poses)} poses, and there are more images")
        self._size = self._passed.first(self._pairs, lambda pair: self._read(pair[0])).shape[1::-1]

    def static_outputs(self) -> Mapping[str, Message]:
        stamp, (width, height) = frame_stamp(self.start, self.rate, self.first_stamp), self._size
        frames = {"left_info": self.left_frame, "right_info": self.right_frame}
        return {
            name: CameraInfo(stamp=stamp, frame=frame, width=width, height=height, K=P[:, :3], P=P)
            for (name, frame), P in zip(frames.items(), self._P, strict=True)
        }

    def stream(self) -> Iterator[Mapping[str, Message]]:
        """Raises SourceError, where it is strict, that names an image that cannot be read or has another size."""
        for i, (left, right) in enumerate(self._pairs):
            stamp = frame_stamp(self.start + i, self.rate, self.first_stamp)
            try:
                pixels = self._read(left), self._read(right)
            except SourceError as error:
                self._passed.take(error)
                continue
            messages: dict[str, Message] = {
                "left": Image(stamp=stamp, frame=self.left_frame, data=pixels[0]),
                "right": Image(stamp=stamp, frame=self.right_frame, data=pixels[1]),
            }
            if self._poses:
                messages["ground_truth"] = Pose.from_matrix(
                    self._poses[i], stamp=stamp, frame=self.world_frame, child_frame=self.left_frame
                )
            yield messages

    def length(self) -> int | None:
        return len(self._pairs) if hasattr(self, "_pairs") else None

    def summary(self) -> Mapping[str, int]:
        return {"passed_over": self._passed.number}

    def _read(self, file: Path) -> NDArray[np.uint8]:
        pixels = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB if self.color else cv2.IMREAD_GRAYSCALE)
        if pixels is None:
            raise SourceError(f"cannot decode {file}" if file.is_file() else f"no file {file}, of a pair")
        size = getattr(self, "_size", None)
        if size is not None and pixels.shape[1::-1] != size:
            raise SourceError(
                f"{file} has {pixels.shape[1]}x{pixels.shape[0]} pixels, the first image {size[0]}x{size[1]}"
            )
        return np.asarray(pixels, np.uint8)


def read_projections(file: Path, cameras: tuple[int, int]) -> tuple[Array, Array]:
    """Returns the projections (3, 4) of two cameras, named `P0:` and so on, or where none is named, the first lines."""
    if not file.is_file():
        raise SourceError(f"no file {file}")
    lines = [line.split() for line in file.read_text().splitlines() if line.strip()]
    named = {words[0].rstrip(":"): words[1:] for words in lines if words[0].startswith("P")}
    found = []
    for i, camera in enumerate(cameras):
        words = named.get(f"P{camera}", lines[i] if not named and i < len(lines) else [])
        found.append(_numbers(file, words, f"projection P{camera}"))
    left, right = found
    if left[0, 0] <= 0 or right[0, 3] - left[0, 3] >= 0:
        raise SourceError(f"{file}: P{cameras[1]}[0, 3] must be below P{cameras[0]}[0, 3]: -fx times the baseline")
    return left, right


def read_poses(file: Path) -> list[Array]:
    """Returns T_world_camera (4, 4) of each line."""
    poses = []
    for number, line in enumerate(file.read_text().splitlines(), 1):
        T = np.eye(4)
        T[:3] = _numbers(file, line.split(), f"pose of line {number}")
        poses.append(orthonormalised(T))
    return poses


def _numbers(file: Path, words: list[str], what: str) -> Array:
    try:
        values = np.array(words, np.float64)
    except ValueError:
        values = np.zeros(0)
    if values.size != 12 or not np.isfinite(values).all():
        raise SourceError(f"{file}: {what} must be 12 numbers, row by row, got {' '.join(words)[:80]!r}")
    return values.reshape(3, 4)
