"""Faults on purpose: a seeded plan of what is to go wrong in a live run, and when.

The plan is pure: it expands to the same timeline for the same seed. The supervisor carries out faults of
processes, and the processes those of their operators and sources. All of it is what robots do to software anyway; the
run records it, and `dataflow verify` repeats the run, faults included.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import pydantic

from dataflow.chaos.faults import SECOND, TO_OPERATORS, TO_SOURCES
from dataflow.graph.model import Graph, Node
from dataflow.graph.problems import Place, Problems, did_you_mean
from dataflow.graph.yaml.document import parse
from dataflow.graph.yaml.tree import at, plain
from dataflow.operator import ParameterError, is_tunable, validate_parameters
from dataflow.sync.stamps import parse_duration


class ChaosError(ValueError):
    """A fault plan is invalid; the message names the place (in a file: the line), and what would be right.

    `where` leads to what is wrong in the plan: ("faults", 2, "operator").
    """

    def __init__(self, what: str, where: tuple[str | int, ...] = (), hint: str = "") -> None:
        place = ".".join(map(str, where))
        super().__init__((f"{place}: " if place else "") + what + (f"; {hint}" if hint else ""))
        self.what, self.where, self.hint = what, where, hint


def _with_unit(value: Any) -> int:
    if not isinstance(value, str):
        raise ValueError("a duration has a unit, such as 100ms")
    return parse_duration(value)


_Time = Annotated[int, pydantic.BeforeValidator(_with_unit)]
"""Nanoseconds of a duration with a unit."""
_Span = Annotated[_Time, pydantic.Field(gt=0)]


class _Timed(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    operator: str
    at: _Time | None = pydantic.Field(None, description="time after the sources were released")
    every: _Span | None = pydantic.Field(None, description="again and again, at random times with this mean distance")
    until: _Span | None = pydantic.Field(None, description="end of `every`; default: the whole run")

    @pydantic.model_validator(mode="after")
    def _once_or_often(self) -> _Timed:
        if (self.at is None) == (self.every is None):
            raise ValueError("give either 'at' (once) or 'every' (again and again)")
        return self


class _Plain(_Timed):
    kind: Literal["kill", "raise", "hang"]


class _Lasting(_Timed):
    kind: Literal["freeze", "stop"]
    span: _Span = pydantic.Field(alias="for")


class _Slow(_Timed):
    kind: Literal["slow"]
    by: _Span
    span: _Span = pydantic.Field(alias="for")


class _Flood(_Timed):
    kind: Literal["flood"]
    factor: int = pydantic.Field(ge=2, le=1000)
    span: _Span = pydantic.Field(alias="for")


class _Jump(_Timed):
    kind: Literal["jump", "past"]
    by: _Span
    back: bool = pydantic.Field(True, description="backwards; false: forwards")


class _Leak(_Timed):
    kind: Literal["leak"]
    megabytes: int = pydantic.Field(ge=1, le=100_000)


class _Malformed(_Timed):
    kind: Literal["malformed"]


class _Param(_Timed):
    kind: Literal["param"]
    name: str
    values: list[Any] = pydantic.Field(min_length=1)


_Entry = Annotated[
    _Plain | _Lasting | _Slow | _Flood | _Jump | _Leak | _Malformed | _Param, pydantic.Field(discriminator="kind")
]


class _Plan(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    seed: int = 0
    faults: list[_Entry]


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: `at` seconds after the release; `fields` belong to the kind (durations in seconds)."""

    at: float
    kind: str
    operator: str
    fields: Mapping[str, Any]


def load_plan(path: Path, graph: Graph, *, seed: int | None = None) -> Iterator[Fault]:
    """The faults of a plan file in the order of their time; endless where one has `every` without `until`.

    `seed` replaces the plan's own. Raises `ChaosError`.
    """
    problems, file = Problems(), str(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ChaosError(f"{path}: {error}") from error
    tree = parse(text, file, problems)
    if not problems.found:
        try:
            return plan_of(None if tree is None else plain(tree), graph, seed=seed)
        except ChaosError as error:
            place = Place(file, 1, 1) if tree is None else at(tree, error.where).place
            problems.add(place, error.what, error.hint)
    raise ChaosError("\n".join(map(str, problems.found)))


def plan_of(content: Any, graph: Graph, *, seed: int | None = None) -> Iterator[Fault]:
    """As `load_plan`, from the plan's content."""
    if not isinstance(content, Mapping):
        raise ChaosError("a fault plan is a mapping with 'faults', a list, and perhaps 'seed'")
    try:
        plan = _Plan.model_validate(content)
    except pydantic.ValidationError as error:
        raise _explained(error.errors()[0]) from None
    for k, entry in enumerate(plan.faults):
        _check(entry, graph, ("faults", k))
    return _merged(plan, plan.seed if seed is None else seed)


def _explained(fault: Any) -> ChaosError:
    loc = fault["loc"]
    where = loc[:2] + loc[3:]  # an entry's third part is its kind
    match fault["type"]:
        case "missing":
            return ChaosError(f"{loc[-1]!r} is missing", where[:-1])
        case "union_tag_not_found":
            return ChaosError("'kind' is missing", where, f"there are {', '.join(_kinds())}")
        case "union_tag_invalid":
            kind = fault["ctx"]["tag"]
            return ChaosError(f"no kind of fault {kind!r}", (*where, "kind"), did_you_mean(kind, _kinds(), "there are"))
        case "extra_forbidden":
            return ChaosError(f"unknown key {loc[-1]!r}", where)
        case "value_error":
            return ChaosError(fault["msg"].removeprefix("Value error, "), where)
    return ChaosError(f"{fault['msg']}, got {fault['input']!r}", where)


def _kinds() -> list[str]:
    return [kind for entry in get_args(get_args(_Entry)[0]) for kind in get_args(entry.model_fields["kind"].annotation)]


def _check(entry: Any, graph: Graph, where: tuple[str | int, ...]) -> None:
    node, name, at_operator = graph.nodes.get(entry.operator), entry.operator, (*where, "operator")
    if node is None:
        raise ChaosError(f"no operator {name!r}", at_operator, did_you_mean(name, graph.nodes, "there are"))
    if entry.kind in TO_SOURCES and not node.source:
        sources = ", ".join(n.name for n in graph.sources())
        raise ChaosError(f"{entry.kind!r} is for sources ({sources}); {name!r} is none", at_operator)
    if entry.kind in TO_OPERATORS and node.source:
        raise ChaosError(f"{entry.kind!r} is for operators with inputs; {name!r} is a source", at_operator)
    if entry.kind == "param":
        _check_parameter(entry, node, where)
    if entry.kind in ("kill", "raise", "hang") and node.live.restart.max < 1:
        hint = f"give {name!r} a restart policy, live: {{restart: {{max: 100, backoff: 100ms}}}}"
        raise ChaosError(f"{entry.kind!r} would end the run", at_operator, hint)
    if entry.kind == "hang" and node.live.deadline is None:
        raise ChaosError(f"nothing would notice that {name!r} hangs", at_operator, "give it live: {deadline: 1s}")


def _check_parameter(entry: _Param, node: Node, where: tuple[str | int, ...]) -> None:
    """The parameter can change while the graph runs, and the operator takes each of the values."""
    fields = node.spec.parameters.model_fields
    able = [name for name, field in fields.items() if is_tunable(field)]
    if entry.name not in fields:
        hint = did_you_mean(entry.name, able, "those that can change while the graph runs")
        raise ChaosError(f"{entry.operator!r} has no parameter {entry.name!r}", (*where, "name"), hint)
    if entry.name not in able:
        text = f"{entry.name!r} of {entry.operator!r} cannot change while the graph runs"
        raise ChaosError(text, (*where, "name"), f"those that can: {', '.join(able) or 'none'}")
    for k, value in enumerate(entry.values):
        try:
            validate_parameters(node.operator, {**node.params, entry.name: value})
        except ParameterError as error:
            raise ChaosError(str(error), (*where, "values", k)) from None


def _merged(plan: _Plan, seed: int) -> Iterator[Fault]:
    """All entries' faults by time; each entry draws from a separate generator, so that one does not move another."""
    entries = [_times(entry, random.Random(f"{seed} {k}")) for k, entry in enumerate(plan.faults)]
    return iter(heapq.merge(*entries, key=lambda fault: fault.at))


def _times(entry: Any, rng: random.Random) -> Iterator[Fault]:
    def fault(at: float) -> Fault:
        fields = entry.model_dump(exclude={"kind", "operator", "at", "every", "until"}, exclude_none=True)
        for name in ("by", "span"):
            if name in fields:
                fields[name] = fields[name] / SECOND
        if "values" in fields:
            fields["value"] = rng.choice(fields.pop("values"))
        return Fault(at, entry.kind, entry.operator, fields)

    if entry.at is not None:
        yield fault(entry.at / SECOND)
        return
    at = rng.expovariate(SECOND / entry.every)
    while entry.until is None or at <= entry.until / SECOND:
        yield fault(at)
        at += rng.expovariate(SECOND / entry.every)
