"""Labelled images for training and validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

ORIGIN = "origin.txt"
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")
_VALIDATION_SHARE = 0.15


class DataError(ValueError):
    """Training data that cannot be used: names file and line, what is wrong and what would be right."""


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image file and the objects in it.

    `boxes` (N, 4) float32: x1, y1, x2, y2 as shares of the image's width and height. `classes` (N,) int32. `ignored`
    (N,) bool: objects that are neither to be found nor wrong to find (crowds, objects hidden too much to be fair).
    `size` is the (width, height) that the labels claim, where they do.
    """

    file: Path
    boxes: NDArray[np.float32]
    classes: NDArray[np.int32]
    ignored: NDArray[np.bool_]
    size: tuple[int, int] | None = None

    def read(self) -> NDArray[np.uint8]:
        """The pixels (H, W, 3), RGB. Raises DataError where the file is no image or not of the labelled size."""
        pixels = read_image(self.file)
        size = (pixels.shape[1], pixels.shape[0])
        if self.size is not None and self.size != size:
            raise DataError(
                f"{self.file} is {size[0]}x{size[1]}, but its labels are for {self.size[0]}x{self.size[1]} pixels"
            )
        return pixels.astype(np.uint8, copy=False)


@dataclass(frozen=True, eq=False)
class DetectionData:
    """Class names, images to train on and images to score on; `notes` lists the assumptions made in reading
    them, `origin` is their producer (see `origin_of`)."""

    classes: tuple[str, ...]
    training: tuple[LabelledImage, ...]
    validation: tuple[LabelledImage, ...]
    notes: tuple[str, ...] = ()
    origin: str = ""

    def only(self, names: Sequence[str]) -> DetectionData:
        """The data with these classes alone, numbered in this order; objects of other classes become background.

        Raises DataError for a name that the data do not have.
        """
        unknown = [name for name in names if name not in self.classes]
        if unknown:
            raise DataError(f"the data have no class {unknown[0]!r}; their classes: {', '.join(self.classes)}")
        number = np.full(len(self.classes), -1, np.int32)
        number[[self.classes.index(name) for name in names]] = np.arange(len(names))

        def chosen(image: LabelledImage) -> LabelledImage:
            keep = number[image.classes] >= 0
            return replace(
                image, boxes=image.boxes[keep], classes=number[image.classes[keep]], ignored=image.ignored[keep]
            )

        return replace(
            self,
            classes=tuple(names),
            training=tuple(map(chosen, self.training)),
            validation=tuple(map(chosen, self.validation)),
        )


def read_image(file: Path, how: int = cv2.IMREAD_COLOR_RGB) -> NDArray[Any]:
    """The pixels (H, W, 3), RGB, of an image file, or as OpenCV's flag `how` has them. Raises DataError."""
    found = cv2.imread(str(file), how)
    if found is None:
        raise DataError(f"{file} cannot be read as an image")
    return found


def origin_of(folder: Path) -> str:
    """Returns the producer of a data folder's images from its file origin.txt (`simulator`); '' without the file."""
    file = folder / ORIGIN
    return read_utf8(file).strip() if file.is_file() else ""


def split(data: DetectionData, seed: int) -> DetectionData:
    """Sets a share of the training images aside for validation."""
    images = data.training
    if len(images) < 2:
        note = "one image only: it serves for training and validation, so the score means little"
        return replace(data, validation=images, notes=(*data.notes, note))
    count = max(1, round(len(images) * _VALIDATION_SHARE))
    aside = set(np.random.default_rng(seed).permutation(len(images))[:count].tolist())
    return replace(
        data,
        training=tuple(image for i, image in enumerate(images) if i not in aside),
        validation=tuple(image for i, image in enumerate(images) if i in aside),
        notes=(*data.notes, f"no validation images are named: {count} of {len(images)} were set aside by seed {seed}"),
    )


def read_utf8(file: Path) -> str:
    """The text of a file. Raises DataError where it is not UTF-8."""
    raw = file.read_bytes()
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise DataError(f"{file}:{line}: byte 0x{raw[error.start]:02x} is not UTF-8; save the file as UTF-8") from None


def labelled(
    file: Path,
    boxes: Sequence[Sequence[float]],
    classes: Sequence[int],
    ignored: Sequence[bool] | None = None,
    size: tuple[int, int] | None = None,
) -> LabelledImage:
    """A labelled image from plain lists, its boxes cut at the border of the image."""
    return LabelledImage(
        file,
        np.clip(np.array(boxes, np.float32).reshape(-1, 4), 0, 1),
        np.array(classes, np.int32),
        np.zeros(len(boxes), np.bool_) if ignored is None else np.array(ignored, np.bool_),
        size,
    )
