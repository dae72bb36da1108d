"""KITTI raw drives, camera, LiDAR and inertial navigation, as a source."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo, Image, Imu, Message, NavSatFix, Odometry, PointCloud, Transforms
from dataflow.messages.geometry import invert
from dataflow.operator import Out, Param, Source, SourceError
from operators.geometry.se3 import orthonormalised
from operators.passed_over import PassedOver
from operators.sources.kitti_files import Numbers, calibration_files, files_in, read_stamps
from operators.sources.kitti_oxts import messages_of, read_packet

Array = NDArray[np.float64]

_IMAGES = ("image_02", "image_02/data")
_SCANS = ("velodyne", "velodyne_points/data")
_PACKETS = "oxts/data"
_IMU = "calib_imu_to_velo.txt"


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
    gave them: not deskewed, and the files do not say when each point was measured. A frame that lacks image or
    scan, or whose files cannot be read, is passed over with a warning.

    Where there is an `oxts` folder, each of its packets gives `imu`, `fix` and `odometry` at its own time of
    `oxts/timestamps.txt`, else at that of the frame of its number: those from the first to the last frame read,
    whatever the stride. The odometry's frame has its origin at the drive's first packet, x east, y north, z up, on a
    plane that touches the ellipsoid (KITTI's own poses take a Mercator projection). Geiger et al., "Vision meets
    robotics: the KITTI dataset", 2013.
    """

    points: Out[PointCloud] = Out(doc="one turn of the Velodyne, with intensities 0 to 1")
    image: Out[Image] = Out(doc="left colour camera, rectified")
    image_info: Out[CameraInfo] = Out(static=True, doc="calibration of the rectified camera")
    extrinsics: Out[Transforms] = Out(static=True, doc="the camera in the Velodyne's frame")
    imu: Out[Imu] = Out(doc="angular velocity, specific force, and the orientation to east, north and up")
    fix: Out[NavSatFix] = Out(doc="position; the covariance is the file's accuracy, which is of north and east")
    odometry: Out[Odometry] = Out(doc="pose of the inertial unit since the first packet, and its velocity")
    imu_extrinsics: Out[Transforms] = Out(
        static=True, doc="the Velodyne in the inertial unit's frame, where it is known"
    )

    path: str = Param(doc="the folder")
    rate: float = Param(10.0, gt=0, doc="frames a second where the folder has no timestamps", unit="Hz")
    first_stamp: int = Param(0, ge=0, doc="stamp of frame 0 where the folder has no timestamps", unit="ns")
    start: int = Param(0, ge=0, doc="first frame read")
    stop: int | None = Param(None, ge=1, doc="frame to stop before; none reads to the end")
    stride: int = Param(1, ge=1, doc="read every stride-th frame")
    strict: bool = Param(False, doc="what cannot be read is an error, instead of being passed over and counted")
    lidar_frame: str = Param("velodyne", min_length=1, doc="frame of the scans")
    image_frame: str = Param("camera_optical", min_length=1, doc="optical frame of the camera")
    imu_frame: str = Param("imu", min_length=1, doc="frame of the inertial unit: x front, y left, z up")
    odometry_frame: str = Param("odom", min_length=1, doc="frame of the odometry")

    def setup(self) -> None:
        """Raises SourceError for a folder or calibration that cannot be used."""
        folder = Path(self.path).expanduser()
        images = {file.stem: file for file in files_in(folder, _IMAGES, ".png")}
        scans = {file.stem: file for file in files_in(folder, _SCANS, ".bin")}
        both = sorted(images.keys() & scans.keys())
        self._passed = PassedOver(self.log, strict=self.strict)
        for name in sorted(images.keys() ^ scans.keys()):
            self._passed.take(SourceError(f"frame {name} has no {'scan' if name in images else 'image'}"))
        stamps = read_stamps(folder / "velodyne_points" / "timestamps.txt", sorted(scans), "scans")
        chosen = list(enumerate(both))[self.start : self.stop : self.stride]
        if not chosen:
            raise SourceError(
                f"{folder} has {len(both)} frames with image and scan: start={self.start}, stop={self.stop}, "
                f"stride={self.stride} leaves none"
            )
        period = 1e9 / self.rate
        times = {n: stamps[n] if stamps else self.first_stamp + round(k * period) for k, n in enumerate(both)}
        self._frames = {times[name]: (images[name], scans[name]) for _, name in chosen}
        self._packets = self._chosen_packets(folder, times)
        files = calibration_files(folder)
        self._calibration = read_calibration(*(self.use_file(file) for file in files))
        images_read = (image for image, _ in self._frames.values())
        self._size = self._passed.first(images_read, _read_image).shape[:2]
        mounting = next((h / _IMU for h in (folder, folder.parent) if (h / _IMU).is_file()), None)
        self._mounting = None if mounting is None else read_mounting(self.use_file(mounting))

    def _chosen_packets(self, folder: Path, times: Mapping[str, int]) -> dict[int, Path]:
        """The packets by stamp, from the first to the last frame; those before and after, where all frames are read."""
        files = {file.stem: file for file in sorted((folder / _PACKETS).glob("*.txt"))}
        if not files:
            return {}
        own = read_stamps(folder / "oxts" / "timestamps.txt", sorted(files), "packets")
        stamped = {(own or times)[name]: file for name, file in files.items() if name in (own or times)}
        first = read_packet(next(iter(files.values())))
        self._origin = (first.lat, first.lon, first.alt)
        begin, end = min(self._frames), max(self._frames)
        return {
            stamp: file
            for stamp, file in stamped.items()
            if (stamp >= begin or not self.start) and (stamp <= end or self.stop is None)
        }

    def static_outputs(self) -> Mapping[str, Message]:
        stamp, K = min(self._frames), self._calibration.K
        height, width = self._size
        made: dict[str, Message] = {
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
        if self._packets and self._mounting is not None:
            made["imu_extrinsics"] = Transforms.from_matrix(
                invert(self._mounting), stamp=stamp, frame=self.imu_frame, child_frame=self.lidar_frame
            )
        return made

    def stream(self) -> Iterator[Mapping[str, Message]]:
        """Raises SourceError that names a file that cannot be read, where it is strict."""
        for stamp in sorted(self._frames.keys() | self._packets.keys()):
            messages: dict[str, Message] = {}
            for read in (self._frame, self._packet):
                try:
                    messages |= read(stamp)
                except SourceError as error:
                    self._passed.take(error)
            if messages:
                yield messages

    def _packet(self, stamp: int) -> Mapping[str, Message]:
        if stamp not in self._packets:
            return {}
        packet = read_packet(self._packets[stamp])
        return messages_of(packet, stamp, origin=self._origin, frame=self.imu_frame, odometry_frame=self.odometry_frame)

    def _frame(self, stamp: int) -> Mapping[str, Message]:
        if stamp not in self._frames:
            return {}
        image_file, scan_file = self._frames[stamp]
        image, scan = _read_image(image_file), read_scan(scan_file)
        if image.shape[:2] != self._size:
            raise SourceError(f"{image_file} has another size than the first image: {image.shape[:2]}, {self._size}")
        return {
            "points": PointCloud(
                stamp=stamp,
                frame=self.lidar_frame,
                points=np.ascontiguousarray(scan[:, :3]),
                intensities=np.ascontiguousarray(scan[:, 3]),
            ),
            "image": Image(stamp=stamp, frame=self.image_frame, data=image),
        }

    def length(self) -> int | None:
        return len(self._frames.keys() | self._packets.keys()) if hasattr(self, "_packets") else None

    def summary(self) -> Mapping[str, int]:
        return {"passed_over": self._passed.number}


def read_scan(file: Path) -> NDArray[np.float32]:
    """Reads x, y, z, reflectance (N, 4) of a Velodyne file. Raises SourceError."""
    try:
        content = file.read_bytes()
    except OSError as error:
        raise SourceError(f"{file}: {error}") from None
    if len(content) % 16:
        raise SourceError(f"{file} has {len(content)} bytes; 16 a point expected (x, y, z, reflectance as float32)")
    return np.frombuffer(content, "<f4").reshape(-1, 4).astype(np.float32)


def read_mounting(file: Path) -> Array:
    """Reads `calib_imu_to_velo.txt`: T_velodyne_imu (4, 4). Raises SourceError."""
    numbers, T = Numbers(file), np.eye(4)
    T[:3, :3] = numbers.of(9, "R").reshape(3, 3)
    T[:3, 3] = numbers.of(3, "T")
    return orthonormalised(T)


def read_calibration(*files: Path) -> Calibration:
    """Reads KITTI calibration files, taken together: lines of a key, a colon and numbers. Raises SourceError."""
    numbers, named = Numbers(*files), ", ".join(file.name for file in files)
    P = numbers.of(12, "P_rect_02").reshape(3, 4)
    if P[0, 0] <= 0 or P[1, 1] <= 0:
        raise SourceError(f"{named}: P_rect_02 has focal lengths {P[0, 0]} and {P[1, 1]}")
    T = np.eye(4)
    T[:3, :3] = numbers.of(9, "R_velo_to_cam", "R").reshape(3, 3)
    T[:3, 3] = numbers.of(3, "T_velo_to_cam", "T")
    R = np.eye(4)
    R[:3, :3] = numbers.of(9, "R_rect_00").reshape(3, 3)
    T = R @ T
    T[:3, 3] += np.linalg.solve(P[:, :3], P[:, 3])  # the colour camera beside the reference camera
    return Calibration(P[:, :3].copy(), orthonormalised(T))


def _read_image(file: Path) -> NDArray[np.uint8]:
    pixels = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB)
    if pixels is None:
        raise SourceError(f"cannot decode {file} as a colour image")
    return np.asarray(pixels, np.uint8)
