"""The colour camera against the depth camera, as an operator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.operator import Duration, In, Operator, Out, Param, Sampled
from operators.geometry.calibration import check_calibration
from operators.geometry.extrinsics import transform_between
from operators.monitoring.edge_alignment import EdgeAlignment, Shift, rims
from operators.status import counted_status


class ColorDepthCheck(Operator):
    """Warns when the edges of colour images do not lie where the depth has its rims: one camera is turned or displaced.

    A camera that is turned against its extrinsic paints things with what is beside them, and nothing fails: boxes are
    lifted from the wrong points. The check adds up images, since a single one has edges that are none of the depth's.

    Method: edges of depth on edges of the image, added up over images, as in Levinson and Thrun, "Automatic online
    calibration of cameras and lasers", 2013.
    """

    image: In[Image] = In(doc="colour or grey, of the same stamp")
    depth: In[DepthImage] = In(doc="depth, metres")
    image_info: Sampled[CameraInfo] = Sampled(doc="calibration of the colour camera")
    depth_info: Sampled[CameraInfo] = Sampled(doc="calibration of the depth camera")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the two cameras' frames; without it they are taken to coincide"
    )
    status: Out[Diagnostics] = Out(doc="with every pair that is looked at; a warning while they do not fit")

    period: Duration = Param("400ms", ge=0, live=True, doc="time between the pairs that are looked at")
    angle: float = Param(1.2, gt=0, live=True, doc="smallest angle that is warned of", unit="°")

    def setup(self) -> None:
        self._alignment = EdgeAlignment()
        self._next = 0
        self._counts: Counter[str] = Counter()

    def process(
        self,
        image: Image,
        depth: DepthImage,
        image_info: CameraInfo,
        depth_info: CameraInfo,
        extrinsics: Transforms | None = None,
    ) -> Diagnostics | None:
        """Raises ValueError where an image does not fit its calibration, or no transform relates the cameras."""
        if depth.stamp < self._next:
            return None
        self._next = depth.stamp + self.period
        check_calibration("image", image, image_info)
        check_calibration("depth", depth, depth_info)
        T = transform_between(extrinsics, depth.frame, image.frame)
        points = rims(depth.data, depth_info.K)
        self._alignment.add(image.data, image_info.K, points @ T[:3, :3].T + T[:3, 3])
        self._counts["pairs"] += 1
        return self._status(depth.stamp, float(image_info.K[0, 0]))

    def on_reset(self, input: str) -> None:
        """The clock of a stream began anew."""
        self._next = 0

    def snapshot(self) -> Mapping[str, Any]:
        return {"alignment": self._alignment.snapshot(), "next": self._next, "counts": dict(self._counts)}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._alignment.restore(state["alignment"])
        self._next = int(state["next"])
        self._counts = Counter({key: int(n) for key, n in state["counts"].items()})

    def summary(self) -> Mapping[str, int]:
        return dict(self._counts)

    def _status(self, stamp: int, focal: float) -> Diagnostics:
        least = max(2, round(float(np.deg2rad(self.angle)) * focal / 2))
        shifts = self._alignment.shifts()
        off = [shift for shift in shifts if shift.off(least)]
        self._counts["off"] += bool(off)
        text = "; ".join(_text(shift, focal) for shift in off[:1]) or "edges of colour and depth fit"
        figures = {
            f"{shift.part} (°)": f"{_degrees(shift.x, focal):.1f} {_degrees(shift.y, focal):.1f}" for shift in shifts
        }
        level = Level.WARN if off else Level.OK
        return counted_status("color_depth_check", stamp, text, level, {**figures, **self._counts})


def _degrees(pixels: int, focal: float) -> float:
    return float(np.rad2deg(np.arctan2(2 * pixels, focal)))


def _text(shift: Shift, focal: float) -> str:
    x, y = _degrees(shift.x, focal), _degrees(shift.y, focal)
    where = f"{x:+.1f}° right and {y:+.1f}° below of depth ({shift.part})"
    return f"colour lies {where}: a camera is turned against its extrinsic"
