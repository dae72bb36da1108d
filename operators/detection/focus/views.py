"""Square parts of images with what is true of them: what the focus network is trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

CLASSES = ("mug", "ball", "bottle", "box", "book", "plant")
"""Things of the simulated worlds that are small enough to be mixed up from afar."""
MOST = 24
"""Things that are told of one view."""
NONE = 255


@dataclass(frozen=True, eq=False)
class Views:
    """`images` (N, S, S, 3) RGB, `owners` (N, S, S) which thing each pixel is of, from 1 (0: none that is told of),
    `classes` (N, MOST) of CLASSES, of each thing (NONE: there is no such thing)."""

    images: NDArray[np.uint8]
    owners: NDArray[np.uint8]
    classes: NDArray[np.uint8]

    def write(self, file: Path) -> None:
        np.savez_compressed(file, images=self.images, owners=self.owners, classes=self.classes)

    @classmethod
    def read(cls, file: Path) -> Self:
        """Raises FileNotFoundError where there is no such file, ValueError for one that holds no views."""
        with np.load(file) as kept:
            lacking = {"images", "owners", "classes"} - set(kept)
            if lacking:
                raise ValueError(f"{file} holds no {', '.join(sorted(lacking))}: delete it, and it is made anew")
            return cls(kept["images"], kept["owners"], kept["classes"])

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Returns all parts one after the other."""
        return cls(
            np.concatenate([part.images for part in parts]),
            np.concatenate([part.owners for part in parts]),
            np.concatenate([part.classes for part in parts]),
        )
