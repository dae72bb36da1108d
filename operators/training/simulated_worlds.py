"""A data folder rendered from simulated worlds: images, class masks and COCO boxes, for both networks.

Each world is drawn from a separate seed; a few images are taken from each, far apart in time, with varied cameras.

python -m operators.training.simulated_worlds DATA [--worlds 480] [--first-seed 10000] [--validation 10] [--frames 10]
                                             [--processes 1]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track

from dataflow.messages import Detections2D, Image, SegmentationMap
from operators.detection.custom.dataset import ORIGIN
from operators.simulator.classes import CLASSES, THINGS
from operators.simulator.robot import SimulatedRobot
from operators.simulator.worlds.make import INDOOR
from operators.weights.network_file import SIMULATOR

VGA, QVGA = (640, 480), (320, 240)
"""Width and height of the images: of worlds with even seeds, of the others."""
LEAST_VISIBLE, LEAST_PIXELS = 0.3, 30
"""Objects shown less, or smaller in an image of 320x240, are to be ignored in training."""
TRAINING, VALIDATION, HELD_OUT = 10_000, 20_000, 30_000
"""First seeds; every world has the next one. Networks are judged on worlds that nothing was chosen by."""
KINDS = ("office", "table_top", "corridor", "office", "table_top")
"""Corridors show few objects, so fewer of them are rendered."""
FOCALS, FOCAL = (0.45, 1.3), 0.85
"""Focal lengths to train on, from and to, and that of a camera as it comes; shares of the image's width."""
_SECONDS = 60
_QUALITIES = (92, 92, 85, 85, 78, 78)  # of the stored JPEGs; two seeds, VGA and 320x240, share one


@dataclass(frozen=True)
class WorldImage:
    """One rendered image with the truth about it."""

    world: str
    seed: int
    image: Image
    objects: Detections2D
    masks: SegmentationMap


def render(
    world: str, seed: int, frames: int, size: tuple[int, int], *, varied: bool, focal: float = FOCAL
) -> Iterator[WorldImage]:
    """Images of a world, evenly spread over a minute.

    `varied` draws by the seed: the lens, light, blur and noise of the camera, lamps that are dimmed, shaking, the way
    that the robot takes, and how many people there are. Otherwise the camera has the focal length `focal`, a share of
    the width, and all else is as `SimulatedRobot` has it.
    """
    settings: dict[str, Any] = _drawn(seed, frames) if varied else {"color_camera": {"focal": focal}}
    settings["color_camera"] |= {"rate": frames / _SECONDS, "width": size[0], "height": size[1]}
    robot = SimulatedRobot(
        world=world,
        seed=seed,
        duration=f"{_SECONDS}s",
        depth_camera={"rate": 0},
        truth={"poses": 0, "relations": 0, "activities": 0, "masks": True},
        **settings,
    )
    robot.setup()
    try:
        for messages in robot.stream():
            image, objects, masks = messages.get("image"), messages.get("objects"), messages.get("masks")
            if isinstance(image, Image) and isinstance(objects, Detections2D) and isinstance(masks, SegmentationMap):
                yield WorldImage(world, seed, image, objects, masks)
    finally:
        robot.close()


def _drawn(seed: int, frames: int) -> dict[str, Any]:
    """Parameters of `SimulatedRobot` that differ from world to world."""
    rng = np.random.default_rng((seed, 8))
    shaken, dimmed = rng.random() < 0.3, rng.random() < 0.3
    blurred = rng.random() < 0.4
    begins = float(rng.uniform(0, 0.6)) * _SECONDS
    return {
        "color_camera": {
            "focal": float(rng.uniform(*FOCALS)),
            "exposure": float(rng.uniform(0.7, 1.35)),
            "read_noise": float(rng.uniform(0.5, 4)),
            "shot_noise": float(rng.uniform(0.05, 0.2)),
            "shutter": int(rng.uniform(2e6, 2e7)) if blurred else 0,
            "phase": int(rng.uniform(0, 0.5) * 1e9 * _SECONDS / frames),
        },
        "people": int(rng.choice([2, 3, 3, 4])),
        "route": str(rng.choice(["round", "tour"])),
        "motion": {"sway": float(rng.uniform(0, 0.03)), "turn": float(rng.uniform(0, 0.06))} if shaken else {},
        "lighting": [{"span": (begins, begins + 0.4 * _SECONDS), "level": float(rng.uniform(0.15, 1.2))}]
        if dimmed
        else [],
    }


def worlds(first_seed: int, count: int, names: Sequence[str] = INDOOR) -> list[tuple[str, int]]:
    """`count` worlds (name, seed), the kinds in turn."""
    return [(names[k % len(names)], first_seed + k) for k in range(count)]


def write_data(
    folder: Path,
    training: Sequence[tuple[str, int]],
    validation: Sequence[tuple[str, int]],
    frames: int,
    processes: int = 1,
) -> Iterator[tuple[int, int]]:
    """Renders worlds into a data folder; yields (worlds done, images written) after each.

    Half of the worlds are rendered at VGA, half at 320x240, and stored so: networks meet images that they shrink and
    images that they enlarge. Worlds that are already there are kept, so an interrupted rendering goes on. The files are
    the same for any number of processes.
    """
    for name in ("images", "masks", "boxes", "annotations"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / "classes.txt").write_text("\n".join(CLASSES) + "\n", encoding="utf-8")
    (folder / ORIGIN).write_text(f"{SIMULATOR}\n", encoding="utf-8")
    every, written = [*training, *validation], 0
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        for k, count in enumerate(pool.imap(partial(_write_world, folder, frames), every)):
            written += count
            yield k + 1, written
    for split, chosen in (("train", training), ("val", validation)):
        _write_annotations(folder, split, chosen)
    held_out = [image["file_name"] for world, seed in validation for image in _images(folder, world, seed)]
    (folder / "val.txt").write_text("\n".join(held_out) + "\n", encoding="utf-8")


def _write_world(folder: Path, frames: int, chosen: tuple[str, int]) -> int:
    """Renders a world unless it is there; the number of its images."""
    world, seed = chosen
    rows = folder / "boxes" / f"{world}_{seed}.json"
    if not rows.is_file():
        images = [
            _store(folder, f"{world}_{seed}_{i:02d}", taken)
            for i, taken in enumerate(render(world, seed, frames, QVGA if seed % 2 else VGA, varied=True))
        ]
        partial_file = rows.with_suffix(".partial")
        partial_file.write_text(json.dumps(images), encoding="utf-8")
        partial_file.replace(rows)
    return len(_images(folder, world, seed))


def _store(folder: Path, stem: str, taken: WorldImage) -> dict[str, Any]:
    pixels, classes = taken.image.data, taken.masks.classes.astype(np.uint8)
    cv2.imwrite(
        str(folder / "images" / f"{stem}.jpg"),
        cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR),
        [cv2.IMWRITE_JPEG_QUALITY, _QUALITIES[taken.seed % len(_QUALITIES)]],
    )
    cv2.imwrite(str(folder / "masks" / f"{stem}.png"), classes)
    found = taken.objects
    visible = found.visible if found.visible is not None else np.ones(found.count, np.float32)
    pixel_counts = found.pixel_counts if found.pixel_counts is not None else np.zeros(found.count, np.int64)
    least = LEAST_PIXELS * taken.image.width * taken.image.height / (QVGA[0] * QVGA[1])
    annotations = []
    for box, label, share, pixel_count in zip(
        found.boxes.tolist(), found.class_ids.tolist(), visible.tolist(), pixel_counts.tolist(), strict=True
    ):
        annotations.append(
            {
                "category_id": label,
                "bbox": [box[0], box[1], box[2] - box[0], box[3] - box[1]],
                "ignore": int(share < LEAST_VISIBLE or pixel_count < least),
                "visible": round(share, 3),
                "pixels": pixel_count,
            }
        )
    size = {"width": taken.image.width, "height": taken.image.height}
    return {"file_name": f"{stem}.jpg", **size, "annotations": annotations}


def _images(folder: Path, world: str, seed: int) -> list[dict[str, Any]]:
    return list(json.loads((folder / "boxes" / f"{world}_{seed}.json").read_text(encoding="utf-8")))


def _write_annotations(folder: Path, split: str, chosen: Sequence[tuple[str, int]]) -> None:
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for world, seed in chosen:
        for image in _images(folder, world, seed):
            images.append({"id": len(images), **{k: image[k] for k in ("file_name", "width", "height")}})
            for row in image["annotations"]:
                annotations.append({"id": len(annotations), "image_id": images[-1]["id"], **row})
    content = {
        "images": images,
        "categories": [{"id": k, "name": name} for k, name in enumerate(THINGS)],
        "annotations": annotations,
    }
    (folder / "annotations" / f"instances_{split}.json").write_text(json.dumps(content), encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> None:
    """Renders a data folder, as told on the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m operators.training.simulated_worlds",
        description="Render a data folder for `dataflow train pair`, `detector` and `segmenter`.",
    )
    parser.add_argument("data", type=Path, help="the folder to write")
    parser.add_argument("--worlds", type=int, default=480, help="worlds to train on")
    parser.add_argument(
        "--first-seed",
        type=int,
        default=TRAINING,
        help="seed of the first world to train on; the others have the next ones",
    )
    parser.add_argument("--validation", type=int, default=10, help=f"worlds to score on, of seeds from {VALIDATION}")
    parser.add_argument("--frames", type=int, default=10, help="images of each world")
    parser.add_argument("--processes", type=int, default=1, help="worlds rendered at once")
    options = parser.parse_args(arguments)
    if not TRAINING <= options.first_seed <= VALIDATION - options.worlds:
        parser.error(f"--first-seed: worlds to train on have seeds from {TRAINING} to {VALIDATION - 1}")
    chosen = worlds(options.first_seed, options.worlds, KINDS), worlds(VALIDATION, options.validation, KINDS)
    rendered = write_data(options.data, *chosen, options.frames, options.processes)
    total = options.worlds + options.validation
    for _ in track(rendered, total=total, description="worlds", console=Console(stderr=True)):
        pass


if __name__ == "__main__":
    main()
