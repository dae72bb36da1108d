"""Whether somebody has in hand what it reached for."""

from __future__ import annotations

import numpy as np
import pytest

from operators.recognition.in_hand import Hand, drinking
from operators.scene.bodies import Body

CLASSES = ("standing", "walking", "sitting", "reaching", "drinking")


def mug(x: float = 0.4) -> Body:
    return Body(7, "mug", np.array([x, 0.0, 0.9]), np.full(3, 0.1), 0.0, np.zeros(3))


def has(activities: str, *, sees: float = -1.0, x: float = 0.4) -> str:
    """A letter for each quarter of a second: s(tands), w(alks), r(eaches), d(rinks); 1 where the hand has the mug.

    The mug is at `x` from the second at which it is seen again.
    """
    hand, names, found = Hand(), {"s": "standing", "w": "walking", "r": "reaching", "d": "drinking"}, ""
    for k, letter in enumerate(activities):
        time = 0.25 * k
        seen = time if 0 <= sees <= time else 0.0
        drinks = {7: (mug(x if seen else 0.4), seen)}
        found += "01"[hand.update(time, names[letter], 7 if letter == "r" else -1, drinks)]
    return found


def test_who_has_reached_has_the_drink_until_it_is_put_back() -> None:
    assert has("ssrrrr" + 14 * "s" + "rrrr" + 4 * "s") == "000000" + 14 * "1" + "0000" + "0000"


def test_who_is_seen_to_drink_for_longer_puts_back_too() -> None:
    assert has("rrrr" + 16 * "d" + "rrrr" + 4 * "s")[-8:] == 8 * "0"


def test_nothing_is_held_for_ever_nor_by_who_walks_or_never_reached() -> None:
    assert has("rrrr" + 24 * "s") == "0000" + 15 * "1" + 9 * "0"
    assert has("rrrr" + "ssss" + "ww" + "ssss") == "0000" + "1111" + "000000"
    assert has("ssww" + 8 * "s") == 12 * "0"


def test_a_drink_that_is_seen_where_it_lay_was_not_taken_and_one_seen_elsewhere_was() -> None:
    assert has("rrrr" + 10 * "s", sees=2.0) == "0000" + "1111" + 6 * "0"
    assert has("rrrr" + 10 * "s", sees=2.0, x=0.6) == "0000" + 10 * "1"


def test_who_seems_to_stand_with_a_drink_in_hand_drinks_and_who_sits_still_may_sit() -> None:
    given = np.array([0.5, 0.1, 0.2, 0.1, 0.1], np.float32)
    np.testing.assert_allclose(drinking(given, CLASSES), [0, 0.1, 0.2, 0.1, 0.6], atol=1e-6)
    np.testing.assert_allclose(given.sum(), drinking(given, CLASSES).sum(), atol=1e-6)


@pytest.mark.parametrize("steps", [2, 5, 9])
def test_a_restored_hand_goes_on_the_same(steps: int) -> None:
    first, second = Hand(), Hand()
    course = ["reaching"] * 4 + ["standing"] * 20
    for k in range(steps):
        first.update(0.25 * k, course[k], 7, {7: (mug(), 0.0)})
    second.restore(first.snapshot())
    for k in range(steps, len(course)):
        given = (0.25 * k, course[k], 7, {7: (mug(), 0.0 if k < 14 else 0.25 * k)})
        assert first.update(*given) == second.update(*given)
