"""The half of an image-text network that describes images, from an ONNX file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.inference import ModelError, Provider, open_session
from operators.network_input import NORMALIZATIONS, image_input


class ImageTower:
    """Turns images into unit vectors. Raises FileNotFoundError, or ModelError for a network of other inputs or outputs.

    The input is square, `normalization` one of `NORMALIZATIONS`, `side` its pixels where the model leaves them open.
    The vector is the first output (N, D). `side` is the input's in the end.
    """

    def __init__(self, file: Path, normalization: str, side: int, provider: Provider = "cpu") -> None:
        self._file = file
        self._session = open_session(file, provider)
        mean, scale = NORMALIZATIONS[normalization]
        self._input = image_input(file, self._session, (side, side), bgr=False, mean=mean, scale=scale)
        self._output = vector_output(file, self._session)
        self._at_once = not isinstance(self._session.get_inputs()[0].shape[0], int)
        self.side = self._input.size[0]
        if self._input.size != (self.side, self.side):
            raise ModelError(f"{file} must have a square input, has {self._input.size}")

    def __call__(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Returns the vectors (N, D) of RGB images (side, side, 3), N above 0: at once where the model takes so."""
        tensors = [self._input.tensor(image) for image in images]
        batches = [np.concatenate(tensors)] if self._at_once else tensors
        answers = [self._session.run([self._output], {self._input.name: batch})[0] for batch in batches]
        return unit_rows(np.concatenate(answers))


def vector_output(file: Path, session: Any) -> str:
    """Returns the name of the first output (N, D). Raises ModelError where there is none."""
    found = [each.name for each in session.get_outputs() if len(each.shape) == 2]
    if not found:
        described = ", ".join(f"{each.name} {each.shape}" for each in session.get_outputs())
        raise ModelError(f"{file} must have an output (N, D), a vector for each image or text; it has {described}")
    return str(found[0])


def unit_rows(vectors: NDArray[Any]) -> NDArray[np.float32]:
    """Returns rows of length 1; those of zeros, which have no direction, stay as they are."""
    rows = vectors.astype(np.float64)
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.where(lengths > 0, lengths, 1), np.float32)
