"""Square parts of images with what is true of them: what the focus network is trained on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operators.kept_arrays import KeptArrays

CLASSES = ("mug", "ball", "bottle", "box", "book", "plant")
"""Things of the simulated worlds that are small enough to be mixed up from afar."""
MOST = 24
"""Things that are told of one view."""
NONE = 255


@dataclass(frozen=True, eq=False)
class Views(KeptArrays):
    """`images` (N, S, S, 3) RGB, `owners` (N, S, S) which thing each pixel is of, from 1 (0: none that is told of),
    `classes` (N, MOST) of CLASSES, of each thing (NONE: there is no such thing)."""

    images: NDArray[np.uint8]
    owners: NDArray[np.uint8]
    classes: NDArray[np.uint8]
