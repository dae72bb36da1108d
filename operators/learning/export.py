"""Writes a trained network as an ONNX file with its metadata, weights stored in half precision."""

from __future__ import annotations

import base64
import copy
import json
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from operators.learning.files import whole
from operators.weights.network_file import KEY, SECOND

_OPSET = 17
_LEAST_ELEMENTS = 256  # smaller constants stay as they are: biases, shapes


def export_network(
    network: nn.Module, size: tuple[int, int], outputs: Sequence[str], facts: Mapping[str, Any], file: Path
) -> None:
    """Exports a network whose input is (1, 3, H, W) in [0, 1] of `size` (width, height).

    Weights are stored as float16 and widened when the file is loaded; arithmetic is float32. The file appears whole or
    not at all. `facts` must be plain values.
    """
    examples = (torch.zeros(1, 3, size[1], size[0]),)
    _write(_model(network, examples, ["image"], list(outputs), None, facts), file)


def export_steps(network: nn.Module, examples: tuple[Tensor, ...], facts: Mapping[str, Any], file: Path) -> None:
    """Exports one step of a recurrent network: (features, hidden, cell) → (probabilities, hidden, cell), any N.

    Features are (N, F), states (L, N, W). Weights are stored as those of `export_network`.
    """
    rows = {"features": {0: "agents"}, "hidden": {1: "agents"}, "cell": {1: "agents"}}
    outputs = ["probabilities", "next_hidden", "next_cell"]
    given = {"probabilities": {0: "agents"}, "next_hidden": {1: "agents"}, "next_cell": {1: "agents"}}
    _write(_model(network, examples, list(rows), outputs, rows | given, facts), file)


def export_rows(
    network: nn.Module, examples: Mapping[str, Tensor], outputs: Sequence[str], facts: Mapping[str, Any], file: Path
) -> None:
    """Exports a network for any number of rows of each input; `examples` are inputs by name.

    Weights are stored as those of `export_network`.
    """
    axes = {name: {0: "rows"} for name in (*examples, *outputs)}
    model = _model(network, tuple(examples.values()), list(examples), list(outputs), axes, facts)
    _in_integers(model)
    _write(model, file)


def attach_second(file: Path, second: Path, out: Path) -> None:
    """Writes a network file with another as its second network, in the place of one that it has."""
    import onnx

    model = onnx.load(file)
    kept = {each.key: each.value for each in model.metadata_props}
    onnx.helper.set_model_props(model, kept | {SECOND: base64.b64encode(second.read_bytes()).decode("ascii")})
    _write(model, out)


def without_second(file: Path) -> bytes:
    """Returns the content of a network file without its second network."""
    import onnx

    model = onnx.load(file)
    kept = {each.key: each.value for each in model.metadata_props if each.key != SECOND}
    onnx.helper.set_model_props(model, kept)
    content: bytes = model.SerializeToString(deterministic=True)
    return content


def _write(model: Any, file: Path) -> None:
    with whole(file) as partial:
        partial.write_bytes(model.SerializeToString())


def _model(
    network: nn.Module,
    examples: tuple[Tensor, ...],
    inputs: list[str],
    outputs: list[str],
    axes: dict[str, dict[int, str]] | None,
    facts: Mapping[str, Any],
) -> Any:
    import onnx  # heavy, and needed only here

    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        # The exporter that needs no further package; its successor needs onnxscript.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            copy.deepcopy(network).cpu().eval(),
            examples,
            Path(folder) / "network.onnx",
            input_names=inputs,
            output_names=outputs,
            dynamic_axes=axes,
            opset_version=_OPSET,
            dynamo=False,
        )
        model = onnx.load(Path(folder) / "network.onnx")
    _store_as_half(model)
    model.producer_name = "dataflow"
    onnx.helper.set_model_props(model, {KEY: json.dumps(dict(facts), sort_keys=True)})
    onnx.checker.check_model(model)
    return model


def _in_integers(model: Any) -> None:
    """Multiplies integers of 8 bits by whole-numbered weights as integers: the same numbers, several times as fast."""
    import onnx

    graph = model.graph
    constants = {each.name: each for each in graph.initializer}
    made = {output: node for node in graph.node for output in node.output}

    def weights(name: str) -> NDArray[np.float32] | None:
        node = made.get(name)
        stored = name if node is None or node.op_type != "Cast" else node.input[0]
        return onnx.numpy_helper.to_array(constants[stored]).astype(np.float32) if stored in constants else None

    for node in list(graph.node):
        cast = made.get(node.input[0]) if node.op_type == "MatMul" else None
        whole = weights(node.input[1]) if cast is not None and cast.op_type == "Cast" else None
        if cast is None or whole is None or np.abs(whole).max() > 127 or not np.array_equal(whole, np.rint(whole)):
            continue
        name = f"{node.name}.integers"
        graph.initializer.append(onnx.numpy_helper.from_array(whole.astype(np.int8), f"{name}.weight"))
        product = onnx.helper.make_node("MatMulInteger", [cast.input[0], f"{name}.weight"], [f"{name}.sums"], name)
        at = list(graph.node).index(node)
        graph.node.insert(at, product)
        node.CopyFrom(onnx.helper.make_node("Cast", [f"{name}.sums"], list(node.output), node.name, to=1))
    _sweep(graph)


def _sweep(graph: Any) -> None:
    """Takes out nodes and constants that nothing uses."""
    while True:
        used = {name for node in graph.node for name in node.input} | {output.name for output in graph.output}
        idle = [node for node in graph.node if not used & set(node.output)]
        for node in idle:
            graph.node.remove(node)
        if not idle:
            break
    for each in [each for each in graph.initializer if each.name not in used]:
        graph.initializer.remove(each)


def _store_as_half(model: Any) -> None:
    """Replaces large float32 constants by float16 ones with a cast, which onnxruntime folds away when it loads."""
    import onnx

    graph = model.graph
    casts = []
    for tensor in graph.initializer:
        if tensor.data_type != onnx.TensorProto.FLOAT:
            continue
        values = onnx.numpy_helper.to_array(tensor)
        if values.size < _LEAST_ELEMENTS or np.abs(values).max() > 6e4:
            continue
        name = tensor.name
        tensor.CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
        casts.append(onnx.helper.make_node("Cast", [f"{name}.half"], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
