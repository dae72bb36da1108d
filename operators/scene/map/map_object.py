"""One object of the map: its voxels, the views of it, and the box that they give."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.labels import SizePrior
from operators.scene.map.cuboid import ImageView, fit_cuboid
from operators.scene.map.trajectory import Correction
from operators.scene.map.voxels import VoxelSet, standing_box

Array = NDArray[np.float64]

MOST_EVIDENCE = 6.0
WHOLE = 100_000_000
"""Nanoseconds since the last view of a thing, from which a view counts in full: sooner ones show the same again."""

_BRINK = 0.012  # metres that masks and clouds lose of each side of an object
_KEPT = 16  # views of an object
_TRACKS = 16  # tracks of an object that are kept
_FAR, _ENOUGH = 1.6, 5  # a view is dropped at so many times the range of the third nearest of so many views
_SAMPLE = 16  # points of a view that are kept
_SMALL = 0.5  # metres up to which things are seen whole, so that the kept views have points enough
_STRAYS = 2.5  # standard deviations by which the edges of a view stray that is of something else
_APART = 0.02  # angle, rad, and a third of the change of the distance, from which two views show different things
_AGAIN = 0.25  # share of the views that are new, from which the box is fitted again
_SETTLED = 9  # views after which the way in which it stands is settled
_POINTS = 45  # points of an object that a fit uses
_PLAIN = ("id", "evidence", "born", "seen", "views", "told", "yaw", "most", "form")
_ARRAYS = ("votes", "color", "center", "size", "velocity", "view")


@dataclass
class MapObject:
    """One object of the map, in an upright box. Times in nanoseconds.

    `told` sums for its views the time since the one before, `WHOLE` at most.
    `votes` (C,) sums scores by class, `view` (2,) the horizontal directions of the views; `most` is the largest number
    of voxels that it had; `images` are the views that its box is fitted to, `form` which of the ways in which its class
    stands, -1 while that is open,
    `fresh` how many of them are new since the last fit; `held` whether it was last seen in a hand. `beside` counts by
    id the views in which another object was seen too, in a separate place in the image. `tracks` are the ids of the
    last tracks in images that were of it, the latest last. `moving` is the probability that it moves, NaN where that
    is left to its places.
    """

    id: int
    voxels: VoxelSet
    votes: Array
    evidence: float
    born: int
    seen: int
    views: int = 1
    told: int = WHOLE
    color: Array = field(default_factory=lambda: np.full(3, np.nan))
    center: Array = field(default_factory=lambda: np.zeros(3))
    size: Array = field(default_factory=lambda: np.zeros(3))
    yaw: float = 0.0
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    view: Array = field(default_factory=lambda: np.zeros(2))
    most: int = 0
    images: list[ImageView] = field(default_factory=list)
    form: int = -1
    beside: Counter[int] = field(default_factory=Counter)
    held: bool = False
    fresh: int = 0
    tracks: list[int] = field(default_factory=list)
    moving: float = math.nan

    def __post_init__(self) -> None:
        self.class_id = int(self.votes.argmax())

    def vote(self, class_id: int, count: float) -> None:
        """Counts labels of a class."""
        self.votes[class_id] += count
        self.class_id = int(self.votes.argmax())

    @property
    def score(self) -> float:
        """Probability that the object is there."""
        return 1 / (1 + math.exp(-self.evidence))

    @property
    def label(self) -> float:
        """Mean over its views of what labels of its class count, others counting as 0."""
        return float(self.votes[self.class_id]) / self.views

    @property
    def sightings(self) -> int:
        """Number of its views, to the nearest, those soon after another counting less: alike at any rate of images."""
        return round(self.told / WHOLE)

    @property
    def longest(self) -> float:
        """Length of the longest side of the box."""
        return float(max(self.size.tolist()))

    @property
    def box(self) -> tuple[Array, Array, float]:
        return self.center, self.size, self.yaw

    def follow(self, tracks: Iterable[int]) -> None:
        """Notes tracks that are of the object, the latest last."""
        new = list(tracks)
        self.tracks = [*(t for t in self.tracks if t not in new), *new][-_TRACKS:]

    def look(self, view: ImageView, points: Array | None = None) -> bool:
        """Keeps a view that adds information, with some of its points (N, 3).

        Of things that are seen whole from near, views from afar are dropped. Returns whether to fit the box again.
        """
        if not view.edges.any():
            return False
        if points is not None:
            view = replace(view, points=points[:: -(-len(points) // _SAMPLE)])
        way = view.eye - self.center
        if len(self.images) >= 3:
            ways = np.array([v.eye for v in self.images]) - self.center
            lengths, length = np.sqrt((ways * ways).sum(axis=1)), float(np.sqrt(way @ way))
            turned = ways @ way < np.cos(_APART) * lengths * length
            if not (turned | (np.abs(lengths - length) > 3 * _APART * lengths)).all():
                return False
        self.images.append(view)
        if len(self.images) >= _ENOUGH:
            lengths = np.sqrt(((np.stack([v.eye for v in self.images]) - self.center) ** 2).sum(axis=1))
            whole = np.sort(lengths[[bool(v.edges.all()) for v in self.images]])
            limit = _FAR * whole[2] if len(whole) >= 3 else np.inf
            self.images = [v for v, far in zip(self.images, (lengths > limit).tolist(), strict=True) if not far]
        if len(self.images) > _KEPT:
            self.images.pop(_most_alike([v.eye - self.center for v in self.images]))
        self.fresh += 1
        return self.fresh >= _AGAIN * len(self.images)

    def fit(
        self,
        usual: Mapping[int, Sequence[SizePrior]],
        heading: float | None = None,
        noise: float = 0.0,
        floor: float | None = None,
        others: Sequence[VoxelSet] = (),
    ) -> None:
        """Puts the box around what is surely the object's and not `others`', in agreement with its images and class.

        `heading` is that of most things around, `noise` that of ranges at one metre; it grows by the square. Its height
        over the `floor`, if that is known, selects among the usual forms of its class.
        """
        self.fresh = 0
        sure = self.voxels.sure(others)
        if not len(sure):
            return
        sizes = [max(u.size) for u in usual.get(self.class_id, ())]
        raw = bool(self.images) and max(sizes, default=1.0) <= _SMALL
        if raw:
            own = np.concatenate([v.points for v in self.images])
            raw = len(own) >= _POINTS // 3
            sure = own if raw else sure
        center, size, yaw = standing_box(sure)
        box = (center, size + 2 * _BRINK, yaw)
        known = usual.get(self.class_id, ())
        if self.images:
            before = (self.form, self.box) if self.form >= 0 else None
            some = sure[:: -(-len(sure) // _POINTS)]
            form, box, strays = fit_cuboid(box, self.images, some, known, before, heading, noise, raw=raw)
            of_others = strays > _STRAYS
            if len(self.images) >= _ENOUGH and of_others.any() and of_others.sum() <= len(of_others) // 3:
                self.images = [v for v, other in zip(self.images, of_others.tolist(), strict=True) if not other]
                form, box, _ = fit_cuboid(box, self.images, some, known, None, heading, noise, raw=raw)
            self.form = form if len(self.images) >= _SETTLED else -1
        elif known:
            stands = floor is not None and all(u.foot > 0 for u in known)
            height = float(box[0][2] + box[1][2] / 2) - floor if stands and floor is not None else float(box[1][2])
            usually = min(known, key=lambda u: abs(math.log(u.size[2] / max(height, 0.01)))) if stands else known[0]
            box = completed(box, self.view / max(self.views, 1), usually)
        self.center, self.size, self.yaw = box

    def keep(self, box: tuple[Array, Array, float]) -> None:
        """Keeps a box from before a view that the image cuts off, moved and grown as little as what is seen needs."""
        center, size, yaw = box
        c, s = math.cos(yaw), math.sin(yaw)
        axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        own = (self.voxels.points - center) @ axes
        low, high = own.min(axis=0), own.max(axis=0)
        larger = np.maximum(size, high - low)
        shift = np.clip(0.0, high - larger / 2, low + larger / 2)
        self.center, self.size, self.yaw = center + axes @ shift, larger, yaw

    def stand_on(self, floor: float, foot: float) -> None:
        """Lets the box reach down to a floor that is not farther below it than a `foot` may be hidden, metres."""
        bottom, top = float(self.center[2] - self.size[2] / 2), float(self.center[2] + self.size[2] / 2)
        if bottom - floor <= foot and top > floor + foot / 2:
            self.center, self.size = self.center.copy(), self.size.copy()
            self.center[2], self.size[2] = (top + floor) / 2, top - floor

    def correct(self, correction: Correction) -> None:
        """Moves each voxel and each image with the place from which it was seen; the box is to be fitted then."""
        weights = self.voxels.hits.sum()
        T = correction.at(round(float(self.voxels.hits @ self.voxels.times / weights)) if weights else self.seen)
        turn = T[:2, :2] @ np.array([math.cos(self.yaw), math.sin(self.yaw)])
        self.voxels.correct(correction)
        self.yaw = math.atan2(float(turn[1]), float(turn[0]))
        self.center = T[:3, :3] @ self.center + T[:3, 3]
        self.velocity, self.view = T[:3, :3] @ self.velocity, T[:2, :2] @ self.view
        self.images = [image.moved(correction.at(image.stamp)) for image in self.images]
        self.most = min(self.most, len(self.voxels))

    # snapshot and restore are written out: saved maps hold what they give, and those of earlier versions are read

    def snapshot(self) -> dict[str, Any]:
        rows = self.images
        images = [np.stack([getattr(v, name) for v in rows]) for name in ("P", "box", "edges", "eye")] if rows else []
        plain = {name: getattr(self, name) for name in (*_PLAIN, *_ARRAYS)}
        beside = sorted(self.beside.items())
        rest = {"cells": self.voxels.snapshot(), "images": images, "beside": [list(each) for each in beside]}
        points = [np.concatenate([v.points for v in rows]), np.array([len(v.points) for v in rows])] if rows else []
        times = {"image_stamps": [v.stamp for v in rows]}
        return (
            plain
            | rest
            | times
            | {"held": self.held, "fresh": self.fresh, "points": points, "tracks": self.tracks, "moving": self.moving}
        )

    @classmethod
    def restored(cls, state: Mapping[str, Any], side: float) -> MapObject:
        voxels = VoxelSet(side)
        voxels.restore(state["cells"])
        fields: dict[str, Any] = {name: np.array(state[name], np.float64) for name in _ARRAYS}
        plain = {"told": state["views"] * WHOLE, **state}  # earlier versions counted views alone
        made = cls(voxels=voxels, **{name: plain[name] for name in _PLAIN}, **fields)
        made.beside = Counter({int(other): int(count) for other, count in state.get("beside", ())})
        made.held = bool(state.get("held", False))
        for P, box, edges, eye in zip(*state["images"], strict=True) if len(state["images"]) else ():
            view = ImageView(np.array(P), np.array(box), np.array(edges, np.bool_), np.array(eye))
            made.images.append(view)
        if len(state.get("points", ())):  # earlier versions have none
            parts = np.split(np.array(state["points"][0]), np.cumsum(state["points"][1])[:-1])
            made.images = [replace(v, points=own) for v, own in zip(made.images, parts, strict=True)]
        if len(state.get("image_stamps", ())):  # and these
            rows = zip(made.images, state["image_stamps"], strict=True)
            made.images = [replace(v, stamp=int(stamp)) for v, stamp in rows]
        made.fresh = int(state.get("fresh", 0))
        made.moving = float(state.get("moving", math.nan))
        made.tracks = [int(track) for track in state.get("tracks", ())]
        return made


def _most_alike(ways: Sequence[Array]) -> int:
    """Returns the view, of all but the newest, that is nearest in direction to another; the older one of two."""
    units = np.array([w / max(float(np.linalg.norm(w)), 1e-9) for w in ways])
    near = units @ units.T - 2 * np.eye(len(units))
    return int(np.argmax(near[:-1].max(axis=1)))


def completed(box: tuple[Array, Array, float], view: Array, usual: SizePrior) -> tuple[Array, Array, float]:
    """Returns a box that is as deep as usual where only its near side was seen.

    `view` (2,) is the mean horizontal direction of the views, of length 1 where all were from one side. The side across
    the view decides which of the two usual sides on the ground lies along it. The box grows away from the viewer, less
    where views differ. No side is much shorter than is usual.
    """
    center, size, yaw = box[0].copy(), box[1].copy(), box[2]
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    along = axes @ view
    deep = int(np.argmax(np.abs(along)))
    short, long, _ = usual.size
    across = float(size[1 - deep])
    size[1 - deep] = max(across, 0.8 * short)  # narrower things are seen in part
    target = long if across < np.sqrt(short * long) else short
    lack = max(0.0, target - float(size[deep])) * min(1.0, abs(float(along[deep])) * 1.2)
    size[deep] += lack
    center[:2] += axes[deep] * np.sign(along[deep]) * lack / 2
    return center, size, yaw
