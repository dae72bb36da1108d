"""Places of the sensors on the body whose state is estimated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Transforms
from dataflow.messages.geometry import invert
from dataflow.operator import Remembered
from operators.geometry.extrinsics import transform_between

Array = NDArray[np.float64]


class LeverArms(Remembered):
    """Looks frames up in the extrinsics, once each. `body` is the frame that moves, empty until it is known."""

    body: str

    def __init__(self, base: str, body: str = "") -> None:
        self._base, self.body = base, body
        self._extrinsics: Transforms | None = None
        self._known: dict[tuple[str, str], Array] = {}

    def given(self, extrinsics: Transforms | None) -> None:
        """Takes the extrinsics that hold from now on."""
        if extrinsics is not self._extrinsics:
            self._extrinsics, self._known = extrinsics, {}

    def of(self, frame: str) -> Array:
        """Returns `T_body_sensor` (4, 4) of a sensor's frame: the identity where nothing is known."""
        if frame == self.body or self._extrinsics is None:
            return np.eye(4)
        key = self.body, frame
        if key not in self._known:
            T_base_body = transform_between(self._extrinsics, self.body or self._base, self._base)
            self._known[key] = invert(T_base_body) @ transform_between(self._extrinsics, frame, self._base)
            self._known[key].flags.writeable = False
        return self._known[key]
