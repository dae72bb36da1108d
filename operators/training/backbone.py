"""MobileNetV2 as feature extractor, with torchvision's parameter names, so that its ImageNet weights fit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from operators.training.files import TrainingFileError, load_safely

# expansion, channels, repeats, stride of each stage (Sandler et al. 2018, table 2), without the last one, whose 320
# channels serve the classifier.
_STAGES = ((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2))
_TAPS = {1: 2, 3: 4, 6: 8, 13: 16, 16: 32}
"""Index of the last block at a resolution → its stride."""
_BLOCK = {"0": "0.0", "1": "0.1", "3": "1.0", "4": "1.1", "6": "2", "7": "3"}
_FIRST_BLOCK = {"0": "0.0", "1": "0.1", "3": "1", "4": "2"}

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


class MobileNetV2(nn.Module):
    """Feature maps at the strides 2, 4, 8, 16 and 32 of images (N, 3, H, W) in [0, 1], RGB.

    `channels` maps each stride to the channels of its map. `width` scales them all (multiples of 8).
    """

    def __init__(self, width: float = 1.0) -> None:
        super().__init__()
        blocks: list[nn.Module] = [ConvNorm(3, _round(32 * width), 3, 2)]
        self.channels: dict[int, int] = {}
        inputs = _round(32 * width)
        for expansion, channels, repeats, stride in _STAGES:
            for repeat in range(repeats):
                outputs = _round(channels * width)
                blocks.append(InvertedResidual(inputs, outputs, stride if repeat == 0 else 1, expansion))
                inputs = outputs
                if len(blocks) - 1 in _TAPS:
                    self.channels[_TAPS[len(blocks) - 1]] = outputs
        self.features = nn.Sequential(*blocks)
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
        last = max((i for i, s in _TAPS.items() if s <= stride), default=-1)
        self.frozen = last + 1
        self.features[: self.frozen].requires_grad_(False)
        self.train(self.training)

    def train(self, mode: bool = True) -> MobileNetV2:
        super().train(mode)
        self.features[: self.frozen].eval()
        return self

    def forward(self, x: Tensor) -> dict[int, Tensor]:
        x = (x - self.get_buffer("mean")) / self.get_buffer("std")
        maps: dict[int, Tensor] = {}
        for i, block in enumerate(self.features):
            x = block(x)
            if i in _TAPS:
                maps[_TAPS[i]] = x
        return maps


def load_backbone(network: MobileNetV2, file: Path) -> None:
    """Copies the weights of a file that holds a MobileNetV2: torchvision's state dict, or a checkpoint of ours.

    Raises FileNotFoundError, or TrainingFileError where a weight is missing or has another shape.
    """
    state = load_safely(file)
    found = state.get("ema", state)
    if not isinstance(found, Mapping):
        raise TrainingFileError(f"{file} holds no state dict; give torchvision's MobileNetV2 weights or a checkpoint")
    wanted = network.state_dict()
    given = _current_names({name.removeprefix("backbone."): value for name, value in found.items()})
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


def _current_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
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
