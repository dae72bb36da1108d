"""A simulated robot in an indoor world of its own, with every sensor and the truth about everything."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import (
    Activity,
    Boxes3D,
    CameraInfo,
    CompressedDepth,
    CompressedImage,
    DepthImage,
    Detections2D,
    Image,
    Imu,
    LandmarkSightings,
    Message,
    NavSatFix,
    Odometry,
    PointCloud,
    Pose,
    RadarScan,
    SceneGraph,
    SegmentationMap,
    Transforms,
    WheelTicks,
)
from dataflow.operator import Duration, Out, Param, Source
from operators.sources.simulator import color, depth, gnss, inertial, landmarks, lidar, radar, wheels
from operators.sources.simulator.frames import BODY_TO_OPTICAL, mounted
from operators.sources.simulator.noise import NoisePool
from operators.sources.simulator.schedule import Tick, generator, merged, ticks
from operators.sources.simulator.settings import (
    ColorCamera,
    DepthCamera,
    Gnss,
    Inertial,
    Landmarks,
    Lidar,
    Mount,
    Radar,
    Sensor,
    StereoRig,
    Truth,
    Wheels,
)
from operators.sources.simulator.worlds import make_world

if TYPE_CHECKING:
    from operators.sources.simulator.renderer import Optics

Array = NDArray[np.float64]
Messages = dict[str, Message]
Rng = np.random.Generator


class SimulatedRobot(Source):
    """A wheeled robot that drives a closed path through a drawn indoor world among people and things that move.

    Worlds: `office`, `corridor` (a ring that returns to its start) and `table_top`. The same seed and parameters give
    the same bytes, whatever the machine's load, the number of threads or what else is switched on: every measurement
    has random numbers of its own. Sensors other than the cameras are off until they are given a rate.

    Stamps are exact: measurement k of a sensor is at first_stamp + phase + k / rate. A faulty clock (`delay`) shows
    what was so long before the stamp; truth that belongs to an image describes what the image shows.
    """

    image: Out[Image] = Out(doc="colour")
    image_jpeg: Out[CompressedImage] = Out(doc="the same as JPEG")
    image_info: Out[CameraInfo] = Out(static=True, doc="calibration of the colour camera")
    depth: Out[DepthImage] = Out(doc="depth, metres; 0 for no return")
    depth_png: Out[CompressedDepth] = Out(doc="the same as PNG of inverse depth; decodes to the same bits")
    depth_info: Out[CameraInfo] = Out(static=True, doc="calibration of the depth camera")
    left: Out[Image] = Out(doc="left image of the stereo pair")
    right: Out[Image] = Out(doc="right image of the stereo pair")
    left_info: Out[CameraInfo] = Out(static=True, doc="calibration of the left camera")
    right_info: Out[CameraInfo] = Out(static=True, doc="calibration of the right camera; P holds the baseline")
    points: Out[PointCloud] = Out(doc="one turn of the lidar, stamped at its end")
    imu: Out[Imu] = Out(doc="angular velocity and specific force")
    wheel_ticks: Out[WheelTicks] = Out(doc="encoder counts of the left and right wheel")
    wheel_odometry: Out[Odometry] = Out(doc="dead reckoning from the wheels; drifts")
    radar_scan: Out[RadarScan] = Out(doc="radar detections with Doppler velocity")
    sightings: Out[LandmarkSightings] = Out(doc="landmarks by range, bearing and elevation")
    landmark_map: Out[LandmarkSightings] = Out(static=True, doc="where the landmarks are in the world")
    fix: Out[NavSatFix] = Out(doc="position from satellites")
    extrinsics: Out[Transforms] = Out(
        static=True, doc="every sensor on the robot; the colour camera in the depth camera's frame"
    )
    ground_truth: Out[Pose] = Out(doc="T_world_camera of the depth camera's optical frame, exact")
    true_base: Out[Odometry] = Out(doc="pose and velocity of the robot in the world, exact")
    objects: Out[Detections2D] = Out(doc="true boxes of what is visible of the objects, with share and pixel count")
    boxes: Out[Boxes3D] = Out(doc="true oriented boxes of the same objects, in the world")
    masks: Out[SegmentationMap] = Out(doc="true class and instance of every pixel of the colour image")
    activities: Out[Activity] = Out(doc="what every mover does, on what, and the goal it was given")
    scene: Out[SceneGraph] = Out(doc="all objects and their true relations")

    world: Literal["office", "corridor", "table_top"] = Param("office", doc="kind of world")
    seed: int = Param(0, ge=0, doc="of the world, its looks, its movers and all noise")
    duration: Duration = Param("30s", doc="length; stamps lie before first_stamp + duration")
    first_stamp: int = Param(0, ge=0, doc="stamp of the start", unit="ns")
    speed: float = Param(0.5, gt=0.02, le=0.8, doc="of the robot on straights; it slows down in curves", unit="m/s")
    hold: float = Param(0.0, ge=0, doc="time that the robot stands still at first", unit="s")
    movers: bool = Param(True, doc="people, balls and robots move; otherwise there are none")
    threads: int = Param(1, ge=1, le=64, doc="threads that cast rays; results do not depend on it")
    color_camera: ColorCamera = Param(ColorCamera(), doc="the colour camera")
    depth_camera: DepthCamera = Param(DepthCamera(), doc="the depth camera")
    stereo: StereoRig = Param(StereoRig(), doc="the stereo pair")
    lidar: Lidar = Param(Lidar(), doc="the rotating laser scanner")
    inertial: Inertial = Param(Inertial(), doc="the inertial measurement unit")
    wheels: Wheels = Param(Wheels(), doc="encoders and wheel odometry")
    radar: Radar = Param(Radar(), doc="the radar")
    landmarks: Landmarks = Param(Landmarks(), doc="the sensor that recognises landmarks")
    gnss: Gnss = Param(Gnss(), doc="the satellite receiver")
    truth: Truth = Param(Truth(), doc="the truth to emit")
    world_frame: str = Param("world", min_length=1, doc="frame of the truth")
    odometry_frame: str = Param("wheel_odom", min_length=1, doc="frame of the wheel odometry")
    base_frame: str = Param("base_link", min_length=1, doc="frame of the robot: on the floor, x forward")
    image_frame: str = Param("camera_color_optical", min_length=1, doc="optical frame of the colour camera")
    depth_frame: str = Param("camera_depth_optical", min_length=1, doc="optical frame of the depth camera")

    def setup(self) -> None:
        """Builds the world.

        Raises ImportError where a sensor casts rays and Open3D is missing, ValueError for parameters that contradict
        each other.
        """
        from operators.sources.simulator.renderer import Optics
        from operators.sources.simulator.stage import Stage
        from operators.sources.simulator.truth import TrueGraph

        if self.image_frame == self.depth_frame:
            raise ValueError(f"image_frame and depth_frame must differ, both are {self.image_frame!r}")
        world = make_world(self.world, self.seed, speed=self.speed, hold=self.hold, movers=self.movers)
        self._stage = Stage(world, self.seed, threads=self.threads)
        self._pool = NoisePool(self.seed)
        camera, other, rig = self.color_camera, self.depth_camera, self.stereo
        if any(sensor.rate for sensor in (camera, other, rig, self.lidar, self.radar, self.landmarks)):
            self._stage.at(0.0)  # what is slow or fails does so now

        def optics(width: int, height: int, focal: float) -> Optics:
            return Optics(width, height, focal * width, focal * width, (width - 1) / 2, (height - 1) / 2)

        self._color_optics = optics(camera.width, camera.height, camera.focal)
        self._depth_optics = optics(
            other.width or camera.width, other.height or camera.height, other.focal or camera.focal
        )
        self._stereo_optics = optics(rig.width, rig.height, rig.focal)
        mount: Mount = camera.mount or world.camera_mount
        self._T_base_color = mounted(mount) @ BODY_TO_OPTICAL
        self._T_base_depth = self._T_base_color @ mounted((*other.offset, *other.rotation))
        self._T_base_left = mounted(rig.mount) @ BODY_TO_OPTICAL if rig.mount else self._T_base_color
        self._T_base_right = self._T_base_left @ _shift(rig.baseline, 0, 0)
        wants_graph = self.truth.relations > 0
        self._graph = TrueGraph(world, with_spatial=self.truth.spatial) if wants_graph else None

    def static_outputs(self) -> Mapping[str, Message]:
        stamp = self.first_stamp
        statics: Messages = {"extrinsics": self._extrinsics()}
        if self.color_camera.rate:
            statics["image_info"] = _info(self._color_optics, stamp, self.image_frame)
        if self.depth_camera.rate:
            statics["depth_info"] = _info(self._depth_optics, stamp, self.depth_frame)
        if self.stereo.rate:
            statics["left_info"] = _info(self._stereo_optics, stamp, "stereo_left_optical", 0.0)
            statics["right_info"] = _info(self._stereo_optics, stamp, "stereo_right_optical", self.stereo.baseline)
        if self.landmarks.rate:
            points = self._stage.world.landmarks
            statics["landmark_map"] = LandmarkSightings(
                stamp=stamp, frame=self.world_frame, ids=np.arange(len(points)), positions=points
            )
        return statics

    def stream(self) -> Iterator[Mapping[str, Message]]:
        sensors = self._sensors()
        self._imu_model = inertial.ImuModel(self.inertial)
        self._wheel_model = wheels.WheelModel(self.wheels, self.seed)
        self._gnss_model = gnss.GnssModel(self.gnss, self.seed)
        for stamp, together in merged({name: self._ticks(sensor, name) for name, (sensor, _) in sensors.items()}):
            messages: Messages = {}
            for tick in together:
                sensor, measure = sensors[tick.sensor]
                messages |= self._measured(sensor, measure, tick)
            if messages:
                yield {name: messages[name] for name in self.spec.outputs if name in messages}
            assert all(message.stamp == stamp for message in messages.values())

    def length(self) -> int | None:
        """An upper bound: drop-outs may leave a stamp without messages."""
        return sum(1 for _ in merged({name: self._ticks(s, name) for name, (s, _) in self._sensors().items()}))

    def _sensors(self) -> dict[str, tuple[Sensor, Callable[[float, Tick, Rng], Messages]]]:
        truth = self.truth
        return {
            "color": (self.color_camera, self._color),
            "depth": (self.depth_camera, self._depth),
            "stereo": (self.stereo, self._stereo),
            "lidar": (self.lidar, self._lidar),
            "imu": (self.inertial, self._imu),
            "wheels": (self.wheels, self._wheels),
            "radar": (self.radar, self._radar),
            "landmarks": (self.landmarks, self._landmarks),
            "gnss": (self.gnss, self._gnss),
            "poses": (Sensor(rate=truth.poses), self._poses),
            "activities": (Sensor(rate=truth.activities), self._activities),
            "relations": (Sensor(rate=truth.relations), self._relations),
        }

    def _ticks(self, sensor: Sensor, name: str) -> Iterator[Tick]:
        return ticks(name, sensor.rate, self.first_stamp + sensor.phase, self.first_stamp + self.duration)

    def _measured(self, sensor: Sensor, measure: Callable[[float, Tick, Rng], Messages], tick: Tick) -> Messages:
        """Returns what a sensor emits at a tick; truth about an image comes also where the image is missing."""
        rng = generator(self.seed, tick.sensor, tick.index)
        elapsed = (tick.stamp - self.first_stamp) * 1e-9
        missing = rng.random() < sensor.dropout or any(a <= elapsed < b for a, b in sensor.outages)
        messages = measure(max(0.0, elapsed - sensor.delay * 1e-9), tick, rng)
        return {k: m for k, m in messages.items() if k in _TRUTH} if missing else messages

    def _color(self, t: float, tick: Tick, rng: Rng) -> Messages:
        camera = self.color_camera
        view = self._stage.view(t, self._T_base_color, self._color_optics, color=True)
        assert view.color is not None
        light = color.blur(view.color, self._smear(t)) if camera.shutter else view.color
        gain = camera.exposure * color.drifting_gain(t, camera.exposure_change, self.seed)
        dark = rng.random() < camera.black
        exposed = color.expose(light, 0.0 if dark else gain)
        pixels = color.develop(exposed, self._pool, rng, camera.read_noise, camera.shot_noise)
        messages: Messages = {}
        if camera.output != "jpeg":
            messages["image"] = Image(stamp=tick.stamp, frame=self.image_frame, data=pixels)
        if camera.output != "raw":
            messages["image_jpeg"] = CompressedImage(
                stamp=tick.stamp, frame=self.image_frame, format="jpeg", data=color.jpeg(pixels, camera.jpeg_quality)
            )
        return messages | self._image_truth(t, tick.stamp)

    def _image_truth(self, t: float, stamp: int) -> Messages:
        from operators.sources.simulator import truth

        view = self._stage.view(t, self._T_base_color, self._color_optics, color=True)
        messages: Messages = {}
        if self.truth.boxes:
            messages["objects"], messages["boxes"] = truth.detections(
                view,
                self._stage.at(t),
                self._stage.T_world_base(t) @ self._T_base_color,
                self._color_optics,
                t,
                min_pixels=self.truth.min_pixels,
                shares=self.truth.visible_share,
                stamp=stamp,
                camera_frame=self.image_frame,
                world_frame=self.world_frame,
            )
        if self.truth.masks:
            messages["masks"] = truth.masks(view, stamp, self.image_frame)
        return messages

    def _smear(self, t: float) -> tuple[float, float]:
        """Tells how far the image moves while the shutter is open, in pixels: by the robot's turning alone."""
        rate = float(self._stage.world.path.at([t]).yaw_rate[0])
        omega = self._T_base_color[:3, :3].T @ [0, 0, rate]
        focal, seconds = self._color_optics.fx, self.color_camera.shutter * 1e-9
        return -focal * omega[1] * seconds, focal * omega[0] * seconds

    def _depth(self, t: float, tick: Tick, rng: Rng) -> Messages:
        camera = self.depth_camera
        view = self._stage.view(t, self._T_base_depth, self._depth_optics, color=False)
        levels = depth.measure(view, camera, self._pool, rng)
        if rng.random() < camera.black:
            levels = np.zeros_like(levels)
        messages: Messages = {}
        if camera.output != "png":
            data = depth.metres(levels, camera.quantum)
            messages["depth"] = DepthImage(stamp=tick.stamp, frame=self.depth_frame, data=data)
        if camera.output != "raw":
            messages["depth_png"] = CompressedDepth(
                stamp=tick.stamp,
                frame=self.depth_frame,
                quantizer="inverse",
                scale=1 / camera.quantum,
                offset=0.0,
                data=depth.png(levels),
            )
        return messages

    def _stereo(self, t: float, tick: Tick, rng: Rng) -> Messages:
        rig, messages = self.stereo, {}
        dark = rng.random() < rig.black
        for port, T in (("left", self._T_base_left), ("right", self._T_base_right)):
            view = self._stage.view(t, T, self._stereo_optics, color=True)
            assert view.color is not None
            light = color.expose(view.color if rig.color else color.grey(view.color), 0.0 if dark else rig.exposure)
            pixels = color.develop(light, self._pool, rng, rig.read_noise, rig.shot_noise)
            messages[port] = Image(stamp=tick.stamp, frame=f"stereo_{port}_optical", data=pixels)
        return dict(messages)

    def _lidar(self, t: float, tick: Tick, rng: Rng) -> Messages:
        return {"points": lidar.sweep(self._stage, self.lidar, t, rng, tick.stamp, "lidar")}

    def _imu(self, t: float, tick: Tick, rng: Rng) -> Messages:
        return {"imu": self._imu_model.measure(self._stage.world.path, t, rng, tick.stamp, "imu")}

    def _wheels(self, t: float, tick: Tick, rng: Rng) -> Messages:
        counts, odometry = self._wheel_model.measure(
            self._stage.world.path, t, rng, tick.stamp, self.odometry_frame, self.base_frame
        )
        return {"wheel_ticks": counts, "wheel_odometry": odometry}

    def _radar(self, t: float, tick: Tick, rng: Rng) -> Messages:
        return {"radar_scan": radar.scan(self._stage, self.radar, t, rng, tick.stamp, "radar")}

    def _landmarks(self, t: float, tick: Tick, rng: Rng) -> Messages:
        return {"sightings": landmarks.sightings(self._stage, self.landmarks, t, rng, tick.stamp, "landmark_sensor")}

    def _gnss(self, t: float, tick: Tick, rng: Rng) -> Messages:
        return {"fix": self._gnss_model.measure(self._stage.world.path, t, rng, tick.stamp, "gnss")}

    def _poses(self, t: float, tick: Tick, rng: Rng) -> Messages:
        from operators.sources.simulator import truth

        return {
            "ground_truth": Pose.from_matrix(
                self._stage.T_world_base(t) @ self._T_base_depth,
                stamp=tick.stamp,
                frame=self.world_frame,
                child_frame=self.depth_frame,
            ),
            "true_base": truth.base_state(self._stage.world.path, t, tick.stamp, self.world_frame, self.base_frame),
        }

    def _activities(self, t: float, tick: Tick, rng: Rng) -> Messages:
        from operators.sources.simulator import truth

        return {"activities": truth.activities(self._stage.world, t, self.first_stamp, tick.stamp)}

    def _relations(self, t: float, tick: Tick, rng: Rng) -> Messages:
        return {} if self._graph is None else {"scene": self._graph.at(t, tick.stamp, self.world_frame)}

    def _extrinsics(self) -> Transforms:
        """Fixed transforms of the sensors that are on."""
        base, placed = self.base_frame, []
        if self.color_camera.rate or self.depth_camera.rate:
            placed.append((base, self.depth_frame, self._T_base_depth))
            placed.append((self.depth_frame, self.image_frame, np.linalg.inv(self._T_base_depth) @ self._T_base_color))
        if self.stereo.rate:
            placed.append((base, "stereo_left_optical", self._T_base_left))
            placed.append(("stereo_left_optical", "stereo_right_optical", _shift(self.stereo.baseline, 0, 0)))
        placed += [
            (base, frame, mounted(sensor.mount))
            for frame, sensor in (
                ("lidar", self.lidar),
                ("imu", self.inertial),
                ("radar", self.radar),
                ("landmark_sensor", self.landmarks),
                ("gnss", self.gnss),
            )
            if sensor.rate
        ]
        single = [
            Transforms.from_matrix(T, stamp=self.first_stamp, frame=parent, child_frame=child)
            for parent, child, T in placed
        ]
        return Transforms(
            stamp=self.first_stamp,
            frames=tuple(parent for parent, _, _ in placed),
            child_frames=tuple(child for _, child, _ in placed),
            translations=np.array([t.translations[0] for t in single]).reshape(-1, 3),
            rotations=np.array([t.rotations[0] for t in single]).reshape(-1, 4),
        )


_TRUTH = {"objects", "boxes", "masks"}


def _shift(x: float, y: float, z: float) -> Array:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def _info(optics: Optics, stamp: int, frame: str, baseline: float | None = None) -> CameraInfo:
    """The calibration of a camera; of a rectified pair where a baseline is given (0 for the left camera)."""
    info = CameraInfo.from_intrinsics(
        stamp=stamp, frame=frame, width=optics.width, height=optics.height,
        fx=optics.fx, fy=optics.fy, cx=optics.cx, cy=optics.cy,
    )  # fmt: skip
    if baseline is None:
        return info
    P = np.hstack([info.K, np.zeros((3, 1))])
    P[0, 3] = -optics.fx * baseline
    return info.replace(P=P)
