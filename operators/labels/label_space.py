"""Reads label spaces: by class its other names, its roles and its usual sizes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from dataflow.operator import Operator

Role = Literal["agent", "person", "rolls", "seat", "container", "portable", "support", "drink", "goal"]

ROLES: Mapping[Role, str] = {
    "agent": "moves by itself: its place is that of its last view, and it has an activity",
    "person": "an agent with hands: it holds and reaches, sits, and has goals",
    "rolls": "an agent that is moved by others: its activities are rolling and resting",
    "seat": "persons sit on it",
    "container": "objects are in it, not only on it or under it",
    "portable": "persons carry it away in their hands",
    "support": "has a top at which persons stand, such as a table",
    "drink": "persons drink from it",
    "goal": "persons may be heading for it",
}
"""The roles that a class may have, with what each means to maps and scene graphs."""

BUILT_IN = ("coco", "simulator")
"""Label spaces that come with the project."""

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_NONE: frozenset[Role] = frozenset()


class LabelSpaceError(ValueError):
    """A file is no label space; the message gives the file, the entry, and what would be right."""


@dataclass(frozen=True)
class SizePrior:
    """One of the usual sizes of a class: shorter and longer side on the ground and height, in metres.

    `spread` holds the standard deviations of the natural logarithms of the three. A `round` object has an elliptic
    outline, as seen from above. Points of a leafy object lie inside its box, by the share `inset` of half its side. An
    object on the floor may have up to `foot` metres of its foot hidden; 0 for others. An object `along` the room is
    always aligned with it: it stands at a wall. A prior may prefer one box over another; it removes nothing from a map.
    """

    size: tuple[float, float, float]
    spread: tuple[float, float, float]
    round: bool = False
    inset: float = 0.0
    foot: float = 0.0
    along: bool = False


@dataclass(frozen=True)
class _Entry:
    roles: frozenset[Role] = _NONE
    sizes: tuple[SizePrior, ...] = ()


class LabelSpace:
    """Roles and usual sizes of classes by name. Case, `_` and surrounding blanks of a name do not matter.

    A class without an entry has no roles and no usual size; it is mapped as any other.
    """

    def __init__(self, name: str, entries: Mapping[str, _Entry] | None = None) -> None:
        self.name = name
        self._entries = dict(entries or {})

    @classmethod
    def read(cls, file: Path) -> LabelSpace:
        """Reads a YAML file. Raises FileNotFoundError, and LabelSpaceError for a file that is no label space."""
        try:
            content = _content(file.read_text(encoding="utf-8"))
        except (YAMLError, UnicodeDecodeError) as error:
            raise LabelSpaceError(f"{file} is no YAML: {error}") from None
        try:
            given = _File.model_validate(content)
        except ValidationError as error:
            raise LabelSpaceError(_explained(file, error)) from None
        entries: dict[str, _Entry] = {}
        for label, entry in given.labels.items():
            made = _Entry(frozenset(entry.roles), tuple(size.prior(_METRES[given.unit]) for size in entry.sizes))
            for name in (label, *entry.aliases):
                if _key(name) in entries:
                    raise LabelSpaceError(f"{file}: labels.{label}: {name!r} is there twice; name each class once")
                entries[_key(name)] = made
        return cls(given.label_space, entries)

    def roles(self, label: str) -> frozenset[Role]:
        """Returns the roles of a class; none where it has no entry."""
        return self._entries.get(_key(label), _Entry()).roles

    def sizes(self, label: str) -> tuple[SizePrior, ...]:
        """Returns the usual sizes of a class, one for each way in which such things stand; none without an entry."""
        return self._entries.get(_key(label), _Entry()).sizes

    def indices(self, labels: Sequence[str], role: Role) -> list[int]:
        """Returns which of the classes have a role, by their numbers."""
        return [k for k, label in enumerate(labels) if role in self.roles(label)]

    def called(self, name: str, labels: Sequence[str]) -> list[str]:
        """Returns which of the classes are called `name`: the class of that name, else those that share its entry."""
        own = [label for label in labels if _key(label) == _key(name)]
        entry = self._entries.get(_key(name))
        return own or [label for label in labels if entry and self._entries.get(_key(label)) is entry]

    def names(self, labels: Iterable[str]) -> list[str]:
        """Returns all names that the classes have, by their entries too; in lower case with blanks, sorted."""
        own = {_key(label) for label in labels}
        entries = {id(self._entries[name]) for name in own if name in self._entries}
        return sorted(own | {name for name, entry in self._entries.items() if id(entry) in entries})

    def unknown(self, labels: Iterable[str]) -> list[str]:
        """Returns the classes that have no entry."""
        return [label for label in labels if _key(label) not in self._entries]


def warn_of_unknown(operator: Operator, labels: LabelSpace, classes: Iterable[str]) -> int:
    """Returns how many classes of a network have no entry, after one warning of an operator that names them."""
    unknown = labels.unknown(classes)
    if unknown:
        names = ", ".join(map(repr, unknown))
        text = "the label space %s has no entry for %s: they have no roles and no usual size; `labels` names another"
        operator.log.warning(text, labels.name, names)
    return len(unknown)


def labels_file(given: str) -> str:
    """Returns the file of a label space that comes with the project, by its name; a path stays as it is."""
    return str(Path(__file__).parent / f"{given}.yaml") if given in BUILT_IN else given


def _key(label: str) -> str:
    return label.replace("_", " ").strip().lower()


def _explained(file: Path, error: ValidationError) -> str:
    lines = []
    for each in error.errors():
        where = ".".join(map(str, each["loc"])) or "the file"
        given = "" if each["type"] == "missing" else f", not {each['input']!r}"
        lines.append(f"{where}: {each['msg']}{given}")
    return f"{file} is no label space: {'; '.join(lines)} (docs/scene-graph.md#labels describes one)"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Three = Annotated[list[_Positive], Field(min_length=3, max_length=3)]


class _Size(_Strict):
    size: _Three
    spread: _Three
    round: bool = False
    inset: Annotated[float, Field(ge=0, lt=1)] = 0.0
    hidden_foot: Annotated[float, Field(ge=0)] = 0.0
    along: bool = False

    def prior(self, metres: float) -> SizePrior:
        width, depth = sorted(zip(self.size[:2], self.spread[:2], strict=True))
        size = (width[0] * metres, depth[0] * metres, self.size[2] * metres)
        spread = (width[1], depth[1], self.spread[2])
        return SizePrior(size, spread, self.round, self.inset, self.hidden_foot * metres, self.along)


class _Label(_Strict):
    aliases: list[str] = []
    roles: list[Role] = []
    sizes: list[_Size] = []


class _File(_Strict):
    label_space: str
    unit: Literal["m", "cm", "mm"]
    labels: dict[str, _Label]


@lru_cache(maxsize=8)
def _content(text: str) -> Any:
    """Returns the values of a YAML text, parsed once for all operators that read it. Raises `YAMLError`."""
    return YAML(typ="safe", pure=True).load(text)
