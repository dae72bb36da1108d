"""The weights of a network file, in 8 bits or not, as the beginning of another training.

A file has its normalisations folded into its convolutions. They are unfolded with the means and variances that images
give, so that the network answers as the file does, and training finds the statistics that it would have left.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from operators.learning.files import TrainingFileError
from operators.weights.network_file import read_facts

if TYPE_CHECKING:
    from operators.learning.loop import Task

MOST_IMAGES = 64
"""Images by which means and variances are measured."""
_NUMBERED = re.compile(r"onnx::Conv_(\d+)")
_STORED = re.compile(r"(\.half)?(_quantized)?$")


@dataclass(frozen=True, eq=False)
class _Folded:
    """A convolution of a file: its weight (O, I, H, W) and bias (O,), normalisation included."""

    name: str
    weight: NDArray[np.float32]
    bias: NDArray[np.float32]


def sample_images(task: Task) -> Tensor:
    """Images (N, 3, H, W) as a training sees them, at most `MOST_IMAGES` of all its samples, evenly chosen."""
    step = max(1, task.samples // MOST_IMAGES)
    chosen = list(range(0, task.samples, step))[:MOST_IMAGES]
    images: Tensor = task.batch(chosen, [np.random.default_rng(k) for k in chosen])[0]
    return images


def fitting_facts(file: Path, **wanted: Any) -> dict[str, Any]:
    """The metadata of a network file. Raises `TrainingFileError` where an entry is not as `wanted`."""
    facts = read_facts(file)
    for name, value in wanted.items():
        if facts.get(name) != value:
            raise TrainingFileError(
                f"a training cannot begin with {file}: its {name} is {facts.get(name)!r}, and this one's {value!r}"
            )
    return facts


def begin_with(network: nn.Module, file: Path, images: Tensor) -> None:
    """Gives a network, whose first module is its backbone, the weights of a file of the same architecture.

    `images` are of the training, (N, 3, H, W) in [0, 1]. Raises `TrainingFileError` where a weight does not fit.
    """
    numbered, named = _convolutions(file)
    network.eval()
    pairs, plain = _layers(network, images[:1])
    if len(pairs) != len(numbered) or len(plain) != len(named):
        raise TrainingFileError(
            f"a training cannot begin with {file}: it has {len(numbered)} convolutions with normalisation and "
            f"{len(named)} without, this network {len(pairs)} and {len(plain)}"
        )
    for name, layer in plain.items():
        tail = name.partition(".")[2]
        found = [each for each in named if each.name.endswith(f".{tail}.weight")]
        if len(found) != 1:
            raise TrainingFileError(f"a training cannot begin with {file}: it has no layer {tail!r}")
        _fill(layer, found[0], file)
        assert layer.bias is not None
        with torch.no_grad():
            layer.bias.copy_(torch.from_numpy(found[0].bias))
    for (layer, norm), folded in zip(pairs, numbered, strict=True):
        _fill(layer, folded, file)
        with torch.no_grad():
            for value, given in ((norm.weight, 1.0), (norm.running_mean, 0.0), (norm.running_var, 1.0 - norm.eps)):
                assert value is not None
                value.fill_(given)
            norm.bias.copy_(torch.from_numpy(folded.bias))
    _unfold(network, pairs, images)


def _convolutions(file: Path) -> tuple[list[_Folded], list[_Folded]]:
    """The convolutions of a file: those with a normalisation in the order of their numbers, and the others, which
    keep their names."""
    import onnx  # heavy, and needed only here

    graph = onnx.load(file).graph
    constants = {each.name: onnx.numpy_helper.to_array(each) for each in graph.initializer}
    made = {output: node for node in graph.node for output in node.output}

    def value(name: str) -> tuple[str, NDArray[Any]]:
        """A constant in full precision, and the name under which it is stored."""
        if name in constants:
            return name, constants[name]
        node = made.get(name)
        if node is None or node.op_type not in ("Cast", "DequantizeLinear"):
            raise TrainingFileError(
                f"{file}: the weight {name!r} is not a constant; `dataflow train` wrote no such file"
            )
        stored, data = value(node.input[0])
        if node.op_type == "Cast":
            return stored, data.astype(np.float32)
        scale, zero = constants[node.input[1]], constants[node.input[2]]
        shape = (-1, *(1,) * (data.ndim - 1)) if scale.ndim else ()
        return stored, (data.astype(np.float32) - zero.astype(np.float32).reshape(shape)) * scale.reshape(shape)

    numbered: dict[int, _Folded] = {}
    named: list[_Folded] = []
    for node in graph.node:
        if node.op_type != "Conv":
            continue
        stored, weight = value(node.input[1])
        _, bias = value(node.input[2])
        folded = _Folded(_STORED.sub("", stored), weight.astype(np.float32), bias.astype(np.float32))
        if number := _NUMBERED.fullmatch(folded.name):
            numbered[int(number[1])] = folded
        else:
            named.append(folded)
    return [numbered[number] for number in sorted(numbered)], named


def _layers(network: nn.Module, image: Tensor) -> tuple[list[tuple[nn.Conv2d, nn.BatchNorm2d]], dict[str, nn.Conv2d]]:
    """The convolutions in the order of their work, each with its normalisation, and by name those that have none."""
    worked: list[tuple[str, nn.Module]] = []
    hooks = [
        module.register_forward_hook(lambda *_, name=name, module=module: worked.append((name, module)))
        for name, module in network.named_modules()
        if isinstance(module, nn.Conv2d | nn.BatchNorm2d)
    ]
    with torch.inference_mode():
        network(image)
    for hook in hooks:
        hook.remove()
    pairs, plain = [], {}
    for k, (name, module) in enumerate(worked):
        if not isinstance(module, nn.Conv2d):
            continue
        after = worked[k + 1][1] if k + 1 < len(worked) else None
        if isinstance(after, nn.BatchNorm2d):
            pairs.append((module, after))
        else:
            plain[name] = module
    return pairs, plain


def _fill(layer: nn.Conv2d, folded: _Folded, file: Path) -> None:
    if tuple(layer.weight.shape) != folded.weight.shape:
        raise TrainingFileError(
            f"a training cannot begin with {file}: its layer {folded.name} is {folded.weight.shape}, this network's "
            f"{tuple(layer.weight.shape)}; give the same --width and classes"
        )
    with torch.no_grad():
        layer.weight.copy_(torch.from_numpy(folded.weight))


def _unfold(network: nn.Module, pairs: Sequence[tuple[nn.Conv2d, nn.BatchNorm2d]], images: Tensor) -> None:
    """Moves into each normalisation the mean and variance of what comes into it; what comes out stays the same."""
    sums = {norm: torch.zeros(2, norm.num_features, dtype=torch.float64) for _, norm in pairs}
    counts = dict.fromkeys(sums, 0)

    def add(norm: nn.Module, inputs: tuple[Tensor, ...], _: Tensor) -> None:
        assert isinstance(norm, nn.BatchNorm2d)
        values = inputs[0].double()
        sums[norm] += torch.stack([values.sum(dim=(0, 2, 3)), values.square().sum(dim=(0, 2, 3))])
        counts[norm] += values.shape[0] * values.shape[2] * values.shape[3]

    hooks = [norm.register_forward_hook(add) for norm in sums]
    with torch.inference_mode():
        for image in images:
            network(image[None])
    for hook in hooks:
        hook.remove()
    with torch.no_grad():
        for norm, (total, square) in sums.items():
            mean = total / counts[norm]
            variance = (square / counts[norm] - mean.square()).clamp(min=0.0)
            assert norm.running_mean is not None
            assert norm.running_var is not None
            norm.running_mean.copy_(mean)
            norm.running_var.copy_(variance)
            norm.weight.copy_((variance + norm.eps).sqrt())
            norm.bias.add_(mean.float())
