"""Foxglove protobufs of the well-known message types: each type's fields there, and what those lack.

An `encode` function returns the protobuf as parts (large arrays are not copied into it) and `lacks`: the names of the
fields that the protobuf does not hold exactly. They go into the companion. A `decode` function returns the fields that
the protobuf holds.
"""

from __future__ import annotations

from functools import partial

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage as CompressedImageProto
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo as CompressedVideoProto
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan as LaserScanProto
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud as PointCloudProto
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from dataflow.messages import (
    Alarm,
    CameraInfo,
    CompressedImage,
    CompressedVideo,
    DepthImage,
    Image,
    Image16,
    LaserScan,
    Message,
    NavSatFix,
    Odometry,
    Path,
    PointCloud,
    Pose,
    Transforms,
)
from dataflow.recording.streams.foxglove import clouds, images, poses, readings
from dataflow.recording.streams.foxglove.schema import FoxgloveSchema, file_descriptor_set, parsed
from dataflow.recording.streams.foxglove.values import Parts, stamp_of
from dataflow.recording.streams.pixels import as_depth, as_image, as_image16

__all__ = ["FOXGLOVE_SCHEMAS", "FoxgloveSchema", "Parts", "file_descriptor_set", "parsed", "stamp_of"]

FOXGLOVE_SCHEMAS: dict[type[Message], FoxgloveSchema] = {
    schema.message: schema
    for schema in (
        FoxgloveSchema(Image, RawImage, images.encode_image, partial(images.decode_raw, as_image)),
        FoxgloveSchema(Image16, RawImage, images.encode_image16, partial(images.decode_raw, as_image16)),
        FoxgloveSchema(DepthImage, RawImage, images.encode_depth, partial(images.decode_raw, as_depth)),
        FoxgloveSchema(CompressedImage, CompressedImageProto, images.encode_compressed, images.decode_compressed),
        FoxgloveSchema(CompressedVideo, CompressedVideoProto, images.encode_video, images.decode_video),
        FoxgloveSchema(
            CameraInfo,
            CameraCalibration,
            images.encode_camera,
            images.decode_camera,
            ("width", "height", "distortion_model", "distortion", "R", "P"),
        ),
        FoxgloveSchema(PointCloud, PointCloudProto, clouds.encode_cloud, clouds.decode_cloud, clouds.CLOUD_EXTRAS),
        FoxgloveSchema(Pose, PoseInFrame, poses.encode_pose, poses.decode_pose, ("child_frame", "covariance")),
        FoxgloveSchema(
            Odometry, PoseInFrame, poses.encode_odometry, poses.decode_pose, ("child_frame", *poses.ODOMETRY_EXTRAS)
        ),
        FoxgloveSchema(Transforms, FrameTransforms, poses.encode_transforms, poses.decode_transforms),
        FoxgloveSchema(Path, PosesInFrame, poses.encode_path, poses.decode_path, ("orientations", "stamps")),
        FoxgloveSchema(LaserScan, LaserScanProto, readings.encode_scan, readings.decode_scan, readings.SCAN_EXTRAS),
        FoxgloveSchema(NavSatFix, LocationFix, readings.encode_fix, readings.decode_fix, ("status", "satellites")),
        FoxgloveSchema(Alarm, Log, readings.encode_alarm, readings.decode_alarm),
    )
}
"""The writers of the well-known types. Every other type is JSON."""
