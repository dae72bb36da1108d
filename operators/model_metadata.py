"""Class names, colours and normalisation from the metadata of ONNX files."""

from __future__ import annotations

import ast
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from operators.inference import ModelError
from operators.network_input import Color, Labels, color
from operators.weights.network_file import KEY

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class ImageMetadata:
    """Labels, mean and deviation (shares of 1) from a model's metadata, each None where it is missing."""

    labels: Labels | None
    mean: Triple | None
    std: Triple | None


def told(file: Path, metadata: Mapping[str, str]) -> ImageMetadata:
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
    return ImageMetadata(labels, _triple(file, metadata, "mean"), _triple(file, metadata, "std"))


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
