"""Memory of a stereo odometry, as plain values that an operator's snapshot may hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from operators.monitoring.image_flaws import Watch
from operators.odometry.motion import Motion
from operators.odometry.plain import fields_of
from operators.odometry.stereo.adjustment import Sightings
from operators.odometry.stereo.map import StereoMap
from operators.odometry.stereo.relocalizer import StereoKeyframe
from operators.odometry.stereo.tracker import StereoState


def to_plain(state: StereoState) -> dict[str, Any]:
    """Numbers, arrays, lists and mappings; `from_plain` is the inverse."""
    return {
        "motion": None if state.motion is None else fields_of(state.motion),
        "covariance": state.covariance,
        "left": state.left,
        "watch": [fields_of(watch) for watch in state.watch],
        "poses": state.poses,
        "points": state.points,
        "pixels": state.pixels,
        "seen": fields_of(state.seen),
        "offset": state.offset,
        "map": fields_of(state.map) | {"keyframes": [fields_of(k) for k in state.map.keyframes]},
    }


def from_plain(values: Mapping[str, Any]) -> StereoState:
    """Raises KeyError or TypeError for what `to_plain` did not make, in this version or the one before it."""
    motion, known = values["motion"], values.get("map", {"keyframes": ()})
    first, second = (Watch(**watch) for watch in values["watch"])
    return StereoState(
        motion=None if motion is None else Motion(**motion),
        covariance=values["covariance"],
        left=values["left"],
        watch=(first, second),
        poses=values["poses"],
        points=values["points"],
        pixels=values["pixels"],
        seen=Sightings(**values["seen"]),
        offset=float(values["offset"]),
        map=StereoMap(**(known | {"keyframes": tuple(StereoKeyframe(**k) for k in known["keyframes"])})),
    )
