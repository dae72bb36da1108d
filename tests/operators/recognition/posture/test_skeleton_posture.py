"""SkeletonPosture on a stick figure that a camera sees from all around."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dataflow.messages import Keypoints2D
from operators.detection.keypoint_detector import COCO_KEYPOINTS, COCO_LINKS
from operators.recognition import SkeletonPosture

TALL = 1.75
UPRIGHT = {"shoulder": (0, 0.82), "hip": (0, 0.53), "knee": (0, 0.285), "ankle": (0, 0.04)}
SEATED = {"shoulder": (0, 0.56), "hip": (0, 0.27), "knee": (0.245, 0.285), "ankle": (0.23, 0.04)}
"""How far ahead and how high joints are, in body heights."""


def seen(body: dict[str, tuple[float, float]], facing: float, pitch: float, roll: float) -> NDArray[np.float32]:
    """Returns joints (17, 2) in the image of a camera 1.4 m high and 3 m away; degrees."""
    points = np.full((17, 2), np.nan, np.float32)
    turned = Rotation.from_euler("z", facing, degrees=True)
    camera = Rotation.from_euler("yxz", [0, -pitch, roll], degrees=True)
    for part, (ahead, height) in body.items():
        for side, left in (("left", 1), ("right", -1)):
            x, y, z = turned.apply([ahead * TALL, 0.15 * left, height * TALL]) + np.array([3, 0, -1.4])
            u, v, depth = camera.apply([-y, -z, x])
            points[COCO_KEYPOINTS.index(f"{side}_{part}")] = 320 + 500 * u / depth, 240 + 500 * v / depth
    return points


def message(*people: NDArray[np.float32], scores: float = 0.9) -> Keypoints2D:
    points = np.stack(people)
    return Keypoints2D(
        stamp=5, frame="camera", width=640, height=480, names=COCO_KEYPOINTS, links=np.array(COCO_LINKS, np.int32),
        points=points, scores=np.full(points.shape[:2], scores, np.float32), ids=np.arange(len(points)) + 30,
    )  # fmt: skip


@pytest.mark.parametrize("pitch", [0.0, 15.0])
@pytest.mark.parametrize("roll", [0.0, 20.0])
def test_people_stand_or_sit_from_all_around(pitch: float, roll: float) -> None:
    ways = np.arange(0, 360, 45.0)
    for body, said in ((UPRIGHT, "standing"), (SEATED, "sitting")):
        found = SkeletonPosture().process(message(*(seen(body, way, pitch, roll) for way in ways)))
        assert found.labels() == (said,) * len(ways)
        assert found.ids.tolist() == [30 + k for k in range(len(ways))]
        assert found.scores.min() > 0.6


def test_hidden_or_unsure_joints_tell_nothing() -> None:
    whole = seen(UPRIGHT, 20, 0, 0)
    legless = seen({part: UPRIGHT[part] for part in ("shoulder", "hip")}, 20, 0, 0)
    operator = SkeletonPosture()
    found = operator.process(message(legless, whole))
    assert found.ids.tolist() == [31]
    assert not operator.process(message(whole, scores=0.3)).labels()
    assert operator.process(message(whole).replace(ids=None)).ids is None
    assert operator.summary() == {"persons": 4, "without a posture": 2}


def test_other_names_are_refused() -> None:
    named = message(seen(UPRIGHT, 0, 0, 0)).replace(names=())
    with pytest.raises(ValueError, match="keypoints have no left_shoulder"):
        SkeletonPosture().process(named)
