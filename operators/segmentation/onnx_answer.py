"""Answers of segmentation networks in ONNX files, and what these say of themselves: names, colours, normalisation."""

from __future__ import annotations

import ast
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.image.letterbox import Fit
from operators.inference import ModelError
from operators.network_input import Color, Labels, color
from operators.weights.network_file import KEY

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Told:
    """Labels, mean and deviation (shares of 1) from a model's metadata, each None where these do not tell."""

    labels: Labels | None
    mean: Triple | None
    std: Triple | None


def told(file: Path, metadata: Mapping[str, str]) -> Told:
    """Reads the metadata `names`, `palette`, `mean` and `std`, JSON or as Python writes it, and those of our training.

    `names` is a list, or a mapping from number to name (as Ultralytics exports it); `palette` has three numbers for
    each. Raises ModelError for an entry of another form.
    """
    names = _names(file, metadata)
    palette = _read(file, metadata, "palette")
    colors: dict[str, Color] = {}
    if palette is not None and names is not None:
        if not isinstance(palette, list) or len(palette) != len(names):
            raise ModelError(f"{file}: metadata 'palette' must be a list of {len(names)} colours, one for each name")
        colors = {name: color(file, name, values) for name, values in zip(names, palette, strict=True)}
    labels = None if names is None else Labels(names, colors)
    return Told(labels, _triple(file, metadata, "mean"), _triple(file, metadata, "std"))


def _names(file: Path, metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    names = _read(file, metadata, "names")
    if names is None and KEY in metadata:
        facts = _read(file, metadata, KEY)
        names = facts.get("classes") if isinstance(facts, dict) else None
    if isinstance(names, dict):
        numbered = {int(number): name for number, name in names.items() if str(number).isdecimal()}
        names = [numbered.get(k) for k in range(len(names))]
    if names is None:
        return None
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise ModelError(f"{file}: metadata 'names' must be a list of names, or a mapping from 0, 1, 2 ... to names")
    return tuple(names)


def _triple(file: Path, metadata: Mapping[str, str], key: str) -> Triple | None:
    values = _read(file, metadata, key)
    if values is None:
        return None
    if not isinstance(values, list) or len(values) != 3 or not all(isinstance(v, int | float) for v in values):
        raise ModelError(f"{file}: metadata {key!r} must be three numbers, red first, is {values}")
    return float(values[0]), float(values[1]), float(values[2])


def _read(file: Path, metadata: Mapping[str, str], key: str) -> Any:
    """Returns an entry as a value, None where there is none. Raises ModelError for text that is neither of the two."""
    if key not in metadata:
        return None
    text = metadata[key]
    for read in (json.loads, ast.literal_eval):
        with suppress(ValueError, SyntaxError):
            return read(text)
    raise ModelError(f"{file}: metadata {key!r} is neither JSON nor a Python literal: {text:.60}")


def scores_of(output: NDArray[Any], classes: int | None, probabilities: bool) -> NDArray[np.float32]:
    """Returns scores (C, H, W) of an output (1, C, H, W), or (1, H, W, C) where that alone fits so many classes.

    One channel is a class and what is not of it: two classes, the background first. Raises ValueError for another
    shape.
    """
    if output.ndim != 4 or output.shape[0] != 1 or 0 in output.shape:
        raise ValueError(f"scores have shape (1, classes, H, W) or (1, H, W, classes), got {output.shape}")
    last = classes is not None and output.shape[1] != classes == output.shape[3]
    scores = np.asarray(output[0].transpose(2, 0, 1) if last else output[0], np.float32)
    if len(scores) > 1:
        return scores
    return np.concatenate([1 - scores if probabilities else np.zeros_like(scores), scores])


def classes_of(output: NDArray[Any]) -> NDArray[np.int64]:
    """Returns classes (H, W) of an output of whole numbers, (H, W) with axes of extent 1. Raises ValueError."""
    extents = [extent for extent in output.shape if extent != 1]
    if len(extents) != 2:
        raise ValueError(f"a map of classes has shape (1, H, W), got {output.shape}")
    return output.reshape(extents).astype(np.int64)


def at_image(values: NDArray[Any], fit: Fit, interpolation: int) -> NDArray[Any]:
    """Returns the plane (H, W) of a network's output at the size of the image, without what was only padding.

    The plane covers the input, in whatever resolution.
    """
    if fit.inner != fit.target:
        if (values.shape[1], values.shape[0]) != fit.target:
            values = cv2.resize(values, fit.target, interpolation=interpolation)
        (x, y), (width, height) = fit.offset, fit.inner
        values = values[y : y + height, x : x + width]
    if (values.shape[1], values.shape[0]) == fit.image:
        return np.ascontiguousarray(values)
    return np.asarray(cv2.resize(np.ascontiguousarray(values), fit.image, interpolation=interpolation))


def best_of(scores: NDArray[np.float32], probabilities: bool) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Returns the best class (H, W) of scores (C, H, W), of equal ones the first, and its probability (H, W)."""
    best = scores.argmax(axis=0)
    highest = np.take_along_axis(scores, best[None], axis=0)[0]
    if probabilities:
        return best, np.clip(highest, 0, 1)
    return best, (1 / np.exp(scores - highest).sum(axis=0, dtype=np.float32)).astype(np.float32)
