"""The meta/ folder of a dataset of LeRobot, which says what is in it: formats 3.0 and 2.1."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dataflow.interop.export.report import Exported

DATA_V3 = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA_V2 = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
FILES_IN_A_CHUNK = 1000
DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
"""Sizes to which LeRobot fills files when it adds episodes; one episode is never divided."""

_INDEXED_BY_TASK = {
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        for name, kind, numpy_type in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ],
    "creator": {"library": "pyarrow", "version": ""},
    "pandas_version": "2.0.0",
}
"""Says to pandas that the task is the index of a table: LeRobot looks tasks up by it."""


@dataclass(frozen=True, slots=True)
class Described:
    """The one episode of a dataset: its frames, what its columns are, and their statistics by column."""

    frames: int
    fps: float
    task: str
    features: Mapping[str, Mapping[str, Any]]
    statistics: Mapping[str, Mapping[str, Any]]

    @property
    def rate(self) -> int | float:
        """Frames a second, a whole number where it is one: LeRobot asks for that."""
        return int(self.fps) if self.fps == int(self.fps) else self.fps


def describe_v3(folder: Path, described: Described, done: Exported) -> None:
    """Writes info.json, stats.json, and the tables of tasks and episodes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": 1,
        "total_frames": described.frames,
        "total_tasks": 1,
        "chunks_size": FILES_IN_A_CHUNK,
        "data_files_size_in_mb": DATA_FILE_MB,
        "video_files_size_in_mb": VIDEO_FILE_MB,
        "fps": described.rate,
        "splits": {"train": "0:1"},
        "data_path": DATA_V3,
        "video_path": None,
        "features": {key: {**feature, "fps": described.rate} for key, feature in described.features.items()},
    }
    _write(folder / "meta" / "info.json", json.dumps(info, indent=4), done)
    _write(folder / "meta" / "stats.json", json.dumps(described.statistics, indent=4), done)
    episode = {
        "episode_index": 0,
        "tasks": [described.task],
        "length": described.frames,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": 0,
        "dataset_to_index": described.frames,
        **{
            f"stats/{key}/{name}": value for key, found in described.statistics.items() for name, value in found.items()
        },
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    tasks = pa.table({"task_index": pa.array([0], pa.int64()), "task": [described.task]})
    tables = {
        "tasks.parquet": tasks.replace_schema_metadata({"pandas": json.dumps(_INDEXED_BY_TASK)}),
        "episodes/chunk-000/file-000.parquet": pa.Table.from_pylist([episode]),
    }
    for name, table in tables.items():
        path = folder / "meta" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path)
        done.files.append(str(path))


def describe_v2(folder: Path, described: Described, done: Exported) -> None:
    """Writes info.json, tasks.jsonl, episodes.jsonl and episodes_stats.jsonl."""
    info = {
        "codebase_version": "v2.1",
        "robot_type": None,
        "total_episodes": 1,
        "total_frames": described.frames,
        "total_tasks": 1,
        "total_videos": 0,
        "total_chunks": 1,
        "chunks_size": FILES_IN_A_CHUNK,
        "fps": described.rate,
        "splits": {"train": "0:1"},
        "data_path": DATA_V2,
        "video_path": None,
        "features": described.features,
    }
    lines = {
        "info.json": json.dumps(info, indent=4),
        "tasks.jsonl": json.dumps({"task_index": 0, "task": described.task}),
        "episodes.jsonl": json.dumps({"episode_index": 0, "tasks": [described.task], "length": described.frames}),
        "episodes_stats.jsonl": json.dumps({"episode_index": 0, "stats": described.statistics}),
    }
    for name, text in lines.items():
        _write(folder / "meta" / name, text, done)


def _write(path: Path, text: str, done: Exported) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n", encoding="utf-8")
    done.files.append(str(path))
