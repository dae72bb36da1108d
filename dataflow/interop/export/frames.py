"""Holds what exports of datasets share: streams by type, messages as one type, and the files of frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.interop.conversions import NARROWING, convert
from dataflow.interop.export.material import Material
from dataflow.interop.export.report import Exported
from dataflow.messages import (
    CompressedDepth,
    CompressedImage,
    DepthImage,
    Image,
    Image16,
    Message,
    Odometry,
    Pose,
)
from dataflow.recording.errors import RecordingError

PAIR_WITHIN = 20_000_000
"""Image, depth and pose of one frame lie at most this far apart (ns)."""
IMAGES = (Image, CompressedImage, Image16)
DEPTHS = (DepthImage, CompressedDepth)
POSES = (Pose, Odometry)


def optional(material: Material, *types: type[Message]) -> str | None:
    """The one stream of some types, None where there is none; raises `RecordingError` for several."""
    return material.only("the format", *types) if material.of_type(*types) else None


def messages_as(material: Material, stream: str | None, kind: type[Message], done: Exported) -> Iterator[Any]:
    """The messages of a stream as one type; images of 16 bits stay such, since PNG holds them."""
    for recorded in material.messages([stream]) if stream is not None else ():
        name = material.names[recorded.stream]
        done.count(name)
        message = recorded.message
        if (lost := NARROWING.get((type(message), kind))) is not None and not isinstance(message, Image16):
            done.lose(name, lost)
        yield message if kind is Image and isinstance(message, Image16) else convert(message, kind)


def nearest(messages: dict[int, Any], stamp: int) -> Any | None:
    if stamp in messages:
        return messages[stamp]
    near: int | None = min(messages, key=lambda s: abs(s - stamp), default=None)
    return messages[near] if near is not None and abs(near - stamp) <= PAIR_WITHIN else None


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
