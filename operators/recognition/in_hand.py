"""Tells whether somebody has in hand what it reached for, though the back, or the hand, may hide it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.scene.bodies import Body

Array = NDArray[np.float64]

_LONGEST = 3.5  # seconds that a drink is held without any further sign of it
_LEAST = 1.5  # seconds after which reaching puts back what is held; what comes earlier is still the taking
_AGAIN = 5.0  # seconds after which reaching takes something again
_TAKEN = 0.8  # seconds after the reaching at which what still lies where it lay was not taken
_MOVED = 0.12  # metres
_LEAVING = ("walking", "sitting_down", "standing_up")


class Hand:
    """One person's hand: `free`, it `takes`, it `has` or, by now unsure, `had`, or it puts `back`.

    Who has reached for a drink and neither walked on nor put it back has it, for 3.5 s at most. A drink that is seen
    where it lay, well after the reaching, was not taken.
    """

    def __init__(self) -> None:
        self._phase, self._reaching, self._since = "free", False, 0.0
        self._drink = -1
        self._place: Array | None = None

    def update(self, time: float, activity: str, reached: int, drinks: Mapping[int, tuple[Body, float]]) -> bool:
        """Returns whether the hand has a drink, `reached` being the id of the one that is reached for, -1 for none.

        `drinks` are the drinks of the scene by their ids, and the times at which a sensor saw them last.
        """
        if activity in _LEAVING:
            self._phase = "free"
        elif activity == "reaching":
            if not self._reaching:
                back = self._phase in ("has", "had") and _LEAST < time - self._since < _AGAIN
                self._phase = "back" if back else "takes"
            if self._phase == "takes":
                self._drink, self._place = reached, drinks[reached][0].center.copy() if reached in drinks else None
        elif self._reaching:
            self._phase, self._since = ("has" if self._phase == "takes" else "free"), time
        self._reaching = activity == "reaching"
        over = self._lies(drinks) or time - self._since > _LONGEST
        if self._phase == "has" and activity != "drinking" and over:
            self._phase = "had"
        return self._phase == "has"

    def _lies(self, drinks: Mapping[int, tuple[Body, float]]) -> bool:
        """Tells whether the drink was seen, well after the reaching, where it lay."""
        if self._place is None or self._drink not in drinks:
            return False
        body, seen = drinks[self._drink]
        return seen > self._since + _TAKEN and float(np.linalg.norm(body.center - self._place)) < _MOVED

    def snapshot(self) -> list[Any]:
        return [self._phase, self._reaching, self._since, self._drink, self._place]

    def restore(self, state: Sequence[Any]) -> None:
        phase, reaching, since, drink, place = state
        self._phase, self._reaching, self._since = str(phase), bool(reaching), float(since)
        self._drink, self._place = int(drink), None if place is None else np.array(place, np.float64)


def drinking(probabilities: NDArray[np.float32], classes: Sequence[str]) -> NDArray[np.float32]:
    """Returns the probabilities (C,) of somebody who has a drink in hand: who seems to stand drinks.

    Who sits is left as is: a table does not hide the hand, and reaching is seen less surely.
    """
    found, names = probabilities.copy(), list(classes)
    if "standing" in names:
        found[names.index("drinking")] += found[names.index("standing")]
        found[names.index("standing")] = 0
    return found
