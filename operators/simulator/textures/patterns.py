"""Procedural textures by name.

Every pattern fills a square of SIZE texels, repeats without a seam where it is meant to be tiled, and is drawn from its
own generator: a pattern's name and the world's seed decide it alone.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np

from operators.simulator.textures import prints, stuffs
from operators.simulator.textures.painting import Pixels, Rng

_PAINTERS: dict[str, Callable[[Rng], Pixels]] = {**stuffs.PAINTERS, **prints.PAINTERS}


def draw(name: str, seed: int) -> Pixels:
    """One pattern. Raises ValueError for an unknown name."""
    kind = name.split(":")[0]
    painter = _PAINTERS.get(kind)
    if painter is None:
        raise ValueError(f"no texture pattern {kind!r}; there are {', '.join(sorted(_PAINTERS))}")
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return np.clip(painter(rng), 0, 255).astype(np.float32)
