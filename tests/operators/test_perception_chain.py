"""The first operators together, as the shipped graphs wire them."""

from __future__ import annotations

from pathlib import Path

import pytest

from dataflow.graph import load_graph
from dataflow.operator import Source
from dataflow.testing import Played, play
from operators.cloud import CloudBuilder
from operators.evaluation import TrajectoryMetrics
from operators.odometry import VisualOdometry
from operators.sources import RgbdFolder, SyntheticRgbd

STATIC = ("depth_info", "image_info", "extrinsics")
CAMERA = ("image", "depth", *STATIC)


def chain(source: Source) -> tuple[Played, Played, TrajectoryMetrics]:
    """The clouds, the odometry and the score of a camera."""
    camera = play(source)
    streams = {port: camera[port] for port in CAMERA}
    cloud = play(CloudBuilder(stride=8), streams, static=STATIC)
    odometry = play(VisualOdometry(), streams, static=STATIC)
    metrics = TrajectoryMetrics()
    scored = play(metrics, {"estimate": odometry["odometry"], "ground_truth": camera["ground_truth"]})
    assert not {**cloud.drops, **odometry.drops, **scored.drops}
    return cloud, odometry, metrics


@pytest.mark.long
def test_the_made_up_sequence_is_tracked_and_every_pose_scored() -> None:
    cloud, odometry, metrics = chain(SyntheticRgbd(frames=30))
    figures = metrics.summary()
    assert len(cloud["cloud"]) == len(odometry["odometry"]) == figures["matched"] == 30
    assert figures["unmatched_estimates"] == figures["unmatched_truths"] == 0
    assert float(figures["path_m"]) > 0.4
    assert float(figures["ate_rmse_m"]) < 0.005


@pytest.mark.data
def test_the_first_real_frames_are_tracked(data_dir: Path) -> None:
    cloud, _, metrics = chain(RgbdFolder(path=str(data_dir / "rgbd_7scenes"), stop=40))
    figures = metrics.summary()
    assert len(cloud["cloud"]) == figures["matched"] == 40
    assert float(figures["ate_rmse_m"]) < 0.025


def test_two_plays_give_equal_digests() -> None:
    first, second = (chain(SyntheticRgbd(frames=5, width=160, height=120)) for _ in range(2))
    assert first[0].digests() == second[0].digests()
    assert first[1].digests() == second[1].digests()
    assert first[2].summary() == second[2].summary()


@pytest.mark.parametrize("name", ["rgbd_perception", "synthetic_rgbd"])
def test_the_shipped_graphs_are_correct(repository: Path, name: str) -> None:
    graph = load_graph(repository / "graphs" / f"{name}.yaml", settings=["camera.first_stamp=5"])
    assert graph.name == name
    assert {"camera", "cloud", "odometry", "metrics"} <= set(graph.nodes)
    assert all(graph.nodes["cloud"].inputs.values())
    assert all(graph.nodes["odometry"].inputs.values())
