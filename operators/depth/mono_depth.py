"""Depth from one image, by a network."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import DepthImage, Diagnostics, Image, RelativeDepth
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.depth.scaling import Scaling, fitted
from operators.inference import ModelError, open_session
from operators.network_input import three_channels
from operators.status import counted_status

if TYPE_CHECKING:
    import onnxruntime

Nearness = NDArray[np.float32]

LEAST_CONTRAST = 4.0  # standard deviation of grey levels below which an image shows nothing


class MonoDepth(Operator):
    """Estimates which pixels of an image are near, with an ONNX model on one CPU thread; metric where depths are given.

    One image has no scale: `relative` is inverse depth up to a factor and a constant. Where `sparse` gives metric
    depth at some pixels (a stereo pair's, a projected LiDAR's), both are fitted to it, robustly, image by image, and
    `depth` is the whole image in metres; without agreement no `depth`, and a warning in `status`. An image that is
    black or without contrast gives neither.

    The model takes one (1, 3, H, W) float32 input of RGB from 0 to 255 and gives one value per pixel, larger for
    nearer, as those of Li et al., "Enforcing temporal consistency in video depth estimation", 2021 (TCMonoDepth). The
    fit is that of Ranftl et al. (MiDaS), 2020.
    """

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    sparse: Sampled[DepthImage] = Sampled(
        required=False,
        max_age="50ms",
        doc="metric depth at some pixels of the same view, which may have other sizes; 0 elsewhere",
    )
    relative: Out[RelativeDepth] = Out(doc="nearness at the image's pixels")
    depth: Out[DepthImage] = Out(doc="depth in metres, where `sparse` gives a scale; 0 where it is beyond `max_range`")
    status: Out[Diagnostics] = Out(
        doc="the scale and how many depths agree; a warning where `sparse` gives none, or the image shows nothing"
    )

    model: str = Param(min_length=1, doc="ONNX file")
    align: Literal["scale_and_shift", "scale"] = Param(
        "scale_and_shift", doc="what is fitted to the given depths: the model's own constant is unknown, or is 0"
    )
    tolerance: float = Param(0.25, gt=0, lt=1, live=True, doc="a given depth agrees when off by less than this share")
    least_given: int = Param(20, ge=2, live=True, doc="fewer given depths give no scale")
    least_agreeing: float = Param(0.5, gt=0, le=1, live=True, doc="nor does a smaller share of them that agree")
    most_given: int = Param(2000, ge=10, doc="of more depths, so many are drawn")
    max_range: float = Param(20.0, gt=0, live=True, doc="farther depths are no returns", unit="m")
    state: Counts

    def setup(self) -> None:
        """Loads the model. Raises FileNotFoundError where there is none, ModelError where it is of another kind."""
        file = self.use_file(self.model)
        self._session = open_session(file)
        self._input, self._size = _input_of(file, self._session)

    def process(self, image: Image, sparse: DepthImage | None = None) -> dict[str, Any]:
        """Raises ValueError where the given depths are of another view, ModelError for an output of another shape."""
        counts = {"given": 0, "agreeing": 0}
        if (flaw := _flaw(image.data)) is not None:
            self.state.counts.update({"images": 1, f"images {flaw}": 1})
            return {"status": counted_status("mono_depth", image.stamp, f"the image is {flaw}", Level.WARN, counts)}
        nearness = self._nearness(image.data)
        messages: dict[str, Any] = {"relative": RelativeDepth(stamp=image.stamp, frame=image.frame, data=nearness)}
        scaling, text, level = None, "no metric depth is given: relative only", Level.OK
        if sparse is not None:
            scaling, counts = self._scaling(nearness, sparse)
            if scaling is None:
                text, level = f"{counts['given']} depths are given, {counts['agreeing']} agree: no scale", Level.WARN
            else:
                text = f"1/depth is {scaling.scale:.3g} of nearness and {scaling.shift:+.3g} 1/m"
                depth = scaling.depth(nearness, self.max_range)
                messages["depth"] = DepthImage(stamp=image.stamp, frame=image.frame, data=depth)
        self.state.counts.update(
            {"images": 1, "images with a scale": int(scaling is not None), "images without": int(level is Level.WARN)}
        )
        return messages | {"status": counted_status("mono_depth", image.stamp, text, level, counts)}

    def _nearness(self, pixels: NDArray[np.uint8]) -> Nearness:
        """Returns the model's output (H, W) for pixels (H, W) or (H, W, 3), at their size."""
        color = three_channels(pixels)
        height, width = color.shape[:2]
        shrinking = width >= self._size[0] and height >= self._size[1]
        fitting = cv2.resize(color, self._size, interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)
        tensor = np.ascontiguousarray(fitting.transpose(2, 0, 1)[None], np.float32)
        output = np.asarray(self._session.run(None, {self._input: tensor})[0])
        if output.size != self._size[0] * self._size[1]:
            raise ModelError(f"{self.model} gave {output.shape}, but one value per pixel of {self._size} is needed")
        small = output.reshape(self._size[1], self._size[0]).astype(np.float32)
        return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)

    def _scaling(self, nearness: Nearness, sparse: DepthImage) -> tuple[Scaling | None, dict[str, int]]:
        height, width = nearness.shape
        if abs(sparse.width * height - sparse.height * width) > max(width, height, sparse.width, sparse.height):
            raise ValueError(
                f"sparse has {sparse.width}x{sparse.height} pixels, but the image {width}x{height}: both must show one "
                f"view, so their aspect ratios must agree"
            )
        rows, columns = np.nonzero(np.isfinite(sparse.data) & (sparse.data > 0))
        if len(rows) > self.most_given:
            drawn = self.rng.choice(len(rows), self.most_given, replace=False)
            rows, columns = rows[drawn], columns[drawn]
        metres = sparse.data[rows, columns].astype(np.float64)
        near = nearness[
            np.minimum((rows + 0.5) * height / sparse.height, height - 1).astype(np.int64),
            np.minimum((columns + 0.5) * width / sparse.width, width - 1).astype(np.int64),
        ].astype(np.float64)
        finite = np.isfinite(near)
        metres, near = metres[finite], near[finite]
        counts = {"given": len(metres), "agreeing": 0}
        if len(metres) < self.least_given:
            return None, counts
        found = fitted(near, metres, self.tolerance, self.rng, shifted=self.align == "scale_and_shift")
        if found is not None:
            counts["agreeing"] = found.agreeing
            if found.agreeing < self.least_agreeing * found.given:
                found = None
        return found, counts


def _flaw(pixels: NDArray[np.uint8]) -> str | None:
    """Returns what keeps an image from showing anything."""
    spread = float(pixels.std())
    if spread >= LEAST_CONTRAST:
        return None
    return "black" if float(pixels.mean()) < 16.0 else "without contrast"


def _input_of(file: Path, session: onnxruntime.InferenceSession) -> tuple[str, tuple[int, int]]:
    """Returns the name of the input, and its (width, height)."""
    inputs = session.get_inputs()
    shape = inputs[0].shape
    fixed = len(shape) == 4 and shape[1] == 3 and all(isinstance(extent, int) for extent in shape[2:])
    if len(inputs) != 1 or not fixed or inputs[0].type != "tensor(float)":
        described = ", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)
        raise ModelError(f"{file} must have one input tensor(float) [1, 3, H, W] of fixed size, has {described}")
    return inputs[0].name, (shape[3], shape[2])
