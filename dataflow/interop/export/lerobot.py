"""A dataset of LeRobot: a table of frames with their images, states and actions, and what is in it.

A frame is an image of the first camera with the newest message of every other stream, as a graph that samples them
would be given. LeRobot takes frames as equally far apart, so a frame's time is its number over the rate; when it was is
in the column `stamp`.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.extras import missing_extra
from dataflow.interop.conversions import convert
from dataflow.interop.export.frames import IMAGES
from dataflow.interop.export.lerobot_layouts import Dataset, Layout, Layout21
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource
from dataflow.messages import CameraInfo, Image, Image16, Message, Transforms
from dataflow.messages.base import ArrayField
from dataflow.recording.errors import RecordingError

UNTAKEN = "messages that no frame took, left out: a frame has the newest of each stream"
ROWS = 64
"""Frames of a row group: their images are in memory together."""
SAMPLED_PIXELS = 4096
"""Pixels of an image that count for statistics."""
INDEXES = ("frame_index", "episode_index", "index", "task_index", "stamp")


@dataclass(slots=True)
class _Statistics:
    """Smallest, largest, mean and standard deviation of vectors, one after the other."""

    count: int = 0
    least: Any = None
    most: Any = None
    total: Any = 0.0
    squares: Any = 0.0

    def add(self, values: npt.NDArray[np.float64]) -> None:
        """Takes rows of values."""
        self.least = values.min(0) if self.least is None else np.minimum(self.least, values.min(0))
        self.most = values.max(0) if self.most is None else np.maximum(self.most, values.max(0))
        self.total, self.squares = self.total + values.sum(0), self.squares + (values**2).sum(0)
        self.count += len(values)

    def as_json(self, frames: int, shape: tuple[int, ...]) -> dict[str, Any]:
        """JSON values, each value of the vectors in an array of `shape`."""
        mean = self.total / self.count
        std = np.sqrt(np.maximum(self.squares / self.count - mean**2, 0.0))
        found = {"min": self.least, "max": self.most, "mean": mean, "std": std}
        return {name: np.reshape(value, shape).tolist() for name, value in found.items()} | {"count": [frames]}


@dataclass(slots=True)
class _Plan:
    """The streams by what they become, and the names of the numbers in each vector."""

    anchor: str
    images: dict[str, str]
    states: list[str]
    action: str | None
    vectors: dict[str, list[str]] = field(default_factory=dict)
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    statistics: dict[str, _Statistics] = field(default_factory=dict)


def export_lerobot(
    source: ExportSource,
    folder: Path,
    done: Exported,
    *,
    layout: Layout | None = None,
    action: str | None = None,
    task: str = "",
) -> None:
    """Writes data/, meta/ and the images in the table, in the layout of LeRobot 2.1 unless another is given.

    Raises `RecordingError` without pyarrow, and without images.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise RecordingError(f"a dataset of LeRobot needs pyarrow; {missing_extra(error)}") from None
    layout = layout or Layout21()
    plan = _planned(source, action, done)
    stamps: list[int] = []
    path = folder / layout.table
    path.parent.mkdir(parents=True, exist_ok=True)
    fps = _rate(source, plan.anchor)
    writer: Any = None
    frames = _frames(source, plan, done)
    for rows in iter(lambda: list(itertools.islice(frames, ROWS)), []):
        number = len(stamps)
        stamps += [stamp for stamp, _ in rows]
        columns = _columns(rows, plan, number, fps)
        if writer is None:
            schema = _schema(pa, plan)
            writer = pq.ParquetWriter(path, schema, compression="zstd")
        writer.write_table(pa.Table.from_pydict(columns, schema=schema))
    if writer is None:
        raise RecordingError(f"{source.path}: no image of {source.names[plan.anchor]} has all others before it")
    writer.close()
    if uneven := int((np.abs(np.diff(stamps) * (fps * 1e-9) - 1) > 0.5).sum()):
        what = f"pauses and gaps between frames, which LeRobot has every {1 / fps:.3g} s"
        done.lose(source.names[plan.anchor], f"{what} (the column stamp has the times)", uneven)
    done.files.append(str(path))
    dataset = _described(plan, len(stamps), fps, task or source.path.stem)
    done.files += [str(file) for file in layout.describe(folder, dataset)]


def _planned(source: ExportSource, action: str | None, done: Exported) -> _Plan:
    cameras = source.of_type(*IMAGES)
    if not cameras:
        raise RecordingError(f"{source.path}: LeRobot takes images; there are none among the streams chosen")
    names = {outside: name for name, outside in source.names.items()}
    acting = None if action is None else names.get(action, action)
    if acting is not None and acting not in source.streams:
        raise RecordingError(f"{source.path}: no stream {action!r} for the action; there are {', '.join(names)}")
    images: dict[str, str] = {}
    for name in cameras:
        key = f"observation.images.{source.names[name].strip('/').replace('/', '.')}"
        if (other := images.setdefault(key, name)) != name:
            both = f"{source.names[other]} and {source.names[name]}"
            raise RecordingError(f"{source.path}: {both} are both {key} in LeRobot: leave one out with --without")
    states = []
    for name, info in source.streams.items():
        if name in cameras or name == acting:
            continue
        if info.static or info.message_type in (CameraInfo, Transforms):
            done.left_out[source.names[name]] = "LeRobot has no place for calibrations and transforms"
            continue
        first = next(source.messages([name]), None)
        if first is None or not len(_numbers(first.message)[0]):
            done.left_out[source.names[name]] = "it holds no numbers of which each message has as many"
        else:
            states.append(name)
    return _Plan(cameras[0], images, states, acting)


def _numbers(message: Message) -> tuple[npt.NDArray[np.float64], list[str]]:
    """The numbers of a message and their names: its scalars and its arrays, without covariances and stamps."""
    values: list[float] = []
    names: list[str] = []
    for declared in type(message).FIELDS:
        name, value = declared.name, getattr(message, declared.name)
        if value is None or name == "stamp" or "covariance" in name:
            continue
        if isinstance(declared, ArrayField) and value.dtype.kind in "fiub" and value.size <= 256:
            flat = np.asarray(value, float).ravel().tolist()
            values += flat
            names += [f"{name}.{k}" for k in range(len(flat))]
        elif isinstance(value, bool | int | float):
            values.append(float(value))
            names.append(name)
    return np.array(values), names


def _frames(source: ExportSource, plan: _Plan, done: Exported) -> Iterator[tuple[int, dict[str, Message]]]:
    """(stamp, newest message by stream) for every image of the first camera that all others come before."""
    wanted = [*plan.images.values(), *plan.states, *([plan.action] if plan.action is not None else [])]
    newest: dict[str, Message] = {}
    now: int | None = None
    untaken: set[str] = set()

    def is_frame() -> bool:
        return len(newest) == len(wanted) and newest[plan.anchor].stamp == now

    def frame() -> dict[str, Message]:
        for name in untaken:
            done.count(source.names[name])
        untaken.clear()
        return dict(newest)

    for recorded in source.messages(wanted):
        if now is not None and recorded.stamp != now and is_frame():
            yield now, frame()
        now = recorded.stamp
        if recorded.stream in untaken:
            done.lose(source.names[recorded.stream], UNTAKEN)
        newest[recorded.stream] = recorded.message
        untaken.add(recorded.stream)
        if isinstance(recorded.message, Image16):
            done.narrow(source.names[recorded.stream], "16 bits, and LeRobot's images have 8")
    if now is not None and is_frame():
        yield now, frame()
    for name in untaken:
        done.lose(source.names[name], UNTAKEN)


def _columns(rows: list[tuple[int, dict[str, Message]]], plan: _Plan, first: int, fps: float) -> dict[str, list[Any]]:
    columns: dict[str, list[Any]] = {}
    for key, stream in plan.images.items():
        columns[key] = [_picture(key, found[stream], plan) for _, found in rows]
    for key, streams in (("observation.state", plan.states), ("action", [plan.action] if plan.action else [])):
        if streams:
            columns[key] = [_vector(key, [found[s] for s in streams], streams, plan) for _, found in rows]
    numbers = range(first, first + len(rows))
    columns["timestamp"] = [number / fps for number in numbers]
    columns |= {"frame_index": list(numbers), "index": list(numbers), "stamp": [stamp for stamp, _ in rows]}
    columns |= {"episode_index": [0] * len(rows), "task_index": [0] * len(rows)}
    for key in ("timestamp", *INDEXES):
        plan.statistics.setdefault(key, _Statistics()).add(np.array(columns[key], float)[:, np.newaxis])
    return columns


def _picture(key: str, message: Message, plan: _Plan) -> dict[str, Any]:
    """An image as PNG. Raises `RecordingError` where its size differs from that of those before."""
    import cv2

    image = convert(message, Image)
    assert isinstance(image, Image)
    data = np.repeat(image.data[..., np.newaxis], 3, 2) if image.data.ndim == 2 else image.data
    size = plan.sizes.setdefault(key, (data.shape[0], data.shape[1]))
    if data.shape[:2] != size:
        raise RecordingError(f"{key}: an image of {data.shape[:2]} after images of {size}: LeRobot takes one size")
    pixels = data.reshape(-1, 3)
    step = max(1, len(pixels) // SAMPLED_PIXELS)
    plan.statistics.setdefault(key, _Statistics()).add(pixels[::step] / 255.0)
    ok, encoded = cv2.imencode(".png", data[..., ::-1])
    if not ok:
        raise RecordingError(f"{key}: an image cannot be encoded")
    return {"bytes": encoded.tobytes(), "path": None}


def _vector(key: str, messages: list[Message], streams: list[str], plan: _Plan) -> list[float] | float:
    """The numbers of several messages in a row, one alone as it is.

    Raises `RecordingError` where there are more or fewer than before.
    """
    parts = [_numbers(message) for message in messages]
    names = [f"{stream}/{name}" for stream, (_, found) in zip(streams, parts, strict=True) for name in found]
    known = plan.vectors.setdefault(key, names)
    if known != names:
        changed = [
            stream
            for stream in streams
            if [n for n in names if n.startswith(f"{stream}/")] != [n for n in known if n.startswith(f"{stream}/")]
        ]
        raise RecordingError(
            f"{key}: {len(names)} numbers after {len(known)}, and LeRobot takes rows of one length: leave out what "
            f"changes size with {' '.join(f'--without {stream}' for stream in changed)}"
        )
    values = np.concatenate([found for found, _ in parts])
    plan.statistics.setdefault(key, _Statistics()).add(values[np.newaxis])
    return [float(value) for value in values] if len(values) > 1 else float(values[0])


def _rate(source: ExportSource, stream: str) -> float:
    """Frames a second, a whole number where it is nearly one; from the median distance of images."""
    stamps = np.array([m.stamp for m in source.messages([stream])])
    if len(stamps) < 2:
        return 1.0
    rate = 1e9 / float(np.median(np.diff(stamps)))
    return float(round(rate)) if abs(rate - round(rate)) < 0.05 * rate and rate > 0.95 else rate


def _schema(pa: Any, plan: _Plan) -> Any:
    """The table's columns, with what the `datasets` library reads them as."""
    fields: list[tuple[str, Any]] = []
    features: dict[str, Any] = {}
    for key in plan.images:
        fields.append((key, pa.struct([("bytes", pa.binary()), ("path", pa.string())])))
        features[key] = {"_type": "Image"}
    for key, names in plan.vectors.items():
        value = {"dtype": "float32", "_type": "Value"}
        alone = len(names) == 1  # LeRobot reads the shape [1] as a number
        fields.append((key, pa.float32() if alone else pa.list_(pa.float32(), len(names))))
        features[key] = value if alone else {"feature": value, "length": len(names), "_type": "Sequence"}
    for key, kind in (("timestamp", "float32"), *((name, "int64") for name in INDEXES)):
        fields.append((key, pa.float32() if kind == "float32" else pa.int64()))
        features[key] = {"dtype": kind, "_type": "Value"}
    return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": features}})})


def _described(plan: _Plan, frames: int, fps: float, task: str) -> Dataset:
    """The columns and their statistics."""
    features: dict[str, Any] = {}
    for key in plan.images:
        names = ["height", "width", "channels"]
        features[key] = {"dtype": "image", "shape": [*plan.sizes[key], 3], "names": names}
    for key, words in plan.vectors.items():
        features[key] = {"dtype": "float32", "shape": [len(words)], "names": words}
    for key in ("timestamp", *INDEXES):
        features[key] = {"dtype": "float32" if key == "timestamp" else "int64", "shape": [1], "names": None}
    statistics = {
        key: found.as_json(frames, (3, 1, 1) if key in plan.images else (-1,)) for key, found in plan.statistics.items()
    }
    return Dataset(features, statistics, frames, fps, task)
