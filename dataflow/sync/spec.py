"""Specifies what an operator waits for: the declaration from which an aligner is built.

A *stream* is named by its key. An input is usually fed by one stream; with `many` it is fed by any number of
them (a wildcard) and its value is kept per stream. Durations are nanoseconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Mode = Literal["join", "merge"]


@dataclass(frozen=True, slots=True)
class TriggerSpec:
    """An `In`: its messages make the operator fire. In a merge, the value of a `many` trigger maps each stream that has
    a message at the firing's stamp to it."""

    name: str
    streams: tuple[str, ...]
    many: bool = False

    def __post_init__(self) -> None:
        _check_streams(self.name, self.streams, self.many)


@dataclass(frozen=True, slots=True)
class SampledSpec:
    """A `Sampled`: supplies the newest message at or before the firing's stamp; never makes it fire.

    `before` moves the cut into the past: None takes stamps <= t, 1 stamps strictly before t
    (``before=True``), D stamps <= t - D. A message older than `max_age` at the firing counts as absent. If
    `required` and absent, there is no firing: its triggers are dropped as `no_sample` (there never was a
    message) or `stale` (it was too old). A `many` input maps each stream to its newest message, and is absent
    when the map is empty.
    """

    name: str
    streams: tuple[str, ...]
    max_age: int | None = None
    required: bool = True
    before: int | None = None
    many: bool = False

    def __post_init__(self) -> None:
        _check_streams(self.name, self.streams, self.many)


@dataclass(frozen=True, slots=True)
class BatchSpec:
    """A `Batch`: supplies every message since the last firing up to the firing's stamp, oldest first.

    At the firing the newest `max` of them, and none older than `max_age`, are kept; the rest are dropped as
    `unused`. A `many` batch is one tuple ordered by (stamp, stream).
    """

    name: str
    streams: tuple[str, ...]
    max: int | None = None
    max_age: int | None = None
    many: bool = False

    def __post_init__(self) -> None:
        _check_streams(self.name, self.streams, self.many)
        if self.max is not None and self.max < 1:
            raise ValueError(f"input {self.name!r}: max must be at least 1 message, not {self.max}")


@dataclass(frozen=True, slots=True)
class AlignSpec:
    """All inputs of one operator, and how its triggers combine.

    mode: "join" fires when every trigger has a message at one stamp (within `tolerance` of the first trigger,
        the anchor); "merge" fires on every trigger message. With one trigger the two are the same.
    every: period of ticks on event time, besides the triggers or without any.
    static: the streams that carry one message, valid at any stamp.
    """

    triggers: tuple[TriggerSpec, ...] = ()
    sampled: tuple[SampledSpec, ...] = ()
    batches: tuple[BatchSpec, ...] = ()
    mode: Mode = "join"
    tolerance: int = 0
    every: int | None = None
    static: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if self.tolerance and not self.joins:
            raise ValueError("tolerance applies to a join of at least two triggers")
        if self.joins:
            for trigger in self.triggers:
                if trigger.many:
                    raise ValueError(f"input {trigger.name!r}: a join takes one stream per trigger; use merge")
                if trigger.streams[0] in self.static:
                    raise ValueError(f"input {trigger.name!r}: a static stream cannot be joined; declare it Sampled")
        if self.every is None:
            if not self.triggers:
                raise ValueError("an operator without a trigger needs `every`: nothing would ever make it fire")
        elif not self.bounds_of_ticks():
            raise ValueError(
                "`every` needs an input that is neither static nor `before`, to say where ticks begin and end"
            )

    @property
    def inputs(self) -> tuple[TriggerSpec | SampledSpec | BatchSpec, ...]:
        """Every input: triggers, then Sampled, then Batch."""
        return (*self.triggers, *self.sampled, *self.batches)

    @property
    def joins(self) -> bool:
        """Returns whether triggers have to meet: a join of two or more."""
        return self.mode == "join" and len(self.triggers) > 1

    @property
    def streams(self) -> frozenset[str]:
        """The keys of all streams that feed the operator."""
        return frozenset(stream for spec in self.inputs for stream in spec.streams)

    def bounds_of_ticks(self) -> tuple[tuple[str, str], ...]:
        """The (input, stream) pairs between whose first and final stamps ticks lie. Those that are neither static nor
        `before`: feedback ends with the operator, so cannot end it."""
        return tuple(
            (spec.name, stream)
            for spec in self.inputs
            if not (isinstance(spec, SampledSpec) and spec.before is not None)
            for stream in spec.streams
            if stream not in self.static
        )


def _check_streams(name: str, streams: Iterable[str], many: bool) -> None:
    streams = tuple(streams)
    if len(set(streams)) != len(streams):
        raise ValueError(f"input {name!r}: a stream is named twice in {', '.join(streams)}")
    if not many and len(streams) != 1:
        raise ValueError(
            f"input {name!r}: expected exactly one stream, not {len(streams)}; only a wildcard takes several"
        )
