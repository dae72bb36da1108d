"""Random operators, streams and interleavings for the aligner's tests."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

from hypothesis import strategies as st

from dataflow.sync import (
    Aligner,
    AlignSpec,
    BatchSpec,
    Entry,
    Firing,
    FiringInputs,
    RecordedAligner,
    SampledSpec,
    TriggerSpec,
    Uses,
)

Step = tuple[str, str, object]
"""(what, stream, argument) with what one of push, advance, end."""

HORIZON = 40


@dataclass(frozen=True)
class Scenario:
    """An operator with all that its streams will ever say; `says` keeps each stream's own order."""

    spec: AlignSpec
    streams: Mapping[str, list[Entry]]
    finals: Mapping[str, int | None]
    says: Mapping[str, list[Step]]


def entries(stream: str, *stamps: int) -> list[Entry]:
    return [Entry(stamp, f"{stream}@{stamp}", seq, stream=stream) for seq, stamp in enumerate(stamps)]


def push(aligner: Aligner, stream: str, *stamps: int) -> None:
    for entry in entries(stream, *stamps):
        aligner.push(stream, entry)


def interleave(says: Mapping[str, list[Step]], rng: random.Random) -> Iterator[Step]:
    """Every stream's steps in its own order, mixed at random; now and then one stream runs far ahead."""
    rest = {stream: list(steps) for stream, steps in says.items() if steps}
    while rest:
        stream = rng.choice(sorted(rest))
        for _ in range(rng.choice((1, 1, 1, 2, 100))):
            if not rest[stream]:
                break
            yield rest[stream].pop(0)
        if not rest[stream]:
            del rest[stream]


def tell(aligner: Aligner, step: Step) -> None:
    what, stream, argument = step
    getattr(aligner, what)(stream, argument)


def run(spec: AlignSpec, steps: Iterable[Step], after: Callable[[Aligner], None] | None = None) -> list[Firing]:
    """The firings of a fresh aligner, polled after each step."""
    aligner = Aligner(spec)
    fired: list[Firing] = []
    for step in steps:
        tell(aligner, step)
        if after is not None:
            after(aligner)
        fired += poll_all(aligner)
    return fired


class Repeater(RecordedAligner):
    """A recorded aligner with the records that it makes again, in order."""

    def __init__(self, spec: AlignSpec, records: Iterable[FiringInputs]) -> None:
        self._records = list(records)
        uses = Uses()
        for record in self._records:
            uses.add(record.inputs)
        super().__init__(spec, uses)

    def poll(self) -> Firing | None:
        firing = self.take(self._records[0]) if self._records else None
        if firing is not None:
            del self._records[0]
        return firing

    def ended(self) -> bool:
        return not self._records


def poll_all(aligner: Aligner | Repeater) -> list[Firing]:
    fired = []
    while (firing := aligner.poll()) is not None:
        fired.append(firing)
    return fired


@st.composite
def specs(draw: st.DrawFn) -> AlignSpec:
    """Any operator: up to three triggers, joined or merged, with Sampled, Batch, ticks and static streams."""
    names = iter(f"s{i}" for i in range(20))
    shared: list[str] = []

    def streams(many: bool) -> tuple[str, ...]:
        picked = [next(names) for _ in range(draw(st.integers(1, 3)) if many else 1)]
        if shared and draw(st.integers(0, 4)) == 0:
            picked[0] = draw(st.sampled_from(shared))  # one stream may feed several inputs
        shared.extend(s for s in picked if s not in shared)
        return tuple(picked)

    mode = draw(st.sampled_from(["join", "merge"]))
    count = draw(st.integers(0, 3))
    flag = st.sampled_from([False, False, True])
    triggers = []
    for i in range(count):
        many = draw(flag) and (mode == "merge" or count == 1)
        triggers.append(TriggerSpec(f"t{i}", streams(many), many))
    joins = mode == "join" and count > 1
    sampled = []
    for i in range(draw(st.integers(0, 2))):
        many = draw(flag)
        sampled.append(
            SampledSpec(
                f"x{i}",
                streams(many),
                draw(st.none() | st.integers(0, 12)),
                draw(st.booleans()),
                draw(st.none() | st.just(1) | st.integers(2, 10)),
                many,
            )
        )
    batches = []
    for i in range(draw(st.integers(0, 2))):
        many = draw(flag)
        batches.append(
            BatchSpec(
                f"b{i}", streams(many), draw(st.none() | st.integers(1, 3)), draw(st.none() | st.integers(0, 8)), many
            )
        )
    triggering = {s for t in triggers for s in t.streams}
    static = frozenset(s for s in shared if draw(st.integers(0, 5)) == 0 and not (joins and s in triggering))
    every = draw(st.none() | st.integers(3, 15))
    bounding = any(
        s not in static for i in (*triggers, *(x for x in sampled if x.before is None), *batches) for s in i.streams
    )
    if not bounding:
        every = None
    if every is None and not triggers:
        triggers = [TriggerSpec("t0", (next(names),))]
    return AlignSpec(
        tuple(triggers), tuple(sampled), tuple(batches), mode,
        draw(st.integers(0, 10)) if joins else 0, every, static,
    )  # fmt: skip


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    spec = draw(specs())
    streams: dict[str, list[Entry]] = {}
    finals: dict[str, int | None] = {}
    says: dict[str, list[Step]] = {}
    for stream in sorted(spec.streams):
        static = stream in spec.static
        stamps = draw(st.lists(st.integers(0, HORIZON), unique=True, max_size=1 if static else 9).map(sorted))
        messages = streams[stream] = entries(stream, *stamps)
        if static:
            finals[stream] = None
            says[stream] = [("push", stream, e) for e in messages] or [("end", stream, None)]
            continue
        final = finals[stream] = draw(
            st.integers(stamps[-1], HORIZON + 5) if stamps else st.none() | st.integers(0, HORIZON)
        )
        said: list[Step] = []
        reached = -3
        for message, upto in zip([*messages, None], [*stamps, None if final is None else final + 1], strict=True):
            for _ in range(draw(st.integers(0, 2))):
                if upto is not None and reached < upto - 1:
                    reached = draw(st.integers(reached, upto - 1))
                    said.append(("advance", stream, reached))
            if message is not None:
                said.append(("push", stream, message))
                reached = message.stamp
        said.append(("end", stream, final))
        says[stream] = said
    return Scenario(spec, streams, finals, says)
