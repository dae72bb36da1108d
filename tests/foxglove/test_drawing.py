"""Messages without a schema of Foxglove's are drawn so that nothing of what they say about space is lost."""

from __future__ import annotations

import numpy as np
import pytest
from example_messages import example

from dataflow.foxglove.drawing import data_of, drawing_of, schema_of
from dataflow.foxglove.server import FRAMES, Topics
from dataflow.messages import Detections2D, Keypoints2D, Mesh, Odometry, SceneGraph, SegmentationMap, Tracks, pack_masks
from dataflow.messages.base import message_types

UPRIGHT = [0.0, 0.0, 0.0, 1.0]
TYPES = [cls for cls in message_types().values() if cls.__module__.startswith("dataflow.messages.")]


def decoded(message):
    drawn = drawing_of(message)
    assert drawn is not None
    assert schema_of(message)[0].name == drawn.proto.DESCRIPTOR.full_name
    return drawn.proto.FromString(data_of(message))


@pytest.mark.parametrize("cls", TYPES, ids=lambda cls: cls.SCHEMA)
@pytest.mark.parametrize("seed", range(3))
def test_every_type_can_be_sent(cls, seed):
    message = example(cls, seed)
    schema, encoding = schema_of(message)

    assert (encoding, schema.encoding) in (("protobuf", "protobuf"), ("json", "jsonschema"))
    assert isinstance(data_of(message), bytes)


def test_a_scene_graph_has_a_cube_for_each_node_and_a_line_for_each_relation():
    scene = decoded(
        SceneGraph(
            stamp=1, frame="map", class_names=("cup", "table"), predicates=("on",), ids=np.array([5, 6]),
            class_ids=np.array([0, 1], np.int32), positions=np.array([[1.0, 2, 1], [1.0, 2, 0]]),
            sizes=np.array([[0.1, 0.1, 0.1], [1.0, 1.0, 0.7]]), subjects=np.array([0], np.int32),
            objects=np.array([1], np.int32),
        )
    )  # fmt: skip

    [entity] = scene.entities
    assert entity.frame_id == "map"
    assert [(c.pose.position.z, c.size.z) for c in entity.cubes] == [(1.0, 0.1), (0.0, 0.7)]
    assert [t.text for t in entity.texts] == ["cup", "table", "on"]
    assert [[(p.x, p.z) for p in line.points] for line in entity.lines] == [[(1.0, 1.0), (1.0, 0.0)]]
    assert scene.deletions[0].type == 1  # everything drawn before


def test_a_mask_is_drawn_by_the_pixels_at_its_rim():
    pixels = np.zeros((1, 6, 9), bool)
    pixels[0, 1:5, 2:6] = True
    over = decoded(
        Detections2D(
            stamp=1, frame="camera", width=9, height=6, boxes=[[2, 1, 6, 5]], scores=[1], class_ids=[0],
            masks=pack_masks(pixels),
        )
    )  # fmt: skip
    drawn = {(p.x, p.y) for p in over.points[0].points}
    assert drawn == {(x + 0.5, y + 0.5) for y in range(1, 5) for x in range(2, 6) if x in (2, 5) or y in (1, 4)}


def test_keypoints_are_drawn_as_limbs():
    drawn = decoded(
        Keypoints2D(
            stamp=1, frame="camera", width=9, height=6, links=[[0, 1], [1, 2]],
            points=[[[1, 2], [3, 4], [5, 6]]], scores=[[1, 0.6, 0.4]],
        )
    )  # fmt: skip
    assert [(p.x, p.y) for p in drawn.points[0].points] == [(1, 2), (3, 4)]


def tracks(**fields):
    count = 2
    return Tracks(
        stamp=1, frame="map", width=64, height=48, class_names=("person",), ids=np.array([3, 8]),
        class_ids=np.zeros(count, np.int32), states=np.ones(count, np.uint8), scores=np.ones(count, np.float32),
        ages=np.ones(count, np.float32), unseen=np.zeros(count, np.float32), **fields,
    )  # fmt: skip


def test_tracks_are_drawn_at_their_positions_or_over_the_image():
    boxes = np.array([[1, 2, 3, 4], [np.nan] * 4], np.float32)
    positions = np.array([[1.0, 2.0, 0.5], [np.nan] * 3])
    over = decoded(tracks(boxes=boxes))
    space = decoded(tracks(boxes=boxes, positions=positions, velocities=np.array([[0.5, 0, 0], [0.0, 0, 0]])))

    assert [t.text for t in over.texts] == ["person 3"]  # the other is not in the image
    [entity] = space.entities
    assert [t.text for t in entity.texts] == ["person 3"]  # nor is it known where
    assert [[p.x for p in line.points] for line in entity.lines] == [[1.0, 1.5]]


def test_a_mask_has_one_colour_for_each_class_and_none_for_void():
    mask = SegmentationMap(
        stamp=1, frame="camera", class_names=("a", "b"), void=255, classes=np.array([[0, 1, 255], [1, 0, 0]], np.uint8)
    )
    image = decoded(mask)
    pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)

    assert (image.encoding, image.step) == ("rgb8", 9)
    assert not pixels[0, 2].any()
    assert (pixels[0, 1] == pixels[1, 0]).all()
    assert (pixels[0, 0] != pixels[0, 1]).any()


def test_a_mesh_keeps_its_triangles_and_colours():
    mesh = Mesh(
        stamp=1, frame="map", vertices=np.eye(3, dtype=np.float32), triangles=np.array([[0, 1, 2]], np.uint32),
        colors=np.array([[255, 0, 0]] * 3, np.uint8),
    )  # fmt: skip
    [triangles] = decoded(mesh).entities[0].triangles

    assert list(triangles.indices) == [0, 1, 2]
    assert [(p.x, p.y, p.z) for p in triangles.points] == [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    assert triangles.colors[0].r == 1.0


def test_topics_leave_the_namespace_out_and_only_the_first_odometry_places_a_frame():
    topics = Topics("robot1")
    pose = Odometry(
        stamp=1, frame="odom", child_frame="base", position=np.zeros(3), orientation=np.array(UPRIGHT),
        linear=np.zeros(3), angular=np.zeros(3),
    )  # fmt: skip

    assert [topic for topic, _ in topics.of("robot1/vo/pose", pose)] == [FRAMES, "/vo/pose"]
    assert [topic for topic, _ in topics.of("robot1/wheels/pose", pose)] == ["/wheels/pose"]
