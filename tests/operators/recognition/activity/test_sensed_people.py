"""Tracks of people from a map and the truth beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_graphs import scene_graph

from dataflow.messages import Pose, SceneGraph
from operators.recognition.activity.features import COUNT
from operators.recognition.activity.sensed_people import (
    SensedTrack,
    nearest_agents,
    read_tracks,
    sensed_tracks,
    write_tracks,
)

CLASSES = ("walking", "standing")


def graph(k: int, people: dict[int, float], chair: bool = False, *, rate: int = 4) -> SceneGraph:
    """The `k`-th of graphs that come so often a second: people by id and where along x they are."""
    things = [(id, "person", (x, 0, 0.8), (0.5, 0.5, 1.6)) for id, x in people.items()]
    things += [(99, "chair", (5.0, 0, 0.4), (0.5, 0.5, 1.6))] if chair else []
    return scene_graph(things, stamp=k * 1_000_000_000 // rate, frame="map")


def robot(k: int) -> Pose:
    return Pose(stamp=k, frame="map", position=(0, 0, 0), orientation=(0, 0, 0, 1))


def made(rate: int = 4) -> list[SensedTrack]:
    count = 12
    graphs = [graph(k, {7: 0.1 * k, 8: 30.0}, chair=True, rate=rate) for k in range(count)]
    truths = [graph(k, {1: 0.1 * k + 0.2}, rate=rate) for k in range(count)]
    doings = [{1: "walking" if k < 6 else "standing"} for k in range(count)]
    views = [{1} if k != 3 else set() for k in range(count)]
    return sensed_tracks(graphs, [robot(k) for k in range(count)], truths, doings, views, CLASSES)


def test_a_node_has_what_its_agent_did_a_quarter_of_a_second_before() -> None:
    (track,) = made()  # what is of no agent is no track
    assert track.features.shape == (12, COUNT)
    assert track.labels.tolist() == [0] * 7 + [1] * 5
    assert track.now.tolist() == [0] * 6 + [1] * 6
    assert track.plain.tolist() == [k != 3 for k in range(12)]
    assert track.right[4].tolist() == [True, True]  # two graphs before it changes
    assert track.right[2].tolist() == [True, False]


def test_more_frequent_graphs_give_a_track_for_each_of_the_steps_in_turn() -> None:
    first, second = made(rate=10)
    both = np.stack([first.now, second.now], axis=1).ravel()
    assert both.tolist() == [0] * 6 + [1] * 6


def test_the_nearest_of_a_class_are_one() -> None:
    assert nearest_agents(graph(0, {7: 0.0, 8: 0.5}), graph(0, {1: 0.4, 2: 9.0}, chair=True)) == {8: 1}


def test_tracks_are_read_as_they_were_written(tmp_path: Path) -> None:
    tracks = made()
    write_tracks(tmp_path / "1.npz", tracks)
    write_tracks(tmp_path / "2.npz", tracks)
    again = read_tracks(tmp_path)
    assert len(again) == 2
    for name in ("features", "labels", "now", "right", "plain"):
        np.testing.assert_array_equal(getattr(again[1], name), getattr(tracks[0], name))


def test_a_folder_without_tracks_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no tracks"):
        read_tracks(tmp_path)
