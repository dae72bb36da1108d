"""Folders as datasets have them: TUM RGB-D, 7-Scenes, EuRoC, KITTI odometry and raw."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.interop.export.frames import (
    DEPTHS,
    IMAGES,
    POSES,
    as_kind,
    calibration,
    frame_of,
    messages_as,
    optional,
    together,
    write_depth,
    write_png,
    write_rows,
    write_text,
)
from dataflow.interop.export.kitti_raw import export_kitti_raw
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource
from dataflow.messages import CameraInfo, DepthImage, Image, Imu, Message, Pose
from dataflow.messages.geometry import transform_matrix
from dataflow.recording.errors import RecordingError

TUM_UNITS, SCENES_UNITS = 5000.0, 1000.0


def export_tum(source: ExportSource, folder: Path, done: Exported) -> None:
    """Writes rgb/, depth/ (5000 units a metre), rgb.txt, depth.txt and groundtruth.txt, as far as there are streams.

    Without images it is a trajectory alone. Poses are those of `frame` to `child_frame` as they are recorded.
    """
    lists = {"rgb.txt": optional(source, *IMAGES), "depth.txt": optional(source, *DEPTHS)}
    poses = optional(source, *POSES)
    if poses is None and not any(lists.values()):
        raise RecordingError(f"{source.path}: TUM RGB-D takes images, depth or poses; there are none")
    rows: dict[str, list[str]] = {"rgb.txt": [], "depth.txt": [], "groundtruth.txt": []}
    for name, kind, units in (("rgb.txt", Image, None), ("depth.txt", DepthImage, TUM_UNITS)):
        stream = lists[name]
        for message in messages_as(source, stream, kind, done):
            place = f"{name[:-4]}/{_seconds(message.stamp)}.png"
            if units is None:
                write_png(folder / place, message)
            else:
                write_depth(folder / place, message, units, source.names[stream or ""], done)
            rows[name].append(f"{_seconds(message.stamp)} {place}")
    for message in messages_as(source, poses, Pose, done):
        assert isinstance(message, Pose)
        values = [*message.position.tolist(), *message.orientation.tolist()]
        rows["groundtruth.txt"].append(" ".join([_seconds(message.stamp), *map(repr, values)]))
    for name, found in rows.items():
        if found:
            head = "# timestamp tx ty tz qx qy qz qw\n" if name == "groundtruth.txt" else "# timestamp filename\n"
            write_text(folder / name, head + "\n".join(found) + "\n", done)
    _intrinsics(source, folder, done)


def export_7scenes(source: ExportSource, folder: Path, done: Exported) -> None:
    """Writes frame-NNNNNN.color.png, .depth.png (millimetres) and .pose.txt, and camera-intrinsics.txt."""
    images, depths = (source.only("7-Scenes", *kinds) for kinds in (IMAGES, DEPTHS))
    poses = optional(source, *POSES)
    others: dict[str, type[Message]] = {images: Image} if poses is None else {images: Image, poses: Pose}
    used: dict[str, set[int]] = {stream: set() for stream in others}
    count = 0
    for recorded, found in together(source, depths, others, done):
        depth = as_kind(source, recorded, DepthImage, done)
        if found[images] is None:
            done.lose(source.names[depths], "depth without an image within 20 ms, left out")
            continue
        stem = f"frame-{count:06d}"
        write_png(folder / f"{stem}.color.png", found[images])
        write_depth(folder / f"{stem}.depth.png", depth, SCENES_UNITS, source.names[depths], done)
        pose = None if poses is None else found[poses]
        if pose is not None:
            rows = transform_matrix(pose.position, pose.orientation)
            write_text(folder / f"{stem}.pose.txt", _matrix_text(rows), None)
        for stream, message in found.items():
            used[stream] |= set() if message is None else {message.stamp}
        count += 1
    if not count:
        raise RecordingError(f"{source.path}: no image lies within 20 ms of a depth image")
    for stream, stamps in used.items():
        if left := done.written.get(source.names[stream], 0) - len(stamps):
            what = "image" if stream == images else "pose"
            done.lose(source.names[stream], f"{what} of which no frame was made, left out", left)
    done.lose(source.names[depths], "the times of frames, which their numbers stand for", count)
    done.files.append(str(folder))
    _intrinsics(source, folder, done)


def export_euroc(source: ExportSource, folder: Path, done: Exported) -> None:
    """Writes mav0/imu0/data.csv, mav0/cam<k>/ for every stream of images, mav0/state_groundtruth_estimate0/data.csv."""
    root = folder / "mav0"
    for k, stream in enumerate(source.of_type(Imu)):
        head = "#timestamp [ns],w_x [rad s^-1],w_y [rad s^-1],w_z [rad s^-1],a_x [m s^-2],a_y [m s^-2],a_z [m s^-2]"
        rows = (
            [str(m.stamp), *map(repr, [*m.angular_velocity.tolist(), *m.linear_acceleration.tolist()])]
            for m in messages_as(source, stream, Imu, done)
            if isinstance(m, Imu)
        )
        write_rows(root / f"imu{k}" / "data.csv", head, rows, done)
    for k, stream in enumerate(source.of_type(*IMAGES)):
        names = []
        for message in messages_as(source, stream, Image, done):
            write_png(root / f"cam{k}" / "data" / f"{message.stamp}.png", message)
            names.append([str(message.stamp), f"{message.stamp}.png"])
        write_rows(root / f"cam{k}" / "data.csv", "#timestamp [ns],filename", iter(names), done)
    truth = optional(source, *POSES)
    if truth is not None:
        head = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
        states = (
            [str(m.stamp), *map(repr, [*m.position.tolist(), float(m.orientation[3]), *m.orientation[:3].tolist()])]
            for m in messages_as(source, truth, Pose, done)
            if isinstance(m, Pose)
        )
        write_rows(root / "state_groundtruth_estimate0" / "data.csv", head, states, done)
    if not done.files:
        raise RecordingError(f"{source.path}: EuRoC takes IMU readings, images or poses; there are none")


def export_kitti(source: ExportSource, folder: Path, done: Exported) -> None:
    """Writes image_0/ (and image_1/ for a second camera), times.txt, calib.txt and poses.txt, as KITTI odometry.

    The first camera's frames count, which have one of the second camera of their stamp. Times begin at 0.
    """
    cameras = source.of_type(*IMAGES)[:2]
    if not cameras:
        raise RecordingError(f"{source.path}: KITTI odometry takes images; there are none")
    stamps = _write_pairs(source, cameras, folder, done)
    if not stamps:
        raise RecordingError(f"{source.path}: no image of the one camera has the stamp of one of the other")
    write_text(folder / "times.txt", "".join(f"{(s - stamps[0]) * 1e-9:e}\n" for s in stamps), done)
    lines = []
    names, frames = source.of_type(CameraInfo), [frame_of(source, camera) for camera in cameras]
    in_order = len(set(frames)) < len(cameras) == len(names)  # a rectified pair has one frame
    for k, camera in enumerate(cameras):
        among = [names[k]] if in_order else names
        info = calibration(source, frames[k], done, among=among, alone=in_order or len(cameras) == 1)
        if info is None:
            done.left_out[f"P{k} of calib.txt"] = f"no calibration has the frame of {source.names[camera]}"
            continue
        P = np.hstack([info.K, np.zeros((3, 1))]) if info.P is None else info.P
        lines.append(f"P{k}: " + " ".join(f"{v:.12e}" for v in P.ravel()))
    if lines:
        write_text(folder / "calib.txt", "\n".join(lines) + "\n", done)
    poses = optional(source, *POSES)
    if poses is not None:
        _write_poses(source, cameras[0], poses, set(stamps), folder, done)


def _write_pairs(source: ExportSource, cameras: Sequence[str], folder: Path, done: Exported) -> list[int]:
    """Writes the images of one camera, or those of two that have one stamp; the stamps."""
    stamps: list[int] = []
    waiting: dict[str, Any] = {}
    for recorded in source.messages(cameras):
        if waiting and next(iter(waiting.values())).stamp != recorded.message.stamp:
            _lose_unpaired(source, waiting, done)
        waiting[recorded.stream] = as_kind(source, recorded, Image, done)
        if len(waiting) == len(cameras):
            for k, stream in enumerate(cameras):
                write_png(folder / f"image_{k}" / f"{len(stamps):06d}.png", waiting[stream])
            stamps.append(recorded.message.stamp)
            waiting.clear()
    _lose_unpaired(source, waiting, done)
    return stamps


def _lose_unpaired(source: ExportSource, waiting: dict[str, Any], done: Exported) -> None:
    for stream in waiting:
        done.lose(source.names[stream], "an image without one of the other camera of its stamp, left out")
    waiting.clear()


def _write_poses(
    source: ExportSource, camera: str, poses: str, stamps: Container[int], folder: Path, done: Exported
) -> None:
    """Writes the pose of each image, the nearest within 20 ms; none where some image has none."""
    paired = together(source, camera, {poses: Pose}, done)
    found = [near[poses] for image, near in paired if image.message.stamp in stamps]
    if any(pose is None for pose in found):
        done.left_out["poses.txt"] = "some images have no pose within 20 ms"
        return
    rows = [transform_matrix(pose.position, pose.orientation)[:3].ravel() for pose in found if pose is not None]
    write_text(folder / "poses.txt", _matrix_text(rows), done)


def tell_untaken(source: ExportSource, what: str, done: Exported) -> None:
    """Reports which streams and topics a dataset has no place for."""
    for name, outside in source.names.items():
        if outside not in done.written and outside not in done.left_out:
            kind = source.streams[name].message_type
            done.left_out[outside] = f"{what} has no place for {kind.SCHEMA if kind else 'it'}"
    for topic in source.untouched:
        done.left_out.setdefault(
            topic.name, f"{what} has no place for {topic.schema.name or 'messages without schema'}"
        )


DATASETS: dict[str, Callable[[ExportSource, Path, Exported], None]] = {
    "tum": export_tum,
    "7scenes": export_7scenes,
    "euroc": export_euroc,
    "kitti": export_kitti,
    "kitti-raw": export_kitti_raw,
}


def _seconds(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


def _matrix_text(rows: Any) -> str:
    return "".join(" ".join(f"{v:.9e}" for v in row) + "\n" for row in rows)


def _intrinsics(source: ExportSource, folder: Path, done: Exported) -> None:
    """The calibration of the depth camera (the one whose frame depth images have), or of the only one."""
    depths = source.of_type(*DEPTHS)
    info = calibration(source, frame_of(source, depths[0]) if depths else "", done, alone=True)
    if info is not None:
        write_text(folder / "camera-intrinsics.txt", _matrix_text(info.K), done)
    elif source.of_type(CameraInfo):
        done.left_out["camera-intrinsics.txt"] = "no calibration has the frame of the depth images"
