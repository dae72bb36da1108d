"""The robot's sensors in a world: what each measures at a time, as messages by port."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from dataflow.messages import CameraInfo, CompressedDepth, CompressedImage, DepthImage, Image, Message, Pose, Transforms
from operators.simulator import settings, truth
from operators.simulator.rendering.optics import Optics
from operators.simulator.sensors import color, depth, gnss, inertial, landmarks, lidar, magnetic, radar, wheels
from operators.simulator.sensors.color import NoisePool
from operators.simulator.sensors.frames import BODY_TO_OPTICAL, Array, displaced_optical, mounted
from operators.simulator.sensors.schedule import Tick
from operators.simulator.stage import Stage

Messages = dict[str, Message]
Rng = np.random.Generator


@dataclass(frozen=True)
class FrameNames:
    """Of the frames whose names are chosen by parameters."""

    world: str
    odometry: str
    base: str
    image: str
    depth: str


class Rig:
    """Sensors with their calibration as it is published. Their settings at a time come with every measurement."""

    def __init__(
        self, stage: Stage, seed: int, frames: FrameNames, sensors: settings.Sensors, true: settings.Truth
    ) -> None:
        self.stage, self.frames, self._seed, self._sensors, self._true = stage, frames, seed, sensors, true
        camera, depth_camera, pair = sensors.color_camera, sensors.depth_camera, sensors.stereo
        self._pool = NoisePool(seed)
        self._color_optics = _optics(camera.width, camera.height, camera.focal)
        self._depth_optics = _optics(
            depth_camera.width or camera.width, depth_camera.height or camera.height, depth_camera.focal or camera.focal
        )
        self._stereo_optics = _optics(pair.width, pair.height, pair.focal)
        mount: settings.Mount = camera.mount or stage.world.camera_mount
        self.T_base_color = mounted(mount) @ BODY_TO_OPTICAL
        self.T_base_depth = self.T_base_color @ mounted((*depth_camera.offset, *depth_camera.rotation))
        self.T_base_left = mounted(pair.mount) @ BODY_TO_OPTICAL if pair.mount else self.T_base_color
        self._wheel_model = wheels.WheelModel(sensors.wheels, seed)
        single: dict[str, tuple[str, str, Callable[..., Message | None]]] = {
            "lidar": ("points", "lidar", lidar.sweep),
            "inertial": ("imu", "imu", inertial.ImuModel(sensors.inertial).measure),
            "magnetometer": ("magnetic_field", "magnetometer", magnetic.MagneticModel(seed).measure),
            "radar": ("radar_scan", "radar", radar.scan),
            "landmarks": ("sightings", sensors.landmarks.frame, landmarks.sightings),
            "gnss": ("fix", "gnss", gnss.GnssModel(sensors.gnss, seed).measure),
        }
        self.measures: dict[str, Callable[..., Messages]] = {
            "color_camera": self.color,
            "depth_camera": self.depth,
            "stereo": self.stereo,
            "wheels": self.wheels,
            **{name: partial(self._single, *how) for name, how in single.items()},
        }
        """Measurements by the parameter of their sensor: (settings, seconds, tick, random numbers) → messages."""

    def color(self, camera: settings.ColorCamera, t: float, tick: Tick, rng: Rng) -> Messages:
        T_base_camera = displaced_optical(self.T_base_color, camera.mount_error)
        view = self.stage.view(t, T_base_camera, self._color_optics, color=True)
        assert view.color is not None
        light = color.blur(view.color, self._smear(t, camera, T_base_camera)) if camera.shutter else view.color
        gain = camera.exposure * color.drifting_gain(t, camera.exposure_change, self._seed)
        dark = rng.random() < camera.black
        exposed = color.expose(light, 0.0 if dark else gain)
        pixels = color.develop(exposed, self._pool, rng, camera.read_noise, camera.shot_noise)
        messages: Messages = {}
        if camera.output != "jpeg":
            messages["image"] = Image(stamp=tick.stamp, frame=self.frames.image, data=pixels)
        if camera.output != "raw":
            messages["image_jpeg"] = CompressedImage(
                stamp=tick.stamp, frame=self.frames.image, format="jpeg", data=color.jpeg(pixels, camera.jpeg_quality)
            )
        if self._true.boxes:
            messages["objects"], messages["boxes"] = truth.detections(
                view,
                self.stage.at(t),
                self.stage.T_world_base(t) @ T_base_camera,
                self._color_optics,
                t,
                min_pixels=self._true.min_pixels,
                shares=self._true.visible_share,
                stamp=tick.stamp,
                camera_frame=self.frames.image,
                world_frame=self.frames.world,
            )
        if self._true.masks:
            messages["masks"] = truth.masks(view, tick.stamp, self.frames.image)
        return messages

    def _smear(self, t: float, camera: settings.ColorCamera, T_base_camera: Array) -> tuple[float, float]:
        """Returns how far the image moves while the shutter is open, in pixels: by the robot's turning alone."""
        omega = T_base_camera[:3, :3].T @ self.stage.drive.state(t).angular
        focal, seconds = self._color_optics.fx, camera.shutter * 1e-9
        return -focal * omega[1] * seconds, focal * omega[0] * seconds

    def depth(self, camera: settings.DepthCamera, t: float, tick: Tick, rng: Rng) -> Messages:
        T_base_camera = displaced_optical(self.T_base_depth, camera.mount_error)
        view = self.stage.view(t, T_base_camera, self._depth_optics, color=False)
        levels = depth.measure(view, camera, self._pool, rng)
        if rng.random() < camera.black:
            levels = np.zeros_like(levels)
        messages: Messages = {}
        if camera.output != "png":
            data = depth.metres(levels, camera.quantum)
            messages["depth"] = DepthImage(stamp=tick.stamp, frame=self.frames.depth, data=data)
        if camera.output != "raw":
            messages["depth_png"] = CompressedDepth(
                stamp=tick.stamp,
                frame=self.frames.depth,
                quantizer="inverse",
                scale=1 / camera.quantum,
                offset=0.0,
                data=depth.png(levels),
            )
        return messages

    def stereo(self, pair: settings.StereoRig, t: float, tick: Tick, rng: Rng) -> Messages:
        messages: Messages = {}
        dark = rng.random() < pair.black
        left = displaced_optical(self.T_base_left, pair.mount_error)
        for port, T in (("left", left), ("right", left @ _shift(pair.baseline, 0, 0))):
            view = self.stage.view(t, T, self._stereo_optics, color=True)
            assert view.color is not None
            light = color.expose(view.color if pair.color else color.grey(view.color), 0.0 if dark else pair.exposure)
            pixels = color.develop(light, self._pool, rng, pair.read_noise, pair.shot_noise)
            messages[port] = Image(stamp=tick.stamp, frame=f"stereo_{port}_optical", data=pixels)
        return messages

    def _single(
        self, port: str, frame: str, measure: Callable[..., Message | None],
        sensor: settings.Sensor, t: float, tick: Tick, rng: Rng,
    ) -> Messages:  # fmt: skip
        """The one message of a sensor, or none."""
        message = measure(self.stage, sensor, t, rng, tick.stamp, frame)
        return {} if message is None else {port: message}

    def wheels(self, driven: settings.Wheels, t: float, tick: Tick, rng: Rng) -> Messages:
        counts, odometry = self._wheel_model.measure(
            driven, self.stage.world.path, t, rng, tick.stamp, self.frames.odometry, self.frames.base
        )
        return {"wheel_ticks": counts, "wheel_odometry": odometry}

    def poses(self, depth_camera: settings.DepthCamera, t: float, tick: Tick) -> Messages:
        """The true ones of the base and of the depth camera, where that really is."""
        T_base_depth = displaced_optical(self.T_base_depth, depth_camera.mount_error)
        return {
            "ground_truth": Pose.from_matrix(
                self.stage.T_world_base(t) @ T_base_depth,
                stamp=tick.stamp,
                frame=self.frames.world,
                child_frame=self.frames.depth,
            ),
            "true_base": truth.base_state(self.stage.drive, t, tick.stamp, self.frames.world, self.frames.base),
        }

    def calibrations(self, stamp: int) -> Messages:
        """Of the cameras that are on, as published."""
        found: Messages = {}
        camera, other, pair = self._sensors.color_camera, self._sensors.depth_camera, self._sensors.stereo
        if camera.rate:
            found["image_info"] = _info(self._color_optics, camera.focal_error, stamp, self.frames.image)
        if other.rate:
            found["depth_info"] = _info(self._depth_optics, other.focal_error, stamp, self.frames.depth)
        if pair.rate:
            for port, baseline in (("left", 0.0), ("right", pair.baseline)):
                found[f"{port}_info"] = _info(
                    self._stereo_optics, pair.focal_error, stamp, f"stereo_{port}_optical", baseline
                )
        return found

    def extrinsics(self, stamp: int) -> Transforms:
        """Fixed transforms of the sensors that are on, as published."""
        base, frames, sensors = self.frames.base, self.frames, self._sensors
        placed = []
        if sensors.color_camera.rate or sensors.depth_camera.rate:
            placed.append((base, frames.depth, self.T_base_depth))
            placed.append((frames.depth, frames.image, np.linalg.inv(self.T_base_depth) @ self.T_base_color))
        if sensors.stereo.rate:
            placed.append((base, "stereo_left_optical", self.T_base_left))
            placed.append(("stereo_left_optical", "stereo_right_optical", _shift(sensors.stereo.baseline, 0, 0)))
        placed += [(base, frame, mounted(sensor.mount)) for frame, sensor in sensors.mounted().items() if sensor.rate]
        single = [
            Transforms.from_matrix(T, stamp=stamp, frame=parent, child_frame=child) for parent, child, T in placed
        ]
        return Transforms(
            stamp=stamp,
            frames=tuple(parent for parent, _, _ in placed),
            child_frames=tuple(child for _, child, _ in placed),
            translations=np.array([t.translations[0] for t in single]).reshape(-1, 3),
            rotations=np.array([t.rotations[0] for t in single]).reshape(-1, 4),
        )


def _optics(width: int, height: int, focal: float) -> Optics:
    return Optics(width, height, focal * width, focal * width, (width - 1) / 2, (height - 1) / 2)


def _shift(x: float, y: float, z: float) -> Array:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def _info(optics: Optics, error: float, stamp: int, frame: str, baseline: float | None = None) -> CameraInfo:
    """The calibration of a camera; of a rectified pair where a baseline is given (0 for the left camera)."""
    fx, fy = optics.fx * (1 + error), optics.fy * (1 + error)
    info = CameraInfo.from_intrinsics(
        stamp=stamp, frame=frame, width=optics.width, height=optics.height, fx=fx, fy=fy, cx=optics.cx, cy=optics.cy
    )
    if baseline is None:
        return info
    P = np.hstack([info.K, np.zeros((3, 1))])
    P[0, 3] = -fx * baseline
    return info.replace(P=P)
