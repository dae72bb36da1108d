"""Every message type can be drawn, at its stamp, with its values."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from example_messages import example
from made_video import PERIOD, clip, decoded
from scipy.spatial.transform import Rotation

from dataflow import messages
from dataflow.messages import (
    Alarm,
    Boxes3D,
    CameraInfo,
    CompressedDepth,
    CompressedVideo,
    DepthImage,
    Detections2D,
    Diagnostics,
    Image,
    Imu,
    Keypoints2D,
    Message,
    Number,
    OccupancyGrid,
    Odometry,
    PointCloud,
    RelativeDepth,
    Rooms,
    SegmentationMap,
    Switch,
    Text,
    Tracks,
    Transforms,
    array,
    pack_masks,
    scalar,
)
from dataflow.messages.declaration import Declaration, generic_type

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    import rerun as rr
    from rrd_rows import Row, at, draw

    from dataflow.view import ViewOptions, colors
    from dataflow.view.drawing import roles_of

TYPES = [
    value
    for value in vars(messages).values()
    if isinstance(value, type) and issubclass(value, Message) and value is not Message
]
STAMP = 1_700_000_000_123_456_789


def test_every_message_type_has_a_visualizer() -> None:
    assert len(TYPES) > 30
    assert [t.__name__ for t in TYPES if not roles_of(t)] == []


@pytest.mark.parametrize("message_type", TYPES, ids=lambda t: t.__name__)
def test_awkward_messages_of_every_type_are_drawn(message_type: type[Message], tmp_path: Path) -> None:
    for seed in range(6):  # all fields, no elements, no optional fields, mixtures; NaN and infinities throughout
        message = example(message_type, seed)
        found = draw(tmp_path, ("a/b", message))
        assert {row.stamp for row in found} <= {None, message.stamp}
    assert draw(tmp_path, *[("a/b", example(message_type, seed)) for seed in (0, 1, 2, 0)])


def test_an_image_is_sent_as_jpeg_or_as_it_is(tmp_path: Path) -> None:
    image = Image(stamp=STAMP, frame="camera", data=np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    found = draw(tmp_path, ("camera/image", image))
    (blob,) = at(found, "/camera/image", "EncodedImage:blob")
    assert blob.stamp == STAMP
    assert bytes(blob.values[0][:2]) == b"\xff\xd8"
    found = draw(tmp_path, ("camera/image", image), options=ViewOptions(jpeg_quality=None))
    (buffer,) = at(found, "/camera/image", "Image:buffer")
    assert bytes(buffer.values[0]) == image.data.tobytes()


@pytest.mark.parametrize("step", [0, 4 * PERIOD])
def test_video_is_decoded_without_the_frames_lost(step: int, tmp_path: Path) -> None:
    packets = [
        CompressedVideo(stamp=k * PERIOD, frame="camera", format="h264", data=np.frombuffer(packet, np.uint8))
        for k, packet in enumerate(clip("h264"))
    ]
    pixels = {m.stamp: frame for m, frame in zip(packets, decoded("h264", clip("h264")), strict=True)}
    del packets[10]
    sent = [("camera/video", packet) for packet in packets]
    found = draw(tmp_path, *sent, options=ViewOptions(jpeg_quality=None, image_step=step))
    shown = {row.stamp: bytes(row.values[0]) for row in at(found, "/camera/video", "Image:buffer")}
    lost = [k * PERIOD for k in range(11, 16)]
    assert list(shown) == [s for s in pixels if s // PERIOD not in range(10, 16) and (not step or s % step == 0)]
    assert all(buffer == pixels[stamp].tobytes() for stamp, buffer in shown.items())
    assert [row.stamp for row in at(found, "/camera/video", "Clear:is_recursive")] == lost
    (notice,) = at(found, "/viewer/log", "TextLog:text")
    assert "frame 3 follows frame 1" in notice.values[0]


def test_depth_survives_to_the_millimetre_and_no_return_stays_none(tmp_path: Path) -> None:
    import cv2

    depth = np.array([[0.0, np.nan, 0.5], [1.2345, 6.0, np.inf]], np.float32)
    found = draw(tmp_path, ("camera/depth", DepthImage(stamp=STAMP, frame="camera", data=depth)))
    (blob,) = at(found, "/camera/depth", "EncodedDepthImage:blob")
    (meter,) = at(found, "/camera/depth", "EncodedDepthImage:meter")
    back = cv2.imdecode(np.array(blob.values[0], np.uint8), cv2.IMREAD_UNCHANGED) / meter.values[0]
    np.testing.assert_allclose(back, [[0, 0, 0.5], [1.2345, 6.0, 0]], atol=0.0005001)


def test_nearness_has_the_colours_of_its_rank_and_unknown_pixels_are_black(tmp_path: Path) -> None:
    data = np.array([[np.nan, 0.2], [0.5, 3.0]], np.float32)
    found = draw(tmp_path, ("mono/relative", RelativeDepth(stamp=STAMP, frame="camera", data=data)))
    (buffer,) = at(found, "/mono/relative", "Image:buffer")
    unknown, far, _, near = np.frombuffer(bytes(buffer.values[0]), np.uint8).reshape(4, 3).astype(int)
    assert unknown.tolist() == [0, 0, 0]
    assert near[0] > near[2]  # red
    assert far[0] < far[2] + 40  # dark blue


def test_inverse_depth_is_decoded(tmp_path: Path) -> None:
    import cv2

    png = cv2.imencode(".png", np.array([[0, 110, 210]], np.uint16))[1].ravel()
    message = CompressedDepth(stamp=STAMP, frame="c", quantizer="inverse", scale=100.0, offset=10.0, data=png)
    found = draw(tmp_path, ("camera/depth", message), options=ViewOptions(depth_step=None))
    (buffer,) = at(found, "/camera/depth", "DepthImage:buffer")
    np.testing.assert_allclose(np.frombuffer(bytes(buffer.values[0]), np.float32), [0.0, 1.0, 0.5])


def test_depth_png_finer_than_depth_step_is_reencoded(tmp_path: Path) -> None:
    import cv2

    noise = np.random.default_rng(0).integers(0, 20, (48, 64)).astype(np.uint16)
    png = cv2.imencode(".png", 2000 + noise)[1].ravel()
    message = CompressedDepth(stamp=STAMP, frame="c", quantizer="linear", scale=0.001, offset=0.0, data=png)
    later = message.replace(stamp=STAMP + 1)
    fine = at(draw(tmp_path, ("c/d", message), ("c/d", later)), "/c/d", "EncodedDepthImage:blob")[-1]
    options = ViewOptions(depth_step=0.02)
    found = draw(tmp_path, ("c/d", message), ("c/d", later), options=options)
    coarse = at(found, "/c/d", "EncodedDepthImage:blob")[-1]
    assert bytes(fine.values[0]) == png.tobytes()
    assert len(coarse.values[0]) < len(fine.values[0]) / 2
    metres = cv2.imdecode(np.array(coarse.values[0], np.uint8), cv2.IMREAD_UNCHANGED) * 0.02
    np.testing.assert_allclose(metres, 2.0 + noise * 0.001, atol=0.0101)


def test_depth_keeps_its_colours_and_has_a_scale(tmp_path: Path) -> None:
    near = DepthImage(stamp=STAMP, frame="c", data=np.full((32, 32), 1.7, np.float32))
    far = DepthImage(stamp=STAMP + 1, frame="c", data=np.full((32, 32), 40.0, np.float32))
    found = draw(tmp_path, ("camera/depth", near), ("camera/depth", far))
    meters = [row.values[0] for row in at(found, "/camera/depth", "EncodedDepthImage:meter")]
    ranges = [row.values[0] for row in at(found, "/camera/depth", "EncodedDepthImage:depth_range")]
    np.testing.assert_allclose([end / meter for (_, end), meter in zip(ranges, meters, strict=True)], [2.0, 2.0])
    (labels,) = at(found, "/camera/depth/scale/marks", "Points2D:labels")
    assert labels.values == ["0 m", "0.5 m", "1 m", "1.5 m", "2 m"]


def test_every_class_can_be_read_on_dark_ground() -> None:
    for number in range(200):
        linear = (np.array(colors.of_identity(number)) / 255) ** 2.2
        luminance = float(linear @ (0.2126, 0.7152, 0.0722))
        assert (luminance + 0.05) / (0.02 + 0.05) > 4.5


def test_detections_lie_in_the_plane_of_their_camera(tmp_path: Path) -> None:
    info = CameraInfo.from_intrinsics(stamp=STAMP, frame="optical", width=64, height=48, fx=50, fy=50, cx=32, cy=24)
    image = Image(stamp=STAMP, frame="optical", data=np.zeros((48, 64, 3), np.uint8))
    boxes = Detections2D(
        stamp=STAMP, frame="optical", width=64, height=48, class_names=("cup", "chair"),
        boxes=[[10, 20, 30, 40]], scores=[0.75], class_ids=[1],
    )  # fmt: skip
    found = draw(tmp_path, ("camera/info", info), ("camera/image", image), ("detector/boxes", boxes))
    (plane,) = at(found, "/camera/info", "Pinhole:child_frame")
    assert at(found, "/camera/info", "Pinhole:parent_frame")[0].values == ["optical"]
    assert at(found, "/camera/image", "CoordinateFrame:frame")[0].values == plane.values
    assert at(found, "/detector/boxes/overlay", "CoordinateFrame:frame")[0].values == plane.values
    assert at(found, "/detector/boxes/overlay", "Boxes2D:centers")[0].values == [[20.0, 30.0]]
    assert at(found, "/detector/boxes/overlay", "Boxes2D:labels")[0].values == ["chair 0.75"]


def test_masks_are_a_layer_that_goes_when_a_message_has_none(tmp_path: Path) -> None:
    pixels = np.zeros((1, 48, 64), bool)
    pixels[0, 20:40, 10:30] = True
    masked = Detections2D(
        stamp=STAMP, frame="optical", width=64, height=48, boxes=[[10, 20, 30, 40]], scores=[0.75], class_ids=[1],
        masks=pack_masks(pixels),
    )  # fmt: skip
    found = draw(tmp_path, ("d/x", masked), ("d/x", masked.replace(stamp=STAMP + 1, masks=None)))
    (layer,) = at(found, "/d/x/overlay/masks", "Image:buffer")
    alpha = np.array(layer.values, np.uint8).reshape(48, 64, 4)[..., 3]
    np.testing.assert_array_equal(alpha > 0, pixels[0])
    (cleared,) = at(found, "/d/x/overlay/masks", "Clear:is_recursive")
    assert cleared.stamp == STAMP + 1


def test_limbs_are_drawn_between_points_that_were_found(tmp_path: Path) -> None:
    points = [[[1, 2], [3, 4], [5, 6]], [[7, 8], [np.nan, np.nan], [9, 10]]]
    message = Keypoints2D(
        stamp=STAMP, frame="optical", width=64, height=48, links=[[0, 1], [1, 2], [0, 2]], points=points,
        scores=[[0.9, 0.6, 0.2], [0.9, 0.9, 0.9]],
    )  # fmt: skip
    found = draw(tmp_path, ("k/x", message))
    (limbs,) = at(found, "/k/x/overlay/limbs", "LineStrips2D:strips")
    assert limbs.values == [[[1, 2], [3, 4]], [[7, 8], [9, 10]]]
    (shown,) = at(found, "/k/x/overlay/points", "Points2D:positions")
    assert shown.values == [[1, 2], [3, 4], [7, 8], [9, 10]]


def test_a_class_has_one_colour_whatever_its_number(tmp_path: Path) -> None:
    def boxes(names: tuple[str, ...], chosen: int) -> Boxes3D:
        return Boxes3D(
            stamp=STAMP, frame="map", class_names=names, centers=[[0, 0, 0]], sizes=[[1, 1, 1]],
            orientations=[[0, 0, 0, 1]], scores=[1.0], class_ids=[chosen],
        )  # fmt: skip

    found = draw(
        tmp_path, ("a/x", boxes(("cup", "chair"), 1)), ("b/x", boxes(("chair",), 0)), ("c/x", boxes(("cup",), 0))
    )
    a, b, c = (at(found, f"/{name}/x/space", "Boxes3D:colors")[0].values for name in "abc")
    assert a == b != c


def test_points_are_thinned_only_with_notice(tmp_path: Path) -> None:
    points = np.arange(300, dtype=np.float32).reshape(100, 3)
    cloud = PointCloud(stamp=STAMP, frame="lidar", points=points)
    found = draw(tmp_path, ("l/c", cloud))
    assert at(found, "/l/c/space", "Points3D:positions")[0].values == points.tolist()
    assert not at(found, "/viewer/log", "TextLog:text")
    found = draw(tmp_path, ("l/c", cloud), ("l/c", cloud.replace(stamp=STAMP + 1)), options=ViewOptions(max_points=40))
    assert [len(row.values) for row in at(found, "/l/c/space", "Points3D:positions")] == [34, 34]
    (notice,) = at(found, "/viewer/log", "TextLog:text")
    assert "at most 40 points" in notice.values[0]


def odometry(t: int, x: float, **fields: object) -> Odometry:
    return Odometry(
        stamp=STAMP + t, frame="odom", child_frame="base", position=[x, 0, 0], orientation=[0, 0, 0, 1], **fields
    )


def test_entity_first_drawn_later_has_its_frame_from_the_beginning(tmp_path: Path) -> None:
    """The viewer reports an error of an entity whose frame it does not know, also while nothing of it is drawn."""
    told = [("first", cloud_in("odom", 5)), ("later", cloud_in("odom", 30)), ("later", cloud_in("odom", 40))]
    found = draw(tmp_path, *told)
    frames = at(found, "/later/space", "CoordinateFrame:frame")
    assert [(row.stamp, row.values) for row in frames] == [(t, ["odom"]) for t in (5, 30, 40)]


def test_a_moving_robot_carries_its_sensors_and_leaves_a_trail(tmp_path: Path) -> None:
    fixed = Transforms(
        stamp=0, frames=["base"], child_frames=["lidar"], translations=[[0, 0, 1]], rotations=[[0, 0, 0, 1]]
    )
    drawn = [("tf/static", fixed)] + [("w/odom", odometry(i, x)) for i, x in enumerate((0.0, 1.0, 1.001, 3.0))]
    found = draw(tmp_path, *drawn, static=("tf/static",))
    (mounted,) = at(found, "/frames/lidar", "Transform3D:translation")
    assert mounted.stamp is None  # static
    moved = at(found, "/frames/base", "Transform3D:translation")
    assert [row.values[0][0] for row in moved if row.stamp >= STAMP][-1] == 3.0
    trail = at(found, "/w/odom/space/trail", "LineStrips3D:strips")
    assert [row.values for row in trail] == [[[[0, 0, 0], [1, 0, 0]]], [[[1, 0, 0], [3, 0, 0]]]]
    assert [row.stamp for row in trail] == [STAMP + 1, STAMP + 3]


def test_poses_in_quick_succession_are_drawn_seldom_but_their_frames_placed_with_each(tmp_path: Path) -> None:
    lost = odometry(5, np.nan)
    told = [*(odometry(t, float(t)) for t in (0, 1, 2, 3, 4)), lost, odometry(6, 6.0)]
    found = draw(tmp_path, *[("w/odom", each) for each in told], options=ViewOptions(pose_step=3))
    axes = at(found, "/w/odom/space/axes", "Arrows3D:origins")
    assert [row.stamp - STAMP for row in axes if row.values] == [0, 3, 6]  # where it was lost it is drawn at once
    placed = at(found, "/frames/base", "Transform3D:translation")
    assert {row.stamp - STAMP for row in placed} >= {0, 1, 2, 3, 4, 6}


@pytest.mark.parametrize("late", [-5, 0, 5])
@pytest.mark.parametrize("order", list(permutations(["color", "depth", "odom", "mounts"])), ids="-".join)
def test_mounts_hold_in_any_order_of_arrival(tmp_path: Path, order: tuple[str, ...], late: int) -> None:
    mounts = Transforms(
        stamp=STAMP + late,
        frames=["base", "depth"],
        child_frames=["depth", "color"],
        translations=[[0, 0, 1], [0, 2, 0]],
        rotations=[[0, 0, 0, 1]] * 2,
    )
    told: dict[str, Message] = {
        "color": cloud_in("color", STAMP),
        "depth": cloud_in("depth", STAMP + 1),
        "odom": odometry(2, 1.0),
        "mounts": mounts,
    }
    found = draw(tmp_path, *[(name, told[name]) for name in order], static=("mounts",))
    assert chain(found, "color", STAMP + 9) == ["color", "depth", "base", "odom"]


def cloud_in(frame: str, stamp: int) -> PointCloud:
    return PointCloud(stamp=stamp, frame=frame, points=np.ones((3, 3), np.float32))


def chain(found: list[Row], frame: str, stamp: int) -> list[str]:
    """The frame and those that it hangs below, as Rerun finds them: a static row is of no use beside earlier ones."""
    path = [frame]
    while len(path) < 9:
        parents = at(found, f"/frames/{path[-1]}", "Transform3D:parent_frame")
        assert len({row.stamp is None for row in parents}) <= 1, f"{path[-1]} has both static rows and others"
        known = [row for row in parents if row.stamp is None or row.stamp <= stamp]
        if not known:
            return path
        path += sorted(known, key=lambda row: row.stamp or 0)[-1].values
    raise AssertionError(f"a loop: {path}")


def test_a_lost_pose_is_not_drawn_and_breaks_the_trail(tmp_path: Path) -> None:
    found = draw(tmp_path, ("w/o", odometry(0, 0.0)), ("w/o", odometry(1, np.nan)), ("w/o", odometry(2, 1.0)))
    assert not at(found, "/w/o/space/trail", "LineStrips3D:strips")
    assert all(np.isfinite(row.values[0]).all() for row in at(found, "/frames/base", "Transform3D:translation"))


def test_ended_tracks_disappear_and_paths_are_bounded_in_time(tmp_path: Path) -> None:
    def tracks(t: int, state: int) -> Tracks:
        return Tracks(
            stamp=STAMP + t * 1_000_000_000, frame="map", ids=[7], states=[state], scores=[1.0], class_ids=[0],
            ages=[1.0], unseen=[0.0], positions=[[float(t), 0, 0]],
        )  # fmt: skip

    found = draw(tmp_path, *[("t/t", tracks(t, 1)) for t in range(9)], ("t/t", tracks(9, 3)))
    paths = at(found, "/t/t/space/paths", "LineStrips3D:strips")
    assert [x for x, _, _ in paths[8].values[0]] == [3, 4, 5, 6, 7, 8]
    assert at(found, "/t/t/space", "Points3D:positions")[9].values == []


def test_a_track_that_was_not_matched_for_a_while_leaves_the_image(tmp_path: Path) -> None:
    message = Tracks(
        stamp=STAMP, frame="camera", width=64, height=48, ids=[7, 8], states=[2, 2], scores=[1.0, 1.0],
        class_ids=[0, 0], ages=[1.0, 1.0], unseen=[0.1, 0.8], boxes=[[1, 2, 11, 22], [30, 2, 41, 22]],
    )  # fmt: skip
    found = draw(tmp_path, ("t/t", message))
    (boxes,) = at(found, "/t/t/overlay", "Boxes2D:half_sizes")
    assert np.allclose(np.array(boxes.values), [(5.0, 10.0)])


def test_segmentation_names_its_classes_and_hides_void(tmp_path: Path) -> None:
    message = SegmentationMap(
        stamp=STAMP, frame="c", class_names=("road", "tree"), void=255, classes=np.array([[0, 1, 255]], np.uint8)
    )
    found = draw(tmp_path, ("s/m", message), ("s/m", message.replace(stamp=STAMP + 1)))
    (context,) = at(found, "/s/m/overlay", "AnnotationContext:context")
    table = {e["class_id"]: e["class_description"]["info"] for e in context.values[0]}
    assert [table[i]["label"] for i in (0, 1, 255)] == ["road", "tree", "void"]
    assert table[255]["color"] & 0xFF == 0
    assert len(at(found, "/s/m/overlay", "SegmentationImage:buffer")) == 2


def test_a_grid_lies_with_its_first_row_at_the_origin(tmp_path: Path) -> None:
    grid = OccupancyGrid(
        stamp=STAMP, frame="map", resolution=0.5, cells=np.array([[0, 100], [-1, 50]], np.int8), position=[1, 2, 0]
    )
    found = draw(tmp_path, ("m/g", grid))
    (data,) = at(found, "/m/g/space", "GridMap:data")
    assert data.values[0] == [255, 50, 0, 100]  # an image has its first row at the top
    assert at(found, "/m/g/space", "GridMap:translation")[0].values == [[1, 2, 0]]


def test_rooms_are_floors_with_their_areas_and_doors_with_their_widths(tmp_path: Path) -> None:
    cells = np.array([[0, 0, -1, 1], [-1, 0, -1, 1]], np.int32)
    rooms = Rooms(
        stamp=STAMP, frame="map", resolution=0.5, cells=cells, position=[1, 2, 0], ids=[1, 7], areas=[0.75, 0.5],
        centers=[[1.5, 2.5, 0], [2.75, 2.5, 0]], doors=[[0, 1]], door_positions=[[2.25, 2.5, 0]], door_widths=[0.8],
    )  # fmt: skip
    found = draw(tmp_path, ("m/r", rooms))
    corners = np.array(at(found, "/m/r/space", "Mesh3D:vertex_positions")[0].values).reshape(-1, 4, 3)
    spans = [(*part.min(axis=0)[:2].tolist(), *part.max(axis=0)[:2].tolist()) for part in corners]
    assert spans == [(1, 2, 2, 2.5), (2.5, 2, 3, 2.5), (1.5, 2.5, 2, 3), (2.5, 2.5, 3, 3)]
    labels = at(found, "/m/r/space/places", "Points3D:labels")[0].values
    assert labels == ["room 1: 0.8 m²", "room 7: 0.5 m²", "door 0.80 m"]


def test_curves_carry_names_and_values(tmp_path: Path) -> None:
    imu = Imu(stamp=STAMP, frame="imu", angular_velocity=[1, 2, np.nan], linear_acceleration=[0, 0, 9.81])
    found = draw(tmp_path, ("i/d", imu))
    (gyro,) = at(found, "/i/d/plot/gyroscope", "Scalars:scalars")
    np.testing.assert_array_equal(gyro.values, [1, 2, np.nan])
    assert at(found, "/i/d/plot/accelerometer", "SeriesLines:names")[0].values == ["ax m/s²", "ay m/s²", "az m/s²"]


def test_an_orientation_is_drawn_as_roll_pitch_and_yaw_in_degrees(tmp_path: Path) -> None:
    imu = Imu(
        stamp=STAMP, frame="imu", angular_velocity=[0, 0, 0], linear_acceleration=[0, 0, 9.81],
        orientation=Rotation.from_euler("xyz", [10, -20, 130], degrees=True).as_quat(),
    )  # fmt: skip
    (row,) = at(draw(tmp_path, ("i/d", imu)), "/i/d/plot/orientation", "Scalars:scalars")
    np.testing.assert_allclose(row.values, [10, -20, 130])


def test_diagnostics_are_logged_on_change_and_plotted_by_kind(tmp_path: Path) -> None:
    def health(t: int, level: int) -> Diagnostics:
        return Diagnostics(
            stamp=STAMP + t, names=("camera",), messages=("fine" if level == 0 else "hot",), levels=[level],
            keys=("rate_hz", "latency", "note"), values=("30", "4.5 ms", "x"), owners=[0, 0, 0],
        )  # fmt: skip

    found = draw(tmp_path, *[("d/d", health(t, level)) for t, level in enumerate((0, 0, 2, 2))])
    assert [row.values[0] for row in at(found, "/d/d/log", "TextLog:text")] == ["camera: OK fine", "camera: ERROR hot"]
    assert [row.values[0] for row in at(found, "/d/d/log", "TextLog:level")] == ["INFO", "ERROR"]
    assert [row.values[0] for row in at(found, "/d/d/status/camera", "StateChange:state")] == ["OK", "ERROR"]
    assert at(found, "/d/d/plot/rate/camera/rate_hz", "Scalars:scalars")[0].values == [30.0]
    assert at(found, "/d/d/plot/latency/camera/latency", "Scalars:scalars")[0].values == [4.5]


class Weather(Message, schema="tests.view.Weather"):
    """A type that nobody wrote a visualiser for."""

    temperature: float = scalar("float", "°C")
    sky: str = scalar("str", "what it looks like")
    wind: object = array("float32", "2", "m/s, to the east and to the north")
    gusts: object = array("float32", "N", "of the last minute, m/s")


def test_type_without_visualiser_is_plotted_and_logged(tmp_path: Path) -> None:
    def weather(t: int, sky: str) -> Weather:
        return Weather(stamp=STAMP + t, temperature=20.5, sky=sky, wind=[3, 4], gusts=[5, 6, 7])

    found = draw(tmp_path, *[("w/d", weather(t, sky)) for t, sky in enumerate(("grey", "grey", "blue"))])
    assert at(found, "/w/d/plot/temperature", "Scalars:scalars")[0].values == [20.5]
    assert at(found, "/w/d/plot/wind", "Scalars:scalars")[0].values == [3.0, 4.0]
    assert at(found, "/w/d/plot/wind", "SeriesLines:names")[0].values == ["wind 0", "wind 1"]
    assert [row.values[0] for row in at(found, "/w/d/log", "TextLog:text")] == [
        "tests.view.Weather sky='grey', gusts: float32[3]",
        "tests.view.Weather sky='blue', gusts: float32[3]",
    ]


def test_a_type_known_from_a_recording_alone_is_drawn_the_same(tmp_path: Path) -> None:
    message = Weather(stamp=STAMP, temperature=20.5, sky="grey", wind=[3, 4], gusts=[5])
    made = generic_type(Declaration.of(Weather))
    again = made.from_parts(STAMP, message.header(), message.arrays())
    one, other = ([row for row in draw(tmp_path, ("w/d", m)) if row.entity.startswith("/w")] for m in (again, message))
    assert one == other != []


def test_numbers_and_switches_are_curves_named_for_their_streams(tmp_path: Path) -> None:
    found = draw(
        tmp_path,
        ("robot/tank/level", Number(stamp=STAMP, value=0.5, unit="l")),
        ("robot/door/open", Switch(stamp=STAMP, on=False)),
        ("robot/door/open", Switch(stamp=STAMP + 1, on=True)),
    )
    assert at(found, "/robot/tank/level/plot/value", "Scalars:scalars")[0].values == [0.5]
    assert at(found, "/robot/tank/level/plot/value", "SeriesLines:names")[0].values == ["tank/level l"]
    assert [row.values for row in at(found, "/robot/door/open/plot/on", "Scalars:scalars")] == [[0.0], [1.0]]
    steps = rr.components.InterpolationMode.StepAfter.value
    assert at(found, "/robot/door/open/plot/on", "SeriesLines:interpolation_mode")[0].values == [steps]


def test_texts_and_alarms_are_lines_of_the_log_with_levels(tmp_path: Path) -> None:
    levels = ("debug", "info", "warning", "error", "fatal")
    found = draw(
        tmp_path,
        ("a/said", Text(stamp=STAMP, text="hello")),
        *[("a/alarm", Alarm(stamp=STAMP + i, level=level, name="arm", text="hot")) for i, level in enumerate(levels)],
    )
    assert [row.values[0] for row in at(found, "/a/said/log", "TextLog:text")] == ["hello"]
    assert {row.values[0] for row in at(found, "/a/alarm/log", "TextLog:text")} == {"arm: hot"}
    shown = [row.values[0] for row in at(found, "/a/alarm/log", "TextLog:level")]
    assert shown == ["DEBUG", "INFO", "WARN", "ERROR", "CRITICAL"]
