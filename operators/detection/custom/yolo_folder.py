"""Reads a folder in YOLO format: a text file of `class cx cy w h` rows for each image, all as shares of its size."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from operators.detection.custom.dataset import (
    IMAGE_SUFFIXES,
    DataError,
    DetectionData,
    LabelledImage,
    labelled,
    read_utf8,
)

_NAME_LISTS = ("classes.txt", "labels/classes.txt", "obj.names")
_VALIDATION = ("val", "valid", "validation")
_TOLERANCE = 1e-3  # boxes that tools round to just outside of the image


def find_names(folder: Path) -> Path | None:
    """The file that names the classes: a YAML file with `names`, or a list; None where there is neither."""
    for file in sorted([*folder.glob("*.yaml"), *folder.glob("*.yml")], key=lambda f: (f.stem != "data", f.name)):
        if "names" in _read_yaml(file):
            return file
    return next((folder / name for name in _NAME_LISTS if (folder / name).is_file()), None)


def read_yolo(folder: Path) -> DetectionData:
    """Raises DataError for what cannot be read, with file and line."""
    source = find_names(folder)
    if source is None:
        raise DataError(f"{folder} has no data.yaml with `names` and no classes.txt")
    settings = _read_yaml(source) if source.suffix in (".yaml", ".yml") else {}
    names = _names(source, settings)
    notes: list[str] = []
    training = list(_images(folder, source, settings, ("train",), notes))
    validation = list(_images(folder, source, settings, _VALIDATION, notes))
    if not training:
        raise DataError(f"{folder}: no image ({', '.join(IMAGE_SUFFIXES)}) under images/ or where {source.name} points")
    held_out = set(validation)
    if held_out.issuperset(training):
        notes.append(
            f"{source.name} names the images to train on for validation too: the score means little for new images"
        )
    else:
        training = [file for file in training if file not in held_out]
    images = {file: _labelled(file, len(names), source) for file in sorted({*training, *validation})}
    return DetectionData(
        names,
        tuple(images[file] for file in training),
        tuple(images[file] for file in validation),
        (*notes, *_unpaired(images)),
    )


def read_rows(file: Path, classes: int, names_file: Path) -> tuple[list[list[float]], list[int]]:
    """Boxes (x1, y1, x2, y2, shares) and classes of a label file; polygon rows become their bounding boxes."""
    boxes: list[list[float]] = []
    labels: list[int] = []
    for number, line in _lines(file):
        where = f"{file}:{number}: {line[:60]!r}"
        try:
            label, *values = (float(word) for word in line.split())
        except ValueError:
            raise DataError(f"{where} is not a row of numbers; it should be `class cx cy w h`") from None
        if label not in range(classes):
            raise DataError(
                f"{where}: class {label:g} is not one of the {classes} classes (0 to {classes - 1}) of {names_file}"
            )
        boxes.append(_box(values, where))
        labels.append(int(label))
    return boxes, labels


def _box(values: Sequence[float], where: str) -> list[float]:
    if len(values) == 4:
        x, y, w, h = values
        if not (w > 0 and h > 0):
            raise DataError(f"{where}: width and height must be positive, got {w:g} and {h:g}")
        box = [x - w / 2, y - h / 2, x + w / 2, y + h / 2]
        centred = 0 <= x <= 1 and 0 <= y <= 1 and max(w, h) <= 1 + _TOLERANCE
    elif len(values) >= 6 and len(values) % 2 == 0:
        box = [min(values[::2]), min(values[1::2]), max(values[::2]), max(values[1::2])]
        centred = box[2] > box[0] and box[3] > box[1] and all(map(math.isfinite, values))
        centred = centred and min(box) >= -_TOLERANCE and max(box) <= 1 + _TOLERANCE
    else:
        raise DataError(
            f"{where} has {len(values) + 1} numbers; a row is `class cx cy w h` or `class x1 y1 x2 y2 x3 y3 ...`"
        )
    if not centred:
        raise DataError(f"{where}: coordinates are shares of the image's width and height, so they lie in [0, 1]")
    return box


def _labelled(image: Path, classes: int, names_file: Path) -> LabelledImage:
    file = label_file(image)
    boxes, labels = read_rows(file, classes, names_file) if file.is_file() else ([], [])
    return labelled(image, boxes, labels)


def label_file(image: Path) -> Path:
    """Returns where the labels of an image lie: the last `images` of its path is `labels`, else beside it."""
    parts = list(image.parts)
    for i in range(len(parts) - 2, -1, -1):
        if parts[i] == "images":
            parts[i] = "labels"
            break
    return Path(*parts).with_suffix(".txt")


def _unpaired(images: Iterable[Path]) -> Iterable[str]:
    """Notes on images without labels and on labels without an image."""
    bare = [image for image in images if not label_file(image).is_file()]
    if bare:
        yield f"{len(bare)} images have no label file and count as background; the first is {bare[0]}"
    # Only folders separate from the images hold nothing but labels.
    folders = {label_file(i).parent: i.parent for i in images if label_file(i).parent != i.parent}
    orphans = []
    for labels, pictures in sorted(folders.items()):
        known = {f.stem for f in pictures.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES} | {"classes"}
        orphans += sorted(f for f in labels.glob("*.txt") if f.stem not in known)
    if orphans:
        yield f"{len(orphans)} label files have no image and are left out; the first is {orphans[0]}"


def _images(
    folder: Path, source: Path, settings: Mapping[str, Any], splits: Sequence[str], notes: list[str]
) -> Iterable[Path]:
    """The image files of a split, sorted."""
    key = next((s for s in splits if settings.get(s)), None)
    found: list[Path] = []
    if key is not None:
        places = settings[key] if isinstance(settings[key], list) else [settings[key]]
        base = _base(folder, settings)
        for place in places:
            found += _at(base, folder, str(place), source, key)
        if found:
            return sorted(set(found))
        if key not in ("train",):
            return []
    for split in splits:
        for place in (folder / "images" / split, folder / split / "images"):
            found += _in_folder(place)
    if not found and "train" in splits:
        found = _in_folder(folder / "images")
        if found and key is not None:
            notes.append(f"{source.name} names {settings[key]!r} for {key}, which is not there: images/ is used")
    return sorted(set(found))


def _base(folder: Path, settings: Mapping[str, Any]) -> Path:
    """The folder that the YAML's paths are relative to; `path` is often one of another machine."""
    named = folder / str(settings.get("path") or ".")
    return named if named.is_dir() else folder


def _at(base: Path, folder: Path, place: str, source: Path, key: str) -> list[Path]:
    """Images of a folder, or listed in a text file. Exports often write `../train/images` for `train/images`."""
    for candidate in (base / place, folder / place, folder / place.removeprefix("../")):
        if candidate.is_dir():
            return _in_folder(candidate)
        if candidate.suffix == ".txt" and candidate.is_file():
            return [_listed(candidate, n, line) for n, line in _lines(candidate)]
    return []


def _listed(file: Path, number: int, line: str) -> Path:
    for candidate in (Path(line), file.parent / line):
        if candidate.is_file():
            return candidate
    raise DataError(f"{file}:{number}: no image {line!r} (relative to {file.parent.absolute()})")


def _lines(file: Path) -> Iterable[tuple[int, str]]:
    """The lines that are not empty, stripped, each with its number from 1."""
    for number, line in enumerate(read_utf8(file).splitlines(), 1):
        if line.strip():
            yield number, line.strip()


def _in_folder(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(f for f in folder.rglob("*") if f.suffix.lower() in IMAGE_SUFFIXES and f.is_file())


def _names(source: Path, settings: Mapping[str, Any]) -> tuple[str, ...]:
    if not settings:
        names = [line for _, line in _lines(source)]
    else:
        given = settings["names"] or []
        if isinstance(given, Mapping):
            numbered = {str(k): name for k, name in given.items()}
            if set(numbered) != set(map(str, range(len(given)))):
                raise DataError(f"{source}: `names` must be numbered 0 to {len(given) - 1}, got {list(given)}")
            given = [numbered[str(i)] for i in range(len(given))]
        elif not isinstance(given, list):
            raise DataError(f"{source}: `names` is {given!r}; it should be a list, such as [{given}]")
        names = [str(name) for name in given]
        if settings.get("nc", len(names)) != len(names):
            raise DataError(f"{source}: `nc` is {settings['nc']!r}, but `names` has {len(names)}; they should agree")
    if not names:
        raise DataError(f"{source} names no class")
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DataError(f"{source} names the class {twice!r} twice")
    return tuple(names)


def _read_yaml(file: Path) -> Mapping[str, Any]:
    try:
        found = YAML(typ="safe").load(read_utf8(file))
    except YAMLError as error:
        raise DataError(f"{file} is not valid YAML: {error}") from None
    return found if isinstance(found, Mapping) else {}
