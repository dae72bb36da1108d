"""Images with a class for every pixel, read from a folder: `images/`, `masks/` and `classes.txt`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.detection.custom.dataset import IMAGE_SUFFIXES, DataError, origin_of, read_image, read_utf8
from operators.learning.augmentation import NONE, Variation, fitted, recolored, varied, warp

VOID = 255
_MASKS = ("masks", "annotations", "labels")
_VALIDATION_SHARE = 0.15


@dataclass(frozen=True)
class MaskedImage:
    """An image file and its mask: a grey PNG of the same size whose values are class ids, 255 for no class."""

    image: Path
    mask: Path

    def pixels(self) -> NDArray[np.uint8]:
        """Pixels (H, W, 3), RGB. Raises DataError."""
        return read_image(self.image)

    def read(self, classes: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Pixels (H, W, 3), RGB, and class ids (H, W). Raises DataError."""
        pixels, mask = self.pixels(), read_image(self.mask, cv2.IMREAD_UNCHANGED)
        if mask.ndim != 2 or mask.dtype != np.uint8:
            raise DataError(f"{self.mask} is {mask.dtype}{list(mask.shape)}; a mask is an 8-bit grey PNG of class ids")
        if mask.shape != pixels.shape[:2]:
            raise DataError(f"{self.mask} is {mask.shape[1]}x{mask.shape[0]}, its image {self.image} is not")
        wrong = mask[(mask >= classes) & (mask != VOID)]
        if wrong.size:
            raise DataError(
                f"{self.mask}: class id {wrong[0]} in {wrong.size} pixels; there are {classes} classes (0 to "
                f"{classes - 1}), and 255 is void"
            )
        return pixels, mask

    def view(
        self, classes: int, size: tuple[int, int], variation: Variation, rng: np.random.Generator | None
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """A random view of pixels and mask, of `size` (width, height); without `rng` as they are, fitted into it."""
        pixels, mask = self.read(classes)
        variation = NONE if rng is None else variation
        rng = np.random.default_rng(0) if rng is None else rng
        affine = varied(fitted((pixels.shape[1], pixels.shape[0]), size), size, variation, rng)
        seen = warp(mask, affine, size, border=VOID, labels=True)
        return recolored(warp(pixels, affine, size), variation, rng), seen


@dataclass(frozen=True)
class SegmentationData:
    """Class names, images to train on and images to score on; `notes` holds the assumptions of reading them, `origin`
    what made them (see `origin_of`)."""

    classes: tuple[str, ...]
    training: tuple[MaskedImage, ...]
    validation: tuple[MaskedImage, ...]
    notes: tuple[str, ...] = ()
    origin: str = ""


def read_segmentation_data(folder: Path, seed: int = 0) -> SegmentationData:
    """`images/` (or `images/train` and `images/val`), masks of the same names in `masks/`, names in `classes.txt`.

    A split file `val.txt` may name the validation images (one file name a line); without any, a share is set aside by
    `seed`. Raises DataError or FileNotFoundError.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"no data folder {str(folder)!r} (looked for {folder.absolute()})")
    names_file = folder / "classes.txt"
    if not names_file.is_file():
        raise DataError(f"{folder} has no classes.txt; it should name the classes 0, 1, 2 ... one a line")
    names = tuple(line.strip() for line in read_utf8(names_file).splitlines() if line.strip())
    masks = next((folder / name for name in _MASKS if (folder / name).is_dir()), None)
    if masks is None or not (folder / "images").is_dir():
        raise DataError(f"{folder} should hold the folders images/ and masks/")
    files = sorted(f for f in (folder / "images").rglob("*") if f.suffix.lower() in IMAGE_SUFFIXES)
    pairs = [MaskedImage(f, _mask(masks / f.relative_to(folder / "images"))) for f in files]
    if not names or not pairs:
        raise DataError(f"{folder} has {len(names)} classes in classes.txt and {len(pairs)} images in images/")
    return _divided(folder, names, pairs, seed)


def _mask(place: Path) -> Path:
    file = place.with_suffix(".png")
    if not file.is_file():
        raise DataError(f"no mask {file} for the image {place.name}")
    return file


def _divided(folder: Path, names: tuple[str, ...], pairs: list[MaskedImage], seed: int) -> SegmentationData:
    listed = folder / "val.txt"
    held_out: set[str] = set()
    if listed.is_file():
        held_out = {line.strip() for line in read_utf8(listed).splitlines() if line.strip()}
        unknown = held_out - {p.image.name for p in pairs}
        if unknown:
            raise DataError(f"{listed} names {min(unknown)!r}, which is not in images/")
    validation = [p for p in pairs if p.image.name in held_out or p.image.parent.name in ("val", "valid")]
    notes: tuple[str, ...] = ()
    if not validation:
        count = max(1, round(len(pairs) * _VALIDATION_SHARE))
        chosen = np.random.default_rng(seed).permutation(len(pairs))[:count]
        validation = [pairs[i] for i in sorted(chosen)]
        notes = (f"no validation images are named: {count} of {len(pairs)} were set aside by seed {seed}",)
    training = [p for p in pairs if p not in validation]
    if not training:
        training = validation
        notes = (*notes, "all images are for validation: they are trained on too, so the score means little")
    return SegmentationData(names, tuple(training), tuple(validation), notes, origin_of(folder))
