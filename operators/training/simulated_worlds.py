"""A data folder rendered from simulated worlds: images, class masks and COCO boxes, for both networks.

Each world is drawn from a seed of its own; a few images are taken from each, far apart in time, with varied cameras.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dataflow.messages import Detections2D, Image, SegmentationMap
from operators.sources.simulated_robot import SimulatedRobot
from operators.sources.simulator.classes import CLASSES, THINGS
from operators.sources.simulator.worlds import NAMES

STORED = (320, 240)
"""Width and height of what is stored; what the networks take."""
VGA = (640, 480)
LEAST_VISIBLE, LEAST_PIXELS = 0.3, 30
"""Objects shown less, or smaller in the stored image, are to be ignored in training."""
_SECONDS = 60


@dataclass(frozen=True)
class WorldImage:
    """One rendered image with the truth about it."""

    world: str
    seed: int
    image: Image
    objects: Detections2D
    masks: SegmentationMap


def render(world: str, seed: int, frames: int, size: tuple[int, int], *, varied: bool) -> Iterator[WorldImage]:
    """Images of a world, evenly spread over a minute. `varied` draws lens, light and noise by the seed."""
    rng = np.random.default_rng((seed, 7))
    camera: dict[str, Any] = {"rate": frames / _SECONDS, "width": size[0], "height": size[1]}
    if varied:
        camera |= {
            "focal": float(rng.uniform(0.7, 1.0)),
            "exposure": float(rng.uniform(0.7, 1.35)),
            "read_noise": float(rng.uniform(0.5, 4)),
            "phase": int(rng.uniform(0, 0.5) * 1e9 * _SECONDS / frames),
        }
    robot = SimulatedRobot(
        world=world,
        seed=seed,
        duration=f"{_SECONDS}s",
        color_camera=camera,
        depth_camera={"rate": 0},
        truth={"poses": 0, "relations": 0, "activities": 0, "masks": True},
    )
    robot.setup()
    try:
        for messages in robot.stream():
            image, objects, masks = messages.get("image"), messages.get("objects"), messages.get("masks")
            if isinstance(image, Image) and isinstance(objects, Detections2D) and isinstance(masks, SegmentationMap):
                yield WorldImage(world, seed, image, objects, masks)
    finally:
        robot.close()


def worlds(first_seed: int, count: int, names: Sequence[str] = NAMES) -> list[tuple[str, int]]:
    """`count` worlds (name, seed), the kinds in turn."""
    return [(names[k % len(names)], first_seed + k) for k in range(count)]


def write_data(
    folder: Path, training: Sequence[tuple[str, int]], validation: Sequence[tuple[str, int]], frames: int
) -> Iterator[tuple[int, int]]:
    """Renders worlds into a data folder; yields (worlds done, images written) after each.

    Worlds of even seeds are rendered at VGA and stored at half the size, as the operators shrink a VGA image; the
    others at the stored size. Worlds that are already there are kept, so an interrupted rendering goes on.
    """
    for name in ("images", "masks", "boxes", "annotations"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / "classes.txt").write_text("\n".join(CLASSES) + "\n", encoding="utf-8")
    written = 0
    for k, (world, seed) in enumerate([*training, *validation]):
        rows = folder / "boxes" / f"{world}_{seed}.json"
        if not rows.is_file():
            images = [
                _store(folder, f"{world}_{seed}_{i:02d}", taken)
                for i, taken in enumerate(render(world, seed, frames, STORED if seed % 2 else VGA, varied=True))
            ]
            rows.write_text(json.dumps(images), encoding="utf-8")
        written += len(json.loads(rows.read_text(encoding="utf-8")))
        yield k + 1, written
    for split, chosen in (("train", training), ("val", validation)):
        _write_annotations(folder, split, chosen)
    held_out = [image["file_name"] for world, seed in validation for image in _images(folder, world, seed)]
    (folder / "val.txt").write_text("\n".join(held_out) + "\n", encoding="utf-8")


def _store(folder: Path, stem: str, taken: WorldImage) -> dict[str, Any]:
    pixels, classes = taken.image.data, taken.masks.classes.astype(np.uint8)
    scale = STORED[0] / taken.image.width
    if scale != 1:
        pixels = np.asarray(cv2.resize(pixels, STORED, interpolation=cv2.INTER_LINEAR), np.uint8)
        classes = np.asarray(cv2.resize(classes, STORED, interpolation=cv2.INTER_NEAREST), np.uint8)
    cv2.imwrite(
        str(folder / "images" / f"{stem}.jpg"),
        cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR),
        [cv2.IMWRITE_JPEG_QUALITY, 92],
    )
    cv2.imwrite(str(folder / "masks" / f"{stem}.png"), classes)
    found = taken.objects
    visible = found.visible if found.visible is not None else np.ones(found.count, np.float32)
    pixel_counts = found.pixel_counts if found.pixel_counts is not None else np.zeros(found.count, np.int64)
    annotations = []
    for box, label, share, pixel_count in zip(
        (found.boxes * scale).tolist(), found.class_ids.tolist(), visible.tolist(), pixel_counts.tolist(), strict=True
    ):
        count = pixel_count * scale**2
        annotations.append(
            {
                "category_id": label,
                "bbox": [box[0], box[1], box[2] - box[0], box[3] - box[1]],
                "ignore": int(share < LEAST_VISIBLE or count < LEAST_PIXELS),
                "visible": round(share, 3),
                "pixels": round(count, 1),
            }
        )
    return {"file_name": f"{stem}.jpg", "annotations": annotations}


def _images(folder: Path, world: str, seed: int) -> list[dict[str, Any]]:
    return list(json.loads((folder / "boxes" / f"{world}_{seed}.json").read_text(encoding="utf-8")))


def _write_annotations(folder: Path, split: str, chosen: Sequence[tuple[str, int]]) -> None:
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for world, seed in chosen:
        for image in _images(folder, world, seed):
            images.append({"id": len(images), "file_name": image["file_name"], "width": STORED[0], "height": STORED[1]})
            for row in image["annotations"]:
                annotations.append({"id": len(annotations), "image_id": images[-1]["id"], **row})
    content = {
        "images": images,
        "categories": [{"id": k, "name": name} for k, name in enumerate(THINGS)],
        "annotations": annotations,
    }
    (folder / "annotations" / f"instances_{split}.json").write_text(json.dumps(content), encoding="utf-8")
