"""Noise of a camera's measurements, learnt from the residuals of the frames so far."""

from dataclasses import dataclass

import numpy as np

RATE = 0.1  # share of a frame in what is believed
PIXEL_BOUNDS = (0.2, 3.0)  # working pixels
DEPTH_BOUNDS = (0.2, 3.0)  # of the depth noise that was declared
MEDIAN_OF_TWO = 1.386  # median of the squared length of two unit normals
MEDIAN_OF_ONE = 0.455  # of one
AGREED = 0.25  # disagreement of tracks and depth in the median of simulated worlds, whose calibration is right
OUTLIER = 10.0  # times what was learnt: a frame that disagrees by more counts as that much


@dataclass(frozen=True)
class Noise:
    """Standard deviations: of a feature track, working pixels, and of a depth as a share of what was declared; and by
    how much tracks and depth disagree on poses, see `disagreement`.

    A gate of three sigmas separates moving from static points only if sigma is that of this camera: tracks of a
    registered camera err by 0.2 pixels, those of an unregistered one by several.
    """

    pixel: float = 1.0
    depth: float = 1.0
    disagreement: float = AGREED

    def after(self, pixel_median: float | None, depth_median: float | None, disagreement: float | None) -> "Noise":
        """Returns the noise after a frame's median squared residuals, each in units of the sigma so far, and by how
        much its tracks and its depth disagree."""
        seen = self.disagreement if disagreement is None else min(disagreement, OUTLIER * self.disagreement)
        return Noise(
            _blend(self.pixel, pixel_median, MEDIAN_OF_TWO, PIXEL_BOUNDS),
            _blend(self.depth, depth_median, MEDIAN_OF_ONE, DEPTH_BOUNDS),
            (1.0 - RATE) * self.disagreement + RATE * seen,
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
