"""The status that an operator gives of one message: a text, a level, and counts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dataflow.messages import Diagnostics, Level


def counted_status(operator: str, stamp: int, text: str, level: Level, counts: Mapping[str, int | str]) -> Diagnostics:
    """Returns diagnostics of one entry, with `counts` as its values."""
    return Diagnostics(
        stamp=stamp,
        names=(operator,),
        messages=(text,),
        levels=np.array([level], np.uint8),
        keys=tuple(counts),
        values=tuple(str(n) for n in counts.values()),
        owners=np.zeros(len(counts), np.int32),
    )
