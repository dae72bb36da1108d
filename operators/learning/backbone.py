"""Feature extractors: MobileNetV2 with torchvision's parameter names, so that its ImageNet weights fit, and a small
residual network, which learns faster where there are no such weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Self

import torch
from torch import Tensor, nn

from operators.learning.files import TrainingFileError, load_safely

# expansion, channels, repeats, stride of each stage (Sandler et al. 2018, table 2), without the last one, whose 320
# channels serve the classifier.
_STAGES = ((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2))
_TAPS = {1: 2, 3: 4, 6: 8, 13: 16, 16: 32}
"""Index of the last block at a resolution → its stride."""
_BLOCK = {"0": "0.0", "1": "0.1", "3": "1.0", "4": "1.1", "6": "2", "7": "3"}
_FIRST_BLOCK = {"0": "0.0", "1": "0.1", "3": "1", "4": "2"}

_STEM, _LEVELS = 24, ((32, 1), (64, 2), (128, 2), (192, 1))
"""Channels at stride 2; channels and residual blocks at the strides 4, 8, 16 and 32."""

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class ConvNorm(nn.Sequential):
    """Convolution, batch normalisation and, unless `linear`, ReLU6."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1, groups: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU6(inplace=True),
        )


class SeparableConv(nn.Sequential):
    """A 3x3 convolution per channel, then a 1x1 convolution across channels."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(ConvNorm(inputs, inputs, 3, groups=inputs), ConvNorm(inputs, outputs, 1))


class InvertedResidual(nn.Module):
    """Expand, filter per channel, project; added to its input where the shapes agree."""

    def __init__(self, inputs: int, outputs: int, stride: int, expansion: int) -> None:
        super().__init__()
        hidden = inputs * expansion
        layers: list[nn.Module] = [] if expansion == 1 else [ConvNorm(inputs, hidden, 1)]
        layers += [
            ConvNorm(hidden, hidden, 3, stride, groups=hidden),
            nn.Conv2d(hidden, outputs, 1, bias=False),
            nn.BatchNorm2d(outputs),
        ]
        self.conv = nn.Sequential(*layers)
        self.residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.conv(x)
        return x + y if self.residual else y


class Backbone(nn.Module):
    """Feature maps by stride (2, 4, 8, 16 and 32) of images (N, 3, H, W) in [0, 1], RGB.

    `features` are its blocks in order; `taps` maps a block (by index) to the stride of its output, and `channels` the
    channels of each stride's map.
    """

    def __init__(self, blocks: list[nn.Module], taps: Mapping[int, int], channels: Mapping[int, int]) -> None:
        super().__init__()
        self.features = nn.Sequential(*blocks)
        self.taps, self.channels = dict(taps), dict(channels)
        self.frozen = 0
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).reshape(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).reshape(1, 3, 1, 1), persistent=False)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out")

    def freeze(self, stride: int) -> None:
        """Keeps the blocks down to this stride as they are: not trained, statistics of normalisation included.

        Edges and textures are the same everywhere, and the finest maps take half of the time of training.
        """
        last = max((i for i, s in self.taps.items() if s <= stride), default=-1)
        self.frozen = last + 1
        self.features[: self.frozen].requires_grad_(False)
        self.train(self.training)

    def train(self, mode: bool = True) -> Self:
        super().train(mode)
        self.features[: self.frozen].eval()
        return self

    def forward(self, x: Tensor) -> dict[int, Tensor]:
        x = (x - self.get_buffer("mean")) / self.get_buffer("std")
        maps: dict[int, Tensor] = {}
        for i, block in enumerate(self.features):
            x = block(x)
            if i in self.taps:
                maps[self.taps[i]] = x
        return maps


class MobileNetV2(Backbone):
    """`width` scales the channels (to multiples of 8)."""

    def __init__(self, width: float = 1.0) -> None:
        blocks: list[nn.Module] = [ConvNorm(3, _round(32 * width), 3, 2)]
        channels: dict[int, int] = {}
        inputs = _round(32 * width)
        for expansion, wanted, repeats, stride in _STAGES:
            for repeat in range(repeats):
                outputs = _round(wanted * width)
                blocks.append(InvertedResidual(inputs, outputs, stride if repeat == 0 else 1, expansion))
                inputs = outputs
                if len(blocks) - 1 in _TAPS:
                    channels[_TAPS[len(blocks) - 1]] = outputs
        super().__init__(blocks, _TAPS, channels)


class Residual(nn.Module):
    """Two 3x3 convolutions, added to their input (He et al. 2016)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        last = nn.BatchNorm2d(channels)
        nn.init.zeros_(last.weight)  # the block begins as the identity
        self.conv = nn.Sequential(
            ConvNorm(channels, channels), nn.Conv2d(channels, channels, 3, padding=1, bias=False), last
        )
        self.active = nn.ReLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.active(x + self.conv(x))
        return y


class SmallResNet(Backbone):
    """A residual network of 1.6 million weights (at `width` 1) and 0.6 billion multiplications at 320x240.

    Its full convolutions use a CPU's arithmetic better than MobileNetV2's, above all in bfloat16.
    """

    def __init__(self, width: float = 1.0) -> None:
        inputs = _round(_STEM * width)
        blocks: list[nn.Module] = [ConvNorm(3, inputs, 3, 2)]
        taps, channels, stride = {0: 2}, {2: inputs}, 2
        for wanted, repeats in _LEVELS:
            outputs = _round(wanted * width)
            blocks += [ConvNorm(inputs, outputs, 3, 2), *(Residual(outputs) for _ in range(repeats))]
            inputs, stride = outputs, 2 * stride
            taps[len(blocks) - 1], channels[stride] = stride, outputs
        super().__init__(blocks, taps, channels)


BACKBONES: dict[str, Callable[[float], Backbone]] = {"mobilenetv2": MobileNetV2, "smallresnet": SmallResNet}


def load_backbone(network: Backbone, file: Path) -> None:
    """Copies the weights of a file that holds a MobileNetV2: torchvision's state dict, or a checkpoint of ours.

    Raises FileNotFoundError, or TrainingFileError where a weight is missing or has another shape.
    """
    state = load_safely(file)
    found = state.get("ema", state)
    if not isinstance(found, Mapping):
        raise TrainingFileError(f"{file} holds no state dict; give torchvision's MobileNetV2 weights or a checkpoint")
    wanted = network.state_dict()
    given = current_names({name.removeprefix("backbone."): value for name, value in found.items()})
    lost = [n for n, v in wanted.items() if n not in given or tuple(given[n].shape) != tuple(v.shape)]
    lost = [n for n in lost if not n.endswith("num_batches_tracked")]
    if lost:
        have = tuple(given[lost[0]].shape) if lost[0] in given else "none"
        raise TrainingFileError(
            f"{file} does not hold this backbone: {len(lost)} of {len(wanted)} weights do not fit, the first is "
            f"{lost[0]!r}, which must be {tuple(wanted[lost[0]].shape)} and is {have}; "
            f"give a file with torchvision's names (features.0.0.weight ...) and the same --width"
        )
    network.load_state_dict({name: given.get(name, value) for name, value in wanted.items()})


def start_from(network: nn.Module, file: Path) -> int:
    """Copies all weights of a checkpoint that fit by name and shape; how many did.

    Raises FileNotFoundError, or TrainingFileError where none fits.
    """
    state = load_safely(file)
    given = state.get("ema")
    wanted = network.state_dict()
    fits = {n: v for n, v in (given or {}).items() if n in wanted and wanted[n].shape == v.shape}
    if not fits:
        raise TrainingFileError(f"{file} holds no weight of this network; give the checkpoint (.pt) of a like training")
    network.load_state_dict(wanted | fits)
    return len(fits)


def current_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The weights by torchvision's names of today; its first releases numbered a block's layers without nesting."""
    if "features.1.conv.0.weight" not in state:
        return dict(state)
    renamed = {}
    for name, value in state.items():
        words = name.split(".")
        if len(words) == 5 and words[2] == "conv":
            words[3] = (_FIRST_BLOCK if words[1] == "1" else _BLOCK)[words[3]]
        renamed[".".join(words)] = value
    return renamed


def _round(channels: float) -> int:
    """The nearest multiple of 8, not more than 10 % below: as MobileNet's reference code rounds."""
    rounded = max(8, int(channels + 4) // 8 * 8)
    return rounded + 8 if rounded < 0.9 * channels else rounded
