"""Each source that stands for a sensor of a recording, fed from a made bag: what was measured is what comes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from made_bags import SECOND, Row, header, ros, transform, write_ros2, xyz, xyzw
from made_video import clip

from dataflow.graph import load_graph
from dataflow.interop.mapping import MappingError
from dataflow.interop.playing import match, play
from dataflow.operator import Source
from operators import sources

FIRST = 1_700_000_000 * SECOND
STAMPS = [FIRST + k * SECOND // 10 for k in range(4)]
LATE = SECOND // 50  # by which a message is recorded after it was measured
K = np.array([500.0, 0.0, 1.0, 0.0, 510.0, 0.5, 0.0, 0.0, 1.0])

Told = Callable[[Any], Any]


def pixels(k: int) -> np.ndarray[Any, Any]:
    return np.arange(24, dtype=np.uint8).reshape(2, 4, 3) + 10 * k


def image(k: int, stamp: int) -> Any:
    return ros(
        "sensor_msgs/Image", header=header(stamp), height=2, width=4, encoding="rgb8", step=12, data=pixels(k).ravel()
    )


def png(k: int) -> bytes:
    return bytes(cv2.imencode(".png", pixels(k))[1])


def depth(k: int, stamp: int) -> Any:
    millimetres = np.array([[1000 + k, 0, 2500, 3000], [1, 2, 3, 4]], np.uint16)
    return ros(
        "sensor_msgs/Image", header=header(stamp), height=2, width=4, encoding="16UC1", step=8,
        data=millimetres.view(np.uint8).ravel(),
    )  # fmt: skip


def info(k: int, stamp: int, baseline: float = 0.0) -> Any:
    P = np.array([500.0, 0, 1, -500 * baseline, 0, 510, 0.5, 0, 0, 0, 1, 0])
    return ros("sensor_msgs/CameraInfo", header=header(stamp), width=4, height=2, k=K, p=P)


def cloud(k: int, stamp: int) -> Any:
    fields = [ros("sensor_msgs/PointField", name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")]
    points = np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, k]], np.float32)
    return ros(
        "sensor_msgs/PointCloud2", header=header(stamp), height=1, width=2, fields=fields, point_step=12, row_step=24,
        data=points.view(np.uint8).ravel(), is_dense=True,
    )  # fmt: skip


def scan(k: int, stamp: int) -> Any:
    return ros(
        "sensor_msgs/LaserScan", header=header(stamp), angle_min=-0.5, angle_max=0.5, angle_increment=0.5,
        range_min=0.1, range_max=9.0, ranges=np.array([1.0, 2.0, 3.0 + k], np.float32),
    )  # fmt: skip


def posed(k: int) -> Any:
    return ros("geometry_msgs/Pose", position=xyz(k, -1, 0.5, "Point"), orientation=xyzw(0, 0, 0.6, 0.8))


def twisted(k: int) -> Any:
    return ros("geometry_msgs/Twist", linear=xyz(0.1 * k, 0, 0), angular=xyz(0, 0, -0.2))


def odometry(k: int, stamp: int) -> Any:
    return ros(
        "nav_msgs/Odometry", header=header(stamp, "odom"), child_frame_id="base",
        pose=ros("geometry_msgs/PoseWithCovariance", pose=posed(k)),
        twist=ros("geometry_msgs/TwistWithCovariance", twist=twisted(k)),
    )  # fmt: skip


def imu(k: int, stamp: int) -> Any:
    return ros(
        "sensor_msgs/Imu", header=header(stamp), angular_velocity=xyz(k, 2, 3), linear_acceleration=xyz(0, 0, 9.81)
    )


@dataclass(frozen=True)
class Case:
    """A port: what a bag has for it as message k, and what its message must then say."""

    source: str
    port: str
    made: Callable[[int, int], Any]
    told: Told
    truth: Told

    @property
    def static(self) -> bool:
        return bool(spec_of(self.source).outputs[self.port].static)


def spec_of(source: str) -> Any:
    return getattr(sources, source).spec


def camera(source: str, *ports: str) -> list[Case]:
    return [Case(source, port, image, lambda m: m.data, pixels) for port in ports]


def calibration(source: str, *ports: str) -> list[Case]:
    return [Case(source, port, info, lambda m: m.K.ravel(), lambda k: K) for port in ports]


CASES = [
    *camera("RecordedCamera", "image"),
    *calibration("RecordedCamera", "info"),
    Case(
        "RecordedCamera",
        "compressed",
        lambda k, s: ros(
            "sensor_msgs/CompressedImage", header=header(s), format="png", data=np.frombuffer(png(k), np.uint8)
        ),
        lambda m: np.frombuffer(m.data, np.uint8),
        lambda k: np.frombuffer(png(k), np.uint8),
    ),
    Case(
        "RecordedCamera",
        "video",
        lambda k, s: ros(
            "ffmpeg_image_transport_msgs/FFMPEGPacket",
            header=header(s),
            width=96,
            height=64,
            encoding="h264",
            pts=k,
            flags=int(k == 0),
            data=np.frombuffer(clip("h264", count=4)[k], np.uint8),
        ),
        lambda m: np.frombuffer(m.data, np.uint8),
        lambda k: np.frombuffer(clip("h264", count=4)[k], np.uint8),
    ),
    *camera("RecordedRgbdCamera", "image"),
    *calibration("RecordedRgbdCamera", "image_info", "depth_info"),
    Case("RecordedRgbdCamera", "depth", depth, lambda m: m.data[0], lambda k: [1 + k / 1000, 0, 2.5, 3]),
    Case(
        "RecordedRgbdCamera",
        "extrinsics",
        lambda k, s: ros("tf2_msgs/TFMessage", transforms=[transform(s, "depth", "color", 0.025)]),
        lambda m: m.matrices()[0][:3, 3],
        lambda k: [0.025, 0, 0],
    ),
    Case(
        "RecordedRgbdCamera",
        "ground_truth",
        lambda k, s: ros("geometry_msgs/PoseStamped", header=header(s, "map"), pose=posed(k)),
        lambda m: m.position,
        lambda k: [k, -1, 0.5],
    ),
    *camera("RecordedStereoCamera", "left", "right"),
    *calibration("RecordedStereoCamera", "left_info"),
    Case("RecordedStereoCamera", "right_info", lambda k, s: info(k, s, 0.12), lambda m: m.P[0, 3], lambda k: -60.0),
    Case("RecordedLidar", "points", cloud, lambda m: m.points, lambda k: [[1, 2, 3], [-1, 0.5, k]]),
    Case("RecordedLidar", "scan", scan, lambda m: m.ranges, lambda k: [1, 2, 3 + k]),
    Case(
        "RecordedImu",
        "imu",
        imu,
        lambda m: [*m.angular_velocity, *m.linear_acceleration],
        lambda k: [k, 2, 3, 0, 0, 9.81],
    ),
    Case(
        "RecordedImu",
        "magnetic_field",
        lambda k, s: ros("sensor_msgs/MagneticField", header=header(s), magnetic_field=xyz(2e-5, 0, -4e-5 - 1e-6 * k)),
        lambda m: m.field,
        lambda k: [2e-5, 0, -4e-5 - 1e-6 * k],
    ),
    Case(
        "RecordedPose", "odometry", odometry, lambda m: [*m.position, *m.linear], lambda k: [k, -1, 0.5, 0.1 * k, 0, 0]
    ),
    Case(
        "RecordedPose",
        "pose",
        lambda k, s: ros("geometry_msgs/PoseStamped", header=header(s, "map"), pose=posed(k)),
        lambda m: m.orientation,
        lambda k: [0, 0, 0.6, 0.8],
    ),
    Case(
        "RecordedPose",
        "twist",
        lambda k, s: ros("geometry_msgs/TwistStamped", header=header(s, "base"), twist=twisted(k)),
        lambda m: [*m.linear, *m.angular],
        lambda k: [0.1 * k, 0, 0, 0, 0, -0.2],
    ),
    Case(
        "RecordedPose",
        "fix",
        lambda k, s: ros(
            "sensor_msgs/NavSatFix", header=header(s, "gps"), latitude=48.1 + k, longitude=11.5, altitude=500.0
        ),
        lambda m: [m.latitude, m.longitude, m.altitude],
        lambda k: [48.1 + k, 11.5, 500],
    ),
    Case(
        "RecordedTransforms",
        "moving",
        lambda k, s: ros("tf2_msgs/TFMessage", transforms=[transform(s, "odom", "base", 0.5 * k)]),
        lambda m: m.matrices()[0][:3, 3],
        lambda k: [0.5 * k, 0, 0],
    ),
    Case(
        "RecordedTransforms",
        "fixed",
        lambda k, s: ros("tf2_msgs/TFMessage", transforms=[transform(s, "base", "lidar", 0.2)]),
        lambda m: m.matrices()[0][:3, 3],
        lambda k: [0.2, 0, 0],
    ),
]


def rows(case: Case) -> list[Row]:
    return [(f"/{case.port}", stamp + LATE, case.made(k, stamp)) for k, stamp in enumerate(STAMPS)]


def graph_of(folder: Path, source: str) -> Path:
    file = folder / f"{source}.yaml"
    file.write_text(f'graph: g\noperators:\n  sensor: {{use: "operators.sources:{source}"}}\n')
    return file


def played(case: Case, folder: Path) -> list[Any]:
    """The messages of a port, from a bag that holds a topic for it."""
    if not (bag := folder / "bag").exists():
        write_ros2(bag, rows(case))
    graph = load_graph(graph_of(folder, case.source))
    stream = f"g/sensor/{case.port}"
    with play(bag, graph, [f"/{case.port}=sensor/{case.port}"]) as streams:
        return [m.message for m in streams.messages() if m.stream == stream]


def test_every_port_of_every_such_source_is_tried() -> None:
    stand_ins = [name for name in sources.__all__ if name.startswith("Recorded")]
    assert {(case.source, case.port) for case in CASES} == {
        (name, port) for name in stand_ins for port in spec_of(name).outputs
    }


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.source}.{case.port}")
def test_recorded_measurements_come_with_their_stamps(case: Case, tmp_path: Path) -> None:
    messages = played(case, tmp_path)
    assert type(messages[0]).__name__ in [t.__name__ for t in spec_of(case.source).outputs[case.port].types]
    if case.static:
        assert len(messages) == 1
    else:
        assert [m.stamp for m in messages] == STAMPS
    for k, message in enumerate(messages):
        np.testing.assert_allclose(case.told(message), case.truth(k), rtol=1e-6)
    assert [m.digest() for m in played(case, tmp_path)] == [m.digest() for m in messages]


SOURCES = sorted({case.source for case in CASES})


@pytest.mark.parametrize("source", SOURCES)
def test_a_topic_of_another_kind_is_refused_by_name(source: str, tmp_path: Path) -> None:
    bag = write_ros2(tmp_path / "bag", [("/said", s, ros("std_msgs/String", data="no measurement")) for s in STAMPS])
    port = next(iter(spec_of(source).outputs))
    with pytest.raises(MappingError, match="/said"):
        match(bag, load_graph(graph_of(tmp_path, source)), [f"/said=sensor/{port}"]).played()


@pytest.mark.parametrize("source", SOURCES)
def test_recorded_source_without_a_recording_raises_with_the_remedy(source: str) -> None:
    operator: Source = getattr(sources, source)()
    with pytest.raises(RuntimeError, match=f"{source} stands for streams of a recording.*dataflow replay RECORDING"):
        operator.setup()
