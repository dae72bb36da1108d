"""A new class of objects, learned from a few labelled images: a prototype in the features of a detector's trunk."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.detection.nms import intersection_over_union
from operators.inference import ModelError
from operators.recognition.objects.proposals import F32, Trunk

PROPOSALS, LEAST = 120, 0.004
"""Counts: boxes around anything that an image gives, and the detector's score from which."""
_ALIKE, _APART = 0.65, 0.3  # overlap from which a box shows the object, and up to which it shows something else
_SHRINKAGE = 0.3
_WIDTH = 0.08  # of the score, over which a resemblance becomes sure
_TOUCHING = 0.3  # overlap of boxes from which the outline is learned
_RIDGE = 1.0
_FARTHEST = 0.5  # share of a box's size by which one step moves a side at most


class LearnedObjectError(ModelError):
    """Raised for an unusable file of a learned object or labelled images; the message gives what would be right."""


@dataclass(frozen=True, eq=False)
class LearnedObject:
    """A class by what sets it apart: `direction` (D,) from the `background` (D,) mean towards the prototype.

    A vector's resemblance is 0 at the background's mean and 1 at the prototype; `threshold` lies between objects and
    background. `outline` (D + 1, 4) is the linear regression from the vector of a box to the change of its middle and
    size to those of the object: shares of its size, and logarithms. `detector` is the SHA-256 of the network that the
    features come from, `inner` the maps of it.
    """

    name: str
    detector: str
    inner: tuple[str, ...]
    background: F32
    direction: F32
    threshold: float
    images: int
    outline: F32

    def drawn(self, boxes: F32, described: F32) -> F32:
        """Returns boxes (N, 4) with vectors (N, D) moved to the outline of the object that they show."""
        change = np.clip(described @ self.outline[:-1] + self.outline[-1], -_FARTHEST, _FARTHEST)
        size = boxes[:, 2:] - boxes[:, :2]
        middle = boxes[:, :2] + size * (0.5 + change[:, :2])
        half = 0.5 * size * np.exp(change[:, 2:])
        return np.concatenate([middle - half, middle + half], axis=1).astype(np.float32)

    def probability(self, described: F32) -> NDArray[np.float32]:
        """Returns how surely each vector (N, D) shows the object, [0, 1]."""
        alike = (described - self.background) @ self.direction
        return np.asarray(1 / (1 + np.exp(-np.clip((alike - self.threshold) / _WIDTH, -30, 30))), np.float32)

    def write(self, file: Path) -> None:
        facts = {"name": self.name, "detector": self.detector, "inner": list(self.inner), "images": self.images}
        with file.open("wb") as handle:
            np.savez(
                handle,
                facts=json.dumps(facts),
                background=self.background,
                direction=self.direction,
                threshold=np.float64(self.threshold),
                outline=self.outline,
            )

    @classmethod
    def read(cls, file: Path) -> LearnedObject:
        """Raises FileNotFoundError or LearnedObjectError."""
        if not file.is_file():
            raise FileNotFoundError(f"no learned object {str(file)!r} (looked for {file.absolute()})")
        return cls.of(file.read_bytes(), str(file))

    @classmethod
    def of(cls, content: bytes, file: str) -> LearnedObject:
        """Reads the bytes of a file. Raises LearnedObjectError, which names the file."""
        try:
            with np.load(io.BytesIO(content)) as kept:
                facts = json.loads(str(kept["facts"]))
                background, direction = kept["background"], kept["direction"]
                threshold = float(kept["threshold"])
                still = np.zeros((len(direction) + 1, 4), np.float32)  # files of the first format have no outline
                outline = kept["outline"].astype(np.float32) if "outline" in kept else still
            return cls(
                str(facts["name"]),
                str(facts["detector"]),
                tuple(map(str, facts["inner"])),
                background.astype(np.float32),
                direction.astype(np.float32),
                threshold,
                int(facts["images"]),
                outline,
            )
        except (ValueError, KeyError, OSError, EOFError, TypeError, zipfile.BadZipFile) as error:
            raise LearnedObjectError(
                f"{file} is no learned object ({error}); make one by `dataflow learn object NAME DATA`"
            ) from None


@dataclass(frozen=True, eq=False)
class ImageExamples:
    """Holds what one image gives: vectors of the object (P, D) and of everything else (Q, D); and those of boxes that
    touch the object (R, D), with the changes (R, 4) that would make them its own."""

    object: F32
    others: F32
    touching: F32
    changes: F32


def shown_in(trunk: Trunk, pixels: NDArray[np.uint8], boxes: F32, rng: np.random.Generator) -> ImageExamples:
    """Returns vectors of an image (H, W, 3) whose objects of the class have boxes (K, 4) in its pixels.

    It is looked at as it is, mirrored, from farther and from nearer, so that few images show many sides and sizes.
    """
    objects, others, touching, changes = [], [], [], []
    for view, known in _variants(pixels, boxes):
        glance = trunk.look(view)
        within = _fitted(known, glance.fit.apply(np.zeros(view.shape, np.uint8)).shape, view.shape)
        proposed = trunk.propose(glance, LEAST, PROPOSALS)
        overlap = np.zeros((len(within), len(proposed)), np.float32)
        for row, box in zip(overlap, within, strict=True):
            row[:] = intersection_over_union(box, proposed)
        best = overlap.max(axis=0, initial=0.0)
        near = np.concatenate([proposed[best >= _ALIKE], *(_jittered(box, rng) for box in within)])
        objects.append(trunk.describe(glance, near.astype(np.float32)))
        others.append(trunk.describe(glance, proposed[best <= _APART]))
        for box in within:
            loose = np.concatenate([proposed, _jittered(box, rng, 0.4, 40)])
            loose = loose[intersection_over_union(box, loose) >= _TOUCHING]
            touching.append(trunk.describe(glance, loose))
            changes.append(_changes(loose, box))
    nothing = np.zeros((0, objects[0].shape[1]), np.float32)
    return ImageExamples(
        np.concatenate(objects),
        np.concatenate(others),
        np.concatenate([nothing, *touching]),
        np.concatenate([np.zeros((0, 4), np.float32), *changes]),
    )


def learn(name: str, shown: Sequence[ImageExamples], detector: str, inner: tuple[str, ...]) -> LearnedObject:
    """Learns from images, at least one of which shows the object. Raises LearnedObjectError where none does.

    The prototype is the mean vector of the object; directions in which everything varies count less (linear
    discriminant with a shrunk covariance). The threshold lies between what images that were left out show of the object
    and of anything else.

    Method: Snell et al., "Prototypical networks for few-shot learning", 2017; Hariharan et al., "Discriminative
    decorrelation for clustering and classification", 2012; Ledoit and Wolf's shrinkage with a fixed share.
    """
    there = [each for each in shown if len(each.object)]
    if not there:
        raise LearnedObjectError(f"no image shows {name}: label a box of it in five images or so")
    background, direction = _discriminant(shown)
    own, other = [], []
    for k, left_out in enumerate(shown):
        rest = [each for j, each in enumerate(shown) if j != k]
        known = any(len(each.object) for each in rest)
        mean, across = _discriminant(rest) if known else (background, direction)
        own.append((left_out.object - mean) @ across)
        other.append((left_out.others - mean) @ across)
    alike = float(np.quantile(np.concatenate(own), 0.2))
    strange = float(np.quantile(np.concatenate(other), 0.998)) if sum(map(len, other)) else 0.0
    return LearnedObject(
        name, detector, inner, background, direction, (alike + strange) / 2, len(there), _outline(there)
    )


def _outline(shown: Sequence[ImageExamples]) -> F32:
    """Returns (D + 1, 4): the change of a box by its vector, least squares with a penalty on the square of weights."""
    vectors = np.concatenate([each.touching for each in shown]).astype(np.float64)
    changes = np.concatenate([each.changes for each in shown]).astype(np.float64)
    if not len(vectors):
        return np.zeros((vectors.shape[1] + 1, 4), np.float32)
    mean, usual = vectors.mean(axis=0), changes.mean(axis=0)
    apart = vectors - mean
    weights = apart.T @ np.linalg.solve(apart @ apart.T + _RIDGE * np.eye(len(apart)), changes - usual)
    return np.concatenate([weights, (usual - mean @ weights)[None]]).astype(np.float32)


def _discriminant(shown: Sequence[ImageExamples]) -> tuple[F32, F32]:
    """Returns the mean of everything else and the direction, scaled so that the prototype's resemblance is 1."""
    objects = np.concatenate([each.object for each in shown]).astype(np.float64)
    others = np.concatenate([each.others for each in shown]).astype(np.float64)
    prototype = objects.mean(axis=0)
    background = others.mean(axis=0) if len(others) else np.zeros_like(prototype)
    apart = prototype - background
    spread = np.concatenate([others - background, objects - prototype]) if len(others) else objects - prototype
    covariance = spread.T @ spread / max(len(spread), 1)
    size = max(float(np.trace(covariance)) / len(covariance), 1e-9)
    direction = np.linalg.solve((1 - _SHRINKAGE) * covariance + _SHRINKAGE * size * np.eye(len(covariance)), apart)
    return background.astype(np.float32), (direction / max(float(direction @ apart), 1e-9)).astype(np.float32)


def _variants(pixels: NDArray[np.uint8], boxes: F32) -> Iterator[tuple[NDArray[np.uint8], F32]]:
    """Yields an image and its boxes as they are, mirrored, from farther away, and from nearer to each object."""
    height, width = pixels.shape[:2]
    yield pixels, boxes
    yield (
        np.ascontiguousarray(pixels[:, ::-1]),
        np.stack([width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], axis=1),
    )
    small = cv2.resize(pixels, (int(0.6 * width), int(0.6 * height)), interpolation=cv2.INTER_AREA)
    wide = np.full_like(pixels, 114)
    wide[: small.shape[0], : small.shape[1]] = small
    yield wide, (boxes * np.float32(0.6)).astype(np.float32)
    for box in boxes:
        side = max(1.6 * float(max(box[2] - box[0], box[3] - box[1])), 0.5 * min(width, height))
        half_x, half_y = min(side * width / height / 2, width / 2), min(side / 2, height / 2)
        x = float(np.clip((box[0] + box[2]) / 2, half_x, width - half_x))
        y = float(np.clip((box[1] + box[3]) / 2, half_y, height - half_y))
        left, top = max(0, int(x - half_x)), max(0, int(y - half_y))
        right, bottom = min(width, int(np.ceil(x + half_x))), min(height, int(np.ceil(y + half_y)))
        corner = np.array([left, top, left, top], np.float32)
        inside = (boxes[:, 0] >= left) & (boxes[:, 2] <= right) & (boxes[:, 1] >= top) & (boxes[:, 3] <= bottom)
        yield np.ascontiguousarray(pixels[top:bottom, left:right]), boxes[inside] - corner


def _fitted(boxes: F32, target: tuple[int, ...], source: tuple[int, ...]) -> F32:
    """Returns boxes of an image in the pixels of the letterboxed network input."""
    scale = min(target[0] / source[0], target[1] / source[1])
    off = np.array([(target[1] - scale * source[1]) / 2, (target[0] - scale * source[0]) / 2] * 2)
    return np.asarray(boxes * scale + off, np.float32)


def _changes(boxes: F32, wanted: F32) -> F32:
    """Returns (N, 4) what makes boxes (N, 4) the wanted one: shift of the middle by their size, logarithm of sizes."""
    size, other = boxes[:, 2:] - boxes[:, :2], wanted[2:] - wanted[:2]
    shift = ((wanted[:2] + wanted[2:]) / 2 - (boxes[:, :2] + boxes[:, 2:]) / 2) / size
    return np.concatenate([shift, np.log(other / size)], axis=1).astype(np.float32)


def _jittered(box: F32, rng: np.random.Generator, most: float = 0.07, count: int = 6) -> F32:
    """Returns a box and some whose sides differ from it by up to a share of its size, as a detector's would."""
    width, height = box[2] - box[0], box[3] - box[1]
    shifts = rng.uniform(-most, most, (count, 4)) * np.array([width, height, width, height])
    return np.concatenate([box[None], box + shifts]).astype(np.float32)
