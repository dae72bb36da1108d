"""Holds what exports of datasets share: streams by type, messages as one type, and the files of frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.interop.conversions import convert
from dataflow.interop.export.material import Material
from dataflow.interop.export.report import Exported
from dataflow.messages import (
    CompressedDepth,
    CompressedImage,
    DepthImage,
    Image,
    Message,
    Odometry,
    Pose,
)
from dataflow.recording.errors import RecordingError

PAIR_WITHIN = 20_000_000
"""Image, depth and pose of one frame lie at most this far apart (ns)."""
IMAGES = (Image, CompressedImage)
DEPTHS = (DepthImage, CompressedDepth)
POSES = (Pose, Odometry)


def optional(material: Material, *types: type[Message]) -> str | None:
    """The one stream of some types, None where there is none; raises `RecordingError` for several."""
    return material.only("the format", *types) if material.of_type(*types) else None


def messages_as(material: Material, stream: str | None, kind: type[Message], done: Exported) -> Iterator[Any]:
    """The messages of a stream as one type."""
    for recorded in material.messages([stream]) if stream is not None else ():
        done.count(material.names[recorded.stream])
        yield convert(recorded.message, kind)


def nearest(messages: dict[int, Any], stamp: int) -> Any | None:
    if stamp in messages:
        return messages[stamp]
    near: int | None = min(messages, key=lambda s: abs(s - stamp), default=None)
    return messages[near] if near is not None and abs(near - stamp) <= PAIR_WITHIN else None


def write_png(path: Path, message: Image | DepthImage, units: float | None) -> None:
    """Writes an image as it is, or depth as 16-bit `units` a metre (0: no return, or too far to be written)."""
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    if units is None:
        pixels: Any = message.data[..., ::-1] if message.data.ndim == 3 else message.data
    else:
        metres = np.nan_to_num(message.data.astype(np.float64), nan=0.0, posinf=0.0)
        scaled = np.rint(metres * units)
        pixels = np.where(scaled <= 65535, scaled, 0).astype(np.uint16)
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
