"""Postures of people by the joints that an image shows: how far the thighs go on from the trunk."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Classification, Keypoints2D
from dataflow.operator import Counts, In, Operator, Out, Param

F32 = NDArray[np.float32]

POSTURES = ("standing", "sitting")
_BETWEEN, _STEEP = 0.55, 12.0  # of the trunk: 0.85 of an upright body (Drillis and Contini), half of it or less seated
_SIDES = ("left", "right")


class SkeletonPosture(Operator):
    """Classifies people as standing or sitting by their joints in the image, without a further network.

    The thigh of a person who stands goes on from the trunk; that of one who sits leaves its direction, or points at the
    camera and is short. So the length of the thigh along the trunk is compared with the trunk's, whatever the roll of
    the camera. A person of whom no shoulder, hip and knee is seen has no row. Persons who crouch count as sitting, and
    those who lie down straight as standing.

    Body segments: Drillis and Contini, "Body segment parameters", 1966: shoulder to hip 0.288, hip to knee 0.245 of the
    height.
    """

    keypoints: In[Keypoints2D] = In(
        doc="joints of people with COCO's names; SceneGraphBuilder wants the ids of their nodes"
    )
    postures: Out[Classification] = Out(
        doc="standing or sitting, with probabilities, of each person whose joints show it"
    )

    least: float = Param(0.5, ge=0, le=1, tunable=True, doc="score from which a joint counts")

    state: Counts

    def process(self, keypoints: Keypoints2D) -> Classification:
        """Raises ValueError for points without the names of shoulders, hips and knees."""
        wanted = [f"{side}_{part}" for part in ("shoulder", "hip", "knee") for side in _SIDES]
        lacking = [name for name in wanted if name not in keypoints.names]
        if lacking and keypoints.count:
            raise ValueError(f"keypoints have no {', '.join(lacking)}: SkeletonPosture needs COCO's names")
        rows, shares = [], []
        for k in range(keypoints.count):
            joints = {name: keypoints.points[k, keypoints.names.index(name)] for name in wanted}
            sure = {name for name in wanted if keypoints.scores[k, keypoints.names.index(name)] >= self.least}
            share = _thigh_along_trunk({n: p for n, p in joints.items() if n in sure and np.isfinite(p).all()})
            if share is not None:
                rows.append(k)
                shares.append(share)
        self.state.counts.update({"persons": keypoints.count, "without a posture": keypoints.count - len(rows)})
        standing = 1 / (1 + np.exp(-_STEEP * (np.array(shares, np.float64) - _BETWEEN)))
        probabilities = np.column_stack([standing, 1 - standing]).astype(np.float32).reshape(-1, 2)
        return Classification(
            frame=keypoints.frame,
            class_names=POSTURES,
            class_ids=probabilities.argmax(axis=1).astype(np.int32),
            scores=probabilities.max(axis=1, initial=0.0),
            probabilities=probabilities,
            ids=None if keypoints.ids is None else keypoints.ids[rows],
        )


def _thigh_along_trunk(joints: dict[str, F32]) -> float | None:
    """Returns the longer thigh's length along the trunk, as a share of the trunk's; None where too little is seen."""
    shoulders, hips = (
        [joints[f"{s}_{part}"] for s in _SIDES if f"{s}_{part}" in joints] for part in ("shoulder", "hip")
    )
    if not shoulders or not hips:
        return None
    trunk = np.array(hips, np.float64).mean(axis=0) - np.array(shoulders, np.float64).mean(axis=0)
    length = float(trunk @ trunk)
    thighs = [
        joints[f"{s}_knee"].astype(np.float64) - joints[f"{s}_hip"]
        for s in _SIDES
        if f"{s}_knee" in joints and f"{s}_hip" in joints
    ]
    return max(float(thigh @ trunk) / length for thigh in thighs) if thighs and length > 0 else None
