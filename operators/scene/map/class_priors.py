"""Knowledge about the classes of a map: which move by themselves, and how large their things are."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from operators.labels import LabelSpace, SizePrior
from operators.scene.map.map_object import MapObject
from operators.scene.map.matching import LARGE

Array = NDArray[np.float64]
_SMALL, _STILL = 0.5, 0.2  # metres, and metres a second
_ODD = 4.0  # spreads above the usual size, from which an object is doubted


class ClassPriors:
    """Derives for objects and classes what follows from which classes move and which sizes are usual."""

    @classmethod
    def of(cls, labels: LabelSpace, classes: Sequence[str]) -> ClassPriors:
        """Returns what a label space has about the classes of a map, by their numbers."""
        movers, carriers, portable = (labels.indices(classes, role) for role in ("agent", "person", "portable"))
        usual = {k: labels.sizes(name) for k, name in enumerate(classes) if labels.sizes(name)}
        return cls(movers, usual, carriers, portable)

    def __init__(
        self,
        movers: Iterable[int],
        usual: Mapping[int, Sequence[SizePrior]],
        carriers: Iterable[int] = (),
        portable: Iterable[int] = (),
    ) -> None:
        """`carriers` may hold what is `portable`."""
        self.carriers, self.portable = frozenset(carriers), frozenset(portable)
        self.movers, self.usual = frozenset(movers), dict(usual)
        self._largest = {i: max((max(u.size) for u in self.usual.get(i, ())), default=0.0) for i in self.movers}
        self._most = {
            i: [[size * math.exp(_ODD * spread) for size, spread in zip(u.size, u.spread, strict=True)] for u in usual]
            for i, usual in self.usual.items()
            if usual and i not in self.movers
        }

    def is_mover(self, object: MapObject) -> bool:
        """Returns whether an object is of a class that moves by itself; small ones do only while they are moved."""
        return object.class_id in self.movers and not self.is_still(object)

    def is_still(self, object: MapObject) -> bool:
        """Returns whether an object is small and lies still, so that it may be of a class that moves or not."""
        size, class_id = object.longest, object.class_id
        if class_id in self.movers:
            size = max(size, self._largest[class_id])
        return size <= _SMALL and max(map(abs, object.velocity.tolist())) <= _STILL

    def may_leave(self, object: MapObject) -> bool:
        """Returns whether an object is small, and of a class that moves by itself or is taken away in hands."""
        return object.longest <= _SMALL and (object.class_id in self.movers or object.class_id in self.portable)

    def is_large(self, object: MapObject) -> bool:
        """Returns whether things of an object's class are seldom seen whole."""
        usual = self.usual.get(object.class_id)
        return (max(u.size[1] for u in usual) if usual else float(object.size[:2].max())) >= LARGE

    def is_round(self, object: MapObject) -> bool:
        return any(u.round for u in self.usual.get(object.class_id, ()))

    def foot(self, object: MapObject) -> float:
        """Returns how much of an object's foot may be hidden, metres; 0 where its class does not stand on the floor."""
        return max((u.foot for u in self.usual.get(object.class_id, ())), default=0.0)

    def doubt(self, object: MapObject, label: float) -> float:
        """Returns the share, in [0, 1), of an object's existence that its class puts in doubt; 0 for none.

        Half where no thing of the class is usually so large, seen in part or whole. A class whose things are small and
        leave their places is often called so by mistake: where its mean label is below `label`, what that lacks.
        """
        kept = 1.0 if self.has_usual_size(object) else 0.5
        if object.label < label and self.may_leave(object):
            kept *= object.label / label
        return 1 - kept

    def has_usual_size(self, object: MapObject) -> bool:
        """Returns whether no side is more than four spreads above a usual one; True where the class has none."""
        most = self._most.get(object.class_id)
        if most is None:
            return True
        width, depth, height = object.size.tolist()
        if width > depth:
            width, depth = depth, width
        return any(width <= most_w and depth <= most_d and height <= most_h for most_w, most_d, most_h in most)

    def near_side(self, points: Array, class_id: int, eye: Array, noise: float) -> Array:
        """Returns one view's points (N, 3) without those that are farther behind most than such a thing is deep.

        Of the ways in which the class stands, that counts which is as high as the points. `noise` is that of ranges.
        """
        usual = self.usual.get(class_id)
        if not usual:
            return points
        x, y, z = points[:, 0] - eye[0], points[:, 1] - eye[1], points[:, 2]
        ranges = np.sqrt(x * x + y * y)
        height = max(float(z.max() - z.min()), 0.01)
        form = min(usual, key=lambda u: abs(math.log(u.size[2] / height)))
        ranked = np.sort(ranges)
        deep = form.size[1] * math.exp(form.spread[1]) + 4 * noise * float(ranked[0]) ** 2
        counts = np.searchsorted(ranked, ranked + deep, side="right") - np.arange(len(ranked))
        first = ranked[int(np.argmax(counts))]
        return np.asarray(points[(ranges >= first) & (ranges <= first + deep)])
