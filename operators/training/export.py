"""Writes a trained network as an ONNX file with its metadata, weights stored in half precision."""

from __future__ import annotations

import copy
import json
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from operators.training.files import whole
from operators.weights.network_file import KEY

_OPSET = 17
_LEAST_ELEMENTS = 256  # smaller constants stay as they are: biases, shapes


def export_network(
    network: nn.Module, size: tuple[int, int], outputs: Sequence[str], facts: Mapping[str, Any], file: Path
) -> None:
    """Exports a network whose input is (1, 3, H, W) in [0, 1] of `size` (width, height).

    Weights are stored as float16 and widened when the file is loaded; arithmetic is float32. The file appears whole or
    not at all. `facts` must be plain values.
    """
    still = copy.deepcopy(network).cpu().eval()
    _write(still, (torch.zeros(1, 3, size[1], size[0]),), ["image"], list(outputs), None, facts, file)


def export_steps(network: nn.Module, examples: tuple[Tensor, ...], facts: Mapping[str, Any], file: Path) -> None:
    """Exports one step of a recurrent network: (features, hidden, cell) → (probabilities, hidden, cell), any N.

    Features are (N, F), states (L, N, W). Weights are stored as those of `export_network`.
    """
    rows = {"features": {0: "agents"}, "hidden": {1: "agents"}, "cell": {1: "agents"}}
    outputs = ["probabilities", "next_hidden", "next_cell"]
    given = {"probabilities": {0: "agents"}, "next_hidden": {1: "agents"}, "next_cell": {1: "agents"}}
    _write(copy.deepcopy(network).cpu().eval(), examples, list(rows), outputs, rows | given, facts, file)


def _write(
    network: nn.Module,
    examples: tuple[Tensor, ...],
    inputs: list[str],
    outputs: list[str],
    axes: dict[str, dict[int, str]] | None,
    facts: Mapping[str, Any],
    file: Path,
) -> None:
    import onnx  # heavy, and needed only here

    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        # The exporter that needs no further package; its successor needs onnxscript.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
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
    with whole(file) as partial:
        partial.write_bytes(model.SerializeToString())


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
