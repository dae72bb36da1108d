"""Semantic segmentation with a network in an ONNX file."""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Image, SegmentationMap
from dataflow.messages.diagnostics import Level
from dataflow.operator import In, Operator, Out, Param
from operators.detection.coco import names_of
from operators.image.letterbox import FitMode, ImageFit
from operators.inference import ModelError, Provider, open_session
from operators.model_metadata import told
from operators.models.use import use_model
from operators.network_input import Labels, image_input, read_labels, three_channels
from operators.segmentation.drawing import draw_segmentation
from operators.segmentation.labelled import labelled, least_of
from operators.status import Row, status_of_rows

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet's, by which most were trained


def scores_of(output: NDArray[Any], classes: int | None, probabilities: bool) -> NDArray[np.float32]:
    """Returns scores (C, H, W) of an output (1, C, H, W), or (1, H, W, C) where that alone fits so many classes.

    One channel is a class and what is not of it: two classes, the background first. Raises ValueError for another
    shape.
    """
    if output.ndim != 4 or output.shape[0] != 1 or 0 in output.shape:
        raise ValueError(f"scores have shape (1, classes, H, W) or (1, H, W, classes), got {output.shape}")
    last = classes is not None and output.shape[1] != classes == output.shape[3]
    scores = np.asarray(output[0].transpose(2, 0, 1) if last else output[0], np.float32)
    if len(scores) > 1:
        return scores
    return np.concatenate([1 - scores if probabilities else np.zeros_like(scores), scores])


def classes_of(output: NDArray[Any]) -> NDArray[np.int64]:
    """Returns classes (H, W) of an output of whole numbers, (H, W) with axes of extent 1. Raises ValueError."""
    extents = [extent for extent in output.shape if extent != 1]
    if len(extents) != 2:
        raise ValueError(f"a map of classes has shape (1, H, W), got {output.shape}")
    return output.reshape(extents).astype(np.int64)


def at_image(values: NDArray[Any], fit: ImageFit, interpolation: int) -> NDArray[Any]:
    """Returns the plane (H, W) of a network's output at the size of the image, without what was only padding.

    The plane covers the input, in whatever resolution.
    """
    if fit.inner != fit.target:
        if (values.shape[1], values.shape[0]) != fit.target:
            values = cv2.resize(values, fit.target, interpolation=interpolation)
        (x, y), (width, height) = fit.offset, fit.inner
        values = values[y : y + height, x : x + width]
    if (values.shape[1], values.shape[0]) == fit.image:
        return np.ascontiguousarray(values)
    return np.asarray(cv2.resize(np.ascontiguousarray(values), fit.image, interpolation=interpolation))


def best_of(scores: NDArray[np.float32], probabilities: bool) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Returns the best class (H, W) of scores (C, H, W), of equal ones the first, and its probability (H, W)."""
    best = scores.argmax(axis=0)
    highest = np.take_along_axis(scores, best[None], axis=0)[0]
    if probabilities:
        return best, np.clip(highest, 0, 1)
    return best, (1 / np.exp(scores - highest).sum(axis=0, dtype=np.float32)).astype(np.float32)


class OnnxSegmenter(Operator):
    """Gives every pixel a class with any exported segmentation network; on the CPU with one thread, the same each time.

    The model has one input, (1, 3, H, W) or (1, H, W, 3) of float, half or uint8, and answers with scores (1, C, H, W)
    or (1, H, W, C) in any resolution, or with a map of classes (1, H, W) of whole numbers. Scores are brought to the
    image's size before the best class is taken, so edges are as fine as scores allow. One channel of scores is a class
    and its background. Size, layout and type are read from the model; class names, palette, mean and deviation from
    parameters, else from its metadata (`names`, `palette`, `mean`, `std`).
    """

    stateless = True

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    segmentation: Out[SegmentationMap] = Out(doc="class of every pixel of the image")
    painted: Out[Image] = Out(doc="the image in its classes' colours, with `paint`")
    status: Out[Diagnostics] = Out(doc="the classes in the image: share and mean confidence; a warning if all is void")

    model: str = Param(min_length=1, doc="a name of `dataflow models list`, or an ONNX file")
    classes: str | None = Param(
        None,
        doc="text file with one class name a line, with or without its colour (`road 128 64 128`); none means the "
        "names in the model's metadata, those of the registry, or numbers",
    )
    provider: Provider = Param("cpu", doc="onnxruntime's execution provider; results repeat bit for bit on the CPU")
    output: str | None = Param(
        None, doc="name of the output with scores or classes; none takes the registry's, or the first"
    )
    scores: Literal["logits", "probabilities"] | None = Param(
        None, doc="what scores are; none takes the registry's, or logits"
    )
    mean: tuple[float, float, float] | None = Param(
        None,
        doc="subtracted from a pixel as a share of 1, red first; none: the registry's, the metadata's, or ImageNet's",
    )
    std: tuple[float, float, float] | None = Param(None, doc="what the difference is divided by; the same")
    bgr: bool = Param(False, doc="the network sees blue first")
    fit: FitMode | None = Param(None, doc="how the image fills the input; none takes the registry's, or stretch")
    input_size: tuple[int, int] | None = Param(
        None, doc="(width, height) where the model leaves it open; none takes the registry's, or 512 x 512", unit="px"
    )
    confidence_threshold: float = Param(0.0, ge=0, le=1, tunable=True, doc="pixels below become void")
    class_thresholds: dict[str, float] = Param({}, doc="the same for single classes, by name")
    with_confidence: bool = Param(False, tunable=True, doc="also give the confidence of every pixel")
    paint: bool = Param(False, tunable=True, doc="also give the image painted")

    def setup(self) -> None:
        """Loads the model. Raises FileNotFoundError, or ModelError where parameters do not fit it."""
        used = use_model(self, self.model)
        file = used.file
        self._session = open_session(file, self.provider)
        self._shares = used.setting(self, "scores", "logits") == "probabilities"
        facts = told(file, self._session.get_modelmeta().custom_metadata_map)
        self._labels = facts.labels if self.classes is None else read_labels(self.use_file(self.classes))
        if self._labels is None and (names := names_of(used.model)) is not None:
            self._labels = Labels(names, {})
        mean, std = used.setting(self, "mean", facts.mean), used.setting(self, "std", facts.std)
        free = tuple(used.setting(self, "input_size", (512, 512)))
        if min(free) < 1 or (std is not None and min(std) <= 0):
            raise ModelError(f"input_size and std must be above 0, are {free} and {std}")
        self._input = image_input(
            file,
            self._session,
            (free[0], free[1]),
            bgr=self.bgr,
            mean=[255 * value for value in mean or _MEAN],
            scale=[255 * value for value in std or _DEVIATION],
        )
        if self._input.type is np.uint8 and (self.mean, self.std) != (None, None):
            raise ModelError(f"{file} takes pixels of uint8 as they are: leave mean and std out")
        self._fit: FitMode = used.setting(self, "fit", "stretch")
        found = {each.name: each for each in self._session.get_outputs()}
        self._output = used.setting(self, "output", next(iter(found)))
        if self._output not in found:
            raise ModelError(f"{file} has no output {self._output!r}; it has {', '.join(found)}")
        self._sure = "int" not in found[self._output].type
        if not self._sure and (self.confidence_threshold or self.class_thresholds or self.with_confidence):
            raise ModelError(
                f"{file} gives classes without scores ({found[self._output].type}), so no confidence is known: leave "
                f"thresholds and with_confidence out, or name an output with scores"
            )
        if self._labels is not None:
            self._least(self._labels.names)

    def process(self, image: Image) -> dict[str, Any]:
        """Raises ModelError where the model's output is no scores and no map of classes, or has other classes."""
        fit = ImageFit.plan(self._fit, (image.width, image.height), self._input.size)
        tensor = self._input.tensor(fit.apply(three_channels(image.data)))
        output = np.asarray(self._session.run([self._output], {self._input.name: tensor})[0])
        try:
            classes, confidence, names = self._scored(output, fit) if self._sure else self._mapped(output, fit)
        except ValueError as error:
            raise ModelError(f"output {self._output!r} of {self.model}: {error}") from None
        void = 255 if max(len(names), int(classes.max(initial=0))) <= 255 else 65535
        made = labelled(
            image,
            names,
            classes.astype(np.uint8 if void == 255 else np.uint16),
            confidence,
            least=self._least(names),
            with_confidence=self.with_confidence,
            void=void,
        )
        messages = {"segmentation": made, "status": _status(made, confidence)}
        if self.paint:
            palette = {} if self._labels is None else self._labels.palette
            messages["painted"] = draw_segmentation(image, made, palette)
        return messages

    def _scored(
        self, output: NDArray[Any], fit: ImageFit
    ) -> tuple[NDArray[np.intp], NDArray[np.float32] | None, tuple[str, ...]]:
        shares = self._shares
        scores = scores_of(output, None if self._labels is None else len(self._labels.names), shares)
        names = tuple(map(str, range(len(scores)))) if self._labels is None else self._labels.names
        if len(names) != len(scores):
            raise ValueError(
                f"there are scores of {len(scores)} classes ({output.shape}), but {len(names)} class names; give the "
                f"model's own in OnnxSegmenter.classes"
            )
        planes = np.stack([at_image(plane, fit, cv2.INTER_LINEAR) for plane in scores])
        return *best_of(planes, shares), names

    def _least(self, names: tuple[str, ...]) -> NDArray[np.float32] | float:
        where = f"{type(self).__name__}.class_thresholds"
        return least_of(names, self.confidence_threshold, self.class_thresholds, where)

    def _mapped(self, output: NDArray[Any], fit: ImageFit) -> tuple[NDArray[np.intp], None, tuple[str, ...]]:
        classes = at_image(classes_of(output).astype(np.int32), fit, cv2.INTER_NEAREST)
        names = () if self._labels is None else self._labels.names
        known = classes[classes != 255] if names and len(names) <= 255 else classes
        if classes.min(initial=0) < 0 or (names and known.max(initial=0) >= len(names)):
            raise ValueError(f"it has class {classes.min()} to {known.max()}, but there are {len(names)} class names")
        return classes, None, names


def _status(made: SegmentationMap, confidence: NDArray[np.float32] | None) -> Diagnostics:
    """A row for each class in the image with its share and mean confidence."""
    flat = made.classes.reshape(-1)
    counts = np.bincount(flat)
    sums = None if confidence is None else np.bincount(flat, confidence.reshape(-1))
    rows: list[Row] = []
    for k in np.flatnonzero(counts).tolist():
        name = "void" if k == made.void else made.class_names[k] if made.class_names else str(k)
        share = counts[k] / len(flat)
        figures = {"share": f"{share:.4f}"}
        if sums is not None:
            figures["confidence"] = f"{sums[k] / counts[k]:.4f}"
        text = ", ".join(f"{key} {value}" for key, value in figures.items())
        rows.append((name, text, Level.WARN if name == "void" and share == 1 else Level.OK, figures))
    return status_of_rows(made.stamp, rows)
