"""Chooses the clock by which the messages of a bag are stamped, and repairs stamps that repeat or go back. Pure.

A message of a bag has the time at which the recorder took it (log time) and, where its type begins with a header, the
time that its sensor gave it. The latter is when it was measured and the one to work with, unless it cannot be trusted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Choice = Literal["auto", "header", "log"]
I64 = npt.NDArray[np.int64]

BACK = 5_000_000_000
"""A header that goes back by more (ns) means that the clock was set, or that a log was played again."""
APART = 1_000_000_000
"""Topics whose headers differ from log time by amounts farther apart (ns) have separate clocks."""
STEP = 100_000_000
"""A step back of more (ns) means the same if the headers stay as far behind the log after it."""
STAYS = 10
"""Messages before and after a step back that show it."""
SOME = 10
"""A topic of which more than one in so many headers carries no time is stamped by the log, and all others with it."""
UNITS_WITHIN = 0.2
"""Of a thousand or a million, by which headers of another unit go on faster or more slowly than the log."""
NEAR = 1_000_000_000
"""Headers that differ from log time by less (ns, in the middle) are of the recorder's own clock."""


@dataclass(frozen=True, slots=True)
class Times:
    """The times of one topic's entries in the order of the log, ns; `header` None where its type carries none.

    `shares`: several messages of one time are usual, since they are of several publishers (transforms).
    """

    topic: str
    log: I64
    header: I64 | None
    latched: bool = False
    shares: bool = False


@dataclass(frozen=True, slots=True)
class Clock:
    """The clock that was chosen: `header` or `log`, why, and what is added to log times of messages without a header.

    A latched topic whose headers are not of this clock counts as one without: its content is valid from when it
    was received, whenever it was made.
    """

    kind: Literal["header", "log"]
    why: str
    shift: int = 0
    notes: tuple[str, ...] = ()

    def stamps(self, times: Times) -> I64:
        """The stamps of a topic's entries, not repaired yet; by the log where a header carries none."""
        if self.kind == "log":
            return times.log
        logged = times.log + self.shift
        if times.header is None:
            return logged
        if times.latched and bool((np.abs(times.header - logged) > APART).any()):
            return logged
        return np.where(times.header > 0, times.header, logged)

    def tells(self, times: Times) -> bool:
        """Returns whether equal stamps of a topic, with equal content, are one message that was recorded twice: not
        where most of its stamps are equal, as of a log that was kept in whole seconds, or without times."""
        return len(times.log) <= 2 * len(np.unique(self.stamps(times)))


def choose_clock(topics: Sequence[Times], wanted: Choice = "auto") -> Clock:
    """Returns the one clock for all topics that are used together.

    Header stamps, unless more than a tenth of a topic's are missing (zero or negative), one goes back by more than 5 s
    or for good, they leap ahead of the log by more than 5 s for good, most of them repeat, or the topics' headers are
    of different clocks: then log times, for all. Fewer that are missing are placed by the log.
    """
    if wanted == "log":
        return Clock("log", "asked for")
    with_header = [t for t in topics if t.header is not None and len(t.header)]
    offsets = {t.topic: _offset(t) for t in with_header if not t.latched}
    typical = int(np.median(list(offsets.values()))) if offsets else 0
    shift = 0 if abs(typical) <= NEAR else -typical
    missing = {t.topic: (int((t.header <= 0).sum()), len(t.header)) for t in with_header if t.header is not None}
    notes = tuple(
        f"{topic}: {unset:,} of {count:,} headers carry no time; those messages are placed by log time"
        for topic, (unset, count) in missing.items()
        if unset and not next(t.latched for t in with_header if t.topic == topic)
    )
    if wanted == "header":
        return Clock("header", "asked for", shift, notes)
    if not with_header:
        return Clock("log", "no message has a time in its header")
    for times in with_header:
        assert times.header is not None
        if times.latched:
            continue
        count = len(times.header)
        set_ = times.header[times.header > 0]
        most = count - 1 if times.shares else count // SOME  # one publisher of several may not stamp what it sends
        if (unset := int((times.header <= 0).sum())) > most:
            return Clock("log", f"{unset:,} of {count:,} headers of {times.topic} carry no time")
        if not times.shares and count > 2 * (distinct := len(np.unique(set_))):
            return Clock("log", f"{count:,} headers of {times.topic} carry only {distinct:,} different times")
        back = int(-np.diff(set_).min(initial=0))
        if back > BACK or (back > STEP and not times.shares and _stays_back(times)):
            return Clock("log", f"the headers of {times.topic} go back by {back * 1e-9:.1f} s")
        if (leap := _leap(times)) > BACK:
            return Clock("log", f"the headers of {times.topic} leap ahead of the log by {leap * 1e-9:,.1f} s")
    if offsets and max(offsets.values()) - min(offsets.values()) > APART:
        late, early = max(offsets, key=lambda t: offsets[t]), min(offsets, key=lambda t: offsets[t])
        apart = (offsets[late] - offsets[early]) * 1e-9
        return Clock("log", f"the headers of {late} and {early} are of different clocks, {apart:.3f} s apart")
    why = "when it was measured"
    if shift:
        why += f"; it runs {abs(typical) * 1e-9:.3f} s {'behind' if typical > 0 else 'ahead of'} the recorder's clock"
    return Clock("header", why, shift, (*notes, *_other_units(with_header)))


def _other_units(topics: Sequence[Times]) -> tuple[str, ...]:
    """A note on topics whose headers go on a thousand or a million times as slowly, or as fast, as the log."""
    for power in (-2, -1, 1, 2):
        found = [t.topic for t in topics if not t.latched and abs(_pace(t) * 1000.0**-power - 1) < UNITS_WITHIN]
        if found:
            much = f"{1000 ** abs(power):,} times {'as slowly as' if power < 0 else 'faster than'} the log"
            return (
                f"the headers of {', '.join(found)} go on {much}: are they in another unit? --clock log plays by it",
            )
    return ()


def _pace(times: Times) -> float:
    """How much time the headers of a topic take in one second of the log; 1 where that is not known."""
    assert times.header is not None
    span, logged = (int(np.ptp(values)) if len(values) > STAYS else 0 for values in (times.header, times.log))
    return span / logged if logged and (times.header > 0).all() else 1.0


def _stays_back(times: Times) -> bool:
    """Returns whether the headers are later against the log by most of their largest step back from then on, as after a
    clock that was set; where single messages come late, the others stay where they were."""
    assert times.header is not None
    given = times.header > 0
    header, log = times.header[given], times.log[given]
    step = int(np.argmin(np.diff(header))) + 1
    before, after = (log - header)[max(step - STAYS, 0) : step], (log - header)[step : step + STAYS]
    lost = float(np.median(after) - np.median(before)) if min(len(before), len(after)) == STAYS else 0.0
    return lost > 0.8 * float(header[step - 1] - header[step])


def _leap(times: Times) -> int:
    """By how much (ns) the headers leap ahead of the log for good, as where a clock was set in the middle; 0 where the
    log goes on at another pace than they do, so that it is no evidence."""
    assert times.header is not None
    given = times.header > 0
    header, log = times.header[given], times.log[given]
    step = int(np.argmax(np.diff(header) - np.diff(log))) + 1 if len(header) > 1 else 0
    before, after = (header - log)[max(step - STAYS, 0) : step], (header - log)[step : step + STAYS]
    if min(len(before), len(after)) < STAYS:
        return 0
    leap, logged = int(np.median(after) - np.median(before)), int(np.ptp(log))
    return leap if logged < 2 * (int(np.ptp(header)) - leap) < 4 * logged else 0


def _offset(times: Times) -> int:
    """By how much the log is behind the headers of a topic, in the middle."""
    assert times.header is not None
    given = times.header > 0
    return int(np.median((times.log - times.header)[given if given.any() else slice(None)]))


@dataclass(frozen=True, slots=True)
class Repair:
    """Entries of one topic in stamp order.

    - `order`: (M,) the entries that are kept; `stamps`: (M,) their stamps, strictly increasing, or with `merge` equal
      for those that become one message.
    - `reordered`: entries that came after one with a later stamp; `repeated`: identical ones left out;
      `moved`: entries that share their stamp with a different one and were put just after it; `merged`: entries that
      became part of another message; `before_epoch`: entries left out since their stamp is negative.
    """

    order: I64
    stamps: I64
    reordered: int = 0
    repeated: int = 0
    moved: int = 0
    merged: int = 0
    before_epoch: int = 0

    def facts(self) -> dict[str, int]:
        """The numbers of what was repaired, those that are not 0."""
        names = ("reordered", "repeated", "moved", "merged", "before_epoch")
        return {name: getattr(self, name) for name in names if getattr(self, name)}


def repair(stamps: I64, digests: npt.NDArray[Any], *, merge: bool = False) -> Repair:
    """Puts entries, given in log order, in the order of their stamps, which then strictly increase.

    Entries of one stamp with the same digest are one message, recorded twice. Different ones are merged where
    `merge` allows it for their type; else each but the first comes 1 ns after the one before it.
    """
    peaks = np.maximum.accumulate(stamps) if len(stamps) else stamps
    reordered = int((stamps < peaks).sum())
    order = np.argsort(stamps, kind="stable")
    negative = int((stamps < 0).sum())
    order = order[negative:]
    kept: list[int] = []
    given: list[int] = []
    repeated = moved = merged = 0
    here: set[Any] = set()
    before = -1
    last = -1
    for entry in order.tolist():
        stamp = int(stamps[entry])
        digest = digests[entry]
        if stamp != before:
            here, before = set(), stamp
        if digest in here:
            repeated += 1
            continue
        here.add(digest)
        if merge and len(here) > 1:
            merged += 1
        elif not merge and stamp <= last:
            moved += 1
            stamp = last + 1
        last = max(last, stamp)
        kept.append(entry)
        given.append(stamp)
    return Repair(
        np.array(kept, np.int64), np.array(given, np.int64), reordered, repeated, moved, merged, before_epoch=negative
    )
