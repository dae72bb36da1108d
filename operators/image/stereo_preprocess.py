"""Stereo pairs made ready for what comes after: rectified, with the calibrations that result.

Bouguet's way, as in Bradski and Kaehler, "Learning OpenCV", 2008: each camera is turned by half of their relative
rotation, then both until the baseline is the x axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dataflow.messages import CameraInfo, Diagnostics, Image, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import invert, matrix_to_quaternion
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry import se3
from operators.geometry.calibration import check_fit, told_again
from operators.geometry.extrinsics import transform_between
from operators.geometry.lens import check_model, check_projection
from operators.geometry.se3 import Matrix
from operators.image.preparation import Preparation, Tone, grey_of
from operators.image.view import Window, fitting_view
from operators.status import counted_status


@dataclass(frozen=True, eq=False)
class Rectification:
    """R (3, 3) of each camera maps its axes to the rectified ones; K (3, 3) is that of both images."""

    R_left: Matrix
    R_right: Matrix
    K: Matrix
    baseline: float


def rectify(left: CameraInfo, right: CameraInfo, T_left_right: Matrix, keep: float) -> Rectification:
    """Returns the rectification of a pair; `keep` as in `fitting_view`.

    Raises ValueError where the right camera is not to the right of the left one: at its place, above or behind it, or
    looking elsewhere.
    """
    T_right_left = invert(T_left_right)
    half = se3.exp(0.5 * np.concatenate([np.zeros(3), se3.log(T_right_left)[3:]]))[:3, :3]
    towards = -(half.T @ T_right_left[:3, 3])  # of the right camera, in the axes half way
    baseline = float(np.linalg.norm(towards))
    if baseline < 1e-6:
        raise ValueError(f"{left.frame!r} and {right.frame!r} are at one place: no baseline")
    x = towards / baseline
    if x[0] < 0.7:
        raise ValueError(
            f"{right.frame!r} must lie to the right of {left.frame!r}, but lies towards {np.round(x, 2).tolist()}"
        )
    axis = np.cross([1.0, 0, 0], x)
    sine = float(np.linalg.norm(axis))
    turn = np.concatenate([np.zeros(3), axis / sine * np.arctan2(sine, x[0]) if sine > 1e-12 else np.zeros(3)])
    R_common = se3.exp(turn)[:3, :3].T
    R_left, R_right = R_common @ half, R_common @ half.T
    return Rectification(R_left, R_right, fitting_view([(left, R_left), (right, R_right)], keep), baseline)


def projection(K: Matrix, baseline: float) -> Matrix:
    """Returns P (3, 4) of a rectified camera so far to the right of the left one, metres."""
    P = np.hstack([K, np.zeros((3, 1))])
    P[0, 3] = -K[0, 0] * baseline
    return P


@dataclass(frozen=True, eq=False)
class _Pair:
    """Both images' preparations, what they have in common, and where the rectified cameras look.

    `infos` and `T_left_right` (None where the calibrations say all) are what it was made of.
    """

    infos: tuple[CameraInfo, CameraInfo]
    T_left_right: Matrix | None
    left: Preparation
    right: Preparation
    baseline: float
    frames: Transforms


class StereoPreprocess(Operator):
    """Rectifies a stereo pair, so that rows of the two images correspond; crops, scales and normalises both alike.

    Where both calibrations hold P, those say how, with R where they turn; else the pair is rectified by `extrinsics`.
    Pixels that need not be sampled again pass bit for bit. Where the rectified cameras look elsewhere than the raw ones
    their frames have new names; `frames` holds their rotations.

    Method: Bouguet's, as in Bradski and Kaehler, "Learning OpenCV", 2008.
    """

    left: In[Image] = In(doc="raw left image, grey or colour")
    right: In[Image] = In(doc="raw right image of the same stamp")
    left_info: Sampled[CameraInfo] = Sampled(doc="calibration of the left camera")
    right_info: Sampled[CameraInfo] = Sampled(doc="calibration of the right camera")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the two cameras; needed where the calibrations hold no P"
    )
    prepared_left: Out[Image] = Out(doc="left image, rectified")
    prepared_right: Out[Image] = Out(doc="right image, rectified")
    prepared_left_info: Out[CameraInfo] = Out(doc="calibration of the left one, with each image")
    prepared_right_info: Out[CameraInfo] = Out(doc="calibration of the right one; P holds the baseline")
    frames: Out[Transforms] = Out(doc="the rectified cameras in the raw ones, with each pair")
    status: Out[Diagnostics] = Out(doc="the baseline; pixels that show nothing; a warning where half do not")

    keep: float = Param(
        0.0, ge=0, le=1, doc="0 shows no pixel without image, 1 every pixel of the raw images; without P"
    )
    crop: tuple[int, int, int, int] | None = Param(
        None, doc="x, y, width and height of the part that is kept of both", unit="px"
    )
    width: int | None = Param(None, ge=1, doc="columns in the end; as the height asks if none", unit="px")
    height: int | None = Param(None, ge=1, doc="rows in the end; as the width asks if none", unit="px")
    grey: bool = Param(False, doc="grey instead of colour")
    normalize: Tone = Param("none", doc="how brightness is made even: stretched, equalised, or equalised in parts")
    suffix: str = Param("_rectified", min_length=1, doc="added to the frames' names")

    _pair: _Pair | None = None
    state: Counts

    def process(
        self, left: Image, right: Image, left_info: CameraInfo, right_info: CameraInfo,
        extrinsics: Transforms | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Raises ValueError where an image does not fit its calibration, or the two cannot be rectified."""
        check_fit("left", left, left_info)
        check_fit("right", right, right_info)
        pair = self._pair_of(left_info, right_info, extrinsics)
        messages: dict[str, Any] = {"frames": pair.frames.replace(stamp=left.stamp)}
        for name, image, preparation in (("left", left, pair.left), ("right", right, pair.right)):
            pixels = preparation.apply(grey_of(image.data) if self.grey else image.data)
            info = preparation.info.replace(stamp=left.stamp)
            messages[f"prepared_{name}"] = Image(stamp=left.stamp, frame=info.frame, data=pixels)
            messages[f"prepared_{name}_info"] = info
        counts = {
            "pixels": pair.left.info.width * pair.left.info.height,
            "left without image": pair.left.empty,
            "right without image": pair.right.empty,
        }
        self.state.counts.update({"pairs": 1, "pixels without image": pair.left.empty + pair.right.empty})
        return messages | {"status": _status(left.stamp, pair.baseline, counts)}

    def _pair_of(self, left: CameraInfo, right: CameraInfo, extrinsics: Transforms | None) -> _Pair:
        """Returns how the pair is prepared; that is computed anew where its inputs change."""
        T_left_right = None
        if left.P is None or right.P is None:
            if extrinsics is None:
                raise ValueError("left_info and right_info hold no P to rectify by, and there are no extrinsics")
            T_left_right = transform_between(extrinsics, right.frame, left.frame)
        made = self._pair
        if made is None or not (
            told_again(made.infos[0], left)
            and told_again(made.infos[1], right)
            and _equal(made.T_left_right, T_left_right)
        ):
            made = self._pair = self._worked_out(left, right, T_left_right)
        return made

    def _worked_out(self, left: CameraInfo, right: CameraInfo, T_left_right: Matrix | None) -> _Pair:
        check_model("left", left)
        check_model("right", right)
        if (left.width, left.height) != (right.width, right.height):
            raise ValueError(
                f"left has {left.width}x{left.height} pixels, but right {right.width}x{right.height}: a pair that is "
                f"rectified must have one size"
            )
        if T_left_right is None:
            assert left.P is not None
            assert right.P is not None
            check_projection("left", left)
            check_projection("right", right)
            turns, projections = (_rotation(left), _rotation(right)), (left.P, right.P)
        else:
            found = rectify(left, right, T_left_right, self.keep)
            turns = (found.R_left, found.R_right)
            projections = (projection(found.K, 0.0), projection(found.K, found.baseline))
        window = Window.of((left.width, left.height), self.crop, self.width, self.height)
        prepared = [
            Preparation(info, _ideal(info, P, self.suffix), window, R=R, tone=self.normalize)
            for info, R, P in zip((left, right), turns, projections, strict=True)
        ]
        baseline = float((projections[0][0, 3] - projections[1][0, 3]) / projections[1][0, 0])
        frames = _turned((left, right), turns, self.suffix)
        return _Pair((left, right), T_left_right, prepared[0], prepared[1], baseline, frames)


def _equal(one: Matrix | None, other: Matrix | None) -> bool:
    return one is other if one is None or other is None else np.array_equal(one, other)


def _rotation(info: CameraInfo) -> Matrix:
    return np.eye(3) if info.R is None else info.R


def _ideal(info: CameraInfo, P: Matrix, suffix: str) -> CameraInfo:
    return info.replace(
        frame=info.frame + suffix, distortion_model="none", distortion=None, K=P[:, :3], R=None, P=P
    )  # fmt: skip


def _turned(infos: tuple[CameraInfo, CameraInfo], turns: tuple[Matrix, Matrix], suffix: str) -> Transforms:
    """The rectified frames in the raw ones: R maps the other way."""
    return Transforms(
        stamp=infos[0].stamp,
        frames=tuple(info.frame for info in infos),
        child_frames=tuple(info.frame + suffix for info in infos),
        translations=np.zeros((2, 3)),
        rotations=np.stack([matrix_to_quaternion(R.T) for R in turns]),
    )


def _status(stamp: int, baseline: float, counts: Mapping[str, int]) -> Diagnostics:
    text, level = f"baseline {baseline:.4f} m", Level.OK
    if max(counts["left without image"], counts["right without image"]) * 2 > counts["pixels"]:
        text, level = f"{text}; most pixels of an image show nothing", Level.WARN
    return counted_status("stereo_preprocess", stamp, text, level, counts)
