"""Foxglove messages of other programs: clouds and scans with a pose, single transforms, 16-bit images."""

from __future__ import annotations

import json

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from dataflow.messages import Image, Image16, Transforms
from dataflow.messages import LaserScan as ScanMessage
from dataflow.messages import PointCloud as CloudMessage
from dataflow.recording import RecordingError
from dataflow.recording.streams.codecs import SchemaText
from dataflow.recording.streams.foreign import foreign_decoder, foreign_losses
from dataflow.recording.streams.foxglove.values import orientation_of

HALF = float(np.sqrt(0.5))


def decoded(proto: object) -> object:
    name = proto.DESCRIPTOR.full_name
    decode = foreign_decoder("protobuf", SchemaText(name, "protobuf", b""))
    assert decode is not None
    return decode(proto.SerializeToString(), 5)


def cloud() -> PointCloud:
    proto = PointCloud(frame_id="lidar", point_stride=12, data=np.array([[1, 0, 0], [0, 0, 1]], np.float32).tobytes())
    for k, axis in enumerate("xyz"):
        proto.fields.add(name=axis, offset=4 * k, type=PackedElementField.FLOAT32)
    return proto


def test_the_pose_of_a_cloud_is_applied() -> None:
    proto = cloud()
    proto.pose.position.x, proto.pose.orientation.z, proto.pose.orientation.w = 10.0, HALF, HALF

    found = decoded(proto)

    assert isinstance(found, CloudMessage)
    np.testing.assert_allclose(found.points, [[10, 1, 0], [10, 0, 1]], atol=1e-6)


def test_a_pose_that_is_not_set_moves_nothing() -> None:
    found = decoded(cloud())

    assert isinstance(found, CloudMessage)
    assert found.points.tolist() == [[1, 0, 0], [0, 0, 1]]


def test_a_scan_is_turned_about_z_and_refused_where_its_pose_is_more() -> None:
    proto = LaserScan(frame_id="laser", start_angle=-1.0, end_angle=1.0, ranges=[1.0, 1.0])
    proto.pose.orientation.z, proto.pose.orientation.w = HALF, HALF

    turned = decoded(proto)

    assert isinstance(turned, ScanMessage)
    assert turned.angle_min == pytest.approx(np.pi / 2 - 1.0)
    proto.pose.position.x = 1.0
    with pytest.raises(RecordingError, match="more than a turn about z"):
        decoded(proto)


def test_one_transform_is_a_set_of_one_as_protobuf_and_as_json() -> None:
    proto = FrameTransform(parent_frame_id="map", child_frame_id="base")
    proto.translation.x, proto.rotation.w = 2.0, 1.0
    value = {"parent_frame_id": "map", "child_frame_id": "base", "translation": {"x": 2.0}, "rotation": {"w": 1.0}}
    decode = foreign_decoder("json", SchemaText("foxglove.FrameTransform", "jsonschema", b"{}"))
    assert decode is not None

    for found in (decoded(proto), decode(json.dumps(value).encode(), 5)):
        assert isinstance(found, Transforms)
        assert (found.stamp, found.frames, found.child_frames) == (5, ("map",), ("base",))
        assert found.translations.tolist() == [[2, 0, 0]]


def test_points_of_64_bits_keep_them() -> None:
    far = np.array([[500_000.01, 5_000_000.02, 3.0]])
    proto = PointCloud(frame_id="utm", point_stride=24, data=far.tobytes())
    for k, axis in enumerate("xyz"):
        proto.fields.add(name=axis, offset=8 * k, type=PackedElementField.FLOAT64)

    found = decoded(proto)

    assert isinstance(found, CloudMessage)
    assert found.precise is not None
    assert found.precise.tolist() == far.tolist()


def test_images_of_other_encodings_become_rgb() -> None:
    found = decoded(RawImage(encoding="bgr8", width=1, height=1, step=3, data=bytes([1, 2, 3])))

    assert isinstance(found, Image)
    assert found.data.tolist() == [[[3, 2, 1]]]


def test_fields_of_points_that_have_no_place_are_named() -> None:
    proto = cloud()
    proto.fields.add(name="ambient", offset=0, type=PackedElementField.FLOAT32)
    schema = SchemaText("foxglove.PointCloud", "protobuf", b"")

    assert foreign_losses("protobuf", schema, proto.SerializeToString()) == ["the field ambient of the points"]
    assert foreign_losses("json", schema, b'{"frame_id": "a", "extra": 1}') == ["extra"]


def test_16_bit_images_keep_their_bits() -> None:
    pixels = np.array([[7000, 7001]], "<u2")

    found = decoded(RawImage(encoding="mono16", width=2, height=1, step=4, data=pixels.tobytes()))

    assert isinstance(found, Image16)
    assert found.data.tolist() == pixels.tolist()


@pytest.mark.parametrize(
    ("sent", "read"),
    [
        ((0, 0, 0, 0), (0, 0, 0, 1)),  # not set, which is usual where a pose is a place alone
        ((0, 0, 3, 4), (0, 0, 0.6, 0.8)),
        ((0, 0, 0.0004, 1), (0, 0, 0.0004, 1)),
    ],
)
def test_orientations_of_others_are_read_as_those_of_ros(sent: tuple[float, ...], read: tuple[float, ...]) -> None:
    assert orientation_of(Quaternion(**dict(zip("xyzw", sent, strict=True)))) == pytest.approx(read, abs=1e-15)
