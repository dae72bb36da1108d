"""Keypoints of people in an image, by a network in an ONNX file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, Image, Keypoints2D
from dataflow.operator import In, Operator, Out, Param, Sampled
from operators.detection.decode import Outputs, Size, shapes_of
from operators.inference import ModelError, Provider, open_session
from operators.models.use import use_model
from operators.network_input import NORMALIZATIONS, image_input, three_channels

F32 = NDArray[np.float32]
KeypointDecoderName = Literal["simcc", "movenet"]

COCO_KEYPOINTS: Final = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle",
    "right_ankle",
)  # fmt: skip
"""The 17 points of a person in COCO, in its order."""

COCO_LINKS: Final = (
    (0, 1), (0, 2), (1, 3), (2, 4), (5, 6), (5, 7), (7, 9), (6, 8), (8, 10), (5, 11), (6, 12), (11, 12), (11, 13),
    (13, 15), (12, 14), (14, 16),
)  # fmt: skip


@dataclass(frozen=True)
class Cut:
    """The part of an image that fills a network's input: around `center` (x, y), `extent` (w, h) pixels of the image.

    It has the aspect ratio of the input, so that nothing is stretched; what is outside the image is black.
    """

    center: tuple[float, float]
    extent: tuple[float, float]
    size: Size

    @classmethod
    def around(cls, box: Sequence[float], size: Size, padding: float) -> Cut:
        """Returns the cut around a box (x1, y1, x2, y2), made larger by a factor.

        Source: `bbox_xyxy2cs` and `TopdownAffine` of MMPose (Apache-2.0).
        """
        x1, y1, x2, y2 = box
        width, height, aspect = (x2 - x1) * padding, (y2 - y1) * padding, size[0] / size[1]
        extent = (width, width / aspect) if width > height * aspect else (height * aspect, height)
        return cls(((x1 + x2) / 2, (y1 + y2) / 2), extent, size)

    def of(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Returns the input (h, w, 3) of an image (H, W, 3)."""
        scale = self.size[0] / self.extent[0]
        shift = [extent / 2 - scale * middle for extent, middle in zip(self.size, self.center, strict=True)]
        matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
        return np.asarray(cv2.warpAffine(pixels, matrix, self.size, flags=cv2.INTER_LINEAR), np.uint8)

    def restore(self, points: F32) -> F32:
        """Returns points (K, 2) of the input as points of the image."""
        center, extent = np.array(self.center), np.array(self.extent)
        return np.asarray(points / np.array(self.size) * extent + center - extent / 2, np.float32)


def decode_simcc(outputs: Outputs, size: Size) -> tuple[F32, F32]:
    """RTMPose and others of SimCC: two distributions over the input's columns (N, K, Wx) and rows (N, K, Wy).

    A point is where both are largest; the smaller one of the two values is its score. NaN where that is not above 0.
    Source: `get_simcc_maximum` of MMPose (Apache-2.0), after Li et al., "SimCC", 2022, and Jiang et al., "RTMPose",
    2023.
    """
    if len(outputs) != 2 or any(o.ndim != 3 for o in outputs) or outputs[0].shape[:2] != outputs[1].shape[:2]:
        raise ValueError(f"SimCC's outputs are (N, K, Wx) and (N, K, Wy), got {shapes_of(outputs)}")
    places = np.stack([o.argmax(axis=2) * (side / o.shape[2]) for o, side in zip(outputs, size, strict=True)], axis=2)
    scores = np.minimum(*(o.max(axis=2) for o in outputs)).astype(np.float32)
    points = places.astype(np.float32)
    points[scores <= 0] = np.nan
    return points, scores


def decode_movenet(outputs: Outputs, size: Size) -> tuple[F32, F32]:
    """MoveNet for one person: (N, 1, K, 3), rows and columns as shares of the input, and scores.

    Source: the model card of MoveNet.SinglePose (Google, 2021; Apache-2.0).
    """
    answer = outputs[0]
    if answer.ndim != 4 or answer.shape[1] != 1 or answer.shape[3] != 3:
        raise ValueError(f"MoveNet's output is (N, 1, K, 3), got {shapes_of(outputs)}")
    rows = answer[:, 0].astype(np.float32)
    return rows[:, :, 1::-1] * np.array(size, np.float32), rows[:, :, 2]


@dataclass(frozen=True)
class KeypointLayout:
    """One family: how its outputs become points (N, K, 2) of the input and scores, and how its input is made.

    `padding` is the factor by which boxes are made larger, `normalization` one of `NORMALIZATIONS`.
    """

    decode: Callable[[Outputs, Size], tuple[F32, F32]]
    padding: float
    normalization: str

    @property
    def scaling(self) -> tuple[Any, Any]:
        """Mean and scale of pixels."""
        return NORMALIZATIONS[self.normalization]


KEYPOINT_LAYOUTS: dict[KeypointDecoderName, KeypointLayout] = {
    "simcc": KeypointLayout(decode_simcc, 1.25, "imagenet"),
    "movenet": KeypointLayout(decode_movenet, 1.0, "none"),
}


class KeypointDetector(Operator):
    """Finds the keypoints of each detected person, or of the one person in the image where there are no detections.

    The model is one of `dataflow models` by name, or an ONNX file: RTMPose and others of SimCC, which see each box, or
    MoveNet, made for one person. On the CPU it runs with one thread, so equal images give equal points. Inputs are
    (N, 3, H, W) or (N, H, W, 3) of float32, float16, uint8 or int32; where N is open all boxes go in at once.

    Sources: Jiang et al., "RTMPose", 2023; Google, "MoveNet", 2021.
    """

    stateless = True

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: Sampled[Detections2D] = Sampled(
        required=False, doc="boxes in the same image; those of another stamp are not used, and nothing is found then"
    )
    keypoints: Out[Keypoints2D] = Out(doc="points in the image's pixels, a row for each person, in the boxes' order")

    model: str = Param(min_length=1, doc="a name of `dataflow models list`, or an ONNX file")
    decoder: KeypointDecoderName | None = Param(None, doc="family of the network; none takes the registry's")
    input_size: tuple[int, int] | None = Param(
        None, doc="(width, height) where the model leaves it open; none takes the registry's, or 192 x 256", unit="px"
    )
    provider: Provider = Param("cpu", doc="onnxruntime's execution provider; results repeat bit for bit on the CPU")
    classes: tuple[str, ...] = Param(("person",), doc="names of the detections that have keypoints")
    min_score: float = Param(0.3, ge=0, le=1, tunable=True, doc="weaker detections are not looked at")

    def setup(self) -> None:
        """Loads the model. Raises FileNotFoundError or ModelError."""
        used = use_model(self, self.model)
        decoder = used.setting(self, "decoder", None)
        if decoder is None:
            raise ModelError(
                f"{used.file} is no file of a model that `dataflow models list` prints, so KeypointDetector.decoder "
                f"must name its family: {', '.join(KEYPOINT_LAYOUTS)}"
            )
        self._layout = KEYPOINT_LAYOUTS[decoder]
        self._session = open_session(used.file, self.provider)
        mean, scale = self._layout.scaling
        free = tuple(used.setting(self, "input_size", (192, 256)))
        self._input = image_input(used.file, self._session, (free[0], free[1]), bgr=False, mean=mean, scale=scale)
        self._at_once = not isinstance(self._session.get_inputs()[0].shape[0], int)

    def process(self, image: Image, detections: Detections2D | None = None) -> Keypoints2D:
        """Raises ModelError for outputs of another shape than the decoder reads."""
        boxes, ids = np.array([[0.0, 0.0, image.width, image.height]]), None
        if detections is not None:
            boxes, ids = self._persons(image, detections)
        cuts = [Cut.around(box, self._input.size, self._layout.padding) for box in boxes.tolist()]
        points, scores = self._points(image, cuts)
        known = points.shape[1] == len(COCO_KEYPOINTS)
        return Keypoints2D(
            width=image.width,
            height=image.height,
            names=COCO_KEYPOINTS if known else (),
            links=np.array(COCO_LINKS if known else np.zeros((0, 2)), np.int32),
            points=points,
            scores=np.clip(scores, 0, 1),
            ids=ids,
        )

    def _persons(self, image: Image, detections: Detections2D) -> tuple[NDArray[np.float64], NDArray[np.int64] | None]:
        """Returns the boxes (N, 4) to look into, and the ids of what is in them, where the detections have any."""
        names = np.array(detections.labels(), object)
        wide = (detections.boxes[:, 2:] > detections.boxes[:, :2]).all(axis=1)
        rows = np.flatnonzero(np.isin(names, self.classes) & (detections.scores >= self.min_score) & wide)
        if detections.stamp != image.stamp:
            rows = rows[:0]
        return detections.boxes[rows].astype(np.float64), None if detections.ids is None else detections.ids[rows]

    def _points(self, image: Image, cuts: list[Cut]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Returns points (N, K, 2) of the image and their scores (N, K)."""
        if not cuts:
            count = len(COCO_KEYPOINTS)
            return np.zeros((0, count, 2), np.float32), np.zeros((0, count), np.float32)
        pixels = three_channels(image.data)
        tensors = [self._input.tensor(cut.of(pixels)) for cut in cuts]
        batches = [np.concatenate(tensors)] if self._at_once else tensors
        answers = [self._decoded(batch) for batch in batches]
        points, scores = (np.concatenate(parts) for parts in zip(*answers, strict=True))
        return np.stack([cut.restore(each) for cut, each in zip(cuts, points, strict=True)]), scores

    def _decoded(self, batch: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        outputs = [np.asarray(each) for each in self._session.run(None, {self._input.name: batch})]
        try:
            return self._layout.decode(outputs, self._input.size)
        except ValueError as error:
            raise ModelError(f"KeypointDetector.decoder does not fit {self.model}: {error}") from None
