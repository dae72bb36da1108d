"""KITTI raw drives, camera and LiDAR, as a source."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo, Image, Message, PointCloud, Transforms
from dataflow.messages.geometry import invert
from dataflow.operator import Out, Param, Source
from operators.geometry.se3 import orthonormalised

Array = NDArray[np.float64]

_IMAGES = ("image_02", "image_02/data")
_SCANS = ("velodyne", "velodyne_points/data")
_CALIBRATIONS = (("calib.txt",), ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt"))


class KittiError(ValueError):
    """A KITTI folder that cannot be read: names the file and what it should hold."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """`K` (3, 3) of the rectified colour camera, pixels, and `T_camera_velodyne` (4, 4)."""

    K: Array
    T_camera_velodyne: Array


class KittiRaw(Source):
    """Reads the left colour camera and the Velodyne of a drive of KITTI raw, synchronised and rectified.

    The folder holds `image_02` and `velodyne` with a `calib.txt`, or it is a drive as KITTI distributes it
    (`image_02/data`, `velodyne_points/data`, calibration files there or in the folder above). Image and scan of a frame
    carry one stamp: that of `velodyne_points/timestamps.txt`, else first_stamp + N / rate. The scans are as the sensor
    gave them: not deskewed, and the files do not say when each point was measured. Geiger et al., "Vision meets
    robotics: the KITTI dataset", 2013.
    """

    points: Out[PointCloud] = Out(doc="one turn of the Velodyne, with intensities 0 to 1")
    image: Out[Image] = Out(doc="left colour camera, rectified")
    image_info: Out[CameraInfo] = Out(static=True, doc="calibration of the rectified camera")
    extrinsics: Out[Transforms] = Out(static=True, doc="the camera in the Velodyne's frame")

    path: str = Param(doc="the folder")
    rate: float = Param(10.0, gt=0, doc="frames a second where the folder has no timestamps", unit="Hz")
    first_stamp: int = Param(0, ge=0, doc="stamp of frame 0 where the folder has no timestamps", unit="ns")
    start: int = Param(0, ge=0, doc="first frame read")
    stop: int | None = Param(None, ge=1, doc="frame to stop before; none reads to the end")
    stride: int = Param(1, ge=1, doc="read every stride-th frame")
    lidar_frame: str = Param("velodyne", min_length=1, doc="frame of the scans")
    image_frame: str = Param("camera_optical", min_length=1, doc="optical frame of the camera")

    def setup(self) -> None:
        """Raises KittiError for a folder or calibration that cannot be used."""
        folder = Path(self.path).expanduser()
        images = {file.stem: file for file in _files(folder, _IMAGES, ".png")}
        scans = {file.stem: file for file in _files(folder, _SCANS, ".bin")}
        both = sorted(images.keys() & scans.keys())
        stamps = _stamps(folder / "velodyne_points" / "timestamps.txt", sorted(scans))
        chosen = list(enumerate(both))[self.start : self.stop : self.stride]
        if not chosen:
            raise KittiError(
                f"{folder} has {len(both)} frames with image and scan: start={self.start}, stop={self.stop}, "
                f"stride={self.stride} leaves none"
            )
        period = 1e9 / self.rate
        self._frames = [
            (stamps[name] if stamps else self.first_stamp + round(k * period), images[name], scans[name])
            for k, name in chosen
        ]
        files = _calibration_files(folder)
        self._calibration = read_calibration(*(self.use_file(file) for file in files))
        self._size = _read_image(self._frames[0][1]).shape[:2]

    def static_outputs(self) -> Mapping[str, Message]:
        stamp, K = self._frames[0][0], self._calibration.K
        height, width = self._size
        return {
            "image_info": CameraInfo.from_intrinsics(
                stamp=stamp, frame=self.image_frame, width=width, height=height,
                fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2],
            ),
            "extrinsics": Transforms.from_matrix(
                invert(self._calibration.T_camera_velodyne),
                stamp=stamp,
                frame=self.lidar_frame,
                child_frame=self.image_frame,
            ),
        }  # fmt: skip

    def stream(self) -> Iterator[Mapping[str, Message]]:
        """Raises KittiError that names a file that cannot be read."""
        for stamp, image_file, scan_file in self._frames:
            image, scan = _read_image(image_file), read_scan(scan_file)
            if image.shape[:2] != self._size:
                raise KittiError(f"{image_file} has another size than the first image: {image.shape[:2]}, {self._size}")
            yield {
                "points": PointCloud(
                    stamp=stamp,
                    frame=self.lidar_frame,
                    points=np.ascontiguousarray(scan[:, :3]),
                    intensities=np.ascontiguousarray(scan[:, 3]),
                ),
                "image": Image(stamp=stamp, frame=self.image_frame, data=image),
            }

    def length(self) -> int | None:
        return len(self._frames) if hasattr(self, "_frames") else None


def read_scan(file: Path) -> NDArray[np.float32]:
    """Reads x, y, z, reflectance (N, 4) of a Velodyne file. Raises KittiError."""
    try:
        content = file.read_bytes()
    except OSError as error:
        raise KittiError(f"{file}: {error}") from None
    if len(content) % 16:
        raise KittiError(f"{file} has {len(content)} bytes; 16 a point expected (x, y, z, reflectance as float32)")
    return np.frombuffer(content, "<f4").reshape(-1, 4).astype(np.float32)


def read_calibration(*files: Path) -> Calibration:
    """Reads KITTI calibration files, taken together: lines of a key, a colon and numbers. Raises KittiError."""
    values: dict[str, list[float]] = {}
    for file in files:
        for line in file.read_text(encoding="utf-8").splitlines():
            key, colon, rest = line.partition(":")
            if not colon or line.startswith("#"):
                continue
            try:
                values[key.strip()] = [float(word) for word in rest.split()]
            except ValueError:
                continue  # dates and names
    named = ", ".join(file.name for file in files)

    def numbers(count: int, *keys: str) -> Array:
        for key in keys:
            if key in values:
                found = np.array(values[key])
                if len(found) != count or not np.isfinite(found).all():
                    raise KittiError(f"{named}: {key} must have {count} finite numbers, has {len(found)}")
                return found
        raise KittiError(f"{named}: no {' or '.join(keys)}")

    P = numbers(12, "P_rect_02").reshape(3, 4)
    if P[0, 0] <= 0 or P[1, 1] <= 0:
        raise KittiError(f"{named}: P_rect_02 has focal lengths {P[0, 0]} and {P[1, 1]}")
    T = np.eye(4)
    T[:3, :3] = numbers(9, "R_velo_to_cam", "R").reshape(3, 3)
    T[:3, 3] = numbers(3, "T_velo_to_cam", "T")
    R = np.eye(4)
    R[:3, :3] = numbers(9, "R_rect_00").reshape(3, 3)
    T = R @ T
    T[:3, 3] += np.linalg.solve(P[:, :3], P[:, 3])  # the colour camera beside the reference camera
    return Calibration(P[:, :3].copy(), orthonormalised(T))


def _read_image(file: Path) -> NDArray[np.uint8]:
    pixels = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB)
    if pixels is None:
        raise KittiError(f"cannot decode {file} as a colour image")
    return np.asarray(pixels, np.uint8)


def _files(folder: Path, places: tuple[str, ...], suffix: str) -> list[Path]:
    for place in places:
        found = sorted((folder / place).glob(f"*{suffix}"))
        if found:
            return found
    raise KittiError(f"no {suffix} files in {' or '.join(str(folder / place) for place in places)}")


def _calibration_files(folder: Path) -> tuple[Path, ...]:
    for home in (folder, folder.parent):
        for names in _CALIBRATIONS:
            if all((home / name).is_file() for name in names):
                return tuple(home / name for name in names)
    wanted = " or ".join(" with ".join(names) for names in _CALIBRATIONS)
    raise KittiError(f"no calibration in {folder} or the folder above: {wanted}")


def _stamps(file: Path, names: list[str]) -> dict[str, int]:
    """Returns the stamp of every scan, ns since the epoch; nothing where there is no such file."""
    if not file.is_file():
        return {}
    lines = [line.strip() for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
    if len(lines) != len(names):
        raise KittiError(f"{file} has {len(lines)} lines for {len(names)} scans")
    stamps = []
    for number, line in enumerate(lines, start=1):
        try:
            whole, _, part = line.partition(".")
            moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
            stamps.append(int(moment.timestamp()) * 10**9 + int((part or "0").ljust(9, "0")[:9]))
        except ValueError:
            raise KittiError(f"{file}, line {number}: {line!r} is no date and time") from None
        if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
            raise KittiError(f"{file}, line {number}: the time is not later than that of the line before")
    return dict(zip(names, stamps, strict=True))
