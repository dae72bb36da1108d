"""The grid detector's loss: CIoU for boxes, binary cross-entropy for objectness (with ignore regions) and classes.

An object is given to every anchor of similar size (YOLOv5's rule: neither side differs by a factor of four) in its
centre's cell and in the nearer neighbours to each side; one that fits no anchor is given to the nearest in shape.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

MAX_RATIO = 4.0
IGNORE_IOU = 0.7
"""A box that overlaps an object by more is not punished, even where its anchor was not given the object."""
_SURELY_EMPTY = -3.0  # objectness before the sigmoid, 5 %
_BALANCE = (4.0, 1.0, 0.4, 0.1)  # many small cells hold few objects, few large cells many


@dataclass(frozen=True, eq=False)
class Truth:
    """The objects of a batch: `image` (T,) int64, `classes` (T,) int64, `boxes` (T, 4) corners in input pixels.

    `ignored` (T,) bool marks those that are neither to be found nor wrong to find.
    """

    image: Tensor
    classes: Tensor
    boxes: Tensor
    ignored: Tensor

    def to(self, device: torch.device) -> Truth:
        return Truth(*(t.to(device) for t in (self.image, self.classes, self.boxes, self.ignored)))


@dataclass(frozen=True, eq=False)
class Assignment:
    """Assigns anchors of one map to objects: entries of (image, anchor, row, column) and the object (index into
    Truth)."""

    image: Tensor
    anchor: Tensor
    row: Tensor
    column: Tensor
    target: Tensor


def assign(truth: Truth, anchors: Tensor, strides: Sequence[int], sizes: Sequence[tuple[int, int]]) -> list[Assignment]:
    """Gives each object that counts to cells and anchors. `anchors` (L, A, 2), `sizes` (H, W) of each map."""
    wanted = torch.nonzero(~truth.ignored).flatten()
    boxes = truth.boxes[wanted]
    center, size = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]).clamp(min=1e-3)
    ratio = size[:, None, None] / anchors[None]  # (T, L, A, 2)
    worst = torch.maximum(ratio, 1 / ratio).amax(dim=3)
    similar = worst < MAX_RATIO
    if len(wanted):
        lonely = torch.nonzero(~similar.flatten(1).any(dim=1)).flatten()
        similar.view(len(wanted), -1)[lonely, worst.flatten(1).argmin(dim=1)[lonely]] = True
    return [
        _in_map(wanted, truth.image[wanted], center / stride, similar[:, level], sizes[level])
        for level, stride in enumerate(strides)
    ]


def _in_map(wanted: Tensor, image: Tensor, center: Tensor, similar: Tensor, size: tuple[int, int]) -> Assignment:
    height, width = size
    target, anchor = torch.nonzero(similar, as_tuple=True)
    limit = torch.tensor([width, height], device=center.device, dtype=center.dtype)
    at = center[target].clamp(min=0).minimum(limit - 1e-3)
    cell, part = at.floor(), at - at.floor()
    side = torch.where(part < 0.5, -1.0, 1.0)  # the neighbour that the centre leans to
    zero = torch.zeros_like(side[:, 0])
    shifts = (torch.zeros_like(side), torch.stack([side[:, 0], zero], 1), torch.stack([zero, side[:, 1]], 1))
    cells = torch.cat([cell + shift for shift in shifts])
    inside = ((cells >= 0) & (cells < limit)).all(dim=1)
    cells = cells[inside].long()
    target, anchor = target.repeat(3)[inside], anchor.repeat(3)[inside]
    return Assignment(image[target], anchor, cells[:, 1], cells[:, 0], wanted[target])


def decode_maps(
    maps: Sequence[Tensor], anchors: Tensor, strides: Sequence[int], classes: int
) -> list[tuple[Tensor, Tensor]]:
    """Per map: boxes (N, A, H, W, 4), corners in input pixels; raw objectness and classes (N, A, H, W, 1 + C)."""
    decoded = []
    for level, (output, stride) in enumerate(zip(maps, strides, strict=True)):
        batch, _, height, width = output.shape
        raw = output.view(batch, anchors.shape[1], 5 + classes, height, width).permute(0, 1, 3, 4, 2)
        columns = torch.arange(width, device=output.device).expand(height, width)
        rows = torch.arange(height, device=output.device)[:, None].expand(height, width)
        center = (raw[..., :2].sigmoid() * 2 - 0.5 + torch.stack([columns, rows], dim=2)) * stride
        half = (raw[..., 2:4].sigmoid() * 2) ** 2 * anchors[level][None, :, None, None] / 2
        decoded.append((torch.cat([center - half, center + half], dim=4), raw[..., 4:]))
    return decoded


def detection_loss(
    maps: Sequence[Tensor], truth: Truth, anchors: Tensor, strides: Sequence[int], classes: int
) -> dict[str, Tensor]:
    """The parts of the loss (`box`, `objectness`, `class`), weighted so that their sum is to be minimised."""
    assigned = assign(truth, anchors, strides, [(m.shape[2], m.shape[3]) for m in maps])
    box_loss = class_loss = objectness_loss = maps[0].new_zeros(())
    for level, (boxes, raw) in enumerate(decode_maps(maps, anchors, strides, classes)):
        cells = assigned[level]
        at = (cells.image, cells.anchor, cells.row, cells.column)
        wanted = torch.zeros_like(raw[..., 0])
        if len(cells.target):
            overlap = complete_iou(boxes[at], truth.boxes[cells.target])
            box_loss = box_loss + (1 - overlap).mean()
            # The score learns how well the box fits; cells given two objects take the better fit, whatever their order.
            quality = overlap.detach().clamp(0.0, 1.0)
            wanted = wanted.index_put(at, quality.new_zeros(())).flatten()
            flat = _flat_index(at, raw.shape)
            wanted = wanted.scatter_reduce(0, flat, quality, "amax").view(raw.shape[:-1])
            label = functional.one_hot(truth.classes[cells.target], classes).to(raw.dtype)
            class_loss = class_loss + functional.binary_cross_entropy_with_logits(raw[at][:, 1:], label)
        weight = 1 - _ignored(boxes, raw[..., 0], truth, strides[level]).to(raw.dtype)
        weight[at] = 1
        entropy = functional.binary_cross_entropy_with_logits(raw[..., 0], wanted, reduction="none")
        objectness_loss = objectness_loss + _BALANCE[level] * (entropy * weight).mean()
    return {"box": 0.05 * 3 * box_loss, "objectness": 3.0 * objectness_loss, "class": 0.5 * class_loss}


def complete_iou(a: Tensor, b: Tensor) -> Tensor:
    """CIoU (N,) of boxes (N, 4), corners: IoU less centre distance and difference of proportions (Zheng 2020)."""
    size_a, size_b = (a[:, 2:] - a[:, :2]).clamp(min=1e-6), (b[:, 2:] - b[:, :2]).clamp(min=1e-6)
    overlap = (torch.minimum(a[:, 2:], b[:, 2:]) - torch.maximum(a[:, :2], b[:, :2])).clamp(min=0).prod(dim=1)
    iou = overlap / (size_a.prod(dim=1) + size_b.prod(dim=1) - overlap + 1e-9)
    hull = torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])
    distance = ((a[:, :2] + a[:, 2:] - b[:, :2] - b[:, 2:]) ** 2).sum(dim=1) / 4
    proportion = torch.atan(size_a[:, 0] / size_a[:, 1]) - torch.atan(size_b[:, 0] / size_b[:, 1])
    v = (4 / math.pi**2) * proportion**2
    with torch.no_grad():
        alpha = v / (1 - iou + v + 1e-9)
    return iou - distance / ((hull**2).sum(dim=1) + 1e-9) - alpha * v


def _flat_index(at: tuple[Tensor, Tensor, Tensor, Tensor], shape: torch.Size) -> Tensor:
    image, anchor, row, column = at
    return ((image * shape[1] + anchor) * shape[2] + row) * shape[3] + column


@torch.no_grad()
def _ignored(boxes: Tensor, objectness: Tensor, truth: Truth, stride: int) -> Tensor:
    """Returns which predictions (N, A, H, W) are not to be punished: cells in an ignored object, boxes much like an
    object.

    Those that are sure enough to be empty are not compared: most are, and the comparison costs more than the network.
    """
    count, _, height, width, _ = boxes.shape
    mask = torch.zeros(boxes.shape[:-1], dtype=torch.bool, device=boxes.device)
    x = (torch.arange(width, device=boxes.device) + 0.5) * stride
    y = (torch.arange(height, device=boxes.device) + 0.5) * stride
    likely = objectness > _SURELY_EMPTY
    for i in range(count):
        mine = truth.image == i
        if not mine.any():
            continue
        hidden, shown = truth.boxes[mine & truth.ignored], truth.boxes[mine]
        columns = (x[None] > hidden[:, 0:1]) & (x[None] < hidden[:, 2:3])
        rows = (y[None] > hidden[:, 1:2]) & (y[None] < hidden[:, 3:4])
        mask[i] = (rows[:, :, None] & columns[:, None, :]).any(dim=0)
        mask[i, likely[i]] |= _pairwise_iou(boxes[i, likely[i]], shown).amax(dim=1) > IGNORE_IOU
    return mask


def _pairwise_iou(a: Tensor, b: Tensor) -> Tensor:
    corner = torch.minimum(a[:, None, 2:], b[None, :, 2:]) - torch.maximum(a[:, None, :2], b[None, :, :2])
    overlap = corner.clamp(min=0).prod(dim=2)
    area_a, area_b = (a[:, 2:] - a[:, :2]).prod(dim=1), (b[:, 2:] - b[:, :2]).prod(dim=1)
    return overlap / (area_a[:, None] + area_b[None] - overlap + 1e-9)
