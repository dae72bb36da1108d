"""ONNX files of a few nodes, written for tests whose answers are thereby known."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np


def node(kind: str, given: str, made: str, **attributes: Any) -> Any:
    """An operation from these values, named with spaces between, to those."""
    import onnx

    return onnx.helper.make_node(kind, given.split(), made.split(), **attributes)


def onnx_model(
    nodes: Iterable[Any],
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    values: Mapping[str, Any] | None = None,
    metadata: Mapping[str, str] | None = None,
    inner: Mapping[str, Any] | None = None,
) -> Any:
    """A model; a port or an inner value is told by its shape, of float, or by (kind, shape)."""
    import onnx

    def port(name: str, told: Any) -> Any:
        kind, shape = told if isinstance(told, tuple) and isinstance(told[0], str) else ("FLOAT", told)
        return onnx.helper.make_tensor_value_info(name, getattr(onnx.TensorProto, kind), shape)

    *ports, told = [[port(*each) for each in side.items()] for side in (inputs, outputs, inner or {})]
    kept = [onnx.numpy_helper.from_array(np.asarray(value), name) for name, value in (values or {}).items()]
    graph = onnx.helper.make_graph(list(nodes), "made", *ports, kept, value_info=told)
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=9)
    onnx.helper.set_model_props(model, dict(metadata or {}))
    return model


def write_model(file: Path, nodes: Iterable[Any], *ports: Mapping[str, Any], **others: Any) -> str:
    """Writes the file of a `onnx_model` and returns its name."""
    import onnx

    onnx.save(onnx_model(nodes, *ports, **others), str(file))
    return str(file)


def with_facts(file: Path, out: Path, **facts: Any) -> Path:
    """Writes a network's file with other facts in its metadata; None takes one out."""
    import onnx

    model = onnx.load(str(file))
    kept = {each.key: each.value for each in model.metadata_props}
    told = json.loads(kept["dataflow.network"]) | facts
    kept["dataflow.network"] = json.dumps({name: value for name, value in told.items() if value is not None})
    onnx.helper.set_model_props(model, kept)
    onnx.save(model, str(out))
    return out
