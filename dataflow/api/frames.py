"""Columns as pandas tables. pandas is imported when a table is made: it is the extra `notebook`."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from dataflow.api.columns import Column, Elements, expanded

if TYPE_CHECKING:
    import pandas as pd

CLASS_NAMES = "class_names"
CLASS_IDS = "class_ids"
"""By convention of the message types, class ids index the list of names in the same message."""


def pandas() -> Any:
    """The pandas module. Raises `ImportError` with what to install."""
    try:
        return importlib.import_module("pandas")
    except ImportError as error:
        raise ImportError(
            "tables need pandas, which is not installed: pip install 'robot-dataflow[notebook]'; "
            "columns() gives the same data as numpy arrays",
            name="pandas",
        ) from error


def frame(
    stamps: npt.NDArray[np.int64], seconds: npt.NDArray[np.float64], columns: Mapping[str, Column], *, asked: bool
) -> pd.DataFrame:
    """A table of columns by time. Without `asked`, columns are left out where they hold nothing."""
    kept = {name: data for name, data in columns.items() if asked or not _is_empty(data)}
    return pandas().DataFrame({"stamp": stamps, "seconds": seconds, **flat(kept)}, index=time_index(stamps))


def element_frame(
    stamps: npt.NDArray[np.int64],
    seconds: npt.NDArray[np.float64],
    found: Elements,
    columns: Mapping[str, Column],
    class_names: Sequence[Sequence[str] | None] | Column,
) -> pd.DataFrame:
    """A table of the elements of messages, by the time of their message; `class_names` by message."""
    at = found.message
    table = {"stamp": stamps[at], "seconds": seconds[at], "message": at, "element": found.number, **flat(columns)}
    if CLASS_IDS in columns and any(names for names in class_names):
        table["class_name"] = np.array(
            [_name(class_names[m], k) for m, k in zip(at.tolist(), columns[CLASS_IDS].tolist(), strict=True)], object
        )
    return pandas().DataFrame(table, index=time_index(stamps[at]))


def flat(columns: Mapping[str, Column]) -> dict[str, Column]:
    """The columns by component: each (N,)."""
    return {name: part for field, data in columns.items() for name, part in expanded(field, data)}


def time_index(stamps: npt.NDArray[np.int64]) -> Any:
    """Timestamps as a pandas index, UTC."""
    return pandas().DatetimeIndex(stamps.astype("datetime64[ns]"), name="time").tz_localize("UTC")


def _is_empty(data: Column) -> bool:
    if data.dtype.kind == "f":
        return bool(data.size) and bool(np.isnan(data).all())
    return data.dtype == object and all(value is None for value in data)


def _name(names: Sequence[str] | None, number: int) -> str:
    return names[number] if names and 0 <= number < len(names) else ""
