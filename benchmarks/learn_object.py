"""Objects learned from five images: found again in other places, and what that does to the classes known before.

    python benchmarks/learn_object.py FOLDER [--objects cone teapot helmet] [--views 30]
    python benchmarks/learn_object.py FOLDER --thresholds 0.2 0.25 0.3 0.4 0.5 [--objects suitcase bucket vase drum]
    python benchmarks/learn_object.py FOLDER --real DATA

The second chooses the threshold: by other objects in other worlds than those that judge.

The third learns a thing of each real scene from five of its labelled views and looks for it in the rest: every tenth
frame, the labelled box moved to it by the labelled poses, right from IoU 0.3, since such boxes are some pixels off.

Each object is a shape that no network was trained on. It stands on floors or tables of simulated worlds; five images of
one world are labelled, `dataflow learn object` learns from them, and images of other worlds judge: an object counts
that is at least half visible, with 300 pixels or more; a box is right from IoU 0.5. FOLDER keeps the images.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from learned_shapes import CHOOSING, JUDGED, ON_FLOOR
from real_scenes import SCENES, matrix_of, moved_box
from sensed_worlds import in_view

from dataflow.messages import Detections2D, Image
from dataflow.messages.geometry import invert
from operators.detection import CustomDetector
from operators.evaluation.detection_score import ScoredFrame, score_frames
from operators.recognition import LearnedDetector
from operators.simulator.classes import THINGS
from operators.simulator.rendering.optics import Optics
from operators.simulator.rendering.renderer import Renderer
from operators.simulator.scene import Thing, World
from operators.simulator.sensors.color import expose
from operators.simulator.sensors.frames import BODY_TO_OPTICAL, mounted
from operators.simulator.shapes import Array, pose
from operators.simulator.truth import detections
from operators.simulator.worlds.make import make_world
from operators.tracking.assignment import overlap
from operators.training.learning import learn as command

OPTICS = Optics(640, 480, 544.0, 544.0, 319.5, 239.5)
LEARNED, HELD_OUT = 71_000, 72_000
"""First seeds of the worlds to learn in and to judge by."""
OF_CHOICE = 10_000
"""Added to both for the worlds by which the threshold is chosen."""
KINDS, WITH_TABLES = ("office", "table_top", "corridor"), ("office", "table_top", "office")
VISIBLE, PIXELS, IOU = 0.5, 300, 0.5


REAL, REAL_IOU = {"seven_0_249": "cup white", "fr1_rpy": "cup"}, 0.3
"""Things of real scenes; in the third scene what is small moves and is labelled at one time alone."""
SHAPES = {**JUDGED, **CHOOSING}


@dataclass(eq=False)
class Put:
    """Stands wherever it was last put."""

    T: Array

    def frame(self, t: float) -> Array:
        return self.T

    def parts(self, t: float) -> Array:
        return self.T[None]


def views(name: str, kind: str, seed: int, count: int) -> Iterator[tuple[np.ndarray, Detections2D]]:
    """Yields images of one world with the object in another place in each, and the true boxes in them."""
    rng = np.random.default_rng((seed, 5))
    world = make_world(kind, seed, speed=0.5, hold=0.0, movers=True, people=2, tour=True)
    id, put = 1 + max(thing.id for thing in world.things), Put(np.eye(4))
    renderer = Renderer(replace(world, things=(*world.things, Thing(id, "box", (SHAPES[name](),), put))), seed)
    made = 0
    for attempt in range(12 * count):
        if made == count:
            return
        put.T = placed(world, name in ON_FLOOR, rng)
        camera = looking(world, put.T, rng)
        if camera is None:
            continue
        renderer.at(0.25 * attempt + 0.01)
        view = renderer.view(camera, OPTICS)
        truth, _ = detections(
            view,
            renderer,
            camera,
            OPTICS,
            0.0,
            min_pixels=30,
            shares=True,
            stamp=0,
            camera_frame="camera",
            world_frame="w",
        )
        rows = np.flatnonzero(truth.ids == id)
        if len(rows) and in_view(truth, VISIBLE, PIXELS)[rows[0]]:
            assert view.color is not None
            made += 1
            noisy = expose(view.color, rng.uniform(0.8, 1.2)) + rng.normal(0, 2, view.color.shape)
            ids = truth.class_ids.copy()
            ids[rows[0]] = len(THINGS)
            yield np.clip(noisy, 0, 255).astype(np.uint8), truth.replace(class_names=(*THINGS, name), class_ids=ids)


def placed(world: World, floor: bool, rng: np.random.Generator) -> Array:
    """Returns a place on the robot's way, which is free, or on a table."""
    yaw = float(rng.uniform(-np.pi, np.pi))
    if floor:
        T = world.path.at([rng.uniform(0, world.path.period)]).T_world_base()[0]
        x, y = T[:2, 3] + rng.uniform(-0.25, 0.25, 2)
        return pose(float(x), float(y), 0.0, yaw)
    tables = [thing.box(0.0) for thing in world.things if thing.label == "table"]
    T, size = tables[int(rng.integers(len(tables)))]
    x, y, z = (T @ np.array([*(rng.uniform(-0.35, 0.35, 2) * size[:2]), size[2] / 2, 1.0]))[:3]
    return pose(float(x), float(y), float(z), yaw)


def looking(world: World, T: Array, rng: np.random.Generator) -> Array | None:
    """Returns a pose of the robot's camera on its way that looks at a place from 0.8 to 3.5 m, if there is one."""
    times = rng.uniform(0, world.path.period, 300)
    cameras = world.path.at(times).T_world_base() @ mounted(world.camera_mount) @ BODY_TO_OPTICAL
    for camera in cameras:
        x, y, z = (invert(camera) @ (T @ np.array([0, 0, 0.12, 1.0])))[:3]
        if 0.8 < z < 3.5 and abs(x / z) < 0.52 and abs(y / z) < 0.38:
            return np.asarray(camera)
    return None


def written(folder: Path, name: str, count: int, shift: int = 0) -> tuple[Path, Path]:
    """Returns the folders to learn from and to judge by, in COCO format; they are made where they are lacking.

    `shift` is added to the seeds of their worlds.
    """
    made = []
    for part, first, worlds, each in (("learn", LEARNED, 1, 5), ("held_out", HELD_OUT, 3, (count + 2) // 3)):
        place = folder / name / part
        made.append(place)
        if (place / "annotations.json").is_file():
            continue
        place.mkdir(parents=True, exist_ok=True)
        images: list[dict[str, Any]] = []
        annotations: list[dict[str, Any]] = []
        for k in range(worlds):
            kinds = KINDS if name in ON_FLOOR else WITH_TABLES
            kind = kinds[k] if part == "held_out" else "office"
            for pixels, truth in views(name, kind, shift + first + k, each):
                file = f"{len(images):03d}.png"
                cv2.imwrite(str(place / file), pixels[..., ::-1])
                images.append(
                    {"id": len(images), "file_name": file, "width": pixels.shape[1], "height": pixels.shape[0]}
                )
                for row in range(truth.count):
                    x1, y1, x2, y2 = truth.boxes[row].tolist()
                    clear = in_view(truth, VISIBLE, PIXELS)[row]
                    annotations.append(
                        {
                            "id": len(annotations), "image_id": len(images) - 1, "bbox": [x1, y1, x2 - x1, y2 - y1],
                            "category_id": int(truth.class_ids[row]), "area": (x2 - x1) * (y2 - y1),
                            "iscrowd": 0, "ignore": int(not clear),
                        }
                    )  # fmt: skip
        categories = [{"id": k, "name": n} for k, n in enumerate((*THINGS, name))]
        content = {"images": images, "categories": categories, "annotations": annotations}
        (place / "annotations.json").write_text(json.dumps(content))
    return made[0], made[1]


def detected(folder: Path, detector: CustomDetector | LearnedDetector) -> list[ScoredFrame]:
    """Returns what is in the images of a folder, and what the detector finds in them."""
    content = json.loads((folder / "annotations.json").read_text())
    names = {c["id"]: c["name"] for c in content["categories"]}
    frames = []
    for image in content["images"]:
        pixels = cv2.imread(str(folder / image["file_name"]), cv2.IMREAD_COLOR_RGB)
        assert pixels is not None
        found = detector.process(Image(stamp=image["id"], frame="camera", data=np.asarray(pixels, np.uint8)))
        own = [a for a in content["annotations"] if a["image_id"] == image["id"]]
        boxes = np.array([[x, y, x + w, y + h] for x, y, w, h in (a["bbox"] for a in own)], np.float64).reshape(-1, 4)
        frames.append(
            ScoredFrame(
                boxes,
                tuple(names[a["category_id"]] for a in own),
                np.array([bool(a["ignore"]) for a in own]),
                found.boxes.astype(np.float64),
                found.labels(),
                found.scores,
            )
        )
    return frames


def judged(frames: Sequence[ScoredFrame], name: str, threshold: float = 0.3) -> tuple[dict[str, Any], float]:
    """Returns the score of the new class from a threshold on, and the mean AP50 of the known ones."""
    scores = score_frames(frames, (*THINGS, name), max_detections=100, iou=IOU, score_threshold=threshold)
    new = scores[name]
    known = [s.ap50 for n, s in scores.items() if n != name and s.ap50 is not None]
    found_there = new.hits + new.false_alarms
    return {
        "recall": new.hits / max(new.truth, 1),
        "precision": new.hits / found_there if found_there else float("nan"),
        "ap50": new.ap50,
        "objects": new.truth,
    }, float(np.mean(known))


def real(data: Path, folder: Path) -> None:
    """Prints recall and precision of a thing of each scene whose poses are labelled."""
    for scene, thing_id in REAL.items():
        labels = json.loads((data / "scenes" / f"{scene}.json").read_text())
        (thing,) = (each for each in labels["objects"] if each["id"] == thing_id)
        K, shift = np.array(labels["K_color"]), matrix_of(labels["T_depth_image"])
        times = np.array([row[1] for row in labels["poses"]])
        T = [matrix_of(row[2:9]) @ shift for row in labels["poses"]]
        files = _colors(data / SCENES[scene][0])
        views = []
        for k, row in enumerate(labels["poses"]):
            box = moved_box(thing, k, times, T, K)
            pixels = cv2.imread(str(files[int(row[0]) - labels["first_frame"]]), cv2.IMREAD_COLOR_RGB)
            assert pixels is not None
            height, width = pixels.shape[:2]
            inside = box is not None and (box >= 0).all() and (box <= (width, height) * 2).all()
            views.append((np.asarray(pixels, np.uint8), box if inside else None, box))
        there = [k for k, (_, box, _) in enumerate(views) if box is not None]
        chosen = there[:: max(1, len(there) // 10)][:5]
        place = folder / f"real_{scene}"
        place.mkdir(parents=True, exist_ok=True)
        images, annotations = [], []
        for k in chosen:
            height, width = views[k][0].shape[:2]
            cv2.imwrite(str(place / f"{k}.png"), views[k][0][..., ::-1])
            x1, y1, x2, y2 = np.asarray(views[k][1]).tolist()
            images.append({"id": k, "file_name": f"{k}.png", "width": width, "height": height})
            annotations.append({"id": k, "image_id": k, "bbox": [x1, y1, x2 - x1, y2 - y1], "category_id": 0})
        content = {"images": images, "annotations": annotations, "categories": [{"id": 0, "name": "thing"}]}
        (place / "annotations.json").write_text(json.dumps(content))
        file = folder / f"real_{scene}.object.npz"
        command(["object", "thing", str(place), "--out", str(file), "--overwrite"], standalone_mode=False)
        detector = started(LearnedDetector(objects=[str(file)]))
        found = right = given = 0
        for k, (pixels, box, anywhere) in enumerate(views):
            if k in chosen or (box is None and anywhere is not None):  # in part out of the image, or behind the camera
                continue
            made = detector.process(Image(stamp=k, frame="camera", data=pixels))
            own = made.boxes[[name == "thing" for name in made.labels()]].astype(np.float64)
            hits = np.zeros(len(own), np.bool_) if box is None else overlap(own, box[None])[:, 0] >= REAL_IOU
            found, right, given = found + bool(hits.any()), right + int(hits.sum()), given + len(own)
        asked = len([k for k in there if k not in chosen])
        print(f"| {scene}, {thing_id} | {found} of {asked} | {right} of {given} |", flush=True)


def _colors(folder: Path) -> list[Path]:
    """Returns the colour images of a folder of 7-Scenes or TUM, in order."""
    listed = folder / "rgb.txt"
    if not listed.is_file():
        return sorted(folder.glob("*.color.jpg"))
    rows = [line.split() for line in listed.read_text().splitlines() if line and not line.startswith("#")]
    return [folder / name for _, name in rows]


def started(detector: CustomDetector | LearnedDetector) -> CustomDetector | LearnedDetector:
    detector.setup()
    return detector


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--objects", nargs="+", choices=list(SHAPES), help=f"default: {' '.join(JUDGED)}")
    parser.add_argument("--views", type=int, default=30, help="images of each object to judge by")
    parser.add_argument("--thresholds", nargs="+", type=float, help="compare these, in the worlds that serve for that")
    parser.add_argument("--real", type=Path, metavar="DATA", help="a thing of each labelled real scene")
    options = parser.parse_args(arguments)
    if options.real:
        real(options.real, options.folder)
        return
    if options.thresholds:
        _compare(options.folder / "choice", options.objects or list(CHOOSING), options.views, options.thresholds)
        return
    for name in options.objects or JUDGED:
        held_out, file = _learned(options.folder, name, options.views)
        _, before = judged(detected(held_out, started(CustomDetector(score_threshold=0.01))), name)
        detector = LearnedDetector(objects=[str(file)], score_threshold=0.01)
        new, after = judged(detected(held_out, started(detector)), name, detector.learned_threshold)
        told = {k: round(v, 3) for k, v in new.items() if v is not None}
        print(f"{name}: {told}, known classes AP50 {before:.4f} -> {after:.4f}", flush=True)


def _learned(folder: Path, name: str, views: int, shift: int = 0) -> tuple[Path, Path]:
    """Learns an object; returns the folder of images to judge by, and the object's file."""
    learn, held_out = written(folder, name, views, shift)
    file = folder / f"{name}.object.npz"
    command(["object", name, str(learn), "--out", str(file), "--overwrite"], standalone_mode=False)
    return held_out, file


def _compare(folder: Path, objects: Sequence[str], views: int, thresholds: Sequence[float]) -> None:
    found = {}
    for name in objects:
        held_out, file = _learned(folder, name, views, OF_CHOICE)
        detector = LearnedDetector(objects=[str(file)], score_threshold=0.01, learned_threshold=min(thresholds))
        found[name] = detected(held_out, started(detector))
    print(f"| threshold | {' | '.join(objects)} | mean: recall, precision |\n|{' --- |' * (len(objects) + 2)}")
    for threshold in thresholds:
        scores = [judged(found[name], name, threshold)[0] for name in objects]
        pairs = [(score["recall"], score["precision"]) for score in scores]
        cells = " | ".join(f"{recall:.2f}, {precision:.2f}" for recall, precision in [*pairs, np.mean(pairs, axis=0)])
        print(f"| {threshold:g} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
