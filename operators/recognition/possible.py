"""Leaves out activities that an agent's motion and surroundings exclude, whatever a network makes of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from operators.recognition.agent_features import FAR, NAMES

SEAT_REACH = 0.9  # metres between an agent and the middle of a seat
DRIVING = 0.05  # m/s over the last 1.6 s
DRIVES, GONE = 0.1, 0.07  # m/s over the last 1.6 s, and metres of the last 2.5 s, from which a robot does not rest
_SEAT, _RISE, _SPEED = (NAMES.index(name) for name in ("seat: away", "rise, short", "speed, long"))
_ROBOT, _WAY = NAMES.index("is a robot"), NAMES.index("way gone")


def possible(features: NDArray[np.float32], classes: Sequence[str]) -> NDArray[np.bool_]:
    """Returns (N, C): which activities are possible for agents with features (N, F) of `agent_features`.

    Who sits down or stands up is at a seat: heads that leave the image come down too. Nobody stands up whose head comes
    down, or sits down whose head goes up. What drives moves, and a robot that moves drives.
    """
    found = np.ones((len(features), len(classes)), bool)
    seated, rise = features[:, _SEAT] * FAR <= SEAT_REACH, features[:, _RISE]
    holds = {"sitting_down": seated & (rise <= 0), "standing_up": seated & (rise >= 0)}
    holds["driving"] = features[:, _SPEED] >= DRIVING
    holds["resting"] = (features[:, _ROBOT] < 0.5) | (features[:, _SPEED] < DRIVES) | (features[:, _WAY] < GONE)
    for name, where in holds.items():
        if name in classes:
            found[:, list(classes).index(name)] = where
    return found
