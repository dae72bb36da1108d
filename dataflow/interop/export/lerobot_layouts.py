"""The two layouts of LeRobot's datasets: where the table of frames lies, and what describes it.

2.1 has a file an episode and lines of JSON; 3.0 has files that hold many episodes, `chunk-000/file-000.parquet` of at
most 100 MB and 1,000 in a chunk, and tables that say which rows an episode is. A recording is one episode, which is
never divided, so here each table is one file. Layout: LeRobot's `CODEBASE_VERSION` v2.1 and v3.0.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

FILES_IN_CHUNK = 1000
DATA_MB, VIDEO_MB = 100, 200
CHUNK = "chunk-{chunk_index:03d}/file-{file_index:03d}"
FIRST = "chunk-000/file-000.parquet"


@dataclass(frozen=True, slots=True)
class Dataset:
    """A dataset of one episode: what its columns are, their statistics, and how many frames it has."""

    features: Mapping[str, Any]
    statistics: Mapping[str, Mapping[str, Any]]
    frames: int
    fps: float
    task: str

    def info(self, version: str, **more: Any) -> dict[str, Any]:
        """The content of `info.json`."""
        counts = {"total_episodes": 1, "total_frames": self.frames, "total_tasks": 1}
        about = {"chunks_size": FILES_IN_CHUNK, "fps": int(self.fps) if self.fps == int(self.fps) else self.fps}
        rest = {"splits": {"train": "0:1"}, "video_path": None, "features": dict(self.features)}
        return {"codebase_version": version, "robot_type": None, **counts, **about, **more, **rest}


class Layout(Protocol):
    """A version of the format."""

    table: str
    """The file of the frames, in the dataset's folder."""

    def describe(self, folder: Path, dataset: Dataset) -> list[Path]:
        """Writes what stands in `meta/`; the files."""


class Layout21:
    """LeRobot 2.1."""

    table = "data/chunk-000/episode_000000.parquet"

    def describe(self, folder: Path, dataset: Dataset) -> list[Path]:
        """Writes what stands in `meta/`; the files."""
        info = dataset.info(
            "v2.1",
            total_videos=0,
            total_chunks=1,
            data_path="data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        )
        episode = {"episode_index": 0, "tasks": [dataset.task], "length": dataset.frames}
        return [
            _write(folder / "meta" / "info.json", json.dumps(info, indent=4)),
            _write(folder / "meta" / "tasks.jsonl", json.dumps({"task_index": 0, "task": dataset.task})),
            _write(folder / "meta" / "episodes.jsonl", json.dumps(episode)),
            _write(
                folder / "meta" / "episodes_stats.jsonl",
                json.dumps({"episode_index": 0, "stats": dict(dataset.statistics)}),
            ),
        ]


class Layout30:
    """LeRobot 3.0. Images stand in the table; there are no videos."""

    table = f"data/{FIRST}"

    def describe(self, folder: Path, dataset: Dataset) -> list[Path]:
        """Writes what stands in `meta/`; the files."""
        info = dataset.info(
            "v3.0", data_files_size_in_mb=DATA_MB, video_files_size_in_mb=VIDEO_MB, data_path=f"data/{CHUNK}.parquet"
        )
        statistics = {key: dict(values) for key, values in dataset.statistics.items()}
        return [
            _write(folder / "meta" / "info.json", json.dumps(info, indent=4)),
            _write(folder / "meta" / "stats.json", json.dumps(statistics, indent=4)),
            _write_table(folder / "meta" / "tasks.parquet", {"task_index": [0], "task": [dataset.task]}, index="task"),
            _write_table(folder / "meta" / "episodes" / FIRST, _episode(dataset)),
        ]


def _episode(dataset: Dataset) -> dict[str, list[Any]]:
    """The row of the episode: its rows in the table of frames, the files of both, and its statistics."""
    row: dict[str, Any] = {
        "episode_index": 0,
        "tasks": [dataset.task],
        "length": dataset.frames,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": 0,
        "dataset_to_index": dataset.frames,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    for key, values in dataset.statistics.items():
        row |= {f"stats/{key}/{name}": value for name, value in values.items()}
    return {name: [value] for name, value in row.items()}


def _write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n", encoding="utf-8")
    return path


def _write_table(path: Path, columns: Mapping[str, list[Any]], index: str | None = None) -> Path:
    """Writes a table; `index`: the column that pandas takes as the rows' names."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    made = pa.Table.from_pydict(dict(columns))
    if index is not None:
        texts = {n for n, values in columns.items() if isinstance(values[0], str)}
        told = [(n, "unicode" if n in texts else "int64", "object" if n in texts else "int64") for n in columns]
        listed = [
            {"name": n, "field_name": n, "pandas_type": kind, "numpy_type": stored, "metadata": None}
            for n, kind, stored in told
        ]
        about = {"index_columns": [index], "column_indexes": [], "columns": listed}
        made = made.replace_schema_metadata({"pandas": json.dumps(about)})
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(made, path)
    return path
