"""A recording as a feed: its streams stand in for the sources that made them."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from dataflow.execution.feeds.playable import PlayableStreams
from dataflow.execution.log import FiringLog
from dataflow.execution.ports import Emitter
from dataflow.execution.work import Work
from dataflow.messages.digest import StreamDigest
from dataflow.recording import Recorded
from dataflow.records.firing import Emission
from dataflow.sync import FOREVER, NEVER, Entry

_NO_DETAIL: Mapping[str, Any] = {}


@dataclass(slots=True)
class _LoggedStream:
    name: str
    node: str
    final: int
    place: int | None
    """The place of its port among those of its node; None where it is none of them."""
    promises: Sequence[int] | None = None
    """The frontier that may be promised, by the number of messages given; None where its clock never went back."""
    promised: int = NEVER
    ended: bool = False
    incarnation: int = 0
    count: int = 0
    digest: StreamDigest = field(default_factory=StreamDigest)

    def may_promise(self, frontier: int) -> int:
        """Returns as much of a promise as the messages to come allow."""
        return frontier if self.promises is None else min(frontier, self.promises[self.count])

    @property
    def is_over(self) -> bool:
        """Returns whether all its messages were given, as far as that is known before the recording has been read."""
        return self.promises is None or self.count == len(self.promises) - 1


class LogFeed:
    """The recorded streams of a graph's sources, merged by (stamp, stream).

    `streams` maps each stream to the node that made it. `finals` holds the stamps that streams ended with in the
    recorded run, where known. `start` and `end` (ns, inclusive) cut the recording; static streams are always given.
    A stream whose clock went back in the recorded run begins its next incarnation where that one did: what it promises
    holds all the same (`promises`).
    """

    def __init__(
        self,
        recording: PlayableStreams,
        streams: Mapping[str, str],
        emitter: Emitter,
        *,
        ports: Mapping[str, tuple[str, ...]],
        finals: Mapping[str, int],
        start: int | None = None,
        end: int | None = None,
        messages: Iterable[Recorded] | None = None,
    ) -> None:
        """`messages`: what is given in place of all that the recording holds of the streams."""
        self.recording, self.emitter = recording, emitter
        self._ports, self._start = ports, start
        self._records = {node: FiringLog(node, emitter) for node in sorted(set(streams.values()))}
        self._static = {s for s in streams if recording.streams[s].static}
        self._streams = {
            name: _LoggedStream(
                name,
                node,
                self._final(name, finals, end),
                ports[node].index(name) if name in ports[node] else None,
                self._promises(name, start, end),
            )
            for name, node in streams.items()
            if name not in self._static
        }
        self._first_end = self._least_final()
        self._nodes = dict(streams)
        self._messages = iter(recording.messages(list(streams), start, end) if messages is None else messages)
        self._step: list[Recorded] = []
        self._following: Recorded | None = None
        self.last = NEVER
        self.firings = self.emitted = 0
        self.ended = False
        self.work = Work()
        self.static_digests: dict[str, StreamDigest] = {}

    def span(self) -> tuple[int, int] | None:
        """The stamps between which it plays; None where it holds none."""
        firsts = [s.first for name in self._streams if (s := self.recording.streams[name]).first is not None]
        if not firsts:
            return None
        begin = max(min(firsts), min(firsts) if self._start is None else self._start)
        return begin, max(begin, *(stream.final for stream in self._streams.values()))

    def _final(self, name: str, finals: Mapping[str, int], end: int | None) -> int:
        last = self.recording.streams[name].last
        final = max(finals.get(name, NEVER), NEVER if last is None else last)
        return final if end is None else min(final, end)

    def _least_final(self) -> int:
        return min((state.final for state in self._streams.values() if not state.ended), default=FOREVER)

    def _promises(self, name: str, start: int | None, end: int | None) -> Sequence[int] | None:
        if self.recording.streams[name].incarnations < 2:
            return None
        return promises(list(self.recording.stamps(name, start, end)))

    def setup(self) -> None:
        """Gives the static streams, and ends the ones that hold nothing."""
        emitted: dict[str, dict[str, Emission]] = {node: {} for node in self._records}
        for item in self._messages:
            if item.stream not in self._static:
                self._following = item
                break
            digest = item.message.digest()
            self.static_digests.setdefault(item.stream, StreamDigest()).update(digest)
            entry = Entry(item.message.stamp, item.message, item.seq, item.incarnation, digest, item.stream)
            self.emitter.message(item.stream, entry)
            self.emitted += 1
            emitted[self._nodes[item.stream]][item.stream] = Emission(item.seq, item.message.stamp, digest)
        for stream in sorted(self._static):
            self.emitter.end(stream, None, "static")
        for node, records in self._records.items():
            outputs = tuple(emitted[node].get(stream) for stream in self._ports[node])
            records.add("setup", NEVER + 1, time.time_ns(), outputs=outputs, detail={"replayed": True})

    def look_ahead(self) -> int | None:
        if not self._step and not self.ended:
            with self.work:
                self._read_step()
        return self._step[0].message.stamp if self._step else None

    def _read_step(self) -> None:
        """Reads the messages of the next stamp."""
        first = self._following or next(self._messages, None)
        self._following = None
        if first is not None:
            self._step.append(first)
            for item in self._messages:
                if item.message.stamp != first.message.stamp:
                    self._following = item
                    break
                self._step.append(item)

    def admit(self) -> tuple[int, int]:
        step, self._step = self._step, []
        stamp = step[0].message.stamp
        self._end_before(stamp)
        by_node: dict[str, list[Emission | None]] = {}
        nbytes = 0
        for item in step:
            state = self._streams[item.stream]
            digest = item.message.digest()
            state.digest.update(digest)
            state.count += 1
            state.promised, state.incarnation = max(state.promised, stamp), item.incarnation
            nbytes += item.message.nbytes()
            self.emitter.message(
                item.stream, Entry(stamp, item.message, item.seq, item.incarnation, digest, item.stream)
            )
            outputs = by_node.get(state.node)
            if outputs is None:
                outputs = by_node[state.node] = [None] * len(self._ports[state.node])
            if state.place is not None:
                outputs[state.place] = Emission(item.seq, stamp, digest)
        self.last = stamp
        self.firings += 1
        self.emitted += len(step)
        started = time.time_ns()
        for node, outputs in by_node.items():
            self._records[node].add_step(stamp, started, tuple(outputs), _NO_DETAIL)
        return len(step), nbytes

    def promise(self) -> None:
        """Every stream of a log is known up to the last stamp that was read, so sparse streams delay no consumer."""
        self._end_before(self.last)
        for state in self._streams.values():
            if not state.ended and state.promised < (frontier := state.may_promise(self.last)):
                state.promised = frontier
                self.emitter.frontier(state.name, frontier)

    def _end_before(self, stamp: int) -> None:
        if stamp <= self._first_end:
            return
        for state in self._streams.values():
            if not state.ended and state.is_over and state.final < stamp:
                self._end(state, state.final, "end of stream")
        self._first_end = self._least_final()

    def _end(self, state: _LoggedStream, final: int, reason: str) -> None:
        state.ended = True
        reached = max(final, state.promised)
        self.emitter.end(state.name, None if reached == NEVER else reached, reason)

    def finish(self, reason: str = "end of recording") -> None:
        if self.ended:
            return
        self.ended = True
        for state in self._streams.values():
            if not state.ended:
                final = state.final if self._following is None and not self._step else self.last
                self._end(state, final, reason)
        for node, records in self._records.items():
            records.add("finish", self.last, time.time_ns(), outputs=(None,) * len(self._ports[node]))

    def close(self) -> None:
        self.recording.close()

    def counts(self) -> Iterable[tuple[str, int, str]]:
        """(stream, messages, digest) of all streams."""
        for name, digest in self.static_digests.items():
            yield name, digest.count, digest.hexdigest()
        for state in self._streams.values():
            yield state.name, state.count, state.digest.hexdigest()


def promises(stamps: Sequence[int]) -> list[int]:
    """Returns the largest frontier that may be promised when the first k messages have been given, for k = 0, 1, ...
    `stamps`: of all messages, in the order of the stream. `NEVER`: nothing beyond the message itself."""
    reached = [NEVER]
    for stamp in stamps:
        reached.append(max(reached[-1], stamp))
    found = [FOREVER]
    following = FOREVER
    """The first stamp to come that is not late, less 1."""
    for k in range(len(stamps) - 1, -1, -1):
        if stamps[k] > reached[k]:
            following = stamps[k] - 1
        caught_up = k == 0 or stamps[k - 1] == reached[k]
        found.append(following if caught_up else NEVER)
    return found[::-1]


def gapless(messages: Iterable[Recorded]) -> Iterator[Recorded]:
    """Numbers the messages of each stream without the gaps that a recording may have.

    A gap means to a process that messages were lost on their way to it, but messages that a recording lacks were never
    sent. The first message of a stream keeps its number, another incarnation begins with 0.
    """
    due: dict[str, tuple[int, int]] = {}
    for item in messages:
        incarnation, number = due.get(item.stream, (item.incarnation, item.seq))
        if item.incarnation != incarnation:
            number = 0
        due[item.stream] = item.incarnation, number + 1
        yield item if item.seq == number else replace(item, seq=number)
