"""Memory of a monocular odometry, as plain values that an operator's snapshot may hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from operators.odometry.mono_map import MonoMap, View
from operators.odometry.mono_odometry import MonoState
from operators.odometry.mono_scale import Scale
from operators.odometry.mono_tracks import Tracks
from operators.odometry.motion import Motion
from operators.odometry.watch import Watch


def to_plain(state: MonoState) -> dict[str, Any]:
    """Numbers, arrays, lists and mappings; `from_plain` is the inverse."""
    known = state.map
    return {
        "motion": None if state.motion is None else _fields_of(state.motion),
        "covariance": state.covariance,
        "views": [_fields_of(view) for view in known.views],
        "numbers": known.numbers,
        "points": known.points,
        "beginning": None if state.beginning is None else _fields_of(state.beginning),
        "tracks": None if state.tracks is None else _fields_of(state.tracks),
        "following": state.following,
        "scale": state.scale.sigma,
        "reference": state.T_reference,
        "watch": _fields_of(state.watch),
        "shape": None if state.shape is None else list(state.shape),
        "turns": state.turns,
    }


def from_plain(values: Mapping[str, Any]) -> MonoState:
    """Raises KeyError or TypeError for what `to_plain` did not make."""
    motion, beginning, tracks = values["motion"], values["beginning"], values["tracks"]
    return MonoState(
        motion=None if motion is None else Motion(**motion),
        covariance=values["covariance"],
        map=MonoMap(tuple(View(**view) for view in values["views"]), values["numbers"], values["points"]),
        beginning=None if beginning is None else View(**beginning),
        tracks=None if tracks is None else Tracks(**tracks),
        following=int(values["following"]),
        scale=Scale(float(values["scale"])),
        T_reference=values["reference"],
        watch=Watch(**values["watch"]),
        shape=None if values["shape"] is None else tuple(values["shape"]),
        turns=int(values["turns"]),
    )


def _fields_of(value: Motion | View | Tracks | Watch) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in fields(value)}
