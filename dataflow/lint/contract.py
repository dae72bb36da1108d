"""A contract: what recordings of a robot have to hold, in a YAML file that is kept with its code."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from dataflow.graph.keys import as_expression, canonical, key_fault, matching
from dataflow.graph.problems import did_you_mean
from dataflow.lint.inputs import StreamFacts
from dataflow.lint.timing import Timing
from dataflow.sync.stamps import parse_duration

MARGIN = 0.1
"""The share by which a proposed rate may vary."""


class ContractError(ValueError):
    """Raised when a contract cannot be read; the message names the place, and what would be right."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


def _seconds(value: Any) -> Any:
    """A duration such as `30ms` in seconds; a number is refused, as everywhere in graphs."""
    if isinstance(value, str):
        return parse_duration(value) * 1e-9
    raise ValueError("expected a duration with a unit, such as 30ms")


class StreamTerms(_Section):
    """Terms for the streams of one name or pattern."""

    type: str | None = Field(None, description="the message type")
    rate: tuple[float, float] | None = Field(None, description="least and largest rate, Hz")
    max_gap: float | None = Field(None, description="the longest time without a message")
    optional: bool = Field(False, description="whether it may be missing")
    allow: tuple[str, ...] = Field((), description="checks whose findings are accepted: gap, duplicate, backward, …")

    @field_validator("max_gap", mode="before")
    @classmethod
    def _read_gap(cls, value: Any) -> Any:
        return None if value is None else _seconds(value)

    @field_validator("rate")
    @classmethod
    def _check_rate(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        if value is not None and not 0 <= value[0] <= value[1]:
            raise ValueError("expected [least, largest], 0 or more, in Hz")
        return value


class FrameTerms(_Section):
    """Terms for the tree of frames."""

    root: str | None = Field(None, description="the frame that all others are connected to")
    required: tuple[str, ...] = Field((), description="frames that must be there")


class ClockTerms(_Section):
    """Terms for the clocks of streams that see the robot turn."""

    reference: str | None = Field(None, description="the stream whose clock is right; without one most decide")
    max_offset: float = Field(0.01, description="the largest offset")
    max_drift: float = Field(2e-4, ge=0, description="the largest drift, seconds per second")
    ignore: tuple[str, ...] = Field((), description="streams that are not looked at")

    @field_validator("max_offset", mode="before")
    @classmethod
    def _read_offset(cls, value: Any) -> Any:
        return value if isinstance(value, float) else _seconds(value)


class Contract(_Section):
    """All terms. Stream names are without the namespace, or whole, or patterns such as `camera/*`."""

    contract: str = Field("", description="its name")
    streams: dict[str, StreamTerms] = Field(default_factory=dict)
    frames: FrameTerms = Field(default_factory=FrameTerms)
    clocks: ClockTerms = Field(default_factory=ClockTerms)

    def terms_of(self, stream: str, namespace: str) -> StreamTerms | None:
        """The terms of the first name or pattern that means a stream."""
        return next((terms for word, terms in self.streams.items() if means(word, stream, namespace)), None)


def means(word: str, stream: str, namespace: str) -> bool:
    """Returns whether a name or pattern of a contract means a stream."""
    bare, key = as_expression(word.strip("/")), stream.strip("/")
    readings = (bare, f"{namespace}/{bare}") if namespace else (bare,)
    return any(matching(canonical(reading), [key]) for reading in readings)


def load_contract(path: Path) -> Contract:
    """Raises `ContractError`, `OSError`."""
    try:
        value = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except (YAMLError, UnicodeDecodeError) as error:
        raise ContractError(f"{path}: no YAML: {' '.join(str(error).split())}") from None
    if not isinstance(value, dict):
        raise ContractError(f"{path}: expected a mapping with streams, frames, clocks")
    try:
        found = Contract.model_validate(value)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        hint = _nearest(first["loc"]) if first["type"] == "extra_forbidden" else ""
        text = "unknown key" if hint else str(first["msg"]).removeprefix("Value error, ")
        raise ContractError(f"{path}: {where}: {text}{hint}") from None
    for word in found.streams:
        if (fault := key_fault(as_expression(word.strip("/")))) is not None:
            raise ContractError(f"{path}: streams.{word}: {fault}")
    return found


def _nearest(place: tuple[int | str, ...]) -> str:
    models: Mapping[str, type[BaseModel]] = {"streams": StreamTerms, "frames": FrameTerms, "clocks": ClockTerms}
    model = models[str(place[0])] if len(place) > 1 else Contract
    return "; " + did_you_mean(str(place[-1]), model.model_fields, "known here")


def proposed(
    name: str, namespace: str, streams: Mapping[str, StreamFacts], timings: Mapping[str, Timing], root: str | None
) -> str:
    """A contract that a recording keeps, as YAML to be looked over."""
    prefix = f"{namespace}/" if namespace else ""
    terms: dict[str, dict[str, Any]] = {}
    for stream, facts in streams.items():
        if not facts.count:
            continue
        found: dict[str, Any] = {"type": facts.type}
        timing = timings.get(stream)
        if timing is not None and timing.steady and not facts.static:
            rate = timing.rate
            found["rate"] = [float(f"{rate * (1 - MARGIN):.3g}"), float(f"{rate * (1 + MARGIN):.3g}")]
            found["max_gap"] = f"{max(round(timing.period * 2500), round(timing.longest * 1000) + 1)}ms"
        terms[stream.removeprefix(prefix)] = found
    value: dict[str, Any] = {"contract": name, "streams": terms}
    if root is not None:
        value["frames"] = {"root": root}
    value["clocks"] = {"max_offset": "10ms", "max_drift": 0.0002}
    text = io.StringIO()
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 120
    yaml.dump(value, text)
    return text.getvalue()
