"""The input of networks in ONNX files: an image as the tensor that they want; and class names from a file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from operators.inference import ModelError

if TYPE_CHECKING:
    import onnxruntime

Layout = Literal["nchw", "nhwc"]
Color = tuple[int, int, int]

NORMALIZATIONS: Mapping[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "none": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
    "unit": ((0.0, 0.0, 0.0), (255.0, 255.0, 255.0)),
    "imagenet": ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375)),
    "clip": ((122.7709383, 116.7460125, 104.09373615), (68.5005327, 66.6321579, 70.32316305)),
}
"""Mean and scale of pixels from 0 to 255, red first, by their names."""

_TYPES: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(uint8)": np.uint8,
    "tensor(int32)": np.int32,
}
NUMBERS: Mapping[str, type[np.generic]] = {**_TYPES, "tensor(int64)": np.int64}
"""Types of numbers that a network takes, by onnxruntime's names of their tensors."""
_COLORED = re.compile(r"(?P<name>.*?\S)\s+(?P<red>\d{1,3})[\s,]+(?P<green>\d{1,3})[\s,]+(?P<blue>\d{1,3})")


@dataclass(frozen=True)
class ImageInput:
    """The one input of a network that takes an image.

    - `size`: (width, height) in pixels, `layout`: where its channels stand, `type`: of its numbers.
    - A number of the tensor is (pixel - `mean`) / `scale`, by channel in RGB order, pixels from 0 to 255; an input of
      uint8 or int32 takes the pixels as they are.
    """

    name: str
    size: tuple[int, int]
    layout: Layout
    type: type[np.generic]
    bgr: bool = False
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    scale: tuple[float, ...] = (255.0, 255.0, 255.0)

    def tensor(self, pixels: NDArray[np.uint8]) -> NDArray[Any]:
        """Returns the tensor of RGB pixels (H, W, 3) of the input's size."""
        channels = pixels[..., ::-1] if self.bgr else pixels
        ordered = channels.transpose(2, 0, 1) if self.layout == "nchw" else channels
        if issubclass(self.type, np.integer):
            return np.ascontiguousarray(ordered[None], self.type)
        tensor = np.ascontiguousarray(ordered[None], np.float32)
        if any(self.mean):
            tensor -= self._by_channel(self.mean)
        tensor /= self._by_channel(self.scale)
        return tensor.astype(self.type, copy=False)

    def _by_channel(self, values: Sequence[float]) -> NDArray[np.float32]:
        ordered = np.array(values[::-1] if self.bgr else values, np.float32)
        return ordered[:, None, None] if self.layout == "nchw" else ordered


def image_input(
    file: Path,
    session: onnxruntime.InferenceSession,
    free: tuple[int, int],
    *,
    bgr: bool,
    mean: Sequence[float],
    scale: Sequence[float],
    layouts: Sequence[Layout] = ("nchw", "nhwc"),
    types: Sequence[str] = tuple(_TYPES),
    others: int = 0,
) -> ImageInput:
    """Reads what the model's input of an image takes; `free` is the (width, height) where an extent is left open.

    The model may have so many `others` besides; the image is the first of four dimensions.

    Raises ModelError for a model whose input is no image of three channels in one of the layouts and types.
    """
    inputs = session.get_inputs()
    image = next((each for each in inputs if len(each.shape) == 4), inputs[0])
    found = [each for each in layouts if _is_image(image.shape, each)] if len(inputs) <= 1 + others else []
    if not found or image.type not in types:
        described = ", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)
        shapes = " or ".join({"nchw": "[1, 3, H, W]", "nhwc": "[1, H, W, 3]"}[each] for each in layouts)
        raise ModelError(f"{file} must have one input {' or '.join(types)} {shapes}, has {described}")
    layout, shape = found[0], image.shape
    height, width = shape[2:] if layout == "nchw" else shape[1:3]
    size = (width if isinstance(width, int) else free[0], height if isinstance(height, int) else free[1])
    return ImageInput(image.name, size, layout, _TYPES[image.type], bgr, tuple(mean), tuple(scale))


def _is_image(shape: Sequence[Any], layout: Layout) -> bool:
    """Returns whether a shape is [1, 3, H, W] or [1, H, W, 3]; a batch of open size takes one image, too."""
    if len(shape) != 4 or (isinstance(shape[0], int) and shape[0] != 1):
        return False
    return bool(shape[1 if layout == "nchw" else 3] == 3)


@dataclass(frozen=True)
class Labels:
    """Class names by number, and their colours (R, G, B) where those are known."""

    names: tuple[str, ...]
    palette: dict[str, Color]


def read_labels(file: Path) -> Labels:
    """Reads a text file with one class name a line, with or without its colour after it: `traffic light 250 170 30`.

    Raises ModelError for a file without a name, or a colour beyond 255.
    """
    lines = [line.strip() for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
    if not lines:
        raise ModelError(f"{file} holds no class name; it should have one a line")
    names, palette = [], {}
    for line in lines:
        colored = _COLORED.fullmatch(line)
        name = line if colored is None else colored["name"]
        names.append(name)
        if colored is not None:
            palette[name] = color(file, name, [int(colored[part]) for part in ("red", "green", "blue")])
    return Labels(tuple(names), palette)


def color(file: Path, name: str, values: Sequence[Any]) -> Color:
    """Returns a colour of three numbers from 0 to 255. Raises ModelError for others."""
    if len(values) != 3 or any(not isinstance(value, int) or not 0 <= value <= 255 for value in values):
        raise ModelError(f"{file}: the colour of {name!r} must be three whole numbers from 0 to 255, is {values}")
    red, green, blue = values
    return red, green, blue


def three_channels(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns pixels (H, W, 3) of an image that is grey (H, W) or has colours."""
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)
