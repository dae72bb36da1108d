"""A network file in 8-bit integers: about half the time on a CPU, a quarter of the float32 bytes.

onnxruntime's static quantisation: ranges are measured on images, weights are scaled channel by channel, and what
computes an output stays in float, since boxes need more than 256 values. Weights take 7 bits, so that no sum saturates
on processors without VNNI.
"""

from __future__ import annotations

import contextlib
import json
import logging
import tempfile
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.detection.assessment import assess as assess_detector
from operators.detection.custom.folder import read_detection_data
from operators.learning.augmentation import fitted, tensor_of, warp
from operators.learning.files import whole
from operators.segmentation.assessment import assess as assess_segmenter
from operators.segmentation.dataset import read_segmentation_data
from operators.segmentation.scores import MOST_CLASSES
from operators.weights.network_file import KEY, SECOND, NetworkFileError, read_facts, training_seed

INT8 = "int8"
_QUANTIZED = ("Conv", "Add", "Relu", "Clip", "Concat", "Resize")

Pixels = NDArray[np.uint8]


def quantize_network(file: Path, images: Iterable[Pixels], out: Path) -> None:
    """Writes `file` in 8 bits to `out`, with ranges measured on `images` ((H, W, 3) RGB of any size).

    Its metadata gain `arithmetic` and `calibration_images`; a segmenter ends with its scores, and gains `score_step`. A
    second network in the file stays as it is. The file appears whole or not at all. The same images give the same
    bytes. Raises FileNotFoundError, or NetworkFileError where the file is not a network of ours or is in 8 bits
    already, and ValueError without an image.
    """
    import onnx
    from onnxruntime.quantization import CalibrationMethod, QuantFormat, QuantType, quantize_static

    facts = read_facts(file)
    if facts.get("arithmetic") == INT8:
        raise NetworkFileError(f"{file} is in 8 bits already; give the file that training wrote")
    reader = _Images(images, (int(facts["width"]), int(facts["height"])))
    with tempfile.TemporaryDirectory() as folder:
        plain, quantized = Path(folder) / "plain.onnx", Path(folder) / "quantized.onnx"
        _fold(file, plain)
        with _quiet():
            quantize_static(
                plain,
                quantized,
                reader,
                quant_format=QuantFormat.QDQ,
                op_types_to_quantize=list(_QUANTIZED),
                nodes_to_exclude=_answering(onnx.load(plain)),
                per_channel=True,
                reduce_range=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                calibrate_method=CalibrationMethod.MinMax,
            )
        model = onnx.load(quantized)
    if facts["kind"] == "segmenter" and len(facts["classes"]) <= MOST_CLASSES:
        model, facts["score_step"] = of_scores(model)
    model.producer_name = "dataflow"
    facts |= {"arithmetic": INT8, "calibration_images": reader.count}
    second = {each.key: each.value for each in onnx.load(file).metadata_props if each.key == SECOND}
    onnx.helper.set_model_props(model, {KEY: json.dumps(facts, sort_keys=True), **second})
    onnx.checker.check_model(model)
    with whole(out) as place:
        place.write_bytes(model.SerializeToString())


def quantize_with(
    file: Path, data: Path, out: Path, images: int = 32, seed: int | None = None
) -> dict[str, dict[str, Any]]:
    """As `quantize_network`, with evenly chosen training images of a data folder such as the network was trained on.

    `seed` sets the validation images aside where the folder names none; None means the seed of the network's training.
    Returns both files' scores on them, by file name, each with the median milliseconds (`ms`). Raises DataError too.
    """
    score: Callable[[Path], dict[str, Any]]
    seed = training_seed(file) if seed is None else seed
    if read_facts(file)["kind"] == "detector":
        boxes = read_detection_data(data, seed)
        seen = [image.read for image in boxes.training]
        score = partial(assess_detector, classes=boxes.classes, images=boxes.validation)
    else:
        masks = read_segmentation_data(data, seed)
        seen = [image.pixels for image in masks.training]
        score = partial(assess_segmenter, classes=masks.classes, images=masks.validation)
    step = max(1, len(seen) // images)
    quantize_network(file, (read() for read in seen[::step][:images]), out)
    return {str(each): score(each) for each in (file, out)}


class _Images:
    """The images as onnxruntime asks for them, one at a time."""

    def __init__(self, images: Iterable[Pixels], size: tuple[int, int]) -> None:
        self._images: Iterator[Pixels] = iter(images)
        self._size, self.count = size, 0

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:
        pixels = next(self._images, None)
        if pixels is None:
            if not self.count:
                raise ValueError("ranges are measured on images, and there is none")
            return None
        self.count += 1
        seen = warp(pixels, fitted((pixels.shape[1], pixels.shape[0]), self._size), self._size)
        return {"image": tensor_of(seen)[None]}


def _fold(file: Path, out: Path) -> None:
    """Writes the network without its casts from half precision and with normalisation folded into convolutions."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = str(out)
    options.log_severity_level = 3
    onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])


def of_scores(model: Any) -> tuple[Any, float]:
    """Returns a segmenter's model in 8 bits that ends with its scores, and what a step of them is.

    What came after enlarges the scores of every class in float, and takes as long as all the rest: `best_classes` does
    without.
    """
    import onnx
    from onnx.utils import Extractor

    made = {name: node for node in model.graph.node for name in node.output}
    node = next(each for each in model.graph.node if each.op_type in ("ArgMax", "ReduceMax"))
    while node.op_type != "DequantizeLinear":
        node = made[node.input[0]]
    scores, step = node.input[0], node.input[1]
    last = made[scores]
    constants = {each.name: onnx.numpy_helper.to_array(each) for each in model.graph.initializer}
    shaped = onnx.shape_inference.infer_shapes(model)
    found = next(each for each in shaped.graph.value_info if each.name == last.input[0])
    shape = [each.dim_value for each in found.type.tensor_type.shape.dim]
    for output in model.graph.output:  # of the float file's own scores, which are left out
        made[output.name].output[list(made[output.name].output).index(output.name)] = f"{output.name} before"
    for each in model.graph.node:
        each.input[:] = ["scores" if name == scores else name for name in each.input]
    last.output[0] = "scores"
    del model.graph.output[:]
    model.graph.output.append(onnx.helper.make_tensor_value_info("scores", onnx.TensorProto.UINT8, shape))
    cut = Extractor(model).extract_model([model.graph.input[0].name], ["scores"])
    return cut, float(constants[step])


def _answering(model: Any) -> list[str]:
    """The nodes that compute an output."""
    outputs = {output.name for output in model.graph.output}
    return [node.name for node in model.graph.node if outputs & set(node.output)]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without onnxruntime's advice to run its own preparation, which `_fold` stands for; errors still show."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
