"""The colour camera against the depth camera, as an operator."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image, Message, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import invert
from dataflow.operator import Counts, Duration, In, Operator, Out, Param, Sampled
from operators.geometry.calibration import check_calibration
from operators.geometry.extrinsics import transform_between, with_transform
from operators.monitoring.edge_alignment import Array, Correction, EdgeAlignment, Shift, rims
from operators.status import counted_status

_SHARE = 0.5  # of what is found, by which each correction changes the extrinsics
_TRUSTED, _LEAST = 12, 2  # pairs after which a correction is made, and working pixels from which one is
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
    Near edges and far ones show whether a camera is displaced or turned, and what would put that right, where one of
    the two fits plainly better: the summary at the end has it as a finding. With `calibrate` it gives extrinsics that
    have half of it put right, again and again while edges do not fit, by what fits better, however little; the finding
    is then what was changed in all.
    Where near and far are about equally far, as in a small room, a displacement may pass for a turn: both fit there.

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

    corrected: Out[Transforms] = Out(doc="with `calibrate`: the extrinsics, as given at first, then as corrected")

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
        """Raises ValueError where an image does not fit its calibration, or no transform relates the cameras, and where
        one frame for both leaves nothing to calibrate."""
        if depth.stamp < self.state.next:
            return None
        self.state.next = depth.stamp + self.period
        check_calibration("image", image, image_info)
        check_calibration("depth", depth, depth_info)
        T = self.state.change @ transform_between(extrinsics, depth.frame, image.frame)
        points = rims(depth.data, depth_info.K)
        self.state.alignment.add(image.data, image_info.K, points @ T[:3, :3].T + T[:3, 3])
        self.state.counts["pairs"] += 1
        status = self._status(depth.stamp, image_info)
        if not self.calibrate:
            return {"status": status}
        if image.frame == depth.frame:
            raise ValueError(f"image and depth are both in frame {image.frame!r}: calibrate needs one for each camera")
        if not self._improved(image_info.K) and self.state.given:
            return {"status": status}
        self.state.given = True
        T_depth_image = invert(self.state.change @ transform_between(extrinsics, depth.frame, image.frame))
        corrected = with_transform(extrinsics, depth.stamp, depth.frame, image.frame, T_depth_image)
        return {"status": status, "corrected": corrected}

    def _improved(self, K: Array) -> bool:
        """Changes how the points are moved, where enough pairs since the last change show that edges do not fit."""
        self.state.since += 1
        if self.state.since < _TRUSTED or not any(shift.off(_LEAST) for shift in self.state.alignment.shifts()):
            return False
        found = self.state.alignment.correction(K)
        if found is None:
            return False
        self.state.change = found.matrix(_SHARE) @ self.state.change
        self.state.alignment, self.state.since = EdgeAlignment(), 0
        self.state.counts["corrections"] += 1
        return True

    def on_reset(self, input: str) -> None:
        """The clock of a stream began anew."""
        self.state.next = 0

    def finding(self) -> str:
        """Returns what would put the cameras right, where a good part of the pairs did not fit, or what was changed."""
        if self.state.counts["corrections"]:
            return f"edges of colour and depth did not fit; {_moved(invert(self.state.change))}"
        often = self.state.counts["off"] >= max(_PAIRS, _OFTEN * self.state.counts["pairs"])
        return self.state.finding if often else ""

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
    """Returns what puts it right, along the colour camera's axes; nothing where near and far edges leave it open."""
    if not found.sure:
        return ""
    right, down = (-100 * each for each in found.displacement)
    if right or down:
        return f"; it fits with the colour camera {right:+.1f} cm to the right and {down:+.1f} cm down"
    right, down = (-float(np.degrees(each)) for each in found.turn)
    return f"; it fits with the colour camera turned by {right:+.1f}° to the right and {down:+.1f}° down"


def _moved(T: Array) -> str:
    """Returns how far a colour camera is away from where it was taken to be, T (4, 4) along the axes that it had."""
    right, down = 100 * T[:2, 3]
    up, aside = np.degrees(cv2.Rodrigues(T[:3, :3])[0][:2, 0])
    return (
        f"the colour camera was put {right:+.1f} cm to the right and {down:+.1f} cm down, "
        f"and turned by {aside:+.1f}° to the right and {-up:+.1f}° down"
    )
