"""The firing records that the end of a recording needs: a run of days is not read to verify its last minute.

Earlier records are left out as from a recording that was cut: a `cut` record replaces them (`dataflow.records.cuts`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from dataflow.recording import Recording
from dataflow.recording.layout import PARAMETERS, RECOVERED, TOLD
from dataflow.recording.streams.cutting import cut_of
from dataflow.records.cuts import Taken, cut_record, is_known
from dataflow.records.firing import CALLS, FiringRecord, FiringRecordError, decode_batch, encode_batch
from dataflow.records.reading import FiringLog, Maker, needed_from

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
) -> FiringLog:
    """Reads the records that repeating all operators from `stamp` (ns) on needs, or all of them where that is not
    known.

    It is known of recordings whose events tell of what happens to operators besides firings, if nothing did before. Of
    an operator with a state it takes one recorded at or before `stamp`. `makers`: the nodes of the graph, of which the
    `stateless` and the `stateful` ones may be repeated. Raises `RecordingError`.
    """
    firsts = [info.first for info in recording.streams.values() if info.first is not None and not info.static]
    told = PARAMETERS in recording.metadata.get(TOLD, {}).get("events", "").split()
    if told and firsts and cut_of(recording.metadata) is None and RECOVERED not in recording.metadata:
        history = min((e.stamp for e in recording.events() if e.name in HISTORY), default=None)
        heads = _heads(recording)
        reach = FIRST_REACH
        while stamp - reach > min(firsts) and (history is None or stamp - reach < 0):
            found = _window(recording, heads, stamp - reach)
            if found is not None and _suffices(found, makers, stamp, stateless, stateful):
                return found
            reach *= 4
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


def _window(recording: Recording, heads: Mapping[str, bytes], start: int) -> FiringLog | None:
    """The records from about `start` on, behind those of each operator's beginning; None where one has none there."""
    batches: dict[str, list[bytes]] = {}
    for operator, payload in recording.firings(start=start):
        batches.setdefault(operator, []).append(payload)
    if any(count > 1 and operator not in batches for operator, count in recording.firing_batches().items()):
        return None
    begins: dict[str, int] = {}
    for operator, found in batches.items():
        head = heads.get(operator)
        if head is None:
            return None
        try:
            before, after = decode_batch(head), decode_batch(found[0])
        except FiringRecordError:
            return None  # a reader of the whole file names the damaged batch
        last, first = before.records[-1], after.records[0]
        if before.incarnation or after.incarnation or before.records[0].index:
            return None
        if first.index > last.index + 1:
            place = FiringRecord(operator, 0, first.index - 1, "fire", first.stamp)
            left_out = first.index - 1 - last.index
            taken = Taken(again=False, at_setup={}, since={}, state=None)
            cut = cut_record(place, left_out=left_out, taken=taken, held=(), stamp=first.stamp)
            found[:0] = [head, encode_batch([cut])]
            begins[operator] = first.index
        elif first.index == last.index + 1:
            found.insert(0, head)
    return FiringLog({name: batches.get(name, [head]) for name, head in heads.items()}, str(recording.path), begins)


def _suffices(
    log: FiringLog, makers: Collection[Maker], stamp: int, stateless: Collection[str], stateful: Collection[str]
) -> bool:
    """Returns whether the window holds a state of every operator that has one, and the makers' records of every message
    that is needed from there on."""
    needed: dict[str, tuple[int, int]] = {}
    made: dict[str, tuple[int, int]] = {}
    for maker in makers:
        begin = log.begins.get(maker.name)
        records = [r for r in log.of(maker.name) if begin is None or r.index >= begin]
        if any(r.incarnation or r.kind in ("reset", "param") for r in records):
            return False
        made |= _made_from(log.of(maker.name), begin, list(maker.outputs.values()))
        since = len(records)
        if maker.name in stateless:
            since = next((k for k, r in enumerate(records) if r.kind in CALLS and r.stamp >= stamp), len(records))
        elif maker.name in stateful:
            since = max((k + 1 for k, r in enumerate(records) if is_known(r) and r.stamp <= stamp), default=0)
            if begin is not None and not since:
                return False
        for stream, place in needed_from(records[since:]).items():
            needed[stream] = min(place, needed.get(stream, place))
    return all(place >= made[stream] for stream, place in needed.items() if stream in made)


def _made_from(
    records: Sequence[FiringRecord], begin: int | None, streams: Sequence[str]
) -> Mapping[str, tuple[int, int]]:
    """By stream, the message (incarnation, number) from which on there are all records of its maker."""
    if begin is None:
        return dict.fromkeys(streams, (-1, -1))
    found: dict[str, tuple[int, int]] = {}
    for record in records:
        for stream, emission in zip(streams, record.outputs, strict=False):
            if emission is not None and (record.kind == "setup" or record.index >= begin):
                found.setdefault(stream, (record.incarnation, emission.seq))
    return dict.fromkeys(streams, NEVER_MADE) | found
