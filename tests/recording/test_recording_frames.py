"""The derived frame tree: what other people's viewers need to put things in place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from dataflow.messages import Odometry, Transforms
from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.streams.frames import VIEWER_ROOT, FrameTree


def odometry(stamp: int, frame: str = "odom", child: str = "base_link") -> Odometry:
    T = np.eye(4)
    T[0, 3] = stamp
    return Odometry.from_matrix(T, stamp=stamp, frame=frame, child_frame=child)


def test_the_first_stream_that_places_a_frame_is_followed_and_its_root_linked_once() -> None:
    tree = FrameTree()

    first = list(tree.transforms("wheels", odometry(1)))
    second = list(tree.transforms("wheels", odometry(2)))

    assert [(t.frames, t.child_frames) for t in first] == [(("odom", VIEWER_ROOT), ("base_link", "odom"))]
    assert [(t.frames, t.child_frames) for t in second] == [(("odom",), ("base_link",))]
    assert list(tree.transforms("visual", odometry(3))) == []


def test_a_frame_that_transforms_place_is_no_root() -> None:
    tree = FrameTree()
    link = Transforms.from_matrix(np.eye(4), stamp=0, frame="map", child_frame="odom")

    assert list(tree.transforms("slam", link)) == []
    assert [t.child_frames for t in tree.transforms("wheels", odometry(1))] == [("base_link",)]


def test_odometry_that_places_its_own_frame_is_no_transform() -> None:
    assert list(FrameTree().transforms("wheels", odometry(1, child="odom"))) == []


def test_the_derived_channel_is_there_for_others_and_no_stream_of_ours(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, metadata={}, namespace="robot1") as writer:
        writer.add_stream("robot1/vo/odometry", Odometry)
        for seq, stamp in enumerate((10, 20, 30)):
            writer.write("robot1/vo/odometry", odometry(stamp), seq=seq)

    with path.open("rb") as handle:
        reader = make_reader(handle, decoder_factories=[DecoderFactory()])
        found = [
            (transform.parent_frame_id, transform.child_frame_id, transform.translation.x)
            for _, _, _, proto in reader.iter_decoded_messages(topics=["robot1/@/frames"])
            for transform in proto.transforms
        ]
    assert found == [
        ("odom", "base_link", 10.0),
        (VIEWER_ROOT, "odom", 0.0),
        ("odom", "base_link", 20.0),
        ("odom", "base_link", 30.0),
    ]
    with Recording(path) as recording:
        assert list(recording.streams) == ["robot1/vo/odometry"]
