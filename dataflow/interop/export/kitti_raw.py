"""KITTI raw: a synchronised drive with the left colour camera, a LiDAR and inertial navigation, and the calibration.

Geiger et al., "Vision meets robotics: the KITTI dataset", 2013.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from dataflow.interop.export.frames import (
    IMAGES,
    PAIR_WITHIN,
    calibration,
    messages_as,
    optional,
    write_png,
    write_text,
)
from dataflow.interop.export.kitti_oxts import write_oxts
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource
from dataflow.messages import Image, PointCloud, Transforms
from dataflow.messages.geometry import invert, transform_matrix
from dataflow.recording.errors import RecordingError

SECOND = 1_000_000_000


def export_kitti_raw(source: ExportSource, folder: Path, done: Exported) -> None:
    """Writes `DATE/DATE_drive_0001_sync/` with image_02, velodyne_points, oxts, their timestamps, and the calibration.

    A frame is a scan and the image nearest to it, within 20 ms; scans alone are a drive without images. Reflectance is
    the cloud's intensity; 0 where it has none. The pose of the camera in the LiDAR's frame comes from a stream of
    transforms between the two frames; of `oxts`, see `write_oxts`. Raises `RecordingError` where there are no scans.
    """
    scans = source.only("KITTI raw", PointCloud)
    camera = optional(source, *IMAGES)
    stamps = {m.stamp for m in source.messages([camera])} if camera is not None else set()
    first = next((m.stamp for m in source.messages([scans])), 0)
    date = datetime.fromtimestamp(first // SECOND, UTC).strftime("%Y_%m_%d")
    drive = folder / date / f"{date}_drive_0001_sync"
    kept: list[tuple[int, int | None]] = []
    lidar = ""
    for message in messages_as(source, scans, PointCloud, done):
        near = min(stamps, key=lambda s: abs(s - message.stamp), default=None)
        if camera is not None and (near is None or abs(near - message.stamp) > PAIR_WITHIN):
            done.lose(source.names[scans], "scans without an image within 20 ms, left out")
            continue
        for field in ("colors", "rings", "time_offsets", "normals", "columns"):
            if getattr(message, field) is not None:
                done.lose(source.names[scans], field)
        if message.precise is not None:
            done.narrow(source.names[scans], "points of 64 bits, and KITTI has 32")
        intensities = np.zeros(message.count, np.float32) if message.intensities is None else message.intensities
        seen = np.isfinite(message.points).all(axis=1)
        if not seen.all():
            done.lose(source.names[scans], "points without a return, left out")
        rows = np.column_stack([message.points, intensities]).astype("<f4")[seen]
        path = drive / "velodyne_points" / "data" / f"{len(kept):010d}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(rows.tobytes())
        lidar = message.frame
        kept.append((message.stamp, near))
    if not kept:
        raise RecordingError(f"{source.path}: no scan has an image within 20 ms")
    write_text(drive / "velodyne_points" / "timestamps.txt", _times([scan for scan, _ in kept]), done)
    unit = write_oxts(source, [scan for scan, _ in kept], drive, _times, done)
    if unit is not None:
        _mounting(source, folder / date, lidar, unit, done)
    if camera is None:
        return
    frame = _images(source, camera, [near for _, near in kept if near is not None], drive / "image_02", done)
    _calibration(source, folder / date, frame, lidar, done)


def _images(source: ExportSource, camera: str, wanted: list[int], folder: Path, done: Exported) -> str:
    """Writes the images of some stamps; the frame that they are in."""
    places: dict[int, list[int]] = {}
    for number, stamp in enumerate(wanted):
        places.setdefault(stamp, []).append(number)
    frame = ""
    for message in messages_as(source, camera, Image, done):
        for number in places.get(message.stamp, ()):
            write_png(folder / "data" / f"{number:010d}.png", message)
        frame = message.frame
    write_text(folder / "timestamps.txt", _times(wanted), done)
    return frame


def _calibration(source: ExportSource, folder: Path, camera: str, lidar: str, done: Exported) -> None:
    """Writes calib_cam_to_cam.txt and calib_velo_to_cam.txt, as far as the recording holds calibration."""
    info = calibration(source, camera, done)
    if info is None:
        done.left_out["calib_cam_to_cam.txt"] = f"no calibration has the frame of the images, {camera!r}"
    else:
        P = np.hstack([info.K, np.zeros((3, 1))]) if info.P is None else info.P
        R = np.eye(3) if info.R is None else info.R
        lines = {"S_rect_02": [info.width, info.height], "R_rect_00": R.ravel(), "P_rect_02": P.ravel()}
        write_text(folder / "calib_cam_to_cam.txt", _lines(lines), done)
    T = _between(source, lidar, camera, done)
    if T is None:
        done.left_out["calib_velo_to_cam.txt"] = f"no transform between {lidar!r} and {camera!r}"
    else:
        T_camera_lidar = invert(T)
        lines = {"R": T_camera_lidar[:3, :3].ravel(), "T": T_camera_lidar[:3, 3]}
        write_text(folder / "calib_velo_to_cam.txt", _lines(lines), done)


def _mounting(source: ExportSource, folder: Path, lidar: str, unit: str, done: Exported) -> None:
    """Writes calib_imu_to_velo.txt, if a transform gives it."""
    T = _between(source, lidar, unit, done)
    if T is None:
        done.left_out["calib_imu_to_velo.txt"] = f"no transform between {lidar!r} and {unit!r}"
    else:
        write_text(folder / "calib_imu_to_velo.txt", _lines({"R": T[:3, :3].ravel(), "T": T[:3, 3]}), done)


def _between(source: ExportSource, parent: str, child: str, done: Exported) -> np.ndarray | None:
    """Returns T_parent_child (4, 4) from the first transform between the two frames, either way round; None without."""
    for name in source.of_type(Transforms):
        for recorded in source.messages([name]):
            message = recorded.message
            assert isinstance(message, Transforms)
            for k, pair in enumerate(zip(message.frames, message.child_frames, strict=True)):
                T = transform_matrix(message.translations[k], message.rotations[k])
                if pair in ((parent, child), (child, parent)):
                    done.count(source.names[name])
                    return T if pair == (parent, child) else invert(T)
    return None


def _lines(values: dict[str, object]) -> str:
    return "".join(f"{key}: {' '.join(f'{v:.12e}' for v in np.asarray(row))}\n" for key, row in values.items())


def _times(stamps: list[int]) -> str:
    moments = ((datetime.fromtimestamp(s // SECOND, UTC), s % SECOND) for s in stamps)
    return "".join(f"{moment:%Y-%m-%d %H:%M:%S}.{rest:09d}\n" for moment, rest in moments)
