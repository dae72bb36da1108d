"""SemanticMap on things far larger than is usual for their class: they stay, with their doubt."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_scene import INFO, Solid, camera, look

from dataflow.testing import Played, play
from operators.scene import ObjectLifter, SemanticMap

AROUND = [((0.3 * np.sin(k), 0.9 * np.sin(0.7 * k), 1.2), 0.15 * np.sin(k)) for k in range(14)]


def mapped(solid: Solid, label: str) -> Played:
    """The map of one thing, called so, that an ideal camera sees from 14 places."""
    lifter = ObjectLifter()
    lifter.setup()
    streams: dict[str, list[Any]] = {name: [] for name in ("boxes", "clusters", "cloud", "pose", "images")}
    for k, (position, yaw) in enumerate(AROUND):
        pose = camera((k + 1) * 200_000_000, position, yaw)
        cloud, detections, masks = look(pose, [solid], noise=0.004)
        detections = detections.replace(class_names=(label, *detections.class_names[1:]))
        masks = masks.replace(class_names=(label, *masks.class_names[1:]))
        lifted = lifter.process(detections, cloud, INFO, segmentation=masks, pose=pose)
        for name, message in (lifted | {"cloud": cloud, "pose": pose}).items():
            if name in streams:
                streams[name].append(message)
    return play(SemanticMap(labels="simulator"), streams | {"image_info": [INFO]}, static=["image_info"])


@pytest.mark.parametrize(
    ("label", "size", "center"),
    [
        ("chair", (0.95, 0.95, 1.0), (3.2, 0.2, 0.5)),  # an armchair
        pytest.param("chair", (0.45, 0.50, 0.95), (3.0, 0.2, 0.475), marks=pytest.mark.long),  # of the usual size
        pytest.param("bin", (0.48, 0.55, 0.93), (3.0, 0.2, 0.465), marks=pytest.mark.long),  # of 120 litres
        ("monitor", (0.10, 1.23, 0.71), (3.2, 0.2, 1.0)),  # of 55 inches
        pytest.param("shelf", (0.60, 1.0, 2.0), (3.8, 0.2, 1.0), marks=pytest.mark.long),
        pytest.param("box", (0.60, 0.80, 0.60), (3.0, 0.2, 0.3), marks=pytest.mark.long),  # for moving
        pytest.param("bottle", (0.27, 0.27, 0.49), (2.6, 0.2, 0.245), marks=pytest.mark.long),  # of a water cooler
        ("book", (0.62, 0.45, 0.06), (2.2, 0.2, 0.5)),  # an atlas that lies open
    ],
)
def test_objects_seen_often_are_mapped_at_any_size(
    label: str, size: tuple[float, float, float], center: tuple[float, float, float]
) -> None:
    objects = mapped((center, size, 0.2, 0), label)["objects"][-1]
    assert objects.labels() == (label,)
    assert np.linalg.norm((objects.centers[0] - center)[:2]) < 0.3


def test_unusually_large_object_is_doubted_in_score_and_status() -> None:
    armchair, chair = (
        mapped(((3.2, 0.2, size[2] / 2), size, 0.2, 0), "chair") for size in ((0.95, 0.95, 1.0), (0.45, 0.5, 0.95))
    )
    for played, doubted in ((armchair, 1), (chair, 0)):
        status, nodes = played["status"][-1], played["nodes"][-1]
        assert nodes.scores[0] == pytest.approx(0.5 if doubted else 1.0, abs=0.01)
        assert dict(zip(status.keys, status.values, strict=True))["doubted"] == str(doubted)
