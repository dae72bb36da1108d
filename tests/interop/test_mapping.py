"""Which topic stands in for which stream."""

from __future__ import annotations

import pytest

from dataflow.interop.mapping import AvailableTopic, MappingError, SourceStream, parse_map, propose


def wanted(name: str, *types: str, needed: bool = True, static: bool = False) -> SourceStream:
    return SourceStream(f"robot/{name}", name, types, static, needed)


IMAGE, DEPTH = wanted("camera/image", "Image"), wanted("camera/depth", "DepthImage")
LEFT, RIGHT = wanted("camera/left", "Image"), wanted("camera/right", "Image")


def test_unambiguous_types_settle_the_mapping() -> None:
    topics = [AvailableTopic("/rgb", ("Image",), 5), AvailableTopic("/d", ("CompressedDepth", "DepthImage"), 5)]

    found = propose([IMAGE, DEPTH], topics, {})

    assert found.settled
    assert {m.wanted.name: (m.topic, m.type) for m in found.matches} == {
        "camera/image": ("/rgb", "Image"),
        "camera/depth": ("/d", "DepthImage"),
    }


def test_names_propose_where_types_leave_a_choice() -> None:
    topics = [
        AvailableTopic("/stereo/right/image_rect", ("Image",), 5),
        AvailableTopic("/stereo/left/image_rect", ("Image",), 5),
    ]

    found = propose([LEFT, RIGHT], topics, {})

    assert not found.settled
    assert {m.wanted.name: m.topic for m in found.guessed} == {
        "camera/left": "/stereo/left/image_rect",
        "camera/right": "/stereo/right/image_rect",
    }


def test_one_topic_for_two_streams_is_no_certainty() -> None:
    assert not propose([LEFT, RIGHT], [AvailableTopic("/image", ("Image",), 5)], {}).settled


def test_given_topics_are_taken_and_not_proposed_again() -> None:
    topics = [AvailableTopic("/a", ("Image",), 5), AvailableTopic("/b", ("Image",), 5)]

    found = propose([LEFT, RIGHT], topics, {"robot/camera/left": "/b"})

    assert found.settled
    assert {m.wanted.name: m.topic for m in found.matches} == {"camera/left": "/b", "camera/right": "/a"}


def test_optional_stream_is_mapped_only_if_given() -> None:
    spare = wanted("camera/ground_truth", "Pose", needed=False)
    topics = [AvailableTopic("/pose", ("Pose",), 5)]

    assert propose([spare], topics, {}).matches == ()
    assert len(propose([spare], topics, {spare.stream: "/pose"}).matches) == 1


def test_missing_streams_are_named() -> None:
    assert [w.name for w in propose([IMAGE], [AvailableTopic("/pose", ("Pose",), 5)], {}).missing] == ["camera/image"]


def test_words_of_map_are_checked() -> None:
    assert parse_map(["a/rgb=camera/image"], [IMAGE], ["/a/rgb"]) == {"robot/camera/image": "/a/rgb"}
    for word, told in (
        ("/a", "expected TOPIC=STREAM"),
        ("/b=camera/image", "the bag has no topic '/b'; it has /a"),
        ("/a=camera/rgb", "no stream 'camera/rgb'; they have camera/image"),
    ):
        with pytest.raises(MappingError, match=told):
            parse_map([word], [IMAGE], ["/a"])
    with pytest.raises(MappingError, match="takes Image"):
        propose([IMAGE], [AvailableTopic("/a", ("Pose",), 1)], {IMAGE.stream: "/a"})
