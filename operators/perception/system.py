"""Perception in one object: measurements in, one result out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from dataflow.api.builder import Graph
from dataflow.api.session import Session
from dataflow.messages import (
    CameraInfo,
    DepthImage,
    Image,
    Imu,
    Message,
    Odometry,
    PointCloud,
    SceneGraph,
    Transforms,
    Twist,
)
from dataflow.shipped import folder
from operators.geometry.calibration import check_fit
from operators.perception.result import PerceptionResult
from operators.perception.sensors import HandedSensors

CORE = "core/perception.yaml"
SENSORS = ("image", "depth", "points", "imu", "wheels", "command")
SENSORS_NODE, PERCEPTION = "robot", "perception"
OUTPUTS = {
    "detections": "detections",
    "segmentation": "segmentation",
    "tracks": "tracks",
    "cloud": "cloud",
    "boxes": "boxes",
    "pose": "odometry",
    "objects": "objects",
    "graph": "graph",
    "activities": "activities",
    "changes": "changes",
}
"""Field of the result → output of the core graph."""
FUSION: dict[str, tuple[str, dict[str, Any]]] = {
    "depth": ("odometry/odometry", {"sigma": 0.03, "angular_sigma": 0.015, "offset": 0.05}),
    "points": ("scans/odometry", {"sigma": 0.05, "angular_sigma": 0.03, "offset": 0.1}),
    "wheels": (f"{SENSORS_NODE}/wheels", {"use": "wheels", "sigma": 0.03}),
    "command": (f"{SENSORS_NODE}/command", {"use": "control"}),
}
"""Sensor → its stream in the fusion, and the default noise parameters of that stream."""
CHECKED_WHEELS = "motion_check/checked"
"""The stream that stands for wheels where something is there to check them against."""
Array = NDArray[Any]


class PerceptionSystem:
    """Runs `graphs/core/perception.yaml` in this process: sensors in, a scene graph out.

        system = PerceptionSystem(image_info=info, depth_info=info, extrinsics=transforms)
        result = system.process(stamp, image=rgb, depth=depth)
        result.detections, result.masks, result.cloud, result.pose, result.graph

    The operators are those of the graph, and so are the results, digest by digest, as long as numpy's libraries use
    as many threads as there (`OMP_NUM_THREADS=1` before Python starts). It is made for certain sensors; each of them
    may be missing at any step, and what depends on it is then None.
    """

    def __init__(
        self,
        sensors: Iterable[str] | None = None,
        *,
        image_info: CameraInfo | None = None,
        depth_info: CameraInfo | None = None,
        extrinsics: Transforms | None = None,
        lidar_frame: str = "lidar",
        fusion: Mapping[str, Mapping[str, Any]] | None = None,
        settings: Mapping[str, Any] | None = None,
        record: str | Path | None = None,
        overwrite: bool = False,
        **params: Any,
    ) -> None:
        """Loads the networks and sets every operator up.

        - `sensors`: those there are: image, depth, points (a LiDAR), imu, wheels, command; those with a calibration
          unless given.
        - `image_info`, `depth_info`, `extrinsics`: calibrations, and where the sensors are on the robot.
        - `lidar_frame`: the frame of points that are given as arrays.
        - `fusion`: how far the fusion believes each sensor (`{"wheels": {"sigma": 0.1}}`): EkfFusion's settings.
        - `settings`: parameters of operators: `{"detector.score_threshold": 0.3}`.
        - `record`: file of a recording, which replays and verifies as those of graphs do.
        - `params`: parameters of the core graph: `base_frame`, `stride`, `detector`, `detector_params`, `segment`, ...

        Raises ValueError for sensors that are unknown or lack a calibration, `GraphError` for parameters, and
        `RunFailed` where an operator cannot be set up.
        """
        infos = {"image": image_info, "depth": depth_info}
        named = [name for name, info in infos.items() if info is not None] if sensors is None else list(sensors)
        self.sensors = tuple(name for name in SENSORS if name in named)
        _check_sensors(named, infos, extrinsics, mounted=bool(params.get("mount")))
        self._infos, self._lidar_frame = infos, lidar_frame
        static: dict[str, Message | None] = {
            **{f"{n}_info": info for n, info in infos.items()},
            "extrinsics": extrinsics,
        }
        given = {name: message for name, message in static.items() if message is not None}
        graph = Graph("perception", namespace="robot1", folder=folder("graphs"))
        graph.add(SENSORS_NODE, HandedSensors)
        believed = _believed(self.sensors, fusion or {})
        graph.add(PERCEPTION, CORE, **{"fusion": believed, **params})
        graph.connect(PERCEPTION, **{name: f"{SENSORS_NODE}/{name}" for name in (*self.sensors, *given)})
        built = graph.build({f"{PERCEPTION}/{name}": value for name, value in (settings or {}).items()})
        made = {f"{PERCEPTION}/{output}" for output in OUTPUTS.values()}
        outputs = [name for name in sorted(made) if f"{built.namespace}/{name}" in built.aliases]
        self._status = [name for name, stream in built.streams.items() if stream.port == "status"]
        self._session = Session(
            built,
            static={f"{SENSORS_NODE}/{name}": message for name, message in given.items()},
            outputs=[*outputs, *(built.relative(stream) for stream in self._status)],
            record=record,
            overwrite=overwrite,
        )
        self._last: int | None = None
        self._graph: SceneGraph | None = None

    @property
    def graph(self) -> SceneGraph | None:
        """The newest scene graph of all steps; None before the first."""
        return self._graph

    @property
    def left_out(self) -> dict[str, str]:
        """The operators of the core graph that these sensors leave out, with the reason."""
        return {name.removeprefix(f"{PERCEPTION}/"): why for name, why in self._session.graph.left_out.items()}

    def process(
        self,
        stamp: int,
        *,
        image: Image | Array | None = None,
        depth: DepthImage | Array | None = None,
        points: PointCloud | Array | None = None,
        imu: Imu | Sequence[Imu] | None = None,
        wheels: Odometry | Sequence[Odometry] | None = None,
        command: Twist | Sequence[Twist] | None = None,
    ) -> PerceptionResult:
        """Takes what was measured up to `stamp` (ns) and returns what follows from it.

        Images (H, W, 3) or (H, W) uint8, depths (H, W) metres and points (N, 3) metres may be arrays, which then have
        the stamp of the step; messages keep their stamps, which lie after the last step's and up to this one's. `imu`,
        `wheels` and `command` may be several messages. Depth belongs to the image of the same stamp.

        Raises ValueError for a stamp that is not after the last one, a sensor that the system was not made for, and
        images that do not fit their calibration, TypeError for what is no measurement, and `RunFailed` where an
        operator fails, after which the system is closed.
        """
        if self._last is not None and stamp <= self._last:
            raise ValueError(f"stamp {stamp} comes after {self._last}: stamps must increase")
        given = {
            "image": _as_image(image, stamp, self._infos["image"]),
            "depth": _as_depth(depth, stamp, self._infos["depth"]),
            "points": _as_points(points, stamp, self._lidar_frame),
            "imu": imu,
            "wheels": wheels,
            "command": command,
        }
        steps = self._steps(stamp, {name: value for name, value in given.items() if value is not None})
        made: dict[str, list[Message]] = {}
        for at, messages in sorted(steps.items()):
            for name, found in self._session.put(at, messages).items():
                made.setdefault(name.removeprefix(f"{PERCEPTION}/"), []).extend(found)
        self._last = stamp
        newest: dict[str, Any] = {field: made[output][-1] for field, output in OUTPUTS.items() if output in made}
        status: dict[str, Any] = {
            name.removesuffix("/status"): found[-1] for name, found in made.items() if name.endswith("/status")
        }
        self._graph = newest.get("graph", self._graph)
        poses: Any = tuple(made.get("odometry", ()))
        return PerceptionResult(stamp=stamp, poses=poses, status=status, **newest)

    def _steps(self, stamp: int, given: Mapping[str, Any]) -> dict[int, dict[str, Message]]:
        """Stamp → the messages by stream."""
        steps: dict[int, dict[str, Message]] = {stamp: {}}
        for name, value in given.items():
            if name not in self.sensors:
                listed = ", ".join(self.sensors)
                raise ValueError(f"this system was made for {listed}, not for {name}: name it in `sensors`")
            kind = HandedSensors.spec.outputs[name].types
            for message in value if isinstance(value, list | tuple) else (value,):
                if not isinstance(message, kind):
                    raise TypeError(f"{name} takes {kind[0].__name__}, not {type(message).__name__}")
                if message.stamp > stamp or (self._last is not None and message.stamp <= self._last):
                    after = "" if self._last is None else f"after {self._last} and "
                    raise ValueError(f"{name} has stamp {message.stamp}; it must be {after}not after {stamp}")
                step = steps.setdefault(message.stamp, {})
                if f"{SENSORS_NODE}/{name}" in step:
                    raise ValueError(f"{name} has two messages of stamp {message.stamp}")
                step[f"{SENSORS_NODE}/{name}"] = message
        return steps

    def close(self) -> None:
        """Closes the operators, and the recording if there is one."""
        self._session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        self._session.__exit__(kind, error, trace)


def _check_sensors(
    named: Sequence[str], infos: Mapping[str, CameraInfo | None], extrinsics: Transforms | None, *, mounted: bool
) -> None:
    """Raises ValueError for what is lacking; a camera alone whose base is found (`mounted`) needs no extrinsics."""
    if unknown := [name for name in named if name not in SENSORS]:
        raise ValueError(f"no sensor {unknown[0]!r}: there are {', '.join(SENSORS)}")
    if not named:
        raise ValueError(f"no sensor: give image_info and depth_info, or name some of {', '.join(SENSORS)}")
    space = [name for name in named if name in ("depth", "points")]
    if "depth" in named and infos["depth"] is None:
        raise ValueError("depth needs its calibration: depth_info")
    if "image" in named and space and infos["image"] is None:
        raise ValueError(f"image with {' and '.join(space)} needs its calibration: image_info")
    frames = {info.frame for info in infos.values() if info is not None}
    alone = mounted and set(named) <= {"image", "depth"} and len(frames) == 1
    if extrinsics is None and (space or "imu" in named) and not alone:
        lacking = " and ".join((*space, *(("imu",) if "imu" in named else ())))
        raise ValueError(
            f"{lacking}: extrinsics must say where the sensors are on the robot, such as Transforms.level_camera("
            f"height, pitch); for image and depth of one frame mount=True finds it"
        )


def _believed(sensors: Sequence[str], given: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Settings of EkfFusion by stream. Raises ValueError for a sensor that has none."""
    if unknown := [name for name in given if name not in FUSION or name not in sensors]:
        usable = ", ".join(name for name in FUSION if name in sensors) or "none"
        raise ValueError(f"fusion has no settings of {unknown[0]!r} here; there are {usable}")
    found = {
        name: FUSION[name] for name in sensors if name in FUSION and not (name == "depth" and "image" not in sensors)
    }
    if "wheels" in found and ({"image", "depth"} <= set(sensors) or "points" in sensors):
        found["wheels"] = (CHECKED_WHEELS, found["wheels"][1])
    return {stream: {**usual, **given.get(name, {})} for name, (stream, usual) in found.items()}


def _as_image(given: Image | Array | None, stamp: int, info: CameraInfo | None) -> Image | None:
    if isinstance(given, np.ndarray):
        given = Image(stamp=stamp, frame="camera" if info is None else info.frame, data=given)
    if isinstance(given, Image) and info is not None:
        check_fit("image", given, info)
    return given


def _as_depth(given: DepthImage | Array | None, stamp: int, info: CameraInfo | None) -> DepthImage | None:
    if isinstance(given, np.ndarray):
        if given.dtype.kind != "f":
            raise TypeError(f"depth is in metres, as floating-point numbers, not {given.dtype}")
        frame = "depth" if info is None else info.frame
        given = DepthImage(stamp=stamp, frame=frame, data=np.asarray(given, np.float32))
    if isinstance(given, DepthImage) and info is not None:
        check_fit("depth", given, info)
    return given


def _as_points(given: PointCloud | Array | None, stamp: int, frame: str) -> PointCloud | None:
    if isinstance(given, np.ndarray):
        return PointCloud(stamp=stamp, frame=frame, points=np.asarray(given, np.float32))
    return given
