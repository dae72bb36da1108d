"""The rules read literally: firings from streams seen whole. Slow, short, and independent of the aligner."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from dataflow.sync import TICK, AlignSpec, Entry, Firing, SampledSpec

Streams = Mapping[str, Sequence[Entry]]


def nearest(stamp: int, stamps: Sequence[int]) -> int | None:
    return min(stamps, key=lambda other: (abs(other - stamp), other), default=None)


def matches(spec: AlignSpec, streams: Streams) -> dict[int, dict[str, Entry]]:
    """Rule 2: the partners of each anchor that has all of them, by the anchor's stamp."""
    anchor, *others = ({e.stamp: e for e in streams[t.streams[0]]} for t in spec.triggers)
    matched = {}
    for stamp in anchor:
        partners = {spec.triggers[0].name: anchor[stamp]}
        for trigger, other in zip(spec.triggers[1:], others, strict=True):
            near = nearest(stamp, list(other))
            if near is not None and abs(near - stamp) <= spec.tolerance and nearest(near, list(anchor)) == stamp:
                partners[trigger.name] = other[near]
        if len(partners) == len(spec.triggers):
            matched[stamp] = partners
    return matched


def merges(spec: AlignSpec, streams: Streams) -> dict[int, dict[str, object]]:
    """Rule 1: all trigger messages of one stamp together."""
    merged: dict[int, dict[str, object]] = {}
    for trigger in spec.triggers:
        for stream in sorted(trigger.streams):
            for entry in streams[stream]:
                at = merged.setdefault(entry.stamp, {})
                if trigger.many:
                    at.setdefault(trigger.name, {})[stream] = entry
                else:
                    at[trigger.name] = entry
    return merged


def ticks(spec: AlignSpec, streams: Streams, finals: Mapping[str, int | None]) -> set[int]:
    """Rule 6, over the inputs that are neither static nor feedback."""
    if spec.every is None:
        return set()
    bounding = {s for _, s in spec.bounds_of_ticks()}
    firsts = [streams[s][0].stamp for s in bounding if streams[s]]
    lasts = [final for s in bounding if (final := finals[s]) is not None]
    if not firsts:
        return set()
    return {k * spec.every for k in range(-1000, 1000) if min(firsts) <= k * spec.every <= max(lasts)}


def sample(spec: SampledSpec, stamp: int, streams: Streams, static: frozenset[str]) -> tuple[object, bool]:
    """The value at a stamp, and whether something was withheld as stale."""
    values, stale = {}, False
    for stream in sorted(spec.streams):
        seen = [e for e in streams[stream] if stream in static or e.stamp <= stamp - (spec.before or 0)]
        if not seen:
            continue
        if stream not in static and spec.max_age is not None and stamp - seen[-1].stamp > spec.max_age:
            stale = True
        else:
            values[stream] = seen[-1]
    return (values if spec.many else next(iter(values.values()), None)), stale


def firings(
    spec: AlignSpec, streams: Streams, finals: Mapping[str, int | None]
) -> tuple[list[Firing], Counter[tuple[str, str]]]:
    drops: Counter[tuple[str, str]] = Counter()
    triggered: dict[int, dict[str, object]] = {}
    if spec.joins:
        triggered.update(matches(spec, streams))
        for trigger in spec.triggers:
            unmatched = len(streams[trigger.streams[0]]) - len(triggered)
            if unmatched:
                drops[trigger.name, "unmatched"] = unmatched
    else:
        triggered = merges(spec, streams)
    ticking = ticks(spec, streams, finals)

    fired: list[Firing] = []
    given: set[tuple[str, str, int]] = set()
    for stamp in sorted({*triggered, *ticking}):
        kind = "fire" if stamp in triggered else "tick"
        inputs: dict[str, object] = {t.name: {} if t.many else None for t in spec.triggers}
        inputs.update(triggered.get(stamp, {}))
        stale_names = set()
        missing = None
        for sampled in spec.sampled:
            inputs[sampled.name], stale = sample(sampled, stamp, streams, spec.static)
            if stale:
                stale_names.add(sampled.name)
            if sampled.required and not inputs[sampled.name] and missing is None:
                missing = "stale" if stale else "no_sample"
        if missing is not None:
            for trigger in spec.triggers:
                value = inputs[trigger.name]
                count = len(value) if isinstance(value, dict) else int(value is not None)
                if count:
                    drops[trigger.name, missing] += count
            if stamp in ticking:
                drops[TICK, missing] += 1
            continue
        for batch in spec.batches:
            since = [
                (e.stamp, s, e) for s in batch.streams for e in streams[s]
                if e.stamp <= stamp and (batch.name, s, e.seq) not in given
            ]  # fmt: skip
            since.sort(key=lambda item: item[:2])
            given.update((batch.name, s, e.seq) for _, s, e in since)
            kept = since[-batch.max :] if batch.max is not None else since
            kept = [k for k in kept if batch.max_age is None or stamp - k[0] <= batch.max_age]
            if len(kept) < len(since):
                drops[batch.name, "unused"] += len(since) - len(kept)
            inputs[batch.name] = tuple(e for _, _, e in kept)
        fired.append(Firing(stamp, kind, stamp in ticking, inputs, frozenset(stale_names)))
    for batch in spec.batches:
        rest = sum(len(streams[s]) for s in batch.streams) - len({g for g in given if g[0] == batch.name})
        if rest:
            drops[batch.name, "unused"] += rest
    fired.append(Firing(finish_stamp(spec, streams, finals), "finish"))
    return fired, drops


def finish_stamp(spec: AlignSpec, streams: Streams, finals: Mapping[str, int | None]) -> int:
    ending = {s for t in spec.triggers for s in t.streams}
    if spec.every is not None:
        ending |= {s for _, s in spec.bounds_of_ticks()}
    reached = [f for s in ending if s not in spec.static and (f := finals[s]) is not None]
    reached += [e.stamp for s in ending & spec.static for e in streams[s]]
    return max(reached, default=-1) + 1
