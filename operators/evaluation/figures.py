"""Figures of operators that score, when they begin anew, and checks of what they can compare."""

from __future__ import annotations

from collections.abc import Mapping


class Figures:
    """Gives the figures of a score at a run's end; a mixin for operators, whose `setup` begins it."""

    _figures: dict[str, float | int | str]

    def setup(self) -> None:
        """Begins the score."""
        self._figures = {}

    def on_reset(self, input: str) -> None:
        """A clock jumped back, so stamps no longer show what belongs together: the score begins anew."""
        self.setup()

    def summary(self) -> Mapping[str, float | int | str]:
        return dict(self._figures)


def check_view(found: tuple[str, int, int], truth: tuple[str, int, int]) -> None:
    """Both, as (optical frame, width, height), show the same view: one may only be a smaller version of the other.

    Raises ValueError where the frames differ or, by more than the rounding of a pixel, the aspect ratios.
    """
    (frame, w, h), (true_frame, W, H) = found, truth
    if frame and true_frame and frame != true_frame:
        raise ValueError(f"the truth is seen by {true_frame!r} but the result by {frame!r}: both must be of one camera")
    if 2 * abs(w * H - h * W) > max(w + h, W + H):
        raise ValueError(
            f"the truth of {true_frame or 'the camera'} has {W}x{H} pixels but the result {w}x{h}: both must show the "
            f"whole image, so their aspect ratios must agree"
        )


def check_names(found: tuple[str, ...], truth: tuple[str, ...]) -> None:
    """Raises ValueError where only one of the two class tables has names, since classes are matched by them."""
    if bool(found) != bool(truth):
        named, nameless = ("truth", "result") if truth else ("result", "truth")
        raise ValueError(
            f"the {named} names its classes ({', '.join((truth or found)[:5])} ...) but the {nameless} has no "
            f"class_names: classes are matched by name, so both must have names, or neither"
        )
