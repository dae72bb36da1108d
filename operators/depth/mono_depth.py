"""Depth from one image, by a network.

Its metric scale is that of pixels of known depth: inverse depth = scale * nearness + shift. Ranftl et al., "Towards
robust monocular depth estimation: mixing datasets for zero-shot cross-dataset transfer", 2020, align so; the fit here
is by RANSAC (Fischler and Bolles, 1981), then least squares on what agrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Image, RelativeDepth
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.image.letterbox import ImageFit
from operators.inference import ModelError, Provider, open_session
from operators.models.use import use_model
from operators.network_input import NORMALIZATIONS, image_input, three_channels
from operators.status import counted_status

Values = NDArray[np.float64]

_SAMPLES = 100
Nearness = NDArray[np.float32]
LEAST_CONTRAST = 4.0  # standard deviation of grey levels below which an image shows nothing


@dataclass(frozen=True)
class Scaling:
    """Inverse depth, 1/m, is `scale` * nearness + `shift`; so many of the given pixels agree with it."""

    scale: float
    shift: float
    given: int
    agreeing: int

    def depth(self, nearness: NDArray[np.float32], farthest: float) -> NDArray[np.float32]:
        """Returns metres, 0 where the inverse depth is below that of the farthest, or nearness is not finite."""
        inverse = self.scale * np.where(np.isfinite(nearness), nearness, -np.inf) + self.shift
        seen = inverse >= 1 / farthest
        return np.where(seen, 1 / np.where(seen, inverse, 1), 0).astype(np.float32)


def fitted(
    nearness: Values, depth: Values, tolerance: float, rng: np.random.Generator, *, shifted: bool
) -> Scaling | None:
    """Fits nearness (N,) to depths (N,), metres, of the same pixels; None where no scale above 0 fits any of them.

    A pixel agrees when its inverse depth is off by less than `tolerance` times itself. Without `shifted` the shift is
    0.
    """
    inverse = 1 / depth
    candidates = _candidates(nearness, inverse, rng, shifted)
    if not len(candidates):
        return None
    off = np.abs(candidates[:, :1] * nearness + candidates[:, 1:] - inverse) < tolerance * inverse
    agrees = off[int(off.sum(axis=1).argmax())]
    for _ in range(3):
        if agrees.sum() < 2:
            return None
        x, y, weight = nearness[agrees], inverse[agrees], depth[agrees]  # errors are shares of the inverse depth
        A = np.column_stack([x, np.ones(len(x))]) if shifted else x[:, None]
        solution = np.linalg.lstsq(A * weight[:, None], y * weight, rcond=None)[0]
        scale, shift = float(solution[0]), float(solution[1]) if shifted else 0.0
        agrees = np.abs(scale * nearness + shift - inverse) < tolerance * inverse
    if not scale > 0:
        return None
    return Scaling(scale, shift, len(depth), int(agrees.sum()))


def _candidates(nearness: Values, inverse: Values, rng: np.random.Generator, shifted: bool) -> Values:
    """Returns scales above 0 and shifts (M, 2) through drawn pixels: two each, or one."""
    if shifted:
        a, b = rng.integers(0, len(nearness), (2, _SAMPLES))
        across = nearness[a] - nearness[b]
        a, b = a[across != 0], b[across != 0]
        scale = (inverse[a] - inverse[b]) / (nearness[a] - nearness[b])
        found = np.column_stack([scale, inverse[a] - scale * nearness[a]])
    else:
        a = rng.integers(0, len(nearness), _SAMPLES)
        a = a[nearness[a] > 0]
        found = np.column_stack([inverse[a] / nearness[a], np.zeros(len(a))])
    return np.asarray(found[found[:, 0] > 0])


class MonoDepth(Operator):
    """Estimates which pixels of an image are near, with an ONNX model; metric where depths are given.

    One image has no scale: `relative` is inverse depth up to a factor and a constant. Where `sparse` gives metric
    depth at some pixels (a stereo pair's, a projected LiDAR's), both are fitted to it, robustly, image by image, and
    `depth` is the whole image in metres; without agreement no `depth`, and a warning in `status`. A model whose
    `answer` is metres gives `depth` by itself. An image that is black or without contrast gives neither.

    The model is one of `dataflow models` by name, or a file; on the CPU it runs with one thread. It takes one
    (1, 3, H, W) input of RGB in float32, float16 or uint8 and gives one value per pixel, larger for nearer, as those of
    Li et al., "Enforcing temporal consistency in video depth estimation", 2021 (TCMonoDepth) and Yang et al., "Depth
    Anything V2", 2024. The fit is that of Ranftl et al. (MiDaS), 2020.
    """

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    sparse: Sampled[DepthImage] = Sampled(
        required=False,
        max_age="50ms",
        doc="metric depth at some pixels of the same view, which may have other sizes; 0 elsewhere",
    )
    image_info: Sampled[CameraInfo] = Sampled(required=False, doc="the image's calibration, for `canonical_focal`")
    relative: Out[RelativeDepth] = Out(doc="nearness at the image's pixels")
    depth: Out[DepthImage] = Out(doc="depth in metres, where `sparse` gives a scale; 0 where it is beyond `max_range`")
    status: Out[Diagnostics] = Out(
        doc="the scale and how many depths agree; a warning where `sparse` gives none, or the image shows nothing"
    )

    model: str = Param(min_length=1, doc="a name of `dataflow models list`, or an ONNX file")
    provider: Provider = Param("cpu", doc="onnxruntime's execution provider; results repeat bit for bit on the CPU")
    normalization: Literal["none", "unit", "imagenet"] | None = Param(
        None,
        doc="of pixels: as they are (`none`), as shares of 255, or those less ImageNet's mean by its deviation; null "
        "takes the registry's, or leaves them as they are",
    )
    answer: Literal["nearness", "metres"] | None = Param(
        None,
        doc="what the model gives: larger for nearer without a scale, or depth in metres; none takes the registry's, "
        "or nearness",
    )
    canonical_focal: float | None = Param(
        None,
        gt=0,
        doc="the focal length, in pixels of the input, of the camera that the model's metres are of (Metric3D: 1000); "
        "none takes the registry's, or that of the image",
        unit="px",
    )
    input_size: tuple[int, int] | None = Param(
        None, doc="(width, height) where the model leaves it open; none takes the registry's, or 518 x 518", unit="px"
    )
    align: Literal["scale_and_shift", "scale"] = Param(
        "scale_and_shift", doc="what is fitted to the given depths: the model's own constant is unknown, or is 0"
    )
    tolerance: float = Param(
        0.25, gt=0, lt=1, tunable=True, doc="a given depth agrees when off by less than this share"
    )
    least_given: int = Param(20, ge=2, tunable=True, doc="fewer given depths give no scale")
    least_agreeing: float = Param(0.5, gt=0, le=1, tunable=True, doc="nor does a smaller share of them that agree")
    most_given: int = Param(2000, ge=10, doc="of more depths, so many are drawn")
    max_range: float = Param(20.0, gt=0, tunable=True, doc="farther depths are no returns", unit="m")
    state: Counts

    def setup(self) -> None:
        """Loads the model. Raises FileNotFoundError where there is none, ModelError where it is of another kind."""
        used = use_model(self, self.model)
        self._session = open_session(used.file, self.provider)
        mean, scale = NORMALIZATIONS[used.setting(self, "normalization", "none")]
        free = tuple(used.setting(self, "input_size", (518, 518)))
        self._focal = used.setting(self, "canonical_focal", None)
        self._metric = used.setting(self, "answer", "nearness") == "metres"
        self._input = image_input(
            used.file, self._session, (free[0], free[1]), bgr=False, mean=mean, scale=scale, layouts=("nchw",)
        )

    def process(
        self, image: Image, sparse: DepthImage | None = None, image_info: CameraInfo | None = None
    ) -> dict[str, Any]:
        """Raises ValueError where the given depths are of another view, ModelError for an output of another shape."""
        counts = {"given": 0, "agreeing": 0}
        if (flaw := _flaw(image.data)) is not None:
            self.state.counts.update({"images": 1, f"images {flaw}": 1})
            return {"status": counted_status("mono_depth", image.stamp, f"the image is {flaw}", Level.WARN, counts)}
        if self._focal is not None and image_info is None:
            self.state.counts.update({"images": 1, "images without": 1})
            text = "no image_info: the model's metres are of another camera"
            return {"status": counted_status("mono_depth", image.stamp, text, Level.WARN, counts)}
        nearness, scale = self._answer(image.data)
        if self._metric:
            if self._focal is not None and image_info is not None:
                nearness = nearness * np.float32(image_info.K[0, 0] / scale / self._focal)
            self.state.counts.update({"images": 1, "images with a scale": 1})
            near = np.where(np.isfinite(nearness) & (nearness > 0) & (nearness <= self.max_range), nearness, 0)
            status = counted_status("mono_depth", image.stamp, "the model gives metres", Level.OK, counts)
            return {"depth": DepthImage(data=near.astype(np.float32)), "status": status}
        messages: dict[str, Any] = {"relative": RelativeDepth(data=nearness)}
        scaling, text, level = None, "no metric depth is given: relative only", Level.OK
        if sparse is not None:
            scaling, counts = self._scaling(nearness, sparse)
            if scaling is None:
                text, level = f"{counts['given']} depths are given, {counts['agreeing']} agree: no scale", Level.WARN
            else:
                text = f"1/depth is {scaling.scale:.3g} of nearness and {scaling.shift:+.3g} 1/m"
                depth = scaling.depth(nearness, self.max_range)
                messages["depth"] = DepthImage(data=depth)
        self.state.counts.update(
            {"images": 1, "images with a scale": int(scaling is not None), "images without": int(level is Level.WARN)}
        )
        return messages | {"status": counted_status("mono_depth", image.stamp, text, level, counts)}

    def _answer(self, pixels: NDArray[np.uint8]) -> tuple[Nearness, float]:
        """Returns the model's output (H, W) for pixels (H, W) or (H, W, 3), and pixels of the image for one of input.

        The image fills the input, or, for a canonical camera, lies in its middle with its proportions.
        """
        color = three_channels(pixels)
        image, size = (color.shape[1], color.shape[0]), self._input.size
        fit = ImageFit.plan("stretch" if self._focal is None else "letterbox", image, size)
        smaller = image[0] >= fit.inner[0] and image[1] >= fit.inner[1]
        inner = cv2.resize(color, fit.inner, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
        tensor = self._input.tensor(fit.framed(np.asarray(inner, np.uint8)))
        output = np.asarray(self._session.run(None, {self._input.name: tensor})[0])
        width, height = size
        if output.size != width * height:
            raise ModelError(f"{self.model} gave {output.shape}, but one value per pixel of {size} is needed")
        (x, y), (w, h) = fit.offset, fit.inner
        small = output.reshape(height, width)[y : y + h, x : x + w].astype(np.float32)
        return np.asarray(cv2.resize(small, image, interpolation=cv2.INTER_LINEAR), np.float32), fit.scale[0]

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
