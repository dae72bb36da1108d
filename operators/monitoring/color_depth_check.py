"""The colour camera against the depth camera, as an operator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image, Message, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import invert
from dataflow.operator import Counts, Duration, In, Operator, Out, Param, Sampled
from operators.geometry.calibration import check_calibration
from operators.geometry.extrinsics import transform_between, with_transform
from operators.monitoring.edge_alignment import Array, Correction, EdgeAlignment, Shift, rims
from operators.status import FINDING, counted_status

_SHARE = 0.5  # of what is found, by which each correction changes the extrinsics
_TRUSTED, _LEAST = 6, 2  # pairs after which a correction is made, and working pixels from which one is
_OFTEN, _PAIRS = 0.2, 3  # share of the pairs, and fewest of them, that must not fit for a finding


@dataclass
class State(Counts):
    """Holds how well edges fit, how the points are moved so that they do, (4, 4), and what was found.

    `next` is the stamp from which the next pair is looked at, `since` the pairs since the last correction.
    """

    alignment: EdgeAlignment = field(default_factory=EdgeAlignment)
    change: Array = field(default_factory=lambda: np.eye(4))
    next: int = 0
    since: int = 0
    given: bool = False
    finding: str = ""


class ColorDepthCheck(Operator):
    """Warns when the edges of colour images do not lie where the depth has its rims: one camera is turned or displaced.

    A camera that is turned against its extrinsic paints things with what is beside them, and nothing fails: boxes are
    lifted from the wrong points. The check adds up images, since a single one has edges that are none of the depth's.
    Near edges and far ones show whether a camera is displaced or turned, and what would put that right: the summary at
    the end has it as a finding. With `calibrate` the extrinsics that it gives have half of that put right, again and
    again while edges do not fit.

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

    corrected: Out[Transforms] = Out(doc="the extrinsics: as given at first, then as corrected if `calibrate`")

    calibrate: bool = Param(False, doc="correct the transform between the cameras")
    period: Duration = Param("400ms", ge=0, tunable=True, doc="time between the pairs that are looked at")
    angle: float = Param(1.2, gt=0, tunable=True, doc="smallest angle that is warned of", unit="°")

    state: State

    def process(
        self,
        image: Image,
        depth: DepthImage,
        image_info: CameraInfo,
        depth_info: CameraInfo,
        extrinsics: Transforms | None = None,
    ) -> dict[str, Message] | None:
        """Raises ValueError where an image does not fit its calibration, or no transform relates the cameras."""
        if depth.stamp < self.state.next:
            return None
        self.state.next = depth.stamp + self.period
        check_calibration("image", image, image_info)
        check_calibration("depth", depth, depth_info)
        T = self.state.change @ transform_between(extrinsics, depth.frame, image.frame)
        points = rims(depth.data, depth_info.K)
        self.state.alignment.add(image.data, image_info.K, points @ T[:3, :3].T + T[:3, 3])
        self.state.counts["pairs"] += 1
        out: dict[str, Message] = {"status": self._status(depth.stamp, image_info)}
        self.state.since += 1
        found = None
        if (
            self.calibrate
            and self.state.since >= _TRUSTED
            and any(shift.off(_LEAST) for shift in self.state.alignment.shifts())
        ):
            found = self.state.alignment.correction(image_info.K)
        if found is not None:
            self.state.change = found.matrix(_SHARE) @ self.state.change
            self.state.alignment, self.state.since = EdgeAlignment(), 0
            self.state.counts["corrections"] += 1
        if found is not None or not self.state.given:
            self.state.given = True
            T_depth_image = invert(self.state.change @ transform_between(extrinsics, depth.frame, image.frame))
            out["corrected"] = with_transform(extrinsics, depth.stamp, depth.frame, image.frame, T_depth_image)
        return out

    def on_reset(self, input: str) -> None:
        """The clock of a stream began anew."""
        self.state.next = 0

    def summary(self) -> Mapping[str, int | str]:
        """Returns the counts; and the finding, where a good part of the pairs did not fit."""
        often = self.state.counts["off"] >= max(_PAIRS, _OFTEN * self.state.counts["pairs"])
        return {**self.state.counts, **({FINDING: self.state.finding} if often else {})}

    def _status(self, stamp: int, info: CameraInfo) -> Diagnostics:
        focal = float(info.K[0, 0])
        least = max(2, round(float(np.deg2rad(self.angle)) * focal / 2))
        shifts = self.state.alignment.shifts()
        off = [shift for shift in shifts if shift.off(least)]
        self.state.counts["off"] += bool(off)
        found = self.state.alignment.correction(info.K) if off else None
        text = "edges of colour and depth fit"
        if off:
            text = self.state.finding = _text(off[0], focal) + ("" if found is None else _remedy(found))
        figures = {
            f"{shift.part} (°)": f"{_degrees(shift.x, focal):.1f} {_degrees(shift.y, focal):.1f}" for shift in shifts
        }
        level = Level.WARN if off else Level.OK
        return counted_status("color_depth_check", stamp, text, level, {**figures, **self.state.counts})


def _degrees(pixels: int, focal: float) -> float:
    return float(np.rad2deg(np.arctan2(2 * pixels, focal)))


def _text(shift: Shift, focal: float) -> str:
    x, y = _degrees(shift.x, focal), _degrees(shift.y, focal)
    where = f"{x:+.1f}° right and {y:+.1f}° below of depth ({shift.part})"
    return f"colour lies {where}: a camera is turned or displaced against its extrinsic"


def _remedy(found: Correction) -> str:
    """Returns what would put it right, as changes of the colour camera in the depth camera's frame."""
    if any(found.displacement):
        right, down = (-100 * each for each in found.displacement)
        return f"; it fits with the colour camera {right:+.1f} cm to the right and {down:+.1f} cm down"
    right, down = (-float(np.degrees(each)) for each in found.turn)
    return f"; it fits with the colour camera turned by {right:+.1f}° to the right and {down:+.1f}° down"
