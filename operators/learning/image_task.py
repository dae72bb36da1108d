"""A network trained on labelled images: the part that its tasks for the training loop have alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import torch

from operators.learning.augmentation import Variation
from operators.weights.network_file import TRAINED_ON


class Labelled(Protocol):
    """Class names, images to train on and images to score on."""

    @property
    def classes(self) -> tuple[str, ...]: ...
    @property
    def training(self) -> Sequence[Any]: ...
    @property
    def validation(self) -> Sequence[Any]: ...


Data = TypeVar("Data", bound=Labelled)


class ImageTask(Generic[Data]):
    """Holds images, the input's `size` (width, height; multiples of `step`) and how images are varied."""

    kind: ClassVar[str]
    step: ClassVar[int]

    def __init__(self, data: Data, size: tuple[int, int], seed: int, variation: Variation | None) -> None:
        """Seeds torch, from which the network is made then. Raises ValueError for another size."""
        if any(extent % self.step or extent <= 0 for extent in size):
            raise ValueError(f"the input's width and height must be multiples of {self.step}, got {size[0]}x{size[1]}")
        torch.manual_seed(seed)
        self.data, self.size, self.samples = data, size, len(data.training)
        self.variation = Variation() if variation is None else variation

    def _description(self, **own: Any) -> dict[str, Any]:
        return {"classes": list(self.data.classes), "size": list(self.size), "images": self.samples, **own}

    def _facts(self, architecture: str, facts: Mapping[str, Any], origin: str = "", **own: Any) -> dict[str, Any]:
        """Returns the metadata of the network file: of this task, and `facts` of its training."""
        return {
            "kind": self.kind,
            "architecture": architecture,
            "classes": list(self.data.classes),
            "width": self.size[0],
            "height": self.size[1],
            "training_images": self.samples,
            **({TRAINED_ON: origin} if origin else {}),
            **own,
            **facts,
        }
