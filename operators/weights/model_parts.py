"""Parts of a serialized ONNX model: what leads to some of its inner values, and what follows from them.

The package onnx is no dependency of those who only run networks. Numbers of fields are those of onnx.proto:
https://github.com/onnx/onnx/blob/main/onnx/onnx.proto
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from operators.protobuf import field, fields, number_field

_GRAPH, _OPERATOR_SETS, _METADATA = 7, 8, 14  # of a model
_NODE, _GRAPH_NAME, _CONSTANT, _INPUT, _OUTPUT = 1, 2, 5, 11, 12  # of a graph
_TAKES, _GIVES, _ARITHMETIC = 1, 2, (4, 5, 7)  # of a node; operation, attributes and domain
_CONSTANT_NAME, _CONSTANT_TOLD = 8, 12  # of a tensor
_VALUE_NAME, _VALUE_TYPE = 1, 2  # of an input or output
_TYPES = {"tensor(float)": 1, "tensor(uint8)": 2}


@dataclass(frozen=True)
class Value:
    """A tensor between two parts: its name, its type as onnxruntime calls it, and its shape."""

    name: str
    type: str
    shape: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class _Node:
    takes: tuple[str, ...]
    gives: tuple[str, ...]
    arithmetic: bytes
    serialized: bytes


class ModelParts:
    """A model of which parts are made. Raises ValueError for what is no protobuf message."""

    def __init__(self, content: bytes) -> None:
        self._model: dict[int, bytes] = {}
        self._nodes: list[_Node] = []
        self._constants: dict[str, bytes] = {}
        self._inputs: dict[str, bytes] = {}
        self._outputs: dict[str, bytes] = {}
        for each in fields(content):
            if each.number == _GRAPH:
                self._read(each.content)
            else:
                self._model[each.number] = self._model.get(each.number, b"") + each.serialized
        self._makers = {name: node for node in self._nodes for name in node.gives}

    def _read(self, graph: bytes) -> None:
        for each in fields(graph):
            if each.number == _NODE:
                self._nodes.append(_node(each.content, each.serialized))
            elif each.number == _CONSTANT:
                self._constants[_text(each.content, _CONSTANT_NAME)] = each.content
            elif each.number == _INPUT:
                self._inputs[_text(each.content, _VALUE_NAME)] = each.content
            elif each.number == _OUTPUT:
                self._outputs[_text(each.content, _VALUE_NAME)] = each.content

    def leading_to(self, names: Sequence[str]) -> bytes:
        """Returns the model, without its metadata, that gives these inner values.

        Raises ValueError for one that it does not have.
        """
        return self._part({}, {name: _named(name) for name in names}, _METADATA)

    def following(self, given: Sequence[Value], more: Sequence[str] = ()) -> bytes:
        """Returns the model that computes its own outputs, then the inner values `more`, from those that are given, of
        which it takes what it needs. Raises ValueError for an inner value that it does not have."""
        outputs = self._outputs | {name: _named(name) for name in more}
        return self._part({each.name: _described(each) for each in given}, outputs)

    def _part(self, given: Mapping[str, bytes], outputs: Mapping[str, bytes], without: int | None = None) -> bytes:
        nodes = self._needed(outputs, given)
        used = {name for node in nodes for name in node.takes}
        graph = [
            *(node.serialized for node in nodes),
            field(_GRAPH_NAME, b"part"),
            *(field(_CONSTANT, each) for name, each in self._constants.items() if name in used),
            *(field(_INPUT, each) for name, each in {**self._inputs, **given}.items() if name in used),
            *(field(_OUTPUT, each) for each in outputs.values()),
        ]
        model = [each for number, each in self._model.items() if number != without]
        return b"".join([*model, field(_GRAPH, b"".join(graph))])

    def _needed(self, outputs: Iterable[str], given: Mapping[str, bytes]) -> list[_Node]:
        """The nodes that compute outputs, in order, as far as they do not come before what is given."""
        wanted, needed = list(outputs), set()
        known = {"", *given, *self._inputs, *self._constants}
        while wanted:
            name = wanted.pop()
            if name in known:
                continue
            if name not in self._makers:
                raise ValueError(f"the model has no inner value {name!r}")
            known.add(name)
            needed.add(self._makers[name])
            wanted += self._makers[name].takes
        return [node for node in self._nodes if node in needed]

    def digest(self, names: Sequence[str]) -> str:
        """Returns what is equal where values are computed from inputs of the same names by the same arithmetic with
        the same constants, whatever constants and inner values are called.

        Raises ValueError for a value that the model does not have.
        """
        missing = [name for name in names if name not in self._digests]
        if missing:
            raise ValueError(f"the model has no inner value {missing[0]!r}")
        return digest_of([self._model.get(_OPERATOR_SETS, b""), *(self._digests[name] for name in names)]).hex()

    @cached_property
    def _digests(self) -> dict[str, bytes]:
        """The digest of every value. In a model, nodes stand in an order in which they can be computed."""
        known = {"": digest_of([b"none"])}
        known |= {name: digest_of([b"input", each]) for name, each in self._inputs.items()}
        known |= {name: digest_of([b"constant", _nameless(each)]) for name, each in self._constants.items()}
        for node in self._nodes:
            own = digest_of([b"node", node.arithmetic, *(known[name] for name in node.takes)])
            known |= {name: digest_of([own, bytes([k])]) for k, name in enumerate(node.gives)}
        return known


def _node(content: bytes, serialized: bytes) -> _Node:
    parts = list(fields(content))
    takes, gives = ([p.content.decode() for p in parts if p.number == number] for number in (_TAKES, _GIVES))
    arithmetic = b"".join(part.serialized for part in parts if part.number in _ARITHMETIC)
    return _Node(tuple(takes), tuple(gives), arithmetic, serialized)


def _text(message: bytes, number: int) -> str:
    return next((each.content.decode() for each in fields(message) if each.number == number), "")


def _nameless(tensor: bytes) -> bytes:
    told = (_CONSTANT_NAME, _CONSTANT_TOLD)
    return b"".join(each.serialized for each in fields(tensor) if each.number not in told)


def digest_of(parts: Iterable[bytes]) -> bytes:
    """The digest of a list of byte strings: lists that read alike in a row differ."""
    found = hashlib.sha256()
    for part in parts:
        found.update(len(part).to_bytes(8, "little") + part)
    return found.digest()


def _named(name: str) -> bytes:
    """An output, whose type and shape onnxruntime infers."""
    return field(_VALUE_NAME, name.encode())


def _described(value: Value) -> bytes:
    """An input."""
    shape = b"".join(field(1, number_field(1, extent)) for extent in value.shape)
    tensor = number_field(1, _TYPES[value.type]) + field(2, shape)
    return _named(value.name) + field(_VALUE_TYPE, field(1, tensor))
