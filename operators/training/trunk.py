"""One trunk for two networks in 8 bits that were trained together: what both compute alike, with the same ranges.

Each was quantized by itself: weights that were equal are equal still, but ranges were measured apart, so that the
trunks give other bits. The second network takes over the first one's, and both files hold where it ends.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.learning.files import TrainingFileError, whole
from operators.training.quantization import INT8
from operators.weights.model_parts import ModelParts, digest_of
from operators.weights.network_file import KEY, TRUNK, read_facts

_LINEAR = ("QuantizeLinear", "DequantizeLinear")


def share_trunk(first: Path, second: Path, first_out: Path, second_out: Path) -> None:
    """Writes two network files in 8 bits with one trunk: that of the first, which answers as before.

    Second networks stay as they are. Raises NetworkFileError, or TrainingFileError where they are not in 8 bits or
    have no trunk of equal weights.
    """
    import onnx

    for file in (first, second):
        if read_facts(file).get("arithmetic") != INT8:
            raise TrainingFileError(f"{file} is not in 8 bits: `dataflow train quantize` first")
    mine, other = _Graph(onnx.load(first)), _Graph(onnx.load(second))
    alike = mine.alike.keys() & other.alike.keys()
    ends = [each for each in mine.alike if each in alike and (mine.ends(each, alike) or other.ends(each, alike))]
    if not ends or not mine.computes(alike):
        raise TrainingFileError(
            f"{first} and {second} have no layers of equal weights at their beginning: they were not trained together"
        )
    other.take_over(mine, alike, second)
    contents = []
    for graph, file in ((mine, first), (other, second)):
        names = [graph.alike[each] for each in ends]
        facts = read_facts(file) | {TRUNK: names}
        kept = {each.key: each.value for each in graph.model.metadata_props}
        onnx.helper.set_model_props(graph.model, kept | {KEY: json.dumps(facts, sort_keys=True)})
        onnx.checker.check_model(graph.model)
        contents.append((graph.model.SerializeToString(), names))
    digests = {ModelParts(content).digest(names) for content, names in contents}
    if len(digests) != 1:
        raise TrainingFileError(f"the layers of {first} and {second} have equal weights, and differ in other ways")
    for (content, _), out in zip(contents, (first_out, second_out), strict=True):
        with whole(out) as place:
            place.write_bytes(content)


class _Graph:
    """A quantized network. `alike` names each value by what it is computed from, leaving out ranges and what depends
    on them."""

    def __init__(self, model: Any) -> None:
        import onnx

        self.model, graph = model, model.graph
        self._stored = {each.name: each for each in graph.initializer}
        self._made = {name: node for node in graph.node for name in node.output}
        self._users: dict[str, list[Any]] = {}
        for node in graph.node:
            for name in node.input:
                self._users.setdefault(name, []).append(node)
        known = {name: digest_of([name.encode()]).hex() for name in ("", *(each.name for each in graph.input))}
        for name, tensor in self._stored.items():
            values = onnx.numpy_helper.to_array(tensor)
            known[name] = digest_of([str((values.dtype, values.shape)).encode(), values.tobytes()]).hex()
        self.alike: dict[str, str] = {}
        for node in graph.node:
            told = [node.op_type.encode(), *sorted(each.SerializeToString() for each in node.attribute)]
            taken = [known[name].encode() for name in node.input]
            if node.op_type == "Conv":
                taken = taken[:2]  # a bias is stored in steps that depend on a range
            elif node.op_type in _LINEAR and node.input[0] not in self._stored:
                taken = taken[:1]
            own = digest_of([*told, *taken]).hex()
            for k, name in enumerate(node.output):
                known[name] = f"{own} {k}"
                self.alike[known[name]] = name

    def computes(self, alike: Iterable[str]) -> bool:
        """Returns whether the common part has a layer with weights: an image is brought to 8 bits in any network."""
        return any(self._made[self.alike[each]].op_type == "Conv" for each in alike)

    def ends(self, value: str, alike: Iterable[str]) -> bool:
        """Returns whether a value in 8 bits, of the common part, is used beyond it."""
        name = self.alike[value]
        if self._made[name].op_type != "QuantizeLinear":
            return False
        common = {self.alike[each] for each in alike}
        restored = [output for node in self._users.get(name, []) for output in node.output]
        return any(not common & set(user.output) for output in restored for user in self._users.get(output, []))

    def take_over(self, first: _Graph, alike: Iterable[str], told: Path) -> None:
        """Gives the common part the ranges of another network, and what follows it the biases that fit them.

        Raises TrainingFileError where biases of the common part differ by more than rounding.
        """
        common = {self.alike[each]: first.alike[each] for each in alike}
        layers = [node for node in self.model.graph.node if node.op_type == "Conv" and node.input[0] in common]
        behind = {node.name: self._bias(node) for node in layers if node.output[0] not in common}
        for name, theirs in common.items():
            node, other = self._made[name], first._made[theirs]
            if node.op_type == "Conv":
                self._check_bias(node, first, other, told)
                node, other = self._made[node.input[2]], first._made[other.input[2]]
            for own, other_name in zip(node.input, other.input, strict=True):
                if own in self._stored:
                    self._stored[own].CopyFrom(first._stored[other_name])
                    self._stored[own].name = own
        for node in layers:
            if node.name in behind:
                self._store_bias(node, behind[node.name])

    def _check_bias(self, conv: Any, first: _Graph, other: Any, told: Path) -> None:
        steps = [graph._value(graph._made[node.input[2]].input[1]) for graph, node in ((self, conv), (first, other))]
        if np.abs(self._bias(conv) - first._bias(other)).max() > np.max(steps):
            raise TrainingFileError(f"the biases of the layer {conv.name} of {told} are not those of the other file")

    def _bias(self, conv: Any) -> NDArray[np.float64]:
        return self._restored(self._made[conv.input[2]])

    def _store_bias(self, conv: Any, bias: NDArray[np.float64]) -> None:
        """Stores a bias in steps of the product of the scales of what comes in and of the weights."""
        restored = self._made[conv.input[2]]
        before = self._value(restored.input[1])
        scale = self._value(self._made[conv.input[0]].input[1]) * self._value(self._made[conv.input[1]].input[1])
        self._store(restored.input[1], scale.astype(np.float32).reshape(before.shape))
        self._store(restored.input[0], np.rint(bias / scale.astype(np.float64)).astype(np.int32))

    def _restored(self, node: Any) -> NDArray[np.float64]:
        return self._value(node.input[0]).astype(np.float64) * self._value(node.input[1]).astype(np.float64)

    def _value(self, name: str) -> NDArray[Any]:
        import onnx

        value: NDArray[Any] = onnx.numpy_helper.to_array(self._stored[name])
        return value

    def _store(self, name: str, value: NDArray[Any]) -> None:
        import onnx

        self._stored[name].CopyFrom(onnx.numpy_helper.from_array(value, name))
