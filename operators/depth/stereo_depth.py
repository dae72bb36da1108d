"""Depth of a stereo pair as an operator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Literal

import numpy as np

from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.depth.stereo_matching import MatchingConfig, StereoMatcher, row_offset
from operators.geometry.calibration import check_calibration
from operators.geometry.stereo import rectified_pair
from operators.image.preparation import grey_of
from operators.status import counted_status

ROWS = 1.0
"""Pixels by which corresponding rows may differ: at two, a third of the disparities is off."""


class StereoDepth(Operator):
    """Measures the depth of a rectified stereo pair at every pixel of the left image where both directions agree.

    Pixels that only one camera sees, that look like others along their row, or that lie in small separate patches
    have no return. Depth is focal length times baseline over disparity; its error grows with its square. The images
    must be rectified: rows of the two correspond.

    Method: Hirschmüller, "Stereo processing by semiglobal matching and mutual information", 2008, left to right and
    right to left, with the mean of the two sub-pixel disparities.
    """

    left: In[Image] = In(doc="left image, rectified, grey or colour")
    right: In[Image] = In(doc="right image of the same stamp")
    left_info: Sampled[CameraInfo] = Sampled(doc="calibration of the left camera; it is that of `depth` too")
    right_info: Sampled[CameraInfo] = Sampled(doc="calibration of the right camera; P holds the baseline")
    depth: Out[DepthImage] = Out(doc="depth at the left image's pixels, metres; 0 for no return")
    status: Out[Diagnostics] = Out(
        doc="pixels measured, unmatched, inconsistent, out of range; a warning where few are, or rows differ"
    )

    disparities: int = Param(
        128, ge=16, le=1024, doc="range of disparities, a multiple of 16: nearer things are not seen", unit="px"
    )
    block: Literal[1, 3, 5, 7, 9, 11] = Param(5, doc="side of the compared squares", unit="px")
    small_step: int = Param(8, ge=1, doc="penalty of a neighbour whose disparity differs by 1, per pixel of the block")
    large_step: int = Param(32, ge=1, doc="and of one whose disparity differs by more")
    uniqueness: int = Param(5, ge=0, le=100, doc="percent by which the best disparity must win")
    speckle: int = Param(100, ge=0, doc="smaller patches of one disparity are removed", unit="px")
    tolerance: float = Param(1.0, ge=0, doc="the two directions may differ by so much", unit="px")
    offset: float = Param(
        0.0, doc="constant error of the disparities, as an imperfect rectification leaves it; subtracted", unit="px"
    )
    min_range: float = Param(0.0, ge=0, tunable=True, doc="nearer depths are no returns", unit="m")
    max_range: float = Param(100.0, gt=0, tunable=True, doc="farther depths are no returns", unit="m")
    least_share: float = Param(
        0.05, ge=0, le=1, tunable=True, doc="of the pixels measured; below, `status` warns of a blind pair"
    )

    _calibration: tuple[CameraInfo, CameraInfo] | None = None
    state: Counts

    def setup(self) -> None:
        """Raises ValueError for parameters that contradict each other."""
        self._check_range()
        settings = {field.name: getattr(self, field.name) for field in fields(MatchingConfig)}
        self._matcher = StereoMatcher(MatchingConfig(**settings))

    def on_parameter(self, name: str) -> None:
        self._check_range()

    def process(self, left: Image, right: Image, left_info: CameraInfo, right_info: CameraInfo) -> dict[str, Any]:
        """Raises ValueError where an image does not fit its calibration, or the two are no rectified pair."""
        check_calibration("left", left, left_info)
        check_calibration("right", right, right_info)
        if left.data.shape[:2] != right.data.shape[:2]:
            raise ValueError(
                f"left has {left.width}x{left.height} pixels, but right {right.width}x{right.height}: no rectified pair"
            )
        if self._calibration != (left_info, right_info):
            K, baseline = rectified_pair(left_info, right_info)
            self._pixel_metres, self._calibration = float(K[0, 0]) * baseline, (left_info, right_info)
        grays = grey_of(left.data), grey_of(right.data)
        matched = self._matcher.match(*grays)
        disparity = matched.disparity - np.float32(self.offset)
        seen = disparity > 0  # false where it is NaN
        z = np.where(seen, np.float32(self._pixel_metres) / np.where(seen, disparity, 1), 0).astype(np.float32)
        kept = seen & (z >= self.min_range) & (z <= self.max_range)
        counts = {
            "pixels": z.size,
            "measured": int(kept.sum()),
            "unmatched": matched.unmatched,
            "inconsistent": matched.inconsistent,
            "out of range": int(np.isfinite(disparity).sum() - kept.sum()),
        }
        blind = counts["measured"] < self.least_share * z.size
        self.state.counts.update(counts | {"pairs": 1, "blind pairs": int(blind)})
        data = np.where(kept, z, 0).astype(np.float32)
        return {
            "depth": DepthImage(data=data),
            "status": _status(left, right, counts, blind, row_offset(*grays, matched.disparity)),
        }

    def _check_range(self) -> None:
        if self.min_range >= self.max_range:
            raise ValueError(f"min_range {self.min_range} m must be below max_range {self.max_range} m")


def _status(left: Image, right: Image, counts: Mapping[str, int], blind: bool, rows: float) -> Diagnostics:
    text = f"{counts['measured']} of {counts['pixels']} pixels measured"
    crooked = not blind and abs(rows) >= ROWS
    if blind:
        plain = [name for name, image in (("left", left), ("right", right)) if np.ptp(image.data) < 8]
        text += f"; no structure in the {' and the '.join(plain)} image" if plain else "; the pair hardly matches"
    elif crooked:
        text += (
            f"; the right image lies {abs(rows):.1f} px {'lower' if rows > 0 else 'higher'}: the pair is not rectified"
        )
    return counted_status("stereo_depth", left.stamp, text, Level.WARN if blind or crooked else Level.OK, counts)
