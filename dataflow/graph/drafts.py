"""A graph on its way from files to operators: drafts of operators, and the key expressions that are to wire them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dataflow.graph.problems import Place
from dataflow.graph.yaml.tree import Leaf, Table, Tree
from dataflow.messages.base import Message
from dataflow.operator import Operator


@dataclass(frozen=True, slots=True)
class Pattern:
    """A key expression of an input: as written, absolute and canonical, and where it stands.

    `scope` is the key prefix that the written text is relative to; `via` the place inside a nested graph, when the
    expression was bound to a nested graph's input outside it.
    """

    text: str
    key: str
    place: Place
    scope: str
    via: Place | None = None


@dataclass(frozen=True, slots=True)
class Absence:
    """Explains why something is not there: `reason` for people, and the prefix of the operators that do without it.

    Operators below it (`"perception/"`) were written for that; a file that leaves an input out may not name what
    would have been made of it.
    """

    reason: str
    inside: str


@dataclass(frozen=True, slots=True)
class Choice:
    """One entry of an input. Of its ways, the first of which anything is there counts; `absence`: it has none.

    `via` is the place inside a nested graph where an input of that graph is named.
    """

    ways: tuple[tuple[Pattern | Choice, ...], ...]
    absence: Absence | None = None
    via: Place | None = None


@dataclass(slots=True)
class OperatorDraft:
    """One operator before its inputs are wired. `inputs` follow from `choices` once it is settled what is there."""

    name: str
    place: Place
    file: str
    use: str
    cls: type[Operator]
    params: dict[str, Any]
    choices: dict[str, list[Choice]]
    input_places: dict[str, Place]
    inputs_place: Place
    process: Leaf | None
    machine: Leaf | None
    env: Leaf | None
    live: Tree | None
    sync: Tree | None
    inputs: dict[str, list[Pattern]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Alias:
    """An exported output of a nested graph: `key` stands for the stream that `target` comes to."""

    key: str
    target: Choice
    place: Place

    @property
    def pattern(self) -> Pattern:
        """The one expression that the target comes to, once that is settled."""
        ((found,),) = self.target.ways
        assert isinstance(found, Pattern)
        return found


@dataclass(frozen=True, slots=True)
class GraphInput:
    """A declared input of a nested graph, bound to expressions outside; `type` is what it promises to carry."""

    choices: tuple[Choice, ...]
    type: type[Message] | None
    place: Place
    """The place where the nested graph declares it."""
    patterns: tuple[Pattern, ...] = ()
    """The expressions that the choices come to."""


@dataclass(slots=True)
class Expansion:
    """All that the files say, flat."""

    root: Table
    name: str
    namespace: str
    drafts: list[OperatorDraft] = field(default_factory=list)
    aliases: list[Alias] = field(default_factory=list)
    graph_inputs: list[tuple[str, GraphInput]] = field(default_factory=list)
    left_out: dict[str, tuple[Absence, ...]] = field(default_factory=dict)
    """Operators and nested graphs that are not made, by full name: `when: false`, and those that lack an input."""
    broken: list[str] = field(default_factory=list)
    """Key prefixes of operators that could not be had: nothing is said about streams below them."""
    names: set[str] = field(default_factory=set)
    """Full names of operators and nested graphs."""


@dataclass(frozen=True, slots=True)
class Scope:
    """Describes where in the nesting a file stands. `prefix` is "" or "front/"; `key` the absolute key prefix."""

    file: str
    shown: str
    prefix: str
    key: str
    given: Mapping[str, Tree]
    bindings: Mapping[str, tuple[Place, list[Choice]]]
    use: Place | None
    process: Leaf | None
    machine: Leaf | None
    env: Leaf | None
    stack: tuple[str, ...]


@dataclass(slots=True)
class WiredOperator:
    """A draft with the streams of its inputs; `places` holds where each was written."""

    draft: OperatorDraft
    inputs: dict[str, tuple[str, ...]]
    places: dict[tuple[str, str], Place]
