"""Trains a second network on the answers of the first one in a file: the part that all kinds of them have alike."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from operators.learning.augmentation import Variation
from operators.learning.export import export_rows, without_second
from operators.learning.files import TrainingFileError
from operators.learning.image_task import Labelled

Image = TypeVar("Image")
Batch = TypeVar("Batch")
Columns = Sequence[NDArray[Any]]
"""Rows by column: arrays whose first axis is the row."""


class SecondTask(ABC, Generic[Image, Batch]):
    """A task for the training loop: the second network for the first one in `file`, whose classes are `known`.

    It learns from rows, such as boxes, that the first network finds in labelled images. They are gathered once and stay
    in memory; `chunk` of them are varied alike and stay together, as one sample of the training loop.
    """

    kind: ClassVar[str]
    first: ClassVar[str]
    """The kind of the first network."""
    chunk: ClassVar[int]
    network: nn.Module

    def __init__(
        self, data: Labelled, file: Path, known: tuple[str, ...], seed: int, variation: Variation | None
    ) -> None:
        """Raises TrainingFileError where the first network has other classes than the data."""
        torch.manual_seed(seed)
        self.data, self.file = data, file
        self.variation = Variation() if variation is None else variation
        if known != data.classes:
            raise TrainingFileError(f"{file} has {', '.join(known)}; the data have {', '.join(data.classes)}")
        self._rows: Columns = ()

    @property
    def samples(self) -> int:
        return max(1, len(self._rows[0]) // self.chunk)

    def description(self) -> dict[str, Any]:
        return {
            "classes": list(self.data.classes),
            "images": len(self.data.training),
            self.first: hashlib.sha256(without_second(self.file)).hexdigest(),
        }

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> Batch:
        parts = []
        for k, rng in zip(samples, rngs, strict=True):
            rows = slice(k * self.chunk, (k + 1) * self.chunk)
            parts.append(self._varied([column[rows] for column in self._rows], rng))
        joined = [np.ascontiguousarray(np.concatenate(column)) for column in zip(*parts, strict=True)]
        return self._batch([torch.from_numpy(column) for column in joined], rngs)

    @abstractmethod
    def loss(self, batch: Batch, device: torch.device) -> dict[str, Tensor]: ...

    @abstractmethod
    def evaluate(self, network: nn.Module) -> dict[str, float]: ...

    @abstractmethod
    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        """Writes the second network alone; `attach_second` puts it into the file of the first."""

    @abstractmethod
    def _of_image(self, image: Image, most: int, rng: np.random.Generator) -> Columns:
        """At most so many rows of an image."""

    @abstractmethod
    def _varied(self, rows: Columns, rng: np.random.Generator) -> Columns:
        """Rows of one chunk, changed at random."""

    @abstractmethod
    def _batch(self, columns: list[Tensor], rngs: list[np.random.Generator]) -> Batch:
        """Joins the rows of all chunks of a batch into what `loss` takes."""

    def _gather(self, most: int, seed: int) -> None:
        """Takes at most so many rows of each image, and puts all in random order."""
        rng, images = np.random.default_rng(seed), self.data.training
        parts = [self._of_image(image, most, rng) for image in images]
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        if not len(columns[0]):
            raise TrainingFileError(f"{self.file} finds nothing to learn from in any of {len(images)} images")
        order = rng.permutation(len(columns[0]))
        self._rows = [column[order] for column in columns]

    def _write(
        self,
        network: nn.Module,
        examples: Mapping[str, Tensor],
        own: Mapping[str, Any],
        facts: Mapping[str, Any],
        file: Path,
    ) -> None:
        """Writes a network that gives `sides` for rows of these inputs, with the facts of its kind and its training."""
        described = {"kind": self.kind, "classes": list(self.data.classes), "training_images": len(self.data.training)}
        export_rows(network, examples, ["sides"], {**described, **own, **facts}, file)


def answered(network: nn.Module, *given: NDArray[Any]) -> NDArray[np.float32]:
    """Runs a network in training on arrays, as its file would run."""
    device = next(network.parameters()).device
    with torch.inference_mode():
        found: NDArray[np.float32] = network(*(torch.from_numpy(each).to(device) for each in given)).cpu().numpy()
    return found
