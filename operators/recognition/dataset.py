"""Images sorted into folders by class: `FOLDER/class/*.jpg`, or `train/` and `val/` with such folders in each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from operators.detection.custom.dataset import IMAGE_SUFFIXES, DataError, read_image

_TRAINING, _VALIDATION = ("train", "training"), ("val", "valid", "validation")
_SHARE = 0.15


@dataclass(frozen=True)
class LabelledImage:
    """An image file and its class id."""

    file: Path
    label: int

    def read(self) -> NDArray[np.uint8]:
        """Pixels (H, W, 3), RGB. Raises DataError."""
        return np.asarray(read_image(self.file), np.uint8)


@dataclass(frozen=True)
class ClassificationData:
    """Class names, images to train on and images to score on; `notes` lists the assumptions made."""

    classes: tuple[str, ...]
    training: tuple[LabelledImage, ...]
    validation: tuple[LabelledImage, ...]
    notes: tuple[str, ...] = ()


def read_classification_data(folder: Path, seed: int = 0) -> ClassificationData:
    """Reads a folder of class folders. Without `train/` and `val/`, a share of every class is set aside by `seed`.

    Raises DataError or FileNotFoundError.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"no data folder {str(folder)!r} (looked for {folder.absolute()})")
    train = next((folder / name for name in _TRAINING if (folder / name).is_dir()), None)
    val = next((folder / name for name in _VALIDATION if (folder / name).is_dir()), None)
    if (train is None) != (val is None):
        there, missing = ("train/", "val/") if val is None else ("val/", "train/")
        raise DataError(f"{folder} has {there} but no {missing}; it should have both, or class folders alone")
    classes = tuple(sorted(f.name for f in (train or folder).iterdir() if f.is_dir() and not f.name.startswith(".")))
    if len(classes) < 2:
        raise DataError(f"{train or folder} should hold a folder of images for each of two classes at least, has "
                        f"{', '.join(classes) or 'none'}")  # fmt: skip
    if train is not None and val is not None:
        strange = sorted({f.name for f in val.iterdir() if f.is_dir()} - set(classes))
        if strange:
            raise DataError(f"{val / strange[0]} is a class that {train} does not have")
        return ClassificationData(classes, _images(train, classes), _images(val, classes, allow_empty=True))
    rng = np.random.default_rng(seed)
    training: list[LabelledImage] = []
    validation: list[LabelledImage] = []
    images = _images(folder, classes)
    for label in range(len(classes)):
        own = [image for image in images if image.label == label]
        count = max(1, round(len(own) * _SHARE)) if len(own) > 1 else 0
        chosen = set(rng.permutation(len(own))[:count].tolist())
        validation += [image for i, image in enumerate(own) if i in chosen]
        training += [image for i, image in enumerate(own) if i not in chosen]
    note = f"no validation images are named: {len(validation)} of {len(images)} were set aside by seed {seed}"
    return ClassificationData(classes, tuple(training), tuple(validation), (note,))


def _images(folder: Path, classes: tuple[str, ...], *, allow_empty: bool = False) -> tuple[LabelledImage, ...]:
    found = []
    for label, name in enumerate(classes):
        place = folder / name
        files = sorted(f for f in place.rglob("*") if f.suffix.lower() in IMAGE_SUFFIXES) if place.is_dir() else []
        if not files and not allow_empty:
            raise DataError(f"{place} holds no image ({', '.join(sorted(IMAGE_SUFFIXES))})")
        found += [LabelledImage(file, label) for file in files]
    return tuple(found)
