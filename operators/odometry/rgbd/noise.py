"""Noise of a camera's measurements, learnt from the residuals of the frames so far."""

from dataclasses import dataclass, replace

import numpy as np

from operators.geometry.se3 import Vector

RATE = 0.1  # share of a frame in what is believed
PIXEL_BOUNDS = (0.2, 3.0)  # working pixels
DEPTH_BOUNDS = (0.2, 3.0)  # of the depth noise that was declared
MEDIAN_OF_TWO = 1.386  # median of the squared length of two unit normals
MEDIAN_OF_ONE = 0.455  # of one
AGREED = 0.25  # disagreement of tracks and depth in the median of simulated worlds, whose calibration is right
OUTLIER = 10.0  # times what was learnt: a frame that disagrees by more counts as that much
RECURS = 0.4  # least share of a disagreement that a frame's keyframe had, too, of one that adds up
RECURRING_RATE = 0.05  # share of a frame in that: frames of one keyframe say much the same


@dataclass(frozen=True)
class Noise:
    """Standard deviations: of a feature track, working pixels, and of a depth as a share of what was declared; and by
    how much tracks and depth disagree on poses: a sixth of the square of what `drawn_apart` returns.

    A gate of three sigmas separates moving from static points only if sigma is that of this camera: tracks of a
    registered camera err by 0.2 pixels, those of an unregistered one by several.

    A disagreement that a frame's keyframe had, too, adds up from keyframe to keyframe: so do those of a wrong
    calibration or distortion. Where colour and depth were taken at different times of a fast motion, it goes to and
    fro. `recurring` is the part that both have, as the product of both.
    """

    pixel: float = 1.0
    depth: float = 1.0
    disagreement: float = AGREED
    recurring: float = AGREED

    @property
    def lasts(self) -> float:
        """Share of the disagreement that adds up."""
        return float(np.clip(self.recurring / max(RECURS * self.disagreement, 1e-9), 0.0, 1.0))

    @property
    def lasting(self) -> float:
        """Disagreement that adds up."""
        return self.lasts * self.disagreement

    def after(self, pixel_median: float | None, depth_median: float | None) -> "Noise":
        """Returns the noise after a frame's median squared residuals, each in units of the sigma so far."""
        pixel = _blend(self.pixel, pixel_median, MEDIAN_OF_TWO, PIXEL_BOUNDS)
        return replace(self, pixel=pixel, depth=_blend(self.depth, depth_median, MEDIAN_OF_ONE, DEPTH_BOUNDS))

    def disagreed(self, apart: Vector, before: Vector | None) -> "Noise":
        """Returns the noise after a frame whose tracks and depth are drawn apart (6,), and its keyframe's were before;
        where that is unknown, they are taken to be so for good."""
        bound = OUTLIER * self.disagreement
        seen = min(float(apart @ apart) / 6, bound)
        both = seen if before is None else float(np.clip(apart @ before / 6, -bound, bound))
        return replace(
            self,
            disagreement=(1.0 - RATE) * self.disagreement + RATE * seen,
            recurring=(1.0 - RECURRING_RATE) * self.recurring + RECURRING_RATE * both,
        )

    def missed(self, pixel_median: float | None) -> float:
        """Returns the standard deviation of one frame's tracks, working pixels, by such a median alone."""
        return self.pixel if pixel_median is None else _seen(self.pixel, pixel_median, MEDIAN_OF_TWO)


def _blend(sigma: float, median: float | None, expected: float, bounds: tuple[float, float]) -> float:
    if median is None:
        return sigma
    return float(np.clip((1.0 - RATE) * sigma + RATE * _seen(sigma, median, expected), *bounds))


def _seen(sigma: float, median: float, expected: float) -> float:
    return sigma * float(np.sqrt(median / expected))
