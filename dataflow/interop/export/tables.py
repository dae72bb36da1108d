"""Tables of streams: one CSV or Parquet file a stream, a row a message, small arrays as one column an element."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import xxhash

from dataflow.extras import missing_extra
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource
from dataflow.messages import Message
from dataflow.messages.base import ArrayField
from dataflow.recording.errors import RecordingError

MAX_COLUMNS = 36
"""Elements of an array that become columns; larger arrays, and those of no fixed shape, are left out."""
ROWS = 4096
MAX_NAME = 200
"""Bytes of one part of a file's path, its suffix aside: file systems take 255."""


def columns_of(kind: type[Message]) -> tuple[dict[str, list[str]], list[str]]:
    """The columns by field of a message type, and the fields that have none."""
    columns: dict[str, list[str]] = {}
    left_out: list[str] = []
    for field in kind.FIELDS:
        if not isinstance(field, ArrayField):
            columns[field.name] = [field.name]
            continue
        sizes = [size for size in field.shape_text().strip("()").split(",") if size]
        sizes = [size.strip() for size in sizes]
        if all(size.isdecimal() for size in sizes) and math.prod(map(int, sizes)) <= MAX_COLUMNS:
            places = np.ndindex(*map(int, sizes))
            columns[field.name] = [f"{field.name}_{'_'.join(map(str, place))}" for place in places]
        else:
            left_out.append(field.name)
    return columns, left_out


def row_of(message: Message, columns: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """The values of a message by column; None for fields without a value."""
    row: dict[str, Any] = {"stamp": message.stamp}
    for name, names in columns.items():
        value = getattr(message, name)
        if len(names) == 1 and not isinstance(value, np.ndarray):
            row[names[0]] = "; ".join(value) if isinstance(value, tuple) else value
        else:
            values = [None] * len(names) if value is None else value.ravel().tolist()
            row |= dict(zip(names, values, strict=True))
    return row


def export_csv(source: ExportSource, folder: Path, done: Exported) -> None:
    """Writes `<stream>.csv`, slashes of the name as folders; stamps in ns, floats with all their digits."""
    with ExitStack() as files:
        writers: dict[str, tuple[Any, dict[str, list[str]]]] = {}
        for name, columns in _tables(source, done):
            path = file_of(folder, source.names[name], ".csv", done.files)
            file = files.enter_context(path.open("w", newline="", encoding="utf-8"))
            names = ["stamp", *(column for group in columns.values() for column in group)]
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writers[name] = writer, columns
            done.files.append(str(path))
        for recorded in source.messages(list(writers)) if writers else ():
            writer, columns = writers[recorded.stream]
            writer.writerow(row_of(recorded.message, columns))
            done.count(source.names[recorded.stream])


def export_parquet(source: ExportSource, folder: Path, done: Exported) -> None:
    """Writes `<stream>.parquet`, zstd, a row group every 4,096 messages. Raises `RecordingError` without pyarrow."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise RecordingError(f"--to parquet needs pyarrow; {missing_extra(error)}") from None
    for name, columns in _tables(source, done):
        path = file_of(folder, source.names[name], ".parquet", done.files)
        kind = source.streams[name].message_type
        assert kind is not None
        schema = pa.schema([("stamp", pa.int64()), *_types(pa, kind, columns)])
        with pq.ParquetWriter(path, schema, compression="zstd") as writer:
            rows: list[dict[str, Any]] = []
            for recorded in source.messages([name]):
                rows.append(row_of(recorded.message, columns))
                done.count(source.names[name])
                if len(rows) == ROWS:
                    writer.write_table(pa.Table.from_pylist(rows, schema))
                    rows = []
            writer.write_table(pa.Table.from_pylist(rows, schema))
        done.files.append(str(path))


def _types(pa: Any, kind: type[Message], columns: Mapping[str, list[str]]) -> Iterator[tuple[str, Any]]:
    plain = {"int": pa.int64(), "float": pa.float64(), "bool": pa.bool_(), "str": pa.string(), "strs": pa.string()}
    fields = {f.name: f for f in kind.FIELDS}
    for name, names in columns.items():
        field = fields[name]
        for column in names:
            if isinstance(field, ArrayField):
                yield column, pa.from_numpy_dtype(np.dtype(field.dtype_text().split()[0]))
            else:
                yield column, plain[field.kind]


def _tables(source: ExportSource, done: Exported) -> Iterator[tuple[str, dict[str, list[str]]]]:
    """The streams that have columns; notes what is left out."""
    for topic in source.untouched:
        done.left_out[topic.name] = f"{topic.encoding} messages of {topic.schema.name or 'no schema'}"
    for name, info in source.streams.items():
        assert info.message_type is not None
        columns, left_out = columns_of(info.message_type)
        if left_out:
            done.left_out[f"{source.names[name]}: {', '.join(left_out)}"] = "arrays of no fixed, small shape"
        if columns:
            yield name, columns


def file_of(folder: Path, name: str, suffix: str, taken: Collection[str]) -> Path:
    """Returns the file of a stream, slashes of its name as folders, other than those `taken`.

    What no file system or terminal takes is spelled as in URLs (`%00`); a part that is too long ends in a digest.
    """
    parts = [_part(part) for part in name.split("/") if part] or ["%2F"]
    path = folder.joinpath(*parts[:-1], f"{parts[-1]}{suffix}")
    numbered = (path.with_name(f"{parts[-1]}-{number}{suffix}") for number in count(2))
    while str(path) in taken:
        path = next(numbered)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _part(part: str) -> str:
    spelled = part.replace(".", "%2E") if part in (".", "..") else part
    spelled = "".join(c if c.isprintable() else quote(c, errors="surrogatepass") for c in spelled)
    if len(spelled.encode()) <= MAX_NAME:
        return spelled
    return f"{spelled.encode()[:MAX_NAME].decode(errors='ignore')}-{xxhash.xxh3_64_hexdigest(part.encode())}"
