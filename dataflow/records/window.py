"""The firing records that a span of a recording needs: a run of days is not read to verify its last minute, or to go to
one of its calls.

Earlier records are left out as from a recording that was cut: a `cut` record replaces them (`dataflow.records.cuts`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import islice

from dataflow.recording import Recording
from dataflow.recording.layout import PARAMETERS, RECOVERED, TOLD
from dataflow.recording.streams.cutting import cut_of
from dataflow.records.cuts import ResumePoint, cut_record, is_known
from dataflow.records.firing import CALLS, FiringRecord, FiringRecordError, decode_batch, encode_batch
from dataflow.records.reading import FiringLog, Maker, note_taken

FIRST_REACH = 60 * 10**9
"""Span (ns) before the stamp in which records are looked for at first: states are recorded about that often."""
HEAD = 4096
"""Batches at the beginning of a recording among which each operator's first one is looked for."""
NEVER_MADE = (2**62, 0)
HISTORY = frozenset({PARAMETERS, "restarted", "clock_jump"})
"""Events after which an operator's beginning in the middle depends on what was before."""


def records_from(
    recording: Recording,
    makers: Collection[Maker],
    stamp: int,
    *,
    stateless: Collection[str],
    stateful: Collection[str],
    end: int | None = None,
    reach: int | None = None,
) -> FiringLog:
    """Reads the records that repeating all operators from `stamp` (ns) on needs, up to about `end` (ns), or all of them
    where that is not known.

    It is known of recordings whose events cover what happens to operators besides firings, if nothing did before. Of
    an operator with a state it takes one recorded at or before `stamp`. `makers`: the nodes of the graph, of which the
    `stateless` and the `stateful` ones may be repeated. `reach`: the span (ns) before `stamp` in which they are looked
    for at first, by default `FIRST_REACH`. Raises `RecordingError`.
    """
    firsts = [info.first for info in recording.streams.values() if info.first is not None and not info.static]
    told = PARAMETERS in recording.metadata.get(TOLD, {}).get("events", "").split()
    if told and firsts and cut_of(recording.metadata) is None and RECOVERED not in recording.metadata:
        history = min((e.stamp for e in recording.events() if e.name in HISTORY), default=None)
        heads = _heads(recording)
        reach = reach or FIRST_REACH
        while stamp - reach > min(firsts) and (history is None or stamp - reach < 0):
            found = _window(recording, heads, makers, stamp - reach, end)
            if found is not None and _suffices(found, makers, stamp, stateless, stateful):
                return found
            reach *= 4
    if end is not None and firsts and end - min(firsts) <= FIRST_REACH:
        batches = {m.name: [payload for _, payload in recording.firings(m.name, end=end)] for m in makers}
        return FiringLog(batches, str(recording.path), remembers=True)
    return FiringLog.read(recording)


def _heads(recording: Recording) -> Mapping[str, bytes]:
    """The first batch of each operator, which has its `setup()`."""
    heads: dict[str, bytes] = {}
    missing = set(recording.firing_batches())
    for number, (operator, payload) in enumerate(recording.firings()):
        if operator in missing:
            missing.discard(operator)
            heads[operator] = payload
        if not missing or number >= HEAD:
            break
    return heads


def _window(
    recording: Recording, heads: Mapping[str, bytes], makers: Collection[Maker], start: int, end: int | None
) -> FiringLog | None:
    """The records of `makers` from about `start` on, behind those of each one's beginning; None where one has none
    there."""
    firsts: dict[str, bytes] = {}
    for maker in makers:
        inside = recording.firings(maker.name, start, end)
        firsts |= islice((each for each in inside if each[1] != heads.get(maker.name)), 1)  # a head may be written late
    names = {maker.name for maker in makers}
    batches = {name: count for name, count in recording.firing_batches().items() if name in names}
    counts = {name: count for name, count in batches.items() if name not in firsts}
    if any(count > 1 or (count and name not in heads) for name, count in counts.items()):
        return None
    kept: dict[str, list[bytes]] = {n: [] if n in firsts else [head] for n, head in heads.items() if n in names}
    begins: dict[str, int] = {}
    for operator, found in firsts.items():
        head = heads.get(operator)
        if head is None:
            return None
        try:
            before, after = decode_batch(head), decode_batch(found)
        except FiringRecordError:
            return None  # a reader of the whole file names the damaged batch
        last, first = before.records[-1], after.records[0]
        if before.incarnation or after.incarnation or before.records[0].index:
            return None
        if first.index > last.index + 1:
            place = FiringRecord(operator, 0, first.index - 1, "fire", first.stamp)
            left_out = first.index - 1 - last.index
            taken = ResumePoint(again=False, at_setup={}, since={}, state=None)
            cut = cut_record(place, left_out=left_out, taken=taken, held=(), stamp=first.stamp)
            kept[operator] = [head, encode_batch([cut])]
            begins[operator] = first.index
        else:
            kept[operator] = [head]
    if end is None:
        return FiringLog(kept, str(recording.path), recording, start=start, begins=begins)
    for name in firsts:
        kept[name] += [payload for _, payload in recording.firings(name, start, end) if payload != heads[name]]
    return FiringLog(kept, str(recording.path), begins=begins, remembers=True)


def _suffices(
    log: FiringLog, makers: Collection[Maker], stamp: int, stateless: Collection[str], stateful: Collection[str]
) -> bool:
    """Returns whether the window holds a state of every operator that has one, and the makers' records of every message
    that is needed from there on."""
    needed: dict[str, tuple[int, int]] = {}
    made: dict[str, tuple[int, int]] = {}
    for maker in makers:
        made |= _made_from(log.records(maker.name), log.begins.get(maker.name), list(maker.outputs.values()))
        taken = _taken_by(log, maker, stamp, stateless=maker.name in stateless, stateful=maker.name in stateful)
        if taken is None:
            return False
        for stream, place in taken.items():
            needed[stream] = min(place, needed.get(stream, place))
    return all(place >= made[stream] for stream, place in needed.items() if stream in made)


def _taken_by(
    log: FiringLog, maker: Maker, stamp: int, *, stateless: bool, stateful: bool
) -> Mapping[str, tuple[int, int]] | None:
    """By stream, the first message that is needed to repeat an operator from `stamp` on; None where its records in the
    window do not suffice for that."""
    begin = log.begins.get(maker.name)
    taken: dict[str, tuple[int, int]] = {}
    counts, known = stateful, False
    for record in log.records(maker.name):
        if begin is not None and record.index < begin:
            continue
        if record.incarnation or record.kind in ("reset", "param"):
            return None
        counts = counts or (stateless and record.kind in CALLS and record.stamp >= stamp)
        if stateful and is_known(record) and record.stamp <= stamp:
            known = True
            taken.clear()
        elif counts:
            note_taken(taken, record)
    return None if stateful and begin is not None and not known else taken


def _made_from(
    records: Iterable[FiringRecord], begin: int | None, streams: Sequence[str]
) -> Mapping[str, tuple[int, int]]:
    """By stream, the message (incarnation, number) from which on there are all records of its maker."""
    if begin is None:
        return dict.fromkeys(streams, (-1, -1))
    found: dict[str, tuple[int, int]] = {}
    for record in records:
        for stream, emission in zip(streams, record.outputs, strict=False):
            if emission is not None and (record.kind == "setup" or record.index >= begin):
                found.setdefault(stream, (record.incarnation, emission.seq))
        if len(found) == len(streams):
            break
    return dict.fromkeys(streams, NEVER_MADE) | found
