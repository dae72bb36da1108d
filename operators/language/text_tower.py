"""The half of an image-text network that describes texts, from an ONNX file and its tokenizer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from operators.inference import ModelError, open_session
from operators.language.bpe import LENGTH, Tokenizer
from operators.language.image_tower import unit_rows, vector_output

_TYPES = {"tensor(int64)": np.int64, "tensor(int32)": np.int32}


class TextTower:
    """Turns texts into unit vectors of the space of its network's images.

    The first input takes tokens (N, L) of int64 or int32, a second one, or one named a mask, whether each counts.
    Raises FileNotFoundError, or ModelError for a network of other inputs or outputs, or a tokenizer that is none.
    """

    def __init__(self, file: Path, tokenizer: Path) -> None:
        self._tokenizer = Tokenizer(tokenizer)
        self._session = open_session(file, "cpu")
        self._inputs = sorted(self._session.get_inputs(), key=lambda each: "mask" in each.name)  # stable
        fits = 1 <= len(self._inputs) <= 2 and all(i.type in _TYPES and len(i.shape) == 2 for i in self._inputs)
        if not fits:
            described = ", ".join(f"{i.name} {i.type} {i.shape}" for i in self._inputs)
            raise ModelError(
                f"{file} must take tokens [N, L] of int64 or int32, and a mask of them; it has {described}"
            )
        self._output = vector_output(file, self._session)
        extent = self._inputs[0].shape[1]
        self._length = extent if isinstance(extent, int) else LENGTH

    def __call__(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Returns the vectors (N, D) of texts, N above 0."""
        rows = []
        for text in texts:  # exports may leave the number of texts open or have it 1
            tokens = self._tokenizer([text], self._length)
            given = {self._inputs[0].name: tokens.astype(_TYPES[self._inputs[0].type])}
            for mask in self._inputs[1:]:
                counts = np.arange(self._length) <= tokens.argmax(axis=1)[:, None]
                given[mask.name] = counts.astype(_TYPES[mask.type])
            rows.append(self._session.run([self._output], given)[0])
        return unit_rows(np.concatenate(rows))
