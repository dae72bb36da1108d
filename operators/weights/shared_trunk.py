"""The trunk that networks trained together have alike: computed once for an image, however many of them see it.

`trunk` in the metadata of a network file lists the inner values that end it: the names of 8-bit maps, in an order that
is the same in all files with this trunk. Networks of a process that have the same trunk (the same arithmetic with the
same constants, by digest) share one. Their results are the same as with separate trunks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import numpy as np
import xxhash
from numpy.typing import NDArray

from operators.inference import open_content
from operators.weights.model_parts import ModelParts, Value

if TYPE_CHECKING:
    import onnxruntime

Maps = tuple[NDArray[np.uint8], ...]

_KEPT = 4
"""Images whose maps are kept: an operator may be some images ahead of another one, or there may be several cameras."""
_MAP = "tensor(uint8)"


class SharedTrunk:
    """A trunk: an image of the networks' input size → its maps.

    The maps of the latest images are kept, by the digest of their pixels: 1.4 MB an image for the networks that come
    with the project. Several threads may use it without waiting; at worst two compute the same maps.
    """

    def __init__(self, session: onnxruntime.InferenceSession) -> None:
        self._session = session
        self._input = session.get_inputs()[0].name
        self._kept: tuple[tuple[bytes, Maps], ...] = ()

    def maps(self, pixels: NDArray[np.uint8]) -> Maps:
        """Returns the maps (1, C, h, w) of an image (H, W, 3), RGB; they are read-only."""
        seen = xxhash.xxh3_128_digest(np.ascontiguousarray(pixels).data)
        for digest, maps in self._kept:
            if digest == seen:
                return maps
        made = tuple(self._session.run(None, {self._input: tensor_of(pixels)}))
        for each in made:
            each.flags.writeable = False
        self._kept = ((seen, made), *self._kept[: _KEPT - 1])
        return made

    def values(self, ends: Sequence[str]) -> list[Value]:
        """Describes the maps by the names that a file gives them."""
        outputs = self._session.get_outputs()
        return [Value(name, each.type, tuple(each.shape)) for name, each in zip(ends, outputs, strict=True)]


_opened: WeakValueDictionary[str, SharedTrunk] = WeakValueDictionary()


def divided(
    content: bytes, ends: Sequence[str], told: str, more: Sequence[str] = ()
) -> tuple[SharedTrunk, onnxruntime.InferenceSession]:
    """Divides a network into its trunk, which others may share, and the head that follows: it takes maps by the names
    of `ends` and gives the network's outputs, then the inner values `more`.

    Raises ModelError for a part that cannot be opened, and ValueError where the network has no inner value of such a
    name, or one that ends its trunk is no map in 8 bits.
    """
    model = ModelParts(content)
    digest = model.digest(ends)
    trunk = _opened.get(digest)
    if trunk is None:
        trunk = SharedTrunk(open_content(model.leading_to(ends), f"the trunk of {told}"))
        _opened[digest] = trunk
    values = trunk.values(ends)
    other = [each for each in values if each.type != _MAP]
    if other:
        raise ValueError(f"its trunk must end with {_MAP}; {other[0].name!r} is {other[0].type}")
    return trunk, open_content(model.following(values, more), f"the head of {told}")


def tensor_of(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Returns an image (H, W, 3), RGB, as networks take it: (1, 3, H, W) in [0, 1]."""
    tensor = np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], np.float32)
    tensor /= np.float32(255)
    return tensor
