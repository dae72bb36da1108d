"""The status that an operator gives of itself: for each of its parts a text, a level, and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dataflow.messages import Diagnostics, Level

Row = tuple[str, str, Level, Mapping[str, object]]
"""Name, text, level and figures of one entry."""


def status_of_rows(stamp: int, rows: Sequence[Row]) -> Diagnostics:
    """Returns diagnostics of several entries."""
    figures = [(key, str(value), k) for k, (_, _, _, values) in enumerate(rows) for key, value in values.items()]
    return Diagnostics(
        stamp=stamp,
        names=tuple(name for name, _, _, _ in rows),
        messages=tuple(text for _, text, _, _ in rows),
        levels=np.array([level for _, _, level, _ in rows], np.uint8),
        keys=tuple(key for key, _, _ in figures),
        values=tuple(value for _, value, _ in figures),
        owners=np.array([owner for _, _, owner in figures], np.int32) if figures else None,
    )


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
