"""The derived frame tree: what other people's viewers need to put things in place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from made_recordings import recorded
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from dataflow.messages import Odometry, Transforms
from dataflow.recording import Recording
from dataflow.recording.streams.frames import VIEWER_ROOT, FrameTree


def odometry(stamp: int, frame: str = "odom", child: str = "base_link") -> Odometry:
    T = np.eye(4)
    T[0, 3] = stamp
    return Odometry.from_matrix(T, stamp=stamp, frame=frame, child_frame=child)


def test_the_first_stream_that_places_a_frame_is_followed_and_its_root_linked_once() -> None:
    tree = FrameTree()

    first, second = (tree.transforms("wheels", odometry(stamp)) for stamp in (1, 2))

    assert first is not None
    assert second is not None
    assert (first.frames, first.child_frames) == (("odom", VIEWER_ROOT), ("base_link", "odom"))
    assert (second.frames, second.child_frames) == (("odom",), ("base_link",))
    assert tree.transforms("visual", odometry(3)) is None


def test_a_frame_that_transforms_place_is_no_root() -> None:
    tree = FrameTree()
    link = Transforms.from_matrix(np.eye(4), stamp=0, frame="map", child_frame="odom")

    assert tree.transforms("slam", link) is None
    placed = tree.transforms("wheels", odometry(1))
    assert placed is not None
    assert placed.child_frames == ("base_link",)


def test_odometry_that_places_its_own_frame_is_no_transform() -> None:
    assert FrameTree().transforms("wheels", odometry(1, child="odom")) is None


def test_the_derived_channel_is_there_for_others_and_no_stream_of_ours(tmp_path: Path) -> None:
    rows = [("robot1/vo/odometry", odometry(stamp)) for stamp in (10, 20, 30)]
    path = recorded(tmp_path / "run.mcap", rows, namespace="robot1")

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
