"""Memory of a monocular odometry, as plain values that an operator's snapshot may hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from operators.monitoring.image_flaws import Watch
from operators.odometry.mono.map import MonoMap, View
from operators.odometry.mono.ranging import RangingMemory
from operators.odometry.mono.scale import Scale
from operators.odometry.mono.tracker import MonoState
from operators.odometry.mono.tracks import Tracks
from operators.odometry.motion import Motion
from operators.odometry.plain import fields_of


def to_plain(state: MonoState) -> dict[str, Any]:
    """Numbers, arrays, lists and mappings; `from_plain` is the inverse."""
    known = state.map
    return {
        "motion": None if state.motion is None else fields_of(state.motion),
        "covariance": state.covariance,
        "views": [fields_of(view) for view in known.views],
        "numbers": known.numbers,
        "points": known.points,
        "beginning": None if state.beginning is None else fields_of(state.beginning),
        "tracks": None if state.tracks is None else fields_of(state.tracks),
        "following": state.following,
        "scale": fields_of(state.scale),
        "ranging": fields_of(state.ranging) | {"watch": fields_of(state.ranging.watch)},
        "origin": state.origin,
        "reference": state.T_reference,
        "watch": fields_of(state.watch),
        "shape": None if state.shape is None else list(state.shape),
        "turns": state.turns,
    }


def from_plain(values: Mapping[str, Any]) -> MonoState:
    """Raises KeyError or TypeError for what `to_plain` did not make, in this version or the one before it."""
    motion, beginning, tracks, scale = (values[name] for name in ("motion", "beginning", "tracks", "scale"))
    ranging = values.get("ranging", {"watch": {}})
    return MonoState(
        motion=None if motion is None else Motion(**motion),
        covariance=values["covariance"],
        map=MonoMap(tuple(View(**view) for view in values["views"]), values["numbers"], values["points"]),
        beginning=None if beginning is None else View(**beginning),
        tracks=None if tracks is None else Tracks(**tracks),
        following=int(values["following"]),
        scale=Scale(**scale) if isinstance(scale, Mapping) else Scale(float(scale)),
        ranging=RangingMemory(**(ranging | {"watch": Watch(**ranging["watch"])})),
        origin=values.get("origin", np.zeros(3)),
        T_reference=values["reference"],
        watch=Watch(**values["watch"]),
        shape=None if values["shape"] is None else tuple(values["shape"]),
        turns=int(values["turns"]),
    )
