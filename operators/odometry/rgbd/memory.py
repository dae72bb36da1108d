"""Memory of an odometry, as plain values that an operator's snapshot may hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from operators.monitoring.image_flaws import Watch
from operators.odometry.motion import Motion
from operators.odometry.plain import fields_of
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.noise import Noise
from operators.odometry.rgbd.surface import Surface
from operators.odometry.rgbd.tracker import State
from operators.odometry.rgbd.trial import Trial


def to_plain(state: State) -> dict[str, Any]:
    """Numbers, arrays, lists and mappings; `from_plain` is the inverse."""
    return {
        "motion": None if state.motion is None else fields_of(state.motion),
        "covariance": state.covariance,
        "keyframes": [fields_of(k) | {"surface": fields_of(k.surface)} for k in state.keyframes],
        "shapes": None if state.shapes is None else [list(shape) for shape in state.shapes],
        "noise": fields_of(state.noise),
        "watch": fields_of(state.watch),
        "recalls": state.recalls,
        "apart_since": state.apart_since,
        "trials": [fields_of(trial) for trial in state.trials],
    }


def from_plain(values: Mapping[str, Any]) -> State:
    """Raises KeyError or TypeError for what `to_plain` did not make, in this version or the one before it."""
    motion, shapes = values["motion"], values["shapes"]
    return State(
        motion=None if motion is None else Motion(**motion),
        covariance=values["covariance"],
        keyframes=tuple(_keyframe(k) for k in values["keyframes"]),
        shapes=None if shapes is None else (tuple(shapes[0]), tuple(shapes[1])),
        noise=Noise(**values.get("noise", {})),
        watch=Watch(**values.get("watch", {})),
        recalls=values.get("recalls", 0),
        apart_since=values.get("apart_since"),
        trials=tuple(Trial(**trial) for trial in values.get("trials", [values.get("trial")]) if trial is not None),
    )


def _keyframe(values: Mapping[str, Any]) -> Keyframe:
    """A keyframe of the former version had descriptors, and its corners no ages."""
    names = {field.name for field in fields(Keyframe)}
    known = {"ages": np.zeros(len(values["pixels"]), np.int64)} | {k: v for k, v in values.items() if k in names}
    return Keyframe(**(known | {"surface": Surface(**values["surface"])}))
