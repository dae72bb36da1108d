"""Images made ready for what comes after, with the calibration that results."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from dataflow.messages import CameraInfo, Diagnostics, Image
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry.calibration import check_fit, told_again
from operators.geometry.lens import check_model, check_projection, is_distorted
from operators.image.preparation import Preparation, Tone, grey_of
from operators.image.view import Window, fitting_view
from operators.status import counted_status


class ImagePreprocess(Operator):
    """Removes a camera's lens distortion or rectifies it, crops, scales and normalises its images.

    In this order; what is not asked for is not done, and an image that needs nothing passes bit for bit. `rectify`
    turns the image as its calibration's R and P say; `undistort` keeps the camera's axes and chooses the focal length
    by `keep`. The calibration that results comes with every image.

    Methods: the lenses, Brown, "Decentering distortion of lenses", 1966, and Kannala and Brandt, 2006, by OpenCV;
    `clahe`, Zuiderveld, "Contrast limited adaptive histogram equalization", 1994.
    """

    image: In[Image] = In(doc="raw image, grey or colour")
    image_info: Sampled[CameraInfo] = Sampled(doc="calibration of the camera, with its lens distortion")
    prepared: Out[Image] = Out(doc="the image made ready")
    prepared_info: Out[CameraInfo] = Out(doc="its calibration, with each image")
    status: Out[Diagnostics] = Out(doc="what was done; pixels that show nothing; a warning where half do not")

    lens: Literal["keep", "undistort", "rectify"] = Param("undistort", doc="what becomes of the lens distortion")
    keep: float = Param(
        0.0, ge=0, le=1, doc="of `undistort`: 0 shows no pixel without image, 1 every pixel of the raw image"
    )
    crop: tuple[int, int, int, int] | None = Param(
        None, doc="x, y, width and height of the part that is kept, after that", unit="px"
    )
    width: int | None = Param(None, ge=1, doc="columns in the end; as the height asks if none", unit="px")
    height: int | None = Param(None, ge=1, doc="rows in the end; as the width asks if none", unit="px")
    grey: bool = Param(False, doc="grey instead of colour")
    normalize: Tone = Param("none", doc="how brightness is made even: stretched, equalised, or equalised in parts")
    rectified_suffix: str = Param("_rectified", doc="added to the frame's name where `rectify` turns it")

    _made: tuple[CameraInfo, Preparation] | None = None
    state: Counts

    def process(self, image: Image, image_info: CameraInfo) -> dict[str, Any]:
        """Raises ValueError where image and calibration do not fit, or that does not do for what is asked for."""
        check_fit("image", image, image_info)
        if self._made is None or not told_again(self._made[0], image_info):
            self._made = (image_info, self._preparation(image_info))
        preparation = self._made[1]
        pixels = preparation.apply(grey_of(image.data) if self.grey else image.data)
        info = preparation.info.replace(stamp=image.stamp)
        counts = {"pixels": info.width * info.height, "without image": preparation.empty}
        self.state.counts.update({"images": 1, "pixels without image": preparation.empty})
        return {
            "prepared": Image(stamp=image.stamp, frame=info.frame, data=pixels),
            "prepared_info": info,
            "status": _status(image, info, self.lens, counts),
        }

    def _preparation(self, info: CameraInfo) -> Preparation:
        window = Window.of((info.width, info.height), self.crop, self.width, self.height)
        if self.lens == "keep" or (self.lens == "undistort" and not is_distorted(info)):
            return Preparation(info, info, window, tone=self.normalize)
        check_model("image", info)
        if self.lens == "undistort":
            R, P = np.eye(3), None
            K = fitting_view([(info, R)], self.keep)
        else:
            if info.P is None:
                raise ValueError("image_info must hold P, and R where it is turned, to rectify by")
            check_projection("image", info)
            R, P = np.eye(3) if info.R is None else info.R, info.P
            K = P[:, :3]
        ideal = info.replace(
            frame=info.frame + (self.rectified_suffix if not np.array_equal(R, np.eye(3)) else ""),
            distortion_model="none",
            distortion=None,
            K=K,
            R=None,
            P=P,
        )
        return Preparation(info, ideal, window, R=R, tone=self.normalize)


def _status(image: Image, info: CameraInfo, lens: str, counts: Mapping[str, int]) -> Diagnostics:
    text = f"{image.width}x{image.height} pixels made {info.width}x{info.height}"
    level = Level.OK
    if counts["without image"] * 2 > counts["pixels"]:
        level, text = Level.WARN, f"{text}; {lens} leaves most of them without image"
    return counted_status("image_preprocess", image.stamp, text, level, counts)
