"""Holds what exports of datasets share: streams by type, messages as one type, and the files of frames."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.interop.conversions import NARROWING, convert
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource
from dataflow.messages import (
    CameraInfo,
    CompressedDepth,
    CompressedImage,
    DepthImage,
    Image,
    Image16,
    Message,
    Odometry,
    Pose,
)
from dataflow.recording import Recorded
from dataflow.recording.errors import RecordingError

PAIR_WITHIN = 20_000_000
"""Image, depth and pose of one frame lie at most this far apart (ns)."""
IMAGES = (Image, CompressedImage, Image16)
DEPTHS = (DepthImage, CompressedDepth)
POSES = (Pose, Odometry)


def optional(source: ExportSource, *types: type[Message]) -> str | None:
    """The one stream of some types, None where there is none; raises `RecordingError` for several."""
    return source.only("the format", *types) if source.of_type(*types) else None


def frame_of(source: ExportSource, stream: str) -> str:
    """The frame of a stream's first message."""
    first = next(source.messages([stream]), None)
    return "" if first is None else str(getattr(first.message, "frame", ""))


def calibration(
    source: ExportSource, frame: str, done: Exported, *, among: Sequence[str] | None = None, alone: bool = False
) -> CameraInfo | None:
    """The first calibration of a camera's frame, counted as written; what of its lens has no place is counted as lost.
    `among`: streams of calibrations; `alone`: the only one there is will do, whatever its frame."""
    streams = source.of_type(CameraInfo) if among is None else among
    infos = [(name, recorded.message) for name in streams for recorded in source.messages([name])]
    chosen = [(name, info) for name, info in infos if getattr(info, "frame", "") == frame]
    chosen = chosen or (infos if alone and len(infos) == 1 else [])
    for name, info in chosen[:1]:
        assert isinstance(info, CameraInfo)
        done.count(source.names[name])
        if info.distortion is not None and info.distortion.any():
            done.lose(source.names[name], f"the distortion of its lens ({info.distortion_model})")
        return info
    return None


def messages_as(source: ExportSource, stream: str | None, kind: type[Message], done: Exported) -> Iterator[Any]:
    """The messages of a stream as one type; images of 16 bits stay such, since PNG holds them."""
    for recorded in source.messages([stream]) if stream is not None else ():
        message = as_kind(source, recorded, kind, done)
        if message is not None:
            yield message


def as_kind(source: ExportSource, recorded: Recorded, kind: type[Message], done: Exported) -> Any:
    """A message as another type, counted; None for a pose that is none, which is left out."""
    name, message = source.names[recorded.stream], recorded.message
    done.count(name)
    if (lost := NARROWING.get((type(message), kind))) is not None and not isinstance(message, Image16):
        done.lose(name, lost)
    made = message if kind is Image and isinstance(message, Image16) else convert(message, kind)
    if isinstance(made, Pose) and not np.isfinite(made.position).all():
        done.lose(name, "a pose that is not finite, left out")
        return None
    return made


def together(
    source: ExportSource, anchor: str, others: Mapping[str, type[Message]], done: Exported
) -> Iterator[tuple[Recorded, dict[str, Any]]]:
    """Each message of a stream with the nearest one of every other, as its type, if there is one within `PAIR_WITHIN`;
    of two as near the earlier. Messages are held as long as one that is to come may be near them.
    """
    waiting: deque[Recorded] = deque()
    held: dict[str, deque[Any]] = {stream: deque() for stream in others}
    for recorded in chain(source.messages([anchor, *others]), [None]):
        now = None if recorded is None else recorded.message.stamp
        while waiting and (now is None or waiting[0].message.stamp + PAIR_WITHIN < now):
            first = waiting.popleft()
            yield first, {stream: nearest(messages, first.message.stamp) for stream, messages in held.items()}
        if recorded is None or now is None:
            return
        if recorded.stream == anchor:
            waiting.append(recorded)
        elif (message := as_kind(source, recorded, others[recorded.stream], done)) is not None:
            held[recorded.stream].append(message)
        oldest = waiting[0].message.stamp if waiting else now
        for messages in held.values():
            while messages and messages[0].stamp < oldest - PAIR_WITHIN:
                messages.popleft()


def nearest(messages: Sequence[Any], stamp: int) -> Any:
    """The message nearest to a stamp, of two as near the earlier; None without one within `PAIR_WITHIN`."""
    at = bisect_left(messages, stamp, key=lambda m: m.stamp)
    near = min(
        (messages[k] for k in (at - 1, at) if 0 <= k < len(messages)), key=lambda m: abs(m.stamp - stamp), default=None
    )
    return near if near is not None and abs(near.stamp - stamp) <= PAIR_WITHIN else None


def write_png(path: Path, message: Image | Image16) -> None:
    """Writes an image as it is, of 8 or 16 bits."""
    _write(path, message.data[..., ::-1] if message.data.ndim == 3 else message.data)


def write_depth(path: Path, message: DepthImage, units: float, name: str, done: Exported) -> None:
    """Writes depth as 16-bit `units` a metre, 0 for no return. Counts the pixels that the format cannot hold."""
    metres = message.data.astype(np.float64)
    seen = np.isfinite(metres) & (metres > 0)
    scaled = np.rint(np.where(seen, metres, 0) * units)
    far = scaled > 65535
    if negative := int((metres < 0).sum()):
        done.lose(name, "negative depth (pixels), written as no return", negative)
    if beyond := int(far.sum()):
        done.lose(name, f"depth beyond {65535 / units:.1f} m (pixels), written as no return", beyond)
    if near := int((seen & (scaled == 0)).sum()):
        done.lose(name, "depth below one unit (pixels), written as no return", near)
    if np.abs(scaled / units - np.where(seen, metres, 0))[~far].max(initial=0) > 1e-6:
        done.lose(name, f"digits of depth: it is written in units of {1000 / units:g} mm")
    _write(path, np.where(far, 0, scaled).astype(np.uint16))


def _write(path: Path, pixels: Any) -> None:
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), pixels):
        raise RecordingError(f"{path} cannot be written")


def write_text(path: Path, text: str, done: Exported | None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    if done is not None:
        done.files.append(str(path))


def write_rows(path: Path, head: str, rows: Iterator[list[str]], done: Exported) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:
        file.write(head + "\n")
        for row in rows:
            file.write(",".join(row) + "\n")
    done.files.append(str(path))
