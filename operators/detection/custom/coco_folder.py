"""Reads a folder in COCO format: JSON of images, categories and annotations with `bbox` [x, y, w, h] in pixels."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from operators.detection.custom.dataset import DataError, DetectionData, LabelledImage, labelled, read_utf8

_PATTERNS = (
    "annotations.json",
    "_annotations.coco.json",
    "instances*.json",
    "annotations/annotations.json",
    "annotations/instances*.json",
    "*/_annotations.coco.json",
    "*/annotations.json",
)
_VALIDATION = ("val", "valid", "validation")
_UNUSED = ("test",)
_OUTSIDE = 2.0  # pixels that a box may reach over the border: labelling tools round


def find_annotations(folder: Path) -> list[Path]:
    """The annotation files of a folder."""
    return sorted({file for pattern in _PATTERNS for file in folder.glob(pattern)})


def read_coco(folder: Path) -> DetectionData:
    """Files with `val` or `valid` in their name or folder are for validation, those with `test` are left alone.

    An annotation with `iscrowd` or `ignore` set is one that is neither to be found nor wrong to find. Raises DataError.
    """
    files = {file: _split(file, folder) for file in find_annotations(folder)}
    contents = {file: _read_json(file) for file, split in files.items() if split != "test"}
    if not contents:
        raise DataError(f"{folder} has only annotations for a test: {', '.join(f.name for f in files)}")
    names = _merged_names(contents)
    images: dict[str, list[LabelledImage]] = {"train": [], "val": []}
    notes = []
    for file, content in contents.items():
        images[files[file]] += _images(folder, file, content, names)
        if flat := [annotation.get("id") for annotation in content["annotations"] if _is_flat(annotation)]:
            some = ", ".join(map(str, flat[:10]))
            notes.append(f"{file.name}: {len(flat)} boxes without width or height left out (id {some})")
    if not images["train"]:
        images = {"train": images["val"], "val": []}
    return DetectionData(names, tuple(images["train"]), tuple(images["val"]), tuple(notes))


def _split(file: Path, folder: Path) -> str:
    words = set("_".join(file.relative_to(folder).with_suffix("").parts).lower().replace("-", "_").split("_"))
    words |= {word.rstrip("0123456789") for word in words}
    if words & set(_VALIDATION):
        return "val"
    return "test" if words & set(_UNUSED) else "train"


def _read_json(file: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(read_utf8(file))
    except json.JSONDecodeError as error:
        raise DataError(f"{file}:{error.lineno}: not valid JSON: {error.msg}") from None
    for key in ("images", "categories", "annotations"):
        if not isinstance(content, dict) or not isinstance(content.get(key), list):
            raise DataError(f"{file} has no list {key!r}; a COCO file has images, categories and annotations")
        for k, entry in enumerate(content[key]):
            if not isinstance(entry, dict):
                raise DataError(f"{file}: {key}[{k}] is {entry!r}; it should be an object with an `id`")
    return dict(content)


def _merged_names(contents: Mapping[Path, Mapping[str, Any]]) -> tuple[str, ...]:
    """Class names by falling use of the first file's category order; every file must agree on the names."""
    names: dict[str, None] = {}
    for file, content in contents.items():
        for k, category in enumerate(content["categories"]):
            if not isinstance(category.get("id"), int) or not category.get("name"):
                raise DataError(
                    f"{file}: categories[{k}] is {category!r}; it should have an `id` (an integer) and a `name`"
                )
        for category in sorted(content["categories"], key=lambda c: int(c["id"])):
            names.setdefault(str(category["name"]))
    used = {
        str(category["name"])
        for content in contents.values()
        for category in content["categories"]
        if any(a.get("category_id") == category["id"] for a in content["annotations"])
    }
    # Exports often carry a super-category as an unused first class; classes without one object cannot be learnt.
    return tuple(name for name in names if name in used) or tuple(names)


def _images(folder: Path, file: Path, content: Mapping[str, Any], names: Sequence[str]) -> list[LabelledImage]:
    number = {c["id"]: names.index(str(c["name"])) for c in content["categories"] if str(c["name"]) in names}
    sizes: dict[Any, tuple[int, int]] = {}
    for k, image in enumerate(content["images"]):
        sizes[image.get("id")] = _size(file, k, image)
    rows: dict[Any, list[tuple[list[float], int, bool]]] = {key: [] for key in sizes}
    for k, annotation in enumerate(content["annotations"]):
        where = f"{file}: annotations[{k}] (id {annotation.get('id')})"
        key = annotation.get("image_id")
        if not isinstance(key, (int, str)) or key not in sizes:
            raise DataError(f"{where}: image_id {key!r} is not among the images")
        label = annotation.get("category_id")
        if not isinstance(label, int) or label not in number:
            raise DataError(f"{where}: category_id {label!r} is not among the categories {sorted(number)}")
        if _is_flat(annotation):
            continue
        ignored = bool(annotation.get("iscrowd") or annotation.get("ignore"))
        rows[key].append((_box(where, annotation.get("bbox"), sizes[key]), number[label], ignored))
    return [
        labelled(_locate(folder, file, str(image["file_name"])), *_columns(rows[image["id"]]), sizes[image["id"]])
        for image in content["images"]
    ]


def _columns(rows: list[tuple[list[float], int, bool]]) -> tuple[list[list[float]], list[int], list[bool]]:
    return [r[0] for r in rows], [r[1] for r in rows], [r[2] for r in rows]


def _size(file: Path, index: int, image: Mapping[str, Any]) -> tuple[int, int]:
    width, height = image.get("width"), image.get("height")
    whole = isinstance(width, int) and isinstance(height, int) and width > 0 and height > 0
    if not isinstance(image.get("id"), (int, str)) or not image.get("file_name") or not whole:
        raise DataError(f"{file}: images[{index}] needs `id`, `file_name`, `width` and `height` (pixels), is {image!r}")
    return int(image["width"]), int(image["height"])


def _box(where: str, box: Any, size: tuple[int, int]) -> list[float]:
    right = "it should be [x, y, width, height] in pixels"
    if not isinstance(box, list) or len(box) != 4 or not all(map(_is_number, box)):
        raise DataError(f"{where}: bbox is {box!r}; {right}")
    x, y, w, h = map(float, box)
    if not (w > 0 and h > 0):
        raise DataError(f"{where}: bbox {box!r} has no area; {right}")
    if min(x, y) < -_OUTSIDE or x + w > size[0] + _OUTSIDE or y + h > size[1] + _OUTSIDE:
        raise DataError(f"{where}: bbox {box!r} reaches over the image of {size[0]}x{size[1]} pixels; {right}")
    return [x / size[0], y / size[1], (x + w) / size[0], (y + h) / size[1]]


def _is_flat(annotation: Mapping[str, Any]) -> bool:
    """Returns whether a box has no width or no height, as two of COCO's own have: nothing can be learnt from it."""
    box = annotation.get("bbox")
    if not isinstance(box, list) or len(box) != 4 or not all(map(_is_number, box)):
        return False
    return bool(min(box[2:]) == 0)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def _locate(folder: Path, annotations: Path, name: str) -> Path:
    stem = annotations.stem.removeprefix("instances_")
    places = (annotations.parent, folder, folder / "images", folder / stem, folder / "images" / stem)
    for place in places:
        if (place / name).is_file():
            return place / name
    looked = ", ".join(dict.fromkeys(str(place) for place in places))
    raise DataError(f"{annotations}: no image {name!r} (looked in {looked})")
