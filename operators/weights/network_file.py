"""Network files: ONNX models that carry, as metadata, all that is needed to use them (classes, input size, anchors).

The metadata entry `dataflow.network` holds a JSON object with at least `kind`, `classes`, `width` and `height`. A
second network, which refines the answers of the first one, lies in the entry `dataflow.second`: a separate ONNX model
with such metadata, in base64; it is optional. If the first entry marks the end of a trunk (`trunk`), other networks of
the process with the same trunk share it.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operators.inference import ModelError, open_content, open_session
from operators.protobuf import fields
from operators.weights.shared_trunk import SharedTrunk, divided, tensor_of

if TYPE_CHECKING:
    import onnxruntime

KEY, SECOND, TRUNK = "dataflow.network", "dataflow.second", "trunk"
TRAINED_ON, SIMULATOR = "trained_on", "simulator"
_METADATA, _NAME, _VALUE = 14, 1, 2  # of a model; of an entry of its metadata
_IMAGES = ("kind", "classes", "width", "height")
_FOLDER = Path(__file__).parent


class NetworkFileError(ModelError):
    """A network file that does not fit its use: names the file, what it has and what would be right."""


def shipped(name: str) -> Path:
    """Returns where the project's own network `name` lies."""
    return _FOLDER / name


def trained_in_simulation(file: str | Path) -> bool:
    """Returns whether a network was trained in simulated worlds alone: it comes with the project, or its metadata state
    it (`trained_on`). Opens no network; False for a missing file and any other network."""
    file = Path(file).expanduser()
    if file.resolve().parent == _FOLDER.resolve():
        return True
    return _peeked(file).get(TRAINED_ON) == SIMULATOR


def kind_of(file: Path) -> str | None:
    """Returns the kind of a network that our training wrote (`detector`); None for any other file. Opens no network."""
    kind = _peeked(file).get("kind")
    return kind if isinstance(kind, str) else None


def _peeked(file: Path) -> dict[str, Any]:
    try:
        entries = (dict(_entry(f.content)) for f in fields(file.read_bytes()) if f.number == _METADATA)
        facts = next((json.loads(e[_VALUE]) for e in entries if e.get(_NAME) == KEY.encode()), None)
    except (OSError, ValueError):
        return {}
    return facts if isinstance(facts, dict) else {}


def _entry(content: bytes) -> Iterator[tuple[int, bytes]]:
    return ((each.number, each.content) for each in fields(content))


@dataclass(frozen=True, eq=False)
class Network:
    """An opened network. `size` is the (width, height) of its input, `facts` its whole metadata.

    Where it has a `trunk`, `session` is of the head that follows it.
    """

    file: Path
    size: tuple[int, int]
    classes: tuple[str, ...]
    facts: dict[str, Any]
    session: onnxruntime.InferenceSession
    trunk: SharedTrunk | None = None

    def run(self, pixels: NDArray[np.uint8]) -> Sequence[NDArray[Any]]:
        """The outputs for an image (H, W, 3), RGB, of the input's size."""
        names = [each.name for each in self.session.get_inputs()]
        if self.trunk is None:
            given: dict[str, NDArray[Any]] = {names[0]: tensor_of(pixels)}
        else:
            maps = dict(zip(self.facts[TRUNK], self.trunk.maps(pixels), strict=True))
            given = {name: maps[name] for name in names}
        found: Sequence[NDArray[Any]] = self.session.run(None, given)
        return found

    def revealing(self, names: Sequence[str]) -> Network:
        """The network that gives these inner values after its outputs. Raises ModelError for a name that it does not
        have."""
        if self.trunk is None:
            return replace(self, session=open_session(self.file, reveal=names))
        return _divided(self, names)


def open_kind(
    file: Path, kind: str, needed: Sequence[str] = _IMAGES, made_for: Mapping[str, Any] | None = None
) -> tuple[onnxruntime.InferenceSession, dict[str, Any]]:
    """Opens a network of a kind, whatever its inputs are; returns it with its metadata.

    Raises FileNotFoundError, or NetworkFileError for one of another kind, without the metadata that are needed, or with
    others than it must be `made_for`.
    """
    session = open_session(file)
    found = facts_of(file, session, ("kind",))["kind"]
    if found != kind:
        raise NetworkFileError(f"{file} is {_called(found)}; {_called(kind)} is needed: `dataflow train {kind} DATA`")
    facts = facts_of(file, session, needed)
    if made_for and any(facts.get(name) != value for name, value in made_for.items()):
        given, wanted = (", ".join(f"{name} {values.get(name)}" for name in made_for) for values in (facts, made_for))
        raise NetworkFileError(f"{file} is made for {given}, not {wanted}: `dataflow train {kind}` makes one")
    return session, facts


def _called(kind: str) -> str:
    """A kind with its article: a detector, an activity network."""
    name = kind if kind.endswith(("er", "or")) else f"{kind} network"
    return f"{'an' if name[:1] in 'aeiou' else 'a'} {name}"


def open_network(file: Path, kind: str) -> Network:
    """Opens a network for one CPU thread, so that equal images give equal outputs on any load and core count.

    Raises NetworkFileError where the file is no network of this `kind` (`detector`, `segmenter`, `classifier`).
    """
    session, facts = open_kind(file, kind)
    inputs = session.get_inputs()
    size = (int(facts["width"]), int(facts["height"]))
    if len(inputs) != 1 or inputs[0].type != "tensor(float)" or list(inputs[0].shape) != [1, 3, size[1], size[0]]:
        described = ", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)
        raise NetworkFileError(
            f"{file} must have one input tensor(float) [1, 3, {size[1]}, {size[0]}], has {described}"
        )
    network = Network(file, size, tuple(map(str, facts["classes"])), facts, session)
    return _divided(network) if TRUNK in facts else network


def _divided(network: Network, reveal: Sequence[str] = ()) -> Network:
    file, ends = network.file, network.facts[TRUNK]
    if not isinstance(ends, list) or not ends or not all(isinstance(each, str) for each in ends):
        raise NetworkFileError(f"{file}: {TRUNK!r} in its metadata must be a list of names, is {ends!r}")
    try:
        trunk, head = divided(file.read_bytes(), ends, str(file), reveal)
    except ValueError as error:
        raise NetworkFileError(f"{file} cannot be divided into trunk and head: {error}") from None
    return replace(network, session=head, trunk=trunk)


@dataclass(frozen=True, eq=False)
class SecondNetwork:
    """An opened second network. `told` describes where it lies, `facts` is its whole metadata."""

    told: str
    facts: dict[str, Any]
    session: onnxruntime.InferenceSession

    @property
    def inputs(self) -> dict[str, tuple[str, list[int]]]:
        """The type and the shape of a row of each input, by name."""
        return {each.name: (each.type, list(each.shape[1:])) for each in self.session.get_inputs()}

    def expect(self, inputs: Mapping[str, tuple[str, list[int]]]) -> None:
        """Raises NetworkFileError where it has other inputs."""
        if self.inputs != inputs:
            raise NetworkFileError(f"{self.told} must have the inputs {inputs}, has {self.inputs}")

    def sides(self, given: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """The answer (N, ...) to N rows of each input."""
        found: NDArray[np.float32] = self.session.run(["sides"], dict(given))[0]
        return found


def open_second(network: Network, kind: str, needed: Sequence[str] = ()) -> SecondNetwork | None:
    """Opens the second network in a file; None where it has none.

    Raises NetworkFileError for one that cannot be read, is of another kind or of other classes than the first, or whose
    metadata lack what is needed.
    """
    text = network.session.get_modelmeta().custom_metadata_map.get(SECOND)
    if text is None:
        return None
    told = f"the second network in {network.file}"
    try:
        content = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise NetworkFileError(f"{told} (metadata {SECOND!r}) is not base64: {error}") from None
    session = open_content(content, told)
    facts = facts_of(told, session, ("kind", "classes"))
    if facts["kind"] != kind or tuple(facts["classes"]) != network.classes:
        raise NetworkFileError(
            f"{told} must be of the kind {kind} and of the classes {', '.join(network.classes)}; it is of the kind "
            f"{facts['kind']} and of the classes {', '.join(map(str, facts['classes']))}"
        )
    return SecondNetwork(told, facts_of(told, session, needed), session)


def read_facts(file: Path) -> dict[str, Any]:
    """The metadata of a network file. Raises NetworkFileError."""
    return facts_of(file, open_session(file))


def training_seed(file: Path) -> int:
    """The seed of a network's training, by which its validation images were set aside; 0 where the file has none.

    Raises FileNotFoundError or NetworkFileError.
    """
    return int(read_facts(file).get("seed", 0))


def facts_of(
    file: Path | str, session: onnxruntime.InferenceSession, needed: Sequence[str] = _IMAGES
) -> dict[str, Any]:
    """Returns the metadata of an opened network file. Raises NetworkFileError where it lacks what is needed."""
    text = session.get_modelmeta().custom_metadata_map.get(KEY)
    if text is None:
        raise NetworkFileError(
            f"{file} has no metadata {KEY!r}; it was not written by `dataflow train` (for another family's ONNX file "
            f"use operators.detection:OnnxDetector)"
        )
    try:
        facts = json.loads(text)
    except json.JSONDecodeError as error:
        raise NetworkFileError(f"{file}: metadata {KEY!r} is not JSON: {error}") from None
    missing = [k for k in needed if not isinstance(facts, dict) or k not in facts]
    if missing:
        raise NetworkFileError(f"{file}: metadata {KEY!r} lacks {', '.join(missing)}")
    return dict(facts)
