"""A simulated robot in a generated indoor world, with every sensor and the truth about everything."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from dataflow.messages import (
    Activity,
    Boxes3D,
    CameraInfo,
    CompressedDepth,
    CompressedImage,
    DepthImage,
    Detections2D,
    Diagnostics,
    Image,
    Imu,
    LandmarkSightings,
    MagneticField,
    Mesh,
    Message,
    NavSatFix,
    OccupancyGrid,
    Odometry,
    Planes,
    PointCloud,
    Pose,
    RadarScan,
    SceneGraph,
    SegmentationMap,
    Transforms,
    WheelTicks,
)
from dataflow.operator import Duration, Out, Param, Source
from operators.simulator import settings
from operators.simulator.events import SENSORS, Fault, FaultPlan, Kidnap, Lighting, changes, level_at
from operators.simulator.sensors.schedule import Tick, generator, merged, ticks, ticks_at

if TYPE_CHECKING:
    from operators.simulator.sensors.rig import Rig

Messages = dict[str, Message]
Rng = np.random.Generator


class SimulatedRobot(Source):
    """A wheeled robot that drives a closed path through a drawn world among people and things that move.

    Worlds: `office`, `corridor` (a ring that returns to its start), `table_top`, and `yard`, half of it outdoors. The
    same seed and parameters give the same bytes, whatever the machine's load, the number of threads or what else is
    switched on: every measurement has separate random numbers. Sensors other than the cameras are off until they are
    given a rate.

    Stamps are exact: measurement k of a sensor is at first_stamp + phase + k / rate. A faulty clock (`delay`) shows
    what was so long before the stamp; truth that belongs to an image describes what the image shows.
    """

    simulated = True

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
    magnetic_field: Out[MagneticField] = Out(doc="the Earth's field and that of iron")
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
    occupancy: Out[OccupancyGrid] = Out(static=True, doc="true map of what stands still: free, taken, never to be seen")
    surfaces: Out[Planes] = Out(static=True, doc="true floor, walls, table tops and boards, as rectangles")
    mesh: Out[Mesh] = Out(static=True, doc="the surface of all that stands still")
    events: Out[Diagnostics] = Out(doc="faults, kidnappings and lamps, when each begins and ends")

    world: Literal["office", "corridor", "table_top", "yard"] = Param("office", doc="kind of world")
    seed: int = Param(0, ge=0, doc="of the world, its looks, its movers and all noise")
    duration: Duration = Param("30s", doc="length; stamps lie before first_stamp + duration")
    first_stamp: int = Param(0, ge=0, doc="stamp of the start", unit="ns")
    speed: float = Param(0.5, gt=0.02, le=0.8, doc="of the robot on straights; it slows down in curves", unit="m/s")
    route: Literal["round", "tour", "watch"] = Param(
        "round",
        doc="of the robot: a round; a tour that crosses itself and, but at the table, leads back too; or it stands and "
        "watches people who choose, of which there must be some",
    )
    hold: float = Param(0.0, ge=0, doc="time that the robot stands still at first", unit="s")
    movers: bool = Param(True, doc="people, balls and robots move; otherwise there are none")
    people: int = Param(2, ge=2, le=4, doc="persons among the movers; beyond two, they choose among drinks and seats")
    threads: int = Param(1, ge=1, le=64, doc="threads that cast rays; results do not depend on it")
    color_camera: settings.ColorCamera = Param(settings.ColorCamera(), doc="the colour camera")
    depth_camera: settings.DepthCamera = Param(settings.DepthCamera(), doc="the depth camera")
    stereo: settings.StereoRig = Param(settings.StereoRig(), doc="the stereo pair")
    lidar: settings.Lidar = Param(settings.Lidar(), doc="the rotating laser scanner")
    inertial: settings.Inertial = Param(settings.Inertial(), doc="the inertial measurement unit")
    magnetometer: settings.Magnetometer = Param(settings.Magnetometer(), doc="the magnetometer")
    wheels: settings.Wheels = Param(settings.Wheels(), doc="encoders and wheel odometry")
    radar: settings.Radar = Param(settings.Radar(), doc="the radar")
    landmarks: settings.Landmarks = Param(settings.Landmarks(), doc="the sensor that recognises landmarks")
    gnss: settings.Gnss = Param(settings.Gnss(), doc="the satellite receiver")
    motion: settings.Motion = Param(
        settings.Motion(), doc="how the body is shaken: bumps of the floor, the sway of a hand"
    )
    faults: tuple[Fault, ...] = Param((), doc="spans in which a sensor has other parameters: it fails or errs")
    lighting: tuple[Lighting, ...] = Param((), doc="spans in which the lamps are dimmed or off")
    kidnaps: tuple[Kidnap, ...] = Param((), doc="times at which the robot is carried to another place of its path")
    truth: settings.Truth = Param(settings.Truth(), doc="the truth to emit")
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
        from operators.simulator.drive import bumps, sway
        from operators.simulator.lookout import watching
        from operators.simulator.stage import Stage
        from operators.simulator.truth import TrueGraph
        from operators.simulator.worlds.make import make_world

        if self.image_frame == self.depth_frame:
            raise ValueError(f"image_frame and depth_frame must differ, both are {self.image_frame!r}")
        world = make_world(
            self.world,
            self.seed,
            speed=self.speed,
            hold=self.hold,
            movers=self.movers,
            people=self.people,
            tour=self.route == "tour",
            jumps=tuple((kidnap.at, kidnap.ahead) for kidnap in self.kidnaps),
        )
        if self.route == "watch":
            if self.kidnaps:
                raise ValueError("a robot that stands and watches (route: watch) has no path to be carried along")
            world = watching(world, self.color_camera)
        shaken = self.motion
        shakes = [bumps(self.seed, shaken.bumps)] if shaken.bumps else []
        shakes += [sway(self.seed, shaken.sway, shaken.turn)] if shaken.sway or shaken.turn else []
        self._stage = Stage(
            world, self.seed, threads=self.threads, shakes=shakes, level=partial(level_at, self.lighting)
        )
        if self._sensors.cast_rays():
            self._stage.at(0.0)  # what is slow or fails does so now
        self._faults = FaultPlan(self.faults)
        self._rig = self._new_rig()
        wants_graph = self.truth.relations > 0
        self._graph = TrueGraph(world, with_spatial=self.truth.spatial) if wants_graph else None

    @property
    def _sensors(self) -> settings.Sensors:
        return settings.Sensors(**{name: getattr(self, name) for name in SENSORS})

    def _new_rig(self) -> Rig:
        """The sensors as they are at the start: their biases walk and their counts grow from there."""
        from operators.simulator.sensors.rig import FrameNames, Rig

        frames = FrameNames(self.world_frame, self.odometry_frame, self.base_frame, self.image_frame, self.depth_frame)
        return Rig(self._stage, self.seed, frames, self._sensors, self.truth)

    def static_outputs(self) -> Mapping[str, Message]:
        stamp, world, truth = self.first_stamp, self._stage.world, self.truth
        statics: Messages = {"extrinsics": self._rig.extrinsics(stamp), **self._rig.calibrations(stamp)}
        if self.landmarks.rate:
            points = world.landmarks
            statics["landmark_map"] = LandmarkSightings(
                stamp=stamp, frame=self.world_frame, ids=np.arange(len(points)), positions=points
            )
        if truth.occupancy or truth.surfaces or truth.mesh:
            from operators.simulator import maps

            if truth.occupancy:
                statics["occupancy"] = maps.occupancy(world, truth.resolution, truth.band, stamp, self.world_frame)
            if truth.surfaces:
                statics["surfaces"] = maps.surfaces(world, stamp, self.world_frame)
            if truth.mesh:
                statics["mesh"] = maps.mesh(world, stamp, self.world_frame)
        return statics

    def stream(self) -> Iterator[Mapping[str, Message]]:
        self._rig, self._last = self._new_rig(), dict[str, Messages]()
        told = self._truths()
        for stamp, together in merged(self._schedule()):
            messages: Messages = {}
            for tick in together:
                if tick.sensor in _PARAMETERS:
                    messages |= self._measured(_PARAMETERS[tick.sensor], tick)
                else:
                    messages |= told[tick.sensor]((tick.stamp - self.first_stamp) * 1e-9, tick)
            if messages:
                yield {name: messages[name] for name in self.spec.outputs if name in messages}
            assert all(message.stamp == stamp for message in messages.values())

    def length(self) -> int | None:
        """An upper bound: drop-outs may leave a stamp without messages."""
        return sum(1 for _ in merged(self._schedule()))

    def _truths(self) -> dict[str, Callable[[float, Tick], Messages]]:
        return {
            "poses": self._poses,
            "activities": self._activities,
            "relations": self._relations,
            "events": self._events,
        }

    def _schedule(self) -> dict[str, Iterator[Tick]]:
        start, end, truth = self.first_stamp, self.first_stamp + self.duration, self.truth
        streams = {
            name: ticks(name, sensor.rate, start + sensor.phase, end)
            for name, parameter in _PARAMETERS.items()
            for sensor in [getattr(self, parameter)]
        }
        for name in ("poses", "activities", "relations"):
            streams[name] = ticks(name, getattr(truth, name), start, end)
        if truth.events:
            times = {change.time for change in changes(self.faults, self.lighting, self.kidnaps)}
            streams["events"] = ticks_at("events", [start + round(t * 1e9) for t in sorted(times)], end)
        return streams

    def _measured(self, parameter: str, tick: Tick) -> Messages:
        """Returns what a sensor emits at a tick; truth about an image comes also where the image is missing."""
        rng = generator(self.seed, tick.sensor, tick.index)
        elapsed = (tick.stamp - self.first_stamp) * 1e-9
        given: settings.Sensor = getattr(self, parameter)
        sensor = self._faults.at(parameter, given, elapsed)
        missing = rng.random() < sensor.dropout or any(a <= elapsed < b for a, b in sensor.outages)
        age = sensor.delay * 1e-9 + sensor.clock_drift * elapsed
        messages: Messages = self._rig.measures[parameter](sensor, max(0.0, elapsed - age), tick, rng)
        if missing:
            return {k: m for k, m in messages.items() if k in _TRUTH}
        last = self._last.get(tick.sensor)
        if (
            last
            and sensor.frozen
            and generator(self.seed, f"frozen {tick.sensor}", tick.index).random() < sensor.frozen
        ):
            return {k: m.replace(stamp=tick.stamp) for k, m in last.items()}
        self._last[tick.sensor] = messages
        return messages

    def _poses(self, t: float, tick: Tick) -> Messages:
        return self._rig.poses(self._faults.at("depth_camera", self.depth_camera, t), t, tick)

    def _activities(self, t: float, tick: Tick) -> Messages:
        from operators.simulator import truth

        return {"activities": truth.activities(self._stage.world, t, self.first_stamp, tick.stamp)}

    def _relations(self, t: float, tick: Tick) -> Messages:
        if self._graph is None:
            return {}
        return {"scene": self._graph.at(t, self._stage.T_world_base(t), tick.stamp, self.world_frame)}

    def _events(self, t: float, tick: Tick) -> Messages:
        from operators.simulator import truth

        now = [
            change
            for change in changes(self.faults, self.lighting, self.kidnaps)
            if self.first_stamp + round(change.time * 1e9) == tick.stamp
        ]
        return {"events": truth.events(now, tick.stamp)}


_TRUTH = {"objects", "boxes", "masks"}
_NAMES = {"color_camera": "color", "depth_camera": "depth", "inertial": "imu"}
_PARAMETERS = {_NAMES.get(name, name): name for name in SENSORS}
"""Parameters of the sensors by the names of their ticks, from which their random numbers are drawn."""
