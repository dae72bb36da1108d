"""What each type's own validation refuses, and that it says what, where and what would be right."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from example_messages import example
from numpy.typing import NDArray

from dataflow import messages as m
from dataflow.messages import LaserScan, Message, MessageError
from dataflow.messages.base import ArrayField

UNIT = [0.0, 0.0, 0.0, 1.0]
NAN = float("nan")

detections = m.Detections2D(
    stamp=0, frame="cam", width=640, height=480, class_names=("cat", "dog"),
    boxes=[[0, 0, 10, 10], [5, 5, 20, 30]], scores=[0.5, 1.0], class_ids=[0, 1],
)  # fmt: skip
boxes = m.Boxes3D(
    stamp=0, frame="map", class_names=("car",), centers=[[0, 0, 0]], sizes=[[1, 1, 1]], orientations=[UNIT],
    scores=[1], class_ids=[0],
)  # fmt: skip
tracks = m.Tracks(
    stamp=0, frame="map", ids=[4, 9], states=[1, 2], scores=[1, 0.5], class_ids=[0, 7], ages=[0, 1],
    unseen=[0, 0.1], positions=np.zeros((2, 3)),
)  # fmt: skip
scene = m.SceneGraph(
    stamp=0, frame="map", class_names=("cup", "table"), labels=("my cup", "the table"), predicates=("on",),
    ids=[1, 2], class_ids=[0, 1], positions=np.zeros((2, 3)), sizes=np.ones((2, 3)), subjects=[0], objects=[1],
)  # fmt: skip
activity = m.Activity(stamp=0, class_names=("walk", "sit"), subjects=[3], class_ids=[0], scores=[0.4])
segments = m.SegmentationMap(stamp=0, frame="cam", class_names=("a", "b"), classes=np.zeros((2, 2), np.uint8))
camera = m.CameraInfo.from_intrinsics(stamp=0, frame="cam", width=640, height=480, fx=500, fy=500, cx=320, cy=240)
sightings = m.LandmarkSightings(stamp=0, frame="base", ids=[-1, 5], ranges=[1, 2], bearings=[0, 0.1])
grid = m.OccupancyGrid(stamp=0, frame="map", resolution=0.05, cells=np.zeros((2, 3), np.int8), position=[0, 0, 0])
rooms = m.Rooms(
    stamp=0, frame="map", resolution=0.05, cells=np.zeros((2, 3), np.int32), position=[0, 0, 0], ids=[1], areas=[0.1],
    centers=[[0, 0, 0]], doors=np.zeros((0, 2), np.int32), door_positions=np.zeros((0, 3)), door_widths=[],
)  # fmt: skip
planes = m.Planes(stamp=0, frame="map", coefficients=[[0, 0, 1, -0.7]])
fix = m.NavSatFix(stamp=0, frame="gps", latitude=48.1, longitude=11.6, altitude=520.0)
tf = m.Transforms(
    stamp=0, frames=("map", "odom"), child_frames=("odom", "base"), translations=np.zeros((2, 3)), rotations=[UNIT] * 2
)
status = m.Diagnostics(
    stamp=0, names=("lidar",), messages=("hot",), keys=("t",), values=("81",), levels=[1], owners=[0]
)
pose = m.Pose(stamp=0, frame="map", position=[0, 0, 0], orientation=UNIT)
picture, video = example(m.CompressedImage, 0), example(m.CompressedVideo, 0)
packed = example(m.CompressedDepth, 0)
wheels = m.WheelTicks(stamp=0, names=("l", "r"), ticks=[1, 2])
joints = m.JointState(stamp=0, names=("a", "b"))
particles = m.ParticleSet(stamp=0, frame="map", poses=[[0, 0, 0]], weights=[1])
scan = LaserScan(stamp=0, frame="laser", angle_min=-1, angle_max=1, ranges=[1])
path = m.Path(stamp=0, frame="map", positions=np.zeros((3, 3)))
mesh = m.Mesh(stamp=0, frame="map", vertices=np.zeros((3, 3)), triangles=np.zeros((0, 3), np.uint32))
clusters = m.Clusters(stamp=0, frame="map", labels=[0, -1], centroids=[[0, 0, 0]])
image = m.Image(stamp=0, frame="c", data=np.zeros((2, 2), np.uint8))
depth = m.DepthImage(stamp=0, frame="c", data=np.zeros((2, 2)))
png8 = np.frombuffer(b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + b"\0\0\0\1" * 2 + b"\x08\0\0\0\0", np.uint8)

REFUSED: list[tuple[Message, dict[str, Any], str]] = [
    (detections, {"scores": [0.5, 1.5]}, r"Detections2D\.scores\[1\] must lie in \[0, 1\], got 1\.5"),
    (detections, {"scores": [NAN, -1]}, r"Detections2D\.scores\[0\] must lie in \[0, 1\], got nan \(and 1 more\)"),
    (detections, {"class_ids": [0, 2]}, r"class_ids\[1\] must index class_names, which has 2 entries, got 2"),
    (detections, {"class_ids": [-1, 0]}, r"class_ids\[0\] must index class_names"),
    (detections, {"class_ids": [0, -3], "class_names": ()}, r"Detections2D\.class_ids\[1\] must be ≥ 0, got -3"),
    (
        detections,
        {"boxes": [[0, 0, 1, 1], [9, 0, 1, 1]]},
        r"boxes\[1\] must be \(x1, .* x1 ≤ x2 and y1 ≤ y2, got \[9\.0, 0",
    ),
    (detections, {"boxes": [[0, 5, 1, 1], [0, 0, 1, 1]]}, r"Detections2D\.boxes\[0\]"),
    (detections, {"boxes": [[NAN] * 4, [0, 0, 1, 1]]}, r"Detections2D\.boxes\[0\]"),
    (detections, {"width": 0}, r"Detections2D\.width must be above zero, got 0"),
    (detections, {"height": -1}, r"Detections2D\.height must be above zero, got -1"),
    (detections, {"visible": [0.1, 1.1]}, r"Detections2D\.visible\[1\]"),
    (
        detections,
        {"masks": np.zeros((2, 480, 79), np.uint8)},
        r"have shape \(N, 480, 80\), .* 640x480 pixels, got \(2, 480",
    ),
    (detections, {"masks": np.zeros((1, 480, 80), np.uint8)}, r"masks has N=1, but boxes has N=2"),
    (
        detections,
        {"width": 15, "height": 1, "masks": np.full((2, 1, 2), 255, np.uint8)},
        r"0 in the 1 bits beyond column 14",
    ),
    (boxes, {"orientations": [[0, 0, 0, 1.01]]}, r"Boxes3D\.orientations\[0\] must be a unit quaternion"),
    (boxes, {"orientations": [[NAN, 0, 0, 1]]}, r"Boxes3D\.orientations\[0\]"),
    (boxes, {"sizes": [[1, -1, 1]]}, r"Boxes3D\.sizes\[0, 1\] must lie in \[0, inf\], got -1\.0"),
    (boxes, {"class_ids": [1]}, r"Boxes3D\.class_ids\[0\] must index class_names"),
    (boxes, {"scores": [2]}, r"Boxes3D\.scores\[0\]"),
    (boxes, {"visible": [2]}, r"Boxes3D\.visible\[0\]"),
    (scene, {"tracks": [7]}, r"SceneGraph\.tracks is given without track_nodes: they come together"),
    (scene, {"tracks": [7], "track_nodes": [2]}, r"SceneGraph\.track_nodes\[0\] must index the 2 nodes, got 2"),
    (tracks, {"ids": [4, 4]}, r"Tracks\.ids must be unique, 4 occurs more than once"),
    (tracks, {"states": [0, 4]}, r"Tracks\.states\[1\] must be a TrackState: 0 tentative.*, got 4"),
    (tracks, {"ages": [-1, 0]}, r"Tracks\.ages\[0\]"),
    (tracks, {"unseen": [0, NAN]}, r"Tracks\.unseen\[1\]"),
    (tracks, {"class_ids": [0, -1]}, r"Tracks\.class_ids\[1\]"),
    (tracks, {"scores": [0, 2]}, r"Tracks\.scores\[1\]"),
    (tracks, {"positions": None}, r"Tracks of 2 objects must have boxes or positions"),
    (tracks, {"width": 640}, r"Tracks\.width is given without height: they come together"),
    (tracks, {"width": 1, "height": 0}, r"Tracks\.height must be above zero"),
    (tracks, {"width": -1, "height": 1}, r"Tracks\.width must be above zero"),
    (tracks, {"boxes": [[0, 0, 1, 1], [1, 0, 0, 0]]}, r"Tracks\.boxes\[1\]"),
    (tracks, {"boxes": [[0, 0, 1, 1], [NAN, 0, 0, 0]]}, r"Tracks\.boxes\[1\]"),
    (tracks, {"sizes": [[1, 1, 1], [1, 1, -1]]}, r"Tracks\.sizes\[1, 2\]"),
    (tracks, {"orientations": np.zeros((2, 4))}, r"Tracks\.orientations\[0\]"),
    (scene, {"ids": [2, 2]}, r"SceneGraph\.ids must be unique, 2"),
    (scene, {"labels": ("one",)}, r"SceneGraph\.labels has 1 entries, but ids has 2: .*, or labels empty"),
    (scene, {"predicates": ()}, r"SceneGraph\.predicates has 0 entries, but subjects has 1"),
    (scene, {"subjects": [2]}, r"SceneGraph\.subjects\[0\] must index the 2 nodes, got 2"),
    (scene, {"objects": [-1]}, r"SceneGraph\.objects\[0\] must index the 2 nodes, got -1"),
    (scene, {"class_ids": [0, 2]}, r"SceneGraph\.class_ids\[1\]"),
    (scene, {"sizes": -np.ones((2, 3))}, r"SceneGraph\.sizes\[0, 0\]"),
    (scene, {"scores": [0, 2]}, r"SceneGraph\.scores\[1\]"),
    (scene, {"relation_scores": [2]}, r"SceneGraph\.relation_scores\[0\]"),
    (scene, {"orientations": np.ones((2, 4))}, r"SceneGraph\.orientations\[0\]"),
    (activity, {"goals": ("a", "b")}, r"Activity\.goals has 2 entries, but subjects has 1"),
    (activity, {"class_ids": [2]}, r"Activity\.class_ids\[0\]"),
    (activity, {"scores": [-0.5]}, r"Activity\.scores\[0\]"),
    (activity, {"probabilities": [[0.5, 1.5]]}, r"Activity\.probabilities\[0, 1\]"),
    (activity, {"probabilities": [[0.5]]}, r"Activity\.probabilities must have one column for each of the 2"),
    (segments, {"classes": np.full((2, 2), 2, np.uint8)}, r"must index class_names, which has 2 .* got 2 in 4 pixels"),
    (segments, {"classes": np.full((2, 2), 9, np.uint8), "void": 255}, r"or be void \(255\), got 9 in 4 pixels"),
    (segments, {"instances": np.zeros((2, 3), np.int32)}, r"SegmentationMap\.instances has W=3, but classes has W=2"),
    (segments, {"confidence": np.full((2, 2), 1.5)}, r"confidence\[0, 0\] must lie in \[0, 1\] or be NaN"),
    (segments, {"classes": np.zeros((0, 2), np.uint8)}, r"SegmentationMap\.classes must hold at least one element"),
    (camera, {"K": np.eye(3) * -1}, r"CameraInfo\.K must have focal lengths above zero"),
    (camera, {"K": np.ones((3, 3))}, r"CameraInfo\.K must have \[0, 0, 1\] as its last row"),
    (camera, {"K": np.full((3, 3), NAN)}, r"CameraInfo\.K\[0, 0\] must be finite"),
    (camera, {"distortion": [0.1]}, r"must have 0 coefficients for the model 'none', got 1"),
    (camera, {"distortion_model": "plumb_bob", "distortion": [0.1] * 3}, r"must have 0 or 4 or 5 coefficients"),
    (camera, {"distortion_model": "equidistant"}, r"must have 4 coefficients for the model 'equidistant', got 0"),
    (camera, {"height": -4}, r"CameraInfo\.height must be above zero"),
    (camera, {"width": 0}, r"CameraInfo\.width must be above zero"),
    (camera, {"R": np.full((3, 3), NAN)}, r"CameraInfo\.R\[0, 0\] must be finite"),
    (camera, {"distortion_model": "equidistant", "distortion": [0, NAN, 0, 0]}, r"CameraInfo\.distortion\[1\]"),
    (camera, {"P": np.full((3, 4), np.inf)}, r"CameraInfo\.P\[0, 0\] must be finite, got inf"),
    (sightings, {"positions": np.zeros((2, 2))}, r"must be polar .* or Cartesian \(positions\), got both"),
    (sightings, {"ranges": None, "bearings": None}, r"got neither"),
    (sightings, {"bearings": None, "elevations": [0, 0]}, r"elevations is given without bearings"),
    (sightings, {"covariances": np.zeros((2, 3, 3))}, r"covariances must have shape \(N, 2, 2\), got \(2, 3, 3\)"),
    (sightings, {"covariances": np.zeros((2, 2, 3))}, r"covariances has D=3, but covariances has D=2"),
    (sightings, {"orientations": np.ones((2, 4))}, r"LandmarkSightings\.orientations\[0\]"),
    (grid, {"cells": np.full((2, 3), 101, np.int8)}, r"cells\[0, 0\] must be -1 or lie in 0\.\.100, got 101 \(and 5"),
    (grid, {"cells": np.full((2, 3), -2, np.int8)}, r"OccupancyGrid\.cells\[0, 0\]"),
    (grid, {"resolution": 0.0}, r"OccupancyGrid\.resolution must be above zero, got 0\.0"),
    (grid, {"resolution": NAN}, r"OccupancyGrid\.resolution must be above zero, got nan"),
    (grid, {"orientation": [1, 1, 0, 0]}, r"OccupancyGrid\.orientation must be a unit quaternion.*\[1\.0, 1\.0, 0"),
    (rooms, {"cells": np.full((2, 3), 1, np.int32)}, r"Rooms\.cells\[0, 0\] must be -1 or index the 1 rooms of ids"),
    (rooms, {"areas": [-1.0]}, r"Rooms\.areas\[0\] must lie in"),
    (planes, {"coefficients": [[0, 0, 2, 1]]}, r"Planes\.coefficients\[0\] must have unit length, got \[0\.0, 0\.0, 2"),
    (planes, {"labels": [0, 1]}, r"Planes\.labels\[1\] must be -1 or index the 1 planes"),
    (planes, {"extents": [[1, 1]]}, r"Planes\.extents is given without centers, orientations"),
    (planes, {"hulls": np.zeros((3, 3))}, r"Planes\.hulls is given without hull_counts"),
    (planes, {"hulls": np.zeros((3, 3)), "hull_counts": [4]}, r"Planes\.hull_counts\[0\] must lie in \[0, 3\]"),
    (planes, {"hulls": np.zeros((3, 3)), "hull_counts": [2]}, r"must add up to the 3 corners of hulls, got 2"),
    (planes, {"extents": [[1, -1]], "centers": [[0, 0, 0]], "orientations": [UNIT]}, r"extents\[0, 1\] must lie"),
    (planes, {"extents": [[1, 1]], "centers": [[0, 0, 0]], "orientations": [[0] * 4]}, r"orientations\[0\]"),
    (fix, {"latitude": 90.5}, r"NavSatFix\.latitude must lie in \[-90, 90\], got 90\.5"),
    (fix, {"longitude": 181.0}, r"NavSatFix\.longitude must lie in \[-180, 180\]"),
    (fix, {"latitude": NAN}, r"NavSatFix\.latitude must lie in \[-90, 90\], got nan"),
    (fix, {"status": "rtk"}, r"NavSatFix\.status must be one of no_fix, fix"),
    (tf, {"frames": ("map",)}, r"Transforms\.frames has 1 entries, but translations has 2: they must be parallel"),
    (tf, {"child_frames": ("odom",)}, r"Transforms\.child_frames has 1 entries"),
    (tf, {"child_frames": ("base", "base")}, r"Transforms\.child_frames must be unique, 'base'"),
    (tf, {"child_frames": ("map", "base")}, r"Transforms\.child_frames: 'map' must differ from its parent"),
    (tf, {"rotations": [UNIT, [0, 0, 0, 0]]}, r"Transforms\.rotations\[1\] must be a unit quaternion"),
    (status, {"names": ()}, r"Diagnostics\.names has 0 entries, but levels has 1"),
    (status, {"messages": ("a", "b")}, r"Diagnostics\.messages has 2 entries"),
    (status, {"hardware_ids": ("a", "b")}, r"Diagnostics\.hardware_ids has 2 entries, .* or hardware_ids empty"),
    (status, {"levels": [4]}, r"Diagnostics\.levels\[0\] must be a Level: 0 ok"),
    (status, {"owners": [1]}, r"Diagnostics\.owners\[0\] must index the 1 statuses, got 1"),
    (status, {"owners": None}, r"Diagnostics\.keys has 1 entries, but owners has 0"),
    (status, {"values": ()}, r"Diagnostics\.values has 0 entries"),
    (pose, {"orientation": [0, 0, 0, 0.9]}, r"Pose\.orientation must be a unit quaternion \(x, y, z, w\), got \[0\.0"),
    (example(m.Odometry, 0), {"orientation": [0, 0, 0, 2]}, r"Odometry\.orientation"),
    (example(m.Imu, 0), {"orientation": [0, 0, 0, 2]}, r"Imu\.orientation"),
    (path, {"stamps": [1, 5, 5]}, r"Path\.stamps must strictly increase, got 5 then 5 at index 2"),
    (path, {"orientations": [[1] * 4] * 3}, r"Path\.orientations\[0\]"),
    (mesh, {"triangles": [[0, 1, 3]]}, r"Mesh\.triangles\[0, 2\] must index the 3 vertices, got 3"),
    (clusters, {"labels": [1, -2]}, r"Clusters\.labels\[0\] must be -1 or .* 1 clusters of centroids, got 1 \(and 1"),
    (particles, {"weights": [-0.1]}, r"ParticleSet\.weights\[0\] must lie in"),
    (particles, {"weights": [np.inf]}, r"ParticleSet\.weights\[0\] must be finite"),
    (particles, {"poses": np.zeros((1, 7))}, r"ParticleSet\.poses\[0\] must end in a unit quaternion"),
    (scan, {"range_min": 5.0, "range_max": 1.0}, r"LaserScan\.range_min must be ≤ range_max, got 5\.0 and 1\.0"),
    (scan, {"angle_min": NAN}, r"LaserScan\.angle_min must be finite, got nan"),
    (scan, {"angle_max": np.inf}, r"LaserScan\.angle_max must be finite, got inf"),
    (scan, {"range_min": -np.inf}, r"LaserScan\.range_min must be finite"),
    (scan, {"range_max": NAN}, r"LaserScan\.range_min must be ≤ range_max"),
    (wheels, {"names": ("l",)}, r"WheelTicks\.names has 1 entries"),
    (wheels, {"names": ("l", "l")}, r"names must be unique, 'l'"),
    (joints, {"efforts": [1]}, r"JointState\.names has 2 entries, but efforts has 1"),
    (joints, {"names": ("a", "a")}, r"JointState\.names must be unique"),
    (m.FeatureVector(stamp=0, model="m", vectors=[[1, 2]]), {"labels": ("a", "b")}, r"FeatureVector\.labels has 2"),
    (image, {"data": np.zeros((0, 2), np.uint8)}, r"Image\.data must"),
    (depth, {"data": np.zeros((2, 0))}, r"DepthImage\.data must hold at least one element, got shape \(2, 0\)"),
    (picture, {"data": [1, 2, 3]}, r"CompressedImage\.data must hold a .* got 3 bytes .* 01 02 03"),
    (picture, {"format": "jpeg", "data": png8}, r"a jpeg file, got 29 bytes that begin with 89 50 .*, which is png"),
    (video, {"data": [0, 0, 0, 9, 0x65]}, r"begin with a start code .* got 5 bytes that begin with 00 00 00 09"),
    (packed, {"data": png8}, r"CompressedDepth\.data must hold a PNG file with one 16-bit channel"),
    (m.Switch(stamp=1, on=True), {"on": 1}, r"Switch\.on must be a bool"),
    (m.Alarm(stamp=1, level="error", name="x"), {"level": "bad"}, r"one of debug, info, warning, error, fatal"),
    (packed, {"data": []}, r"CompressedDepth\.data must hold a PNG .* got 0 bytes"),
    (packed, {"scale": -1.0}, r"CompressedDepth\.scale must be above zero"),
    (packed, {"offset": NAN}, r"CompressedDepth\.offset must be finite"),
]


def test_an_invalid_value_is_refused() -> None:
    for message, changes, error in REFUSED:
        with pytest.raises(MessageError, match=error):
            message.replace(**changes)


def test_the_decoder_refuses_it_as_well() -> None:
    for message, changes, error in REFUSED:
        values = dict(message.items()) | changes
        arrays = [_as_decoded(field, values[field.name]) for field in message.ARRAYS]
        header = [values[field.name] for field in message.SCALARS]
        with pytest.raises(MessageError):
            pytest.fail(f"{type(message).from_parts(message.stamp, header, arrays)} passes, though {error}")


def _as_decoded(field: ArrayField, data: Any) -> NDArray[Any] | None:
    if data is None:
        return None
    data = np.array(data, getattr(data, "dtype", None) if field.dtypes[1:] else field.dtypes[0], order="C")
    if data.size == 0 and data.ndim == 1 and len(field.shapes[0]) == 2:
        data = data.reshape(0, 3)
    data.flags.writeable = False
    return data


def test_values_for_missing_measurements_are_kept() -> None:
    odd = np.array([[0.0, -0.0, NAN, np.inf, -1.0]], np.float32)
    assert m.DepthImage(stamp=0, frame="c", data=odd).data.tobytes() == odd.tobytes()
    assert m.PointCloud(stamp=0, frame="l", points=odd[:, :3]).points.tobytes() == odd[:, :3].tobytes()
    assert LaserScan(stamp=0, frame="l", angle_min=0, angle_max=1, ranges=odd[0]).ranges.tobytes() == odd.tobytes()
    assert fix.replace(status="no_fix", latitude=NAN, longitude=NAN, altitude=NAN).status == "no_fix"
    assert segments.replace(confidence=np.full((2, 2), NAN)).confidence is not None


def test_a_track_may_lack_a_box_or_a_position() -> None:
    mixed = tracks.replace(
        boxes=[[NAN] * 4, [0, 0, 5, 5]], positions=[[1, 2, 3], [NAN] * 3], sizes=[[1, 1, 1], [NAN] * 3]
    )
    assert np.isnan(mixed.boxes[0]).all()


def test_quaternions_are_kept_as_they_are_within_the_tolerance() -> None:
    near = [0.0, 0.0, -0.0, 1.0009]
    assert pose.replace(orientation=near).orientation.tolist() == near


def test_void_pixels_need_no_class_name() -> None:
    classes = np.array([[0, 1], [255, 255]], np.uint8)
    assert segments.replace(classes=classes, void=255).void == 255
    assert segments.replace(classes=classes, class_names=()).class_names == ()


@pytest.mark.parametrize("model", ["double_sphere", "omnidirectional"])
def test_a_lens_model_unknown_here_is_passed_on(model: str) -> None:
    assert camera.replace(distortion_model=model, distortion=[0.1, 0.2, 0.3]).distortion_model == model


def test_a_clockwise_scanner_is_allowed() -> None:
    scan = LaserScan(stamp=0, frame="l", angle_min=1.0, angle_max=-1.0, ranges=[1, 1, 1])
    assert scan.angle_increment == -1.0
