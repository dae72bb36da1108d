"""Images that follow the light and the noise, as an operator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import log, sqrt
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Image
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param
from operators.image.preparation import grey_of
from operators.status import counted_status

Picture = NDArray[np.uint8]

LEAST_GAIN = 1.02  # a smaller one is not worth a change of every pixel
_SECOND_DIFFERENCES = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_RESPONSE = 6.0  # standard deviation of those differences, of noise of 1
_MEDIAN = 0.6745  # median of the absolute value of a unit normal
_GREY = 0.67  # noise of a grey value as a share of that of its three colours, which err apart
_WINDOW = 7  # pixels, of the filter that takes noise away


@dataclass(frozen=True)
class Measured:
    """Measures of an image: standard deviation of its noise and mean brightness, both in grey levels."""

    noise: float
    brightness: float


@dataclass(frozen=True)
class Adaptation:
    """Makes noisy images smoother and dark images brighter; others stay as they are, bit for bit.

    - Noise above `usual_noise` is taken away: each pixel is drawn to the mean around it, the less the more the image
      varies there beyond what noise explains (Lee, "Digital image enhancement and noise filtering by use of local
      statistics", 1980).
    - A mean brightness below `brightness` is raised to it, as by a longer exposure with a soft shoulder, but never by
      more than `most_gain`, nor so far that the noise that was measured would exceed `most_noise`.

    Both begin at nothing at their limit, so that an image beside it is not changed abruptly. An image's result depends
    on that image alone.
    """

    usual_noise: float = 3.0
    brightness: float = 80.0
    most_gain: float = 5.0
    most_noise: float = 8.0

    def excess(self, measured: Measured) -> float:
        """Returns the standard deviation of the noise beyond the usual, in grey levels."""
        return sqrt(max(0.0, measured.noise**2 - self.usual_noise**2))

    def gain(self, measured: Measured) -> float:
        """Returns how many times as long the exposure should have been; 1 where it was long enough."""
        seen = min(max(measured.brightness, 1.0), 254.0)
        wanted = log(1 - self.brightness / 255) / log(1 - seen / 255)
        bearable = self.most_noise / max(measured.noise, 0.1)
        gain = min(wanted, bearable, self.most_gain)
        return gain if gain >= LEAST_GAIN else 1.0

    def apply(self, pixels: Picture, measured: Measured) -> Picture:
        """Returns the adapted image (H, W) or (H, W, 3) RGB; the same array where nothing is to be done."""
        excess, gain = self.excess(measured), self.gain(measured)
        if excess > 0:
            pixels = denoised(pixels, excess if pixels.ndim == 2 else excess / _GREY)
        return exposed_longer(pixels, gain) if gain > 1 else pixels


def measure(pixels: Picture) -> Measured:
    """Measures an image (H, W) or (H, W, 3) RGB of at least 3 x 3 pixels.

    The noise is that of second differences in both directions, in which surfaces and straight edges cancel (Immerkær,
    "Fast noise variance estimation", 1996); their median leaves texture and corners out.
    """
    grey = grey_of(pixels)
    differences = np.abs(cv2.filter2D(grey, cv2.CV_32F, _SECOND_DIFFERENCES))
    return Measured(float(np.median(differences)) / _MEDIAN / _RESPONSE, float(grey.mean()))


def denoised(pixels: Picture, noise: float) -> Picture:
    """Returns an image without noise of a standard deviation, in grey levels of each channel (Lee, 1980)."""
    values = pixels.astype(np.float32)
    mean = cv2.blur(values, (_WINDOW, _WINDOW))
    variance = cv2.blur(values * values, (_WINDOW, _WINDOW)) - mean * mean
    share = np.maximum(variance - np.float32(noise**2), 0) / np.maximum(variance, np.float32(1e-6))
    return np.asarray(np.clip(np.rint(mean + share * (values - mean)), 0, 255), np.uint8)


def exposed_longer(pixels: Picture, gain: float) -> Picture:
    """Returns an image as of a longer exposure: dark values times the gain, bright ones drawn to white softly."""
    levels = 1 - (1 - np.arange(256) / 255) ** gain
    return np.asarray(cv2.LUT(pixels, np.rint(255 * levels).astype(np.uint8)), np.uint8)


class ImageAdapter(Operator):
    """Brings dark and noisy images nearer to those that networks were trained on, by what it measures in each.

    Put it in front of a detector or a segmenter: what it does there under switched lamps, noise and blur is a table in
    benchmarks/adaptation.md. Images that are neither dark nor noisy pass bit for bit. The result of an image depends on
    that image alone, so it is the same wherever a replay begins.

    Methods: Immerkær, "Fast noise variance estimation", 1996; Lee, "Digital image enhancement and noise filtering by
    use of local statistics", 1980.
    """

    image: In[Image] = In(doc="RGB or grey")
    adapted: Out[Image] = Out(doc="the same view, brighter and with less noise where it needs that")
    status: Out[Diagnostics] = Out(doc="with every image: its noise and brightness, and what was done; counts")

    adapt: bool = Param(True, tunable=True, doc="off passes every image as it is")
    usual_noise: float = Param(3.0, ge=0, le=50, tunable=True, doc="grey levels of noise that are left as they are")
    brightness: float = Param(80.0, ge=1, le=200, tunable=True, doc="mean grey level to which darker images are raised")
    most_gain: float = Param(5.0, ge=1, le=20, tunable=True, doc="the exposure is lengthened so many times at most")
    most_noise: float = Param(8.0, gt=0, le=50, tunable=True, doc="nor so far that noise exceeds so many grey levels")
    state: Counts

    def process(self, image: Image) -> Mapping[str, Any]:
        self.state.counts["images"] += 1
        if not self.adapt or min(image.width, image.height) < 3:
            return {"adapted": image, "status": self._status(image.stamp, "passed as it is")}
        adaptation = Adaptation(self.usual_noise, self.brightness, self.most_gain, self.most_noise)
        measured = measure(image.data)
        gain, excess = adaptation.gain(measured), adaptation.excess(measured)
        self.state.counts.update({"made brighter": int(gain > 1), "noise removed": int(excess > 0)})
        text = f"noise {measured.noise:.1f}, of which {excess:.1f} removed; brightness {measured.brightness:.0f}"
        text += f", exposed {gain:.1f} times as long" if gain > 1 else ""
        pixels = adaptation.apply(image.data, measured)
        adapted = image if pixels is image.data else image.replace(data=pixels)
        return {"adapted": adapted, "status": self._status(image.stamp, text)}

    def _status(self, stamp: int, text: str) -> Diagnostics:
        return counted_status("image_adapter", stamp, text, Level.OK, self.state.counts)
