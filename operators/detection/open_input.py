"""Networks of convolutions for images of any size, out of files that were exported for one size."""

from __future__ import annotations

from collections.abc import Callable, Collection

from operators.protobuf import field, fields

# Numbers of fields in the messages of ONNX
_GRAPH = 7
_INPUT, _OUTPUT, _INNER = 11, 12, 13  # of a graph; what describes its inner values
_NAME, _TYPE = 1, 2  # of what describes a value
_TENSOR = 1  # of a type
_SHAPE = 2  # of a tensor's type
_EXTENT = 1  # of a shape


def opened(model: bytes, image: str, extents: Collection[int]) -> bytes:
    """Returns an ONNX model whose input `image` leaves some extents open, and whose outputs say nothing of theirs.

    A network of convolutions answers an image of any size then; one that reshapes to given numbers fails where it runs.
    """

    def graph(message: bytes) -> bytes:
        parts = []
        for each in fields(message):
            if each.number == _INPUT and _name(each.content) == image:
                parts.append(field(_INPUT, _of_shape(each.content, lambda shape: _open(shape, extents))))
            elif each.number == _OUTPUT:
                parts.append(field(_OUTPUT, _of_shape(each.content, lambda shape: None)))
            elif each.number != _INNER:
                parts.append(each.serialized)
        return b"".join(parts)

    return _changed(model, _GRAPH, graph)


def _name(value: bytes) -> str:
    return next((each.content.decode() for each in fields(value) if each.number == _NAME), "")


def _of_shape(value: bytes, change: Callable[[bytes], bytes | None]) -> bytes:
    """Returns what describes a value, with its shape changed, or without one."""
    return _changed(value, _TYPE, lambda kind: _changed(kind, _TENSOR, lambda tensor: _changed(tensor, _SHAPE, change)))


def _open(shape: bytes, extents: Collection[int]) -> bytes:
    """Returns a shape without the numbers of some extents."""
    every = [each for each in fields(shape) if each.number == _EXTENT]
    return b"".join(field(_EXTENT, b"") if k in extents else each.serialized for k, each in enumerate(every))


def _changed(message: bytes, number: int, change: Callable[[bytes], bytes | None]) -> bytes:
    """Returns a message with the content of the fields of a number changed; without those that give None."""
    parts = []
    for each in fields(message):
        content = change(each.content) if each.number == number else None
        if each.number != number:
            parts.append(each.serialized)
        elif content is not None:
            parts.append(field(number, content))
    return b"".join(parts)
