"""Depth images without pixels that are wrong."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from dataflow.messages import DepthImage, Diagnostics
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param
from operators.depth.despeckling import bilateral, flying, median, outlying, replaced, valid
from operators.status import counted_status


class DepthFilter(Operator):
    """Replaces wrong pixels of a depth image by the median of the right ones around them, and smooths what is left.

    Wrong are flying pixels, which saw a nearer and a farther surface at once, and statistical outliers, far from the
    local median in terms of the local deviation. Pixels without return stay without; a wrong pixel with no right one
    around it loses its return. Depths outside the range lose theirs first.

    Method: median and median absolute deviation in a window, as in Hampel's identifier (1974), on inverse depth;
    smoothing by the median or by Tomasi and Manduchi, "Bilateral filtering for gray and color images", 1998.
    """

    depth: In[DepthImage] = In(doc="depth, metres")
    filtered: Out[DepthImage] = Out(doc="the same with wrong pixels replaced; 0 for no return")
    status: Out[Diagnostics] = Out(doc="how many pixels were wrong, and replaced; a warning where there is no return")

    min_range: float = Param(0.0, ge=0, doc="nearer depths are no returns", unit="m")
    max_range: float = Param(100.0, gt=0, doc="farther depths are no returns", unit="m")
    window: Literal[3, 5, 7] = Param(5, doc="side of the window that medians are taken in", unit="px")
    flying_ratio: float = Param(
        0.04, ge=0, lt=1, tunable=True, doc="a flying pixel is this share of its depth off either surface; 0 finds none"
    )
    outlier_deviations: float = Param(
        4.0, ge=0, tunable=True, doc="an outlier is so many deviations off the local median; 0 finds none"
    )
    outlier_ratio: float = Param(0.03, gt=0, lt=1, tunable=True, doc="and at least this share of its depth")
    support: int = Param(2, ge=1, le=8, tunable=True, doc="with so many agreeing neighbours of eight, a pixel is none")
    smoothing: Literal["none", "median", "bilateral"] = Param("none", doc="what is done with the pixels that are left")
    smoothing_sigma: float = Param(
        0.005, gt=0, tunable=True, doc="of the bilateral filter, in inverse depth: a few times the noise", unit="1/m"
    )
    state: Counts

    def setup(self) -> None:
        """Raises ValueError for a range that holds no depth, and for a median that OpenCV does not have."""
        if self.min_range >= self.max_range:
            raise ValueError(f"min_range {self.min_range} m must be below max_range {self.max_range} m")
        if self.smoothing == "median" and self.window > 5:
            raise ValueError(f"the median smooths in a window of 3 or 5 pixels, not {self.window}")

    def process(self, depth: DepthImage) -> dict[str, Any]:
        given = valid(depth.data)
        z = np.where(given, depth.data, 0).astype(np.float32)
        z[(z < np.float32(self.min_range)) | (z > np.float32(self.max_range))] = 0
        nothing = np.zeros(z.shape, np.bool_)
        hanging = flying(z, self.flying_ratio) if self.flying_ratio else nothing
        lonely = nothing
        if self.outlier_deviations:
            kept = np.where(hanging, 0, z).astype(np.float32)
            lonely = outlying(kept, self.window, self.outlier_ratio, self.outlier_deviations, self.support)
        wrong = hanging | lonely
        out = replaced(z, wrong, self.window)
        counts = {
            "pixels": z.size,
            "returns": int(given.sum()),
            "out of range": int((given & (z == 0)).sum()),
            "flying": int(hanging.sum()),
            "outliers": int(lonely.sum()),
            "replaced": int((wrong & (out > 0)).sum()),
            "removed": int((wrong & (out == 0)).sum()),
        }
        if self.smoothing == "median":
            out = median(out, self.window)
        elif self.smoothing == "bilateral":
            out = bilateral(out, self.window, self.smoothing_sigma)
        blind = not out.any()
        self.state.counts.update(counts | {"images": 1, "images without return": int(blind)})
        return {"filtered": depth.replace(data=out), "status": _status(depth.stamp, counts, blind)}


def _status(stamp: int, counts: Mapping[str, int], blind: bool) -> Diagnostics:
    text = f"{counts['replaced']} of {counts['returns']} returns replaced, {counts['removed']} removed"
    if blind:
        text = "no return in range" if counts["returns"] else "the image has no return"
    return counted_status("depth_filter", stamp, text, Level.WARN if blind else Level.OK, counts)
