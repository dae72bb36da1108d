"""Reads labelled images from a folder, in COCO or YOLO format by its files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from operators.detection.custom.coco_folder import find_annotations, read_coco
from operators.detection.custom.dataset import DataError, DetectionData, origin_of, split
from operators.detection.custom.yolo_folder import find_names, read_yolo


def read_detection_data(folder: Path, seed: int = 0) -> DetectionData:
    """Returns the data in a folder, whichever of the two formats it has.

    COCO: `annotations.json`, `instances_*.json` or `annotations/instances_*.json`, and the images. YOLO: `data.yaml`
    (or another `.yaml` with `names`) or `classes.txt`, with `images/` and `labels/`. Where the folder names no
    validation images, a share of the training images is set aside, chosen by `seed`.

    Raises DataError or FileNotFoundError.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"no data folder {str(folder)!r} (looked for {folder.absolute()})")
    if find_annotations(folder):
        data = read_coco(folder)
    elif find_names(folder) is not None:
        data = read_yolo(folder)
    else:
        held = ", ".join(sorted(p.name for p in folder.iterdir())[:8]) or "nothing"
        raise DataError(
            f"{folder} is neither COCO (annotations.json or instances_*.json) nor YOLO (data.yaml with `names`, or "
            f"classes.txt, with images/ and labels/); it holds {held}"
        )
    if not any(len(image.boxes) for image in data.training):
        raise DataError(f"{folder}: none of the {len(data.training)} training images has a label")
    data = replace(data, origin=origin_of(folder))
    return data if data.validation else split(data, seed)
