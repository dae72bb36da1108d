"""Recognition networks trained here beside the same data given to torchvision's, and to baselines that learn nothing.

    python benchmarks/recognition.py objects WORLDS           classes of objects; WORLDS: a folder of simulated_worlds
    python benchmarks/recognition.py photographs COCO128 [--backbone FILE]    the same of photographs, every second one
    python benchmarks/recognition.py people RECORDING --backbone FILE    people known again
    python benchmarks/recognition.py streets CAMVID [--backbone FILE]    classes of pixels of photographs of streets

`objects`: the objects of simulated worlds (`python -m operators.training.simulated_worlds WORLDS`) cut out by their
true boxes; trained in some worlds, scored in others. `people`: a recording of images and tracks whose ids are right;
of each track the first half of its cut-outs is known, the rest is asked for, and the nearest decides. `streets`: every
second image of CamVid to train on, the others scored. `--backbone` is a state dict of torchvision's mobilenet_v2. All
networks get the same images, variations, steps and optimiser; the last epoch is scored, not the best. Nothing that is
trained is kept.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
import torchvision  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from places import extractor, with_head  # noqa: E402
from torch import Tensor, nn  # noqa: E402

import dataflow  # noqa: E402
from dataflow.messages import Image, Tracks, TrackState  # noqa: E402
from operators.detection.custom.folder import read_detection_data  # noqa: E402
from operators.learning.backbone import current_names  # noqa: E402
from operators.learning.loop import Settings, train  # noqa: E402
from operators.recognition.dataset import ClassificationData, LabelledImage  # noqa: E402
from operators.recognition.training import ClassifierTask  # noqa: E402
from operators.segmentation.dataset import MaskedImage, SegmentationData  # noqa: E402
from operators.segmentation.score import confusion, mean_iou  # noqa: E402
from operators.segmentation.training import SegmenterTask  # noqa: E402
from operators.training.running import prepare  # noqa: E402

CAMVID = ("sky", "building", "pole", "road", "pavement", "tree", "sign", "fence", "car", "pedestrian", "bicyclist")
SIDE = (64, 64)
MOST, LEAST, FEW = 150, 24, 6
"""Cut-outs of a class at most to train on; width and height in pixels at least; cut-outs of a class at least."""


class Torchvision(ClassifierTask):
    """torchvision's ResNet-18 in the place of our classifier, from random weights as it is."""

    def __init__(self, data: ClassificationData, size: tuple[int, int]) -> None:
        super().__init__(data, size)
        self.network = torchvision.models.resnet18(weights=None, num_classes=len(data.classes))

    def loss(self, batch: tuple[Tensor, Tensor], device: torch.device) -> dict[str, Tensor]:
        images, labels = batch
        scores = self.network(images.to(device)).float()
        return {"entropy": nn.functional.cross_entropy(scores, labels, self.class_weights, label_smoothing=0.05)}

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        """Nothing is kept."""


class Fcn(nn.Module):
    """torchvision's mobilenet_v2 as far as stride 16, with torchvision's FCN head; scores at half the resolution."""

    def __init__(self, classes: int, weights: Path | None) -> None:
        super().__init__()
        whole = torchvision.models.mobilenet_v2(weights=None)
        if weights is not None:
            given = current_names(torch.load(weights, map_location="cpu", weights_only=True))
            whole.load_state_dict(given, strict=False)
        self.features = whole.features[:14]
        self.head = torchvision.models.segmentation.fcn.FCNHead(96, classes)
        self.mean: Tensor
        self.deviation: Tensor
        self.register_buffer("mean", torch.tensor([0.485, 0.456, 0.406]).view(1, 3, 1, 1))
        self.register_buffer("deviation", torch.tensor([0.229, 0.224, 0.225]).view(1, 3, 1, 1))

    def forward(self, images: Tensor) -> Tensor:
        scores = self.head(self.features((images - self.mean) / self.deviation))
        size = (images.shape[2] // 2, images.shape[3] // 2)
        return nn.functional.interpolate(scores, size=size, mode="bilinear", align_corners=False)


class FcnTask(SegmenterTask):
    """`Fcn` in the place of our segmenter."""

    def __init__(self, data: SegmentationData, size: tuple[int, int], weights: Path | None) -> None:
        super().__init__(data, size)
        self.network = Fcn(len(data.classes), weights)

    def loss(self, batch: tuple[Tensor, Tensor], device: torch.device) -> dict[str, Tensor]:
        images, masks = batch
        return self.loss_of(self.network(images.to(device)), masks)

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        """Nothing is kept."""


def trained(task: Any, epochs: int, batch: int) -> dict[str, float]:
    """The scores after the last epoch."""
    settings = Settings(epochs, batch, seed=0, evaluate_every=epochs, workers=1, threads=1, bfloat16=True)
    with tempfile.TemporaryDirectory() as folder:
        return train(task, settings, Path(folder) / "network.onnx").history[-1]


def cut_out(worlds: Path, folder: Path, *, halves: bool = False) -> ClassificationData:
    """Writes the objects of a folder of detection data as images; those that are to be ignored are left out.

    With `halves` every second image is to be scored, and classes with less than `FEW` cut-outs in either are left out.
    """
    read = read_detection_data(worlds, 0)
    if halves:
        whole = sorted((*read.training, *read.validation), key=lambda image: image.file)
        read = replace(read, training=tuple(whole[::2]), validation=tuple(whole[1::2]))
    parts: dict[str, list[LabelledImage]] = {"training": [], "validation": []}
    for part, images in (("training", read.training), ("validation", read.validation)):
        count = np.zeros(len(read.classes), np.int64)
        for k in np.random.default_rng(0).permutation(len(images)).tolist():
            image = images[k]
            pixels = None
            for i, (box, label) in enumerate(zip(image.boxes, image.classes, strict=True)):
                if image.ignored[i] or (part == "training" and count[label] >= MOST):
                    continue
                pixels = image.read()[..., ::-1] if pixels is None else pixels
                height, width = pixels.shape[:2]
                x1, y1, x2, y2 = (
                    np.clip(box * (width, height, width, height), 0, (width, height) * 2).round().astype(int)
                )
                if min(x2 - x1, y2 - y1) < LEAST:
                    continue
                file = folder / part / f"{image.file.stem}_{i}.jpg"
                file.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(file), pixels[y1:y2, x1:x2])
                parts[part].append(LabelledImage(file, int(label)))
                count[label] += 1
    data = ClassificationData(tuple(read.classes), tuple(parts["training"]), tuple(parts["validation"]))
    return frequent(data) if halves else data


def frequent(data: ClassificationData) -> ClassificationData:
    """Returns the classes with `FEW` cut-outs to train on and to score."""
    sides = [
        np.bincount([i.label for i in part], minlength=len(data.classes)) for part in (data.training, data.validation)
    ]
    kept = np.flatnonzero(np.minimum(*sides) >= FEW).tolist()
    training, validation = (
        tuple(LabelledImage(i.file, kept.index(i.label)) for i in part if i.label in kept)
        for part in (data.training, data.validation)
    )
    return ClassificationData(tuple(data.classes[k] for k in kept), training, validation)


def described(images: Sequence[LabelledImage], backbone: Path) -> NDArray[np.float64]:
    """Returns the vectors (N, D) of images by `FeatureExtractor` with torchvision's mobilenet_v2."""
    with tempfile.TemporaryDirectory() as folder:
        whole = with_head(backbone, Path(folder) / "mobilenet_v2.pt")
        describe = extractor(model="mobilenet_v2", checkpoint=str(whole))
    return np.array([describe(image.read()) for image in images], np.float64)


def people(recording: Path, backbone: Path) -> None:
    """Prints how often the nearest known cut-out is of the same person: by colours, by features of ImageNet."""
    stream = dataflow.open(recording)
    images, tracks = (next(name for name in stream if name.endswith(end)) for end in ("camera/image", "tracker/tracks"))
    at = {m.stamp: m for m in stream[tracks]}
    with tempfile.TemporaryDirectory() as folder:
        of: dict[int, list[LabelledImage]] = {}
        for image in stream[images]:
            found = at.get(image.stamp)
            if not (isinstance(image, Image) and isinstance(found, Tracks) and found.boxes is not None):
                continue
            for k in np.flatnonzero((found.states == TrackState.CONFIRMED) & (found.unseen == 0)).tolist():
                x1, y1, x2, y2 = np.clip(found.boxes[k], 0, (image.width, image.height) * 2).round().astype(int)
                if found.labels()[k] == "person" and min(x2 - x1, y2 - y1) >= LEAST:
                    file = Path(folder) / f"{found.ids[k]}_{image.stamp}.png"
                    cv2.imwrite(str(file), image.data[y1:y2, x1:x2, ::-1])
                    of.setdefault(int(found.ids[k]), []).append(LabelledImage(file, int(found.ids[k])))
        of = {i: each for i, each in of.items() if len(each) >= 2 * FEW}
        known = [image for each in of.values() for image in each[: len(each) // 2]]
        asked = [image for each in of.values() for image in each[len(each) // 2 :]]
        labels, truth = (np.array([image.label for image in part]) for part in (known, asked))
        print(f"{len(of)} people, {len(known)} cut-outs known, {len(asked)} asked for")
        values, counts = np.unique(labels, return_counts=True)
        rows = {"the most frequent person": scored(np.full(len(truth), values[counts.argmax()]), truth)}
        a, b = (np.array([histogram(i) for i in part]) for part in (known, asked))
        rows["the nearest colour histogram"] = scored(labels[(b @ a.T).argmax(axis=1)], truth)
        a, b = (described(part, backbone) for part in (known, asked))
        rows["FeatureExtractor, torchvision's mobilenet_v2"] = scored(labels[(b @ a.T).argmax(axis=1)], truth)
    for name, row in rows.items():
        print(f"| {name} | {row['accuracy']:.3f} | {row['mean_accuracy']:.3f} |")


def histogram(image: LabelledImage) -> NDArray[np.float64]:
    """The root of the shares of 8 levels of each colour (the product of two is Bhattacharyya's coefficient)."""
    counts = np.bincount((image.read() // 32).reshape(-1, 3).astype(np.int64) @ (64, 8, 1), minlength=512)
    return np.asarray(np.sqrt(counts / counts.sum()))


def objects(worlds: Path, epochs: int, backbone: Path | None = None, *, halves: bool = False) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        data = cut_out(worlds, Path(folder), halves=halves)
        labels = np.array([image.label for image in data.training])
        truth = np.array([image.label for image in data.validation])
        print(f"{len(labels)} cut-outs to train on, {len(truth)} to score, {len(data.classes)} classes")
        rows = {"the most frequent class": scored(np.full(len(truth), np.bincount(labels).argmax()), truth)}
        known, asked = (np.array([histogram(i) for i in part]) for part in (data.training, data.validation))
        rows["the nearest colour histogram"] = scored(labels[(asked @ known.T).argmax(axis=1)], truth)
        if backbone is not None:
            known, asked = (described(part, backbone) for part in (data.training, data.validation))
            rows["the nearest features of torchvision's mobilenet_v2"] = scored(
                labels[(asked @ known.T).argmax(axis=1)], truth
            )
        for name, task in (
            ("plain", ClassifierTask(data, SIDE)),
            ("residual", ClassifierTask(data, SIDE, architecture="residual")),
            ("torchvision's resnet18", Torchvision(data, SIDE)),
        ):
            rows[name] = trained(task, epochs, 32)
    for name, row in rows.items():
        print(f"| {name} | {row['accuracy']:.3f} | {row['mean_accuracy']:.3f} |")
    return rows


def scored(found: NDArray[np.int64], truth: NDArray[np.int64]) -> dict[str, float]:
    right = found == truth
    each = [float(right[truth == c].mean()) for c in np.unique(truth)]
    return {"accuracy": float(right.mean()), "mean_accuracy": float(np.mean(each))}


def camvid(folder: Path) -> SegmentationData:
    """Every second image to train on. Its void class becomes 255: masks are read where they lie."""
    files = sorted((folder / "images").glob("*.png"))
    if not files:
        raise SystemExit(f"no PNGs in {folder / 'images'}: give a folder with CamVid's images/ and annotations/")
    pairs = [MaskedImage(f, folder / "annotations" / f.name) for f in files]
    return SegmentationData((*CAMVID, "void"), tuple(pairs[::2]), tuple(pairs[1::2]))


def streets(folder: Path, backbone: Path | None, epochs: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as place:
        data = without_void(camvid(folder), Path(place))
        rows: dict[str, Any] = baselines(data)
        size = (384, 288)
        tasks: dict[str, Any] = {
            "segmenter": SegmenterTask(data, size),
            "torchvision's mobilenet_v2 + FCN head": FcnTask(data, size, None),
        }
        prepare(tasks["segmenter"], None, None, None)
        if backbone is not None:
            ours = SegmenterTask(data, size, backbone=backbone)
            prepare(ours, backbone, None, None)
            tasks["segmenter, ImageNet backbone"] = ours
            tasks["torchvision's, ImageNet backbone"] = FcnTask(data, size, backbone)
        for name, task in tasks.items():
            rows[name] = trained(task, epochs, 8)["miou"]
    for name, value in rows.items():
        print(f"| {name} | {value:.3f} |")
    return rows


def without_void(data: SegmentationData, folder: Path) -> SegmentationData:
    """The same masks with 255 where the class is void, the last one."""
    void = len(data.classes) - 1

    def written(image: MaskedImage) -> MaskedImage:
        mask = image.read(void + 1)[1]
        file = folder / image.mask.name
        cv2.imwrite(str(file), np.where(mask == void, 255, mask).astype(np.uint8))
        return MaskedImage(image.image, file)

    return SegmentationData(data.classes[:-1], tuple(map(written, data.training)), tuple(map(written, data.validation)))


def baselines(data: SegmentationData) -> dict[str, float]:
    """mIoU of the most frequent class, at each pixel, and of each colour (32 levels)."""
    classes = len(data.classes)
    shape = data.training[0].read(classes)[1].shape
    places, shades = np.zeros((*shape, classes), np.int64), np.zeros((32**3, classes), np.int64)
    for image in data.training:
        pixels, mask = image.read(classes)
        for c in range(classes):
            places[..., c] += mask == c
            shades[:, c] += np.bincount(shade(pixels)[mask == c], minlength=32**3)
    tables = {name: np.zeros((classes, classes + 1), np.int64) for name in ("class", "place", "colour")}
    most = int(places.sum(axis=(0, 1)).argmax())
    for image in data.validation:
        pixels, mask = image.read(classes)
        by_shade = np.where(shades.any(axis=1), shades.argmax(axis=1), most)
        guesses = {"class": np.full(shape, most), "place": places.argmax(axis=2), "colour": by_shade[shade(pixels)]}
        for name, guess in guesses.items():
            tables[name] += confusion(mask, guess.astype(np.uint8), classes)
    return {f"the most frequent {name if name == 'class' else f'class of the {name}'}": mean_iou(t)
            for name, t in tables.items()}  # fmt: skip


def shade(pixels: NDArray[np.uint8]) -> NDArray[np.int64]:
    return np.asarray((pixels // 8).astype(np.int64) @ np.array((1024, 32, 1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["objects", "photographs", "people", "streets"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--backbone", type=Path, help="state dict of torchvision's mobilenet_v2")
    parser.add_argument("--epochs", type=int, help="8 for objects, 60 for photographs and streets")
    parser.add_argument("--json", type=Path, help="file for all figures")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.what == "people":
        people(arguments.folder, arguments.backbone)
        return
    if arguments.what == "objects":
        rows = objects(arguments.folder, arguments.epochs or 8)
    elif arguments.what == "photographs":
        rows = objects(arguments.folder, arguments.epochs or 60, arguments.backbone, halves=True)
    else:
        rows = streets(arguments.folder, arguments.backbone, arguments.epochs or 60)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
