"""The outcomes of a sweep: kept by key, made into one Parquet table, summed up."""

from __future__ import annotations

import json
import math
import os
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dataflow.sweep.plan import Choice, Task
from dataflow.sweep.work import Result

TIMES = ("cpu_ms", "wall_ms", "total_wall_s")
"""Columns that differ from one sweep to another of the same; all others do not."""
GROUP = 20_000
"""Rows that are held in memory until they are written."""


class Store:
    """A sweep's folder: `results/KEY.json` of each task, `logs/KEY.txt` of those that failed, the table."""

    def __init__(self, folder: Path) -> None:
        """Raises `OSError` where the folder cannot be made."""
        self.folder = folder
        for name in ("results", "logs"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def keep(self, result: Result) -> None:
        """Writes a result, whole or not at all; what is not final will be tried again by the next sweep."""
        if result.log:
            self.log(result.key).write_text(result.log, encoding="utf-8")
        else:
            self.log(result.key).unlink(missing_ok=True)
        file = self._file(result.key)
        part = file.with_suffix(f".{os.getpid()}.part")
        part.write_text(json.dumps(asdict(result)), encoding="utf-8")
        part.replace(file)

    def of(self, key: str) -> Result | None:
        """Returns the result that is kept for a key."""
        try:
            value = json.loads(self._file(key).read_text(encoding="utf-8"))
            return Result(**{**value, "rows": tuple(value["rows"])})
        except (OSError, ValueError, TypeError, KeyError):  # none yet, or of another version: the task is done again
            return None

    def has(self, key: str) -> bool:
        """Returns whether there is a result that another try would not change."""
        result = self.of(key)
        return result is not None and result.final

    def empty(self) -> bool:
        """Returns whether there is no result at all."""
        return not any((self.folder / "results").iterdir())

    def log(self, key: str) -> Path:
        """Returns the file of a failed task's output."""
        return self.folder / "logs" / f"{key}.txt"

    def _file(self, key: str) -> Path:
        return self.folder / "results" / f"{key}.json"


def rows_of(task: Task, result: Result, store: Store) -> Iterator[dict[str, Any]]:
    """Yields the table's rows of one task: one for each operator, or one without where there is no report."""
    for row in result.rows:
        yield {
            "recording": task.source.name,
            **{f"set {name}": value for name, value in task.settings},
            "what": task.what,
            "outcome": result.outcome,
            "error": result.error or None,
            **row,
            "figures": list(row.get("figures", {}).items()),
            "total_wall_s": result.wall,
            "log": str(store.log(task.key)) if result.log else None,
        }


def write_table(file: Path, tasks: Sequence[Task], store: Store) -> int:
    """Writes the Parquet table of what is kept of `tasks`, in their order; returns its number of rows.

    Columns: `recording`, `set NAME` for each name with values, `what`, `outcome`, `error`, `operator`, `verdict`,
    `firings`, `emitted`, `dropped`, `differing`, `restarts`, `digest` (of the operator's streams), `figures` (name →
    number), `cpu_ms`, `wall_ms`, `total_wall_s` (of the whole command), `log`.
    """
    import pyarrow as pa
    import pyarrow.parquet as parquet

    from dataflow.sweep.columns import table

    text, whole, real = pa.string(), pa.int64(), pa.float64()
    settings = {f"set {name}": text for choice in dict.fromkeys(task.settings for task in tasks) for name, _ in choice}
    columns = {
        "recording": text,
        **settings,
        **dict.fromkeys(("what", "outcome", "error", "operator", "verdict"), text),
        **dict.fromkeys(("firings", "emitted", "dropped", "differing", "restarts"), whole),
        "digest": text,
        "figures": pa.map_(text, real),
        **dict.fromkeys(TIMES, real),
        "log": text,
    }
    schema = pa.schema(list(columns.items()))
    part, written, held = file.with_suffix(f".{os.getpid()}.part"), 0, list[dict[str, Any]]()
    with parquet.ParquetWriter(part, schema, compression="zstd") as writer:
        for task in tasks:
            if (result := store.of(task.key)) is not None:
                held += rows_of(task, result, store)
            if len(held) >= GROUP:
                writer.write_table(table(held, schema))
                written, held = written + len(held), []
        writer.write_table(table(held, schema))
    part.replace(file)
    return written + len(held)


def summed_up(tasks: Iterable[Task], store: Store) -> list[dict[str, Any]]:
    """Returns a summary for each choice of settings, in the order of the tasks.

    `recordings`, `outcomes` (outcome → number), `verdicts` (verdict → operators), `culprits` (operator → recordings),
    `dropped` messages, `cpu_s`, and `figures`: "operator: name" → mean, standard deviation, number of recordings.
    """
    found: dict[Choice, dict[str, Any]] = {}
    figures: dict[Choice, dict[str, list[float]]] = {}
    for task in tasks:
        here = found.setdefault(
            task.settings,
            {"settings": dict(task.settings), "recordings": 0, "outcomes": {}, "verdicts": {}, "culprits": {}}
            | {"dropped": 0, "cpu_s": 0.0},
        )
        here["recordings"] += 1
        result = store.of(task.key)
        _count(here["outcomes"], "not done" if result is None else result.outcome)
        for row in () if result is None else result.rows:
            here["dropped"] += row.get("dropped") or 0
            here["cpu_s"] += (row.get("cpu_ms") or 0.0) * 1e-3
            if (verdict := row.get("verdict")) is not None:
                _count(here["verdicts"], verdict)
                if verdict in ("culprit", "changed"):
                    _count(here["culprits"], row["operator"])
            for name, value in finite(row):
                figures.setdefault(task.settings, {}).setdefault(f"{row['operator']}: {name}", []).append(value)
    for settings, summary in found.items():
        summary["figures"] = {
            name: {"mean": statistics.fmean(values), "std": statistics.pstdev(values), "recordings": len(values)}
            for name, values in figures.get(settings, {}).items()
        }
    return list(found.values())


def finite(row: Mapping[str, Any]) -> list[tuple[str, float]]:
    """Returns the figures of a row that are numbers one can take a mean of."""
    return [(name, value) for name, value in row.get("figures", {}).items() if math.isfinite(value)]


def _count(counts: dict[str, int], name: str) -> None:
    counts[name] = counts.get(name, 0) + 1
