"""Memory of an odometry, as plain values that an operator's snapshot may hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from operators.odometry.keyframe import Keyframe
from operators.odometry.motion import Motion
from operators.odometry.rgbd_odometry import State
from operators.odometry.surface import Surface


def to_plain(state: State) -> dict[str, Any]:
    """Numbers, arrays, lists and mappings; `from_plain` is the inverse."""
    return {
        "motion": None if state.motion is None else _fields_of(state.motion),
        "covariance": state.covariance,
        "keyframes": [_fields_of(k) | {"surface": _fields_of(k.surface)} for k in state.keyframes],
        "shapes": None if state.shapes is None else [list(shape) for shape in state.shapes],
    }


def from_plain(values: Mapping[str, Any]) -> State:
    """Raises KeyError or TypeError for what `to_plain` did not make."""
    motion, shapes = values["motion"], values["shapes"]
    return State(
        motion=None if motion is None else Motion(**motion),
        covariance=values["covariance"],
        keyframes=tuple(Keyframe(**{**k, "surface": Surface(**k["surface"])}) for k in values["keyframes"]),
        shapes=None if shapes is None else (tuple(shapes[0]), tuple(shapes[1])),
    )


def _fields_of(value: Motion | Keyframe | Surface) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in fields(value)}
