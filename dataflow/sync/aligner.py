"""The aligner: from messages and frontiers to firings, whatever the order in which they arrive.

A pure state machine without clock, thread or I/O. Its law: for every interleaving that keeps each stream's
own order, the sequence of firings is the same. It implements the eight rules of `docs/design.md`; where those
leave room, this is the reading:

* *Final stamps.* A stream ends with a final stamp at or above every frontier it promised. So a frontier at g
  proves that ticks reach g, and the `finish` firing, 1 ns above the largest final stamp of the triggers (and,
  with ticks, of the streams that bound them), lies above every output frontier given out before.
* *Ticks* are not bounded by `before` inputs. Those are feedback: they end with the operator, so they cannot
  end it.
* *`finish`* has no inputs. Batch messages after the last firing are dropped as `unused`.
* *Dropped firings.* Where a required Sampled input is absent there is no firing: its triggers (and tick) are
  dropped, and its Batch messages wait for the next one.
* *A join passes over an anchor* as soon as one input cannot match, without waiting for the others.
* *Forced frontiers.* A trigger message is `late` when its stamp is not above everything decided, which
  includes everything that `output_frontier` has told. Above that it still takes part, even below a forced
  frontier.
* *Static streams* are waited for; forcing does not apply to them. As a trigger in a merge, or in a Batch, a
  static message is an ordinary one at its stamp, on a stream that ends with it.
* *Restarted streams.* `reset` begins a new incarnation; what lies at or below the last stamp of the earlier
  ones is late for every input, because firing stamps never go back. A graph that should follow a clock which
  jumped back by much starts new aligners.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import count
from typing import NamedTuple

from dataflow.sync.context import Context, InputAbsent
from dataflow.sync.drops import DropLog
from dataflow.sync.entries import Drop, Entry, Firing, FiringKind, Waiting
from dataflow.sync.inputs import Inputs
from dataflow.sync.join import Join
from dataflow.sync.lanes import Lane
from dataflow.sync.merge import Merge
from dataflow.sync.spec import AlignSpec
from dataflow.sync.stamps import FOREVER, NEVER
from dataflow.sync.ticks import Ticks
from dataflow.sync.undecided import Undecided

_NO_NAMES: frozenset[str] = frozenset()


class StreamEnd(NamedTuple):
    """End of a stream: its final stamp (None if it carried and promised nothing) and why."""

    final_stamp: int | None
    reason: str


class Aligner:
    """Decides one operator's firings. `push`, `advance` and `end` take what streams carry; `poll` asks. One thread at
    a time. Frontiers and stamps are integer nanoseconds."""

    def __init__(self, spec: AlignSpec) -> None:
        self.spec = spec
        self.ends: dict[str, StreamEnd] = {}
        """The streams that ended, and how."""
        self._drop_log = DropLog()
        self.dropped: Collection[Drop] = self._drop_log.pending
        """The drops that were not taken (`take_drops`)."""
        self._inputs = Inputs(spec)
        self._streams, lanes = self._inputs.streams, self._inputs.lanes
        triggers = [lane for trigger in spec.triggers for lane in lanes[trigger.name]]
        self._triggers: Join | Merge
        if spec.joins:
            self._triggers = Join(triggers, spec.tolerance, self._drop_log.entry)
        else:
            self._triggers = Merge(spec.triggers, triggers, self._drop_log.entry)
        self._context = Context(spec, lanes, self._drop_log)
        ticks: Ticks | None = None
        bounding: list[Lane] = []
        if spec.every is not None:
            bounds = spec.bounds_of_ticks()
            bounding = [lane for name, stream in bounds for lane in lanes[name] if lane.state.name == stream]
            ticks = Ticks(spec.every, bounding)
        self._finals = {lane.state.name: lane.state for lane in (*triggers, *bounding)}
        self._undecided = Undecided(self._triggers, ticks, triggers)
        self._last_firing = NEVER
        self._finished = False
        self.paused = False
        """True when the last `poll` ended before all was decided, since it had dropped so many."""

    def begin_at(self, stamp: int) -> None:
        """Everything before `stamp` was decided elsewhere, ticks included. To be called before the first `push`;
        messages from before may still be pushed, as partners, samples and parts of batches of what is to come."""
        self._undecided.begin_at(stamp)

    # What streams say

    def push(self, stream: str, entry: Entry) -> None:
        """A message arrives; it implies the frontier at its stamp. Raises StreamOrderError if the stream had promised
        that there would be no such message."""
        state = self._streams.get(stream) or self._inputs.stream(stream)
        if entry.incarnation > state.incarnation and entry.stamp < FOREVER:
            self.reset(stream, entry.incarnation)
        if not entry.stream:
            entry = Entry(entry.stamp, entry.value, entry.seq, entry.incarnation, entry.digest, stream)
        if not state.accept(entry):
            for lane in state.lanes:
                self._drop_log.entry(lane, entry, "late")
            return
        self._undecided.settled = False
        frontier = entry.stamp
        if state.static:
            self.ends[stream] = StreamEnd(None, "static")
            frontier = FOREVER
        for lane in state.lanes:
            if lane.role != "trigger":
                self._push_context(lane, entry)
            elif entry.stamp > lane.frontier:
                lane.entries.append(entry)
            else:
                self._push_forced(lane, entry)
            if frontier > lane.frontier:
                lane.frontier = frontier

    def advance(self, stream: str, frontier: int) -> None:
        """The stream promises: no later message has a stamp at or below `frontier`. Never takes one back. Raises
        StreamOrderError for a frontier at the end of time, where `end` is meant."""
        state = self._inputs.stream(stream)
        if state.advance(frontier):
            self._undecided.settled = False
            for lane in state.lanes:
                lane.raise_frontier(frontier)

    def end(self, stream: str, final_stamp: int | None = None, reason: str = "") -> None:
        """The stream ends: no later message. The second end of a stream is ignored.

        final_stamp: event time the stream reached, at or above its last message and every frontier it
            promised. None takes the larger of these, which is repeatable only if the promised frontiers are.
            Raises StreamOrderError for one that lies below.
        """
        state = self._inputs.stream(stream)
        if state.ended:
            return
        state.end(final_stamp)
        self._undecided.settled = False
        self.ends[stream] = StreamEnd(state.final, reason)
        for lane in state.lanes:
            lane.raise_frontier(FOREVER)

    def reset(self, stream: str, incarnation: int) -> None:
        """The stream's source restarted and begins a new incarnation.

        What it then sends at or below the last stamp of earlier incarnations is late, for every input. A
        stream that had ended is open again. `push` does this by itself on a message of a higher incarnation.
        Firings are repeatable across a restart if the old incarnation promised nothing above its last stamp.
        """
        state = self._inputs.stream(stream)
        state.reset(incarnation)
        self._undecided.settled = False
        self.ends.pop(stream, None)
        for lane in state.lanes:
            lane.reopen(self._undecided.decided)

    # What the process decides when it will not wait

    def force(self, input: str, frontier: int) -> bool:
        """Pretends that the streams of `input`, but for static ones, have promised `frontier`; False when that is no
        news. Live only."""
        moved = self._inputs.force(input, frontier)
        if moved:
            self._undecided.settled = False
        return moved

    def owed_ticks(self) -> tuple[int, int, int]:
        """The ticks that are due now, with nothing between them: how many, the first and the last."""
        return (0, NEVER, NEVER) if self._finished else self._undecided.owed_ticks(self._context.lanes())

    def skip_ticks(self, stamp: int) -> None:
        """Drops the ticks before `stamp` that are not decided yet, as overflow. Live only."""
        if not self._finished:
            self._drop_log.ticks(self._undecided.skip_ticks(stamp), "overflow")

    def waiting(self) -> Waiting | None:
        """The first undecided stamp and what it waits for; None if the next message decides.

        When all inputs named in `needs` have been forced there, the stamp is decided, unless one needs `FOREVER`: a
        static stream that has not come.
        """
        if self._finished:
            return None
        self._undecided.settle()
        if self._undecided.exhausted():
            return None
        stamp = self._undecided.first_possible()
        if stamp is None:
            held = self._triggers.oldest_wait()
            return Waiting(*held) if held is not None else None
        needs = self._undecided.needs(stamp)
        for name, frontier in self._context.needs(stamp).items():
            needs[name] = max(frontier, needs.get(name, NEVER))
        needs.update(dict.fromkeys(self._inputs.awaits_static(needs), FOREVER))
        return Waiting(stamp, needs)

    # What comes out

    def poll(self, most: int | None = None) -> Firing | None:
        """The next firing, or None while it is not decided. The last one has kind "finish". None also after `most`
        decided stamps that were dropped instead of fired; `paused` then shows that there is more to decide."""
        self.paused = False
        if self._finished:
            return None
        undecided = self._undecided
        for _ in count() if most is None else range(most):
            undecided.settle()
            stamp = undecided.stamp
            if not undecided.ready or stamp is None:
                return self._finish() if undecided.exhausted() else None
            if not self._context.knows(stamp):
                return None
            firing = self._fire(stamp)
            undecided.settled = False
            undecided.decided = stamp
            if firing is not None:
                self._last_firing = stamp
                return firing
        self.paused = True
        return None

    def output_frontier(self) -> int:
        """No firing that `poll` has still to return has a stamp at or below this. It never goes back. A firing that
        poll has returned counts as done: until its messages are out, promise its stamp - 1."""
        if self._finished:
            return FOREVER
        undecided = self._undecided
        undecided.settle()
        frontier = self._finish_stamp() - 1 if undecided.exhausted() else undecided.frontier()
        if frontier > undecided.decided:
            undecided.decided = frontier
        return undecided.decided

    def idle_frontier(self) -> int:
        """The output frontier, where no firing is held back and none is left: nothing will come before an input brings
        more. NEVER where `poll` is to be asked."""
        undecided = self._undecided
        undecided.settle()
        if undecided.stamp is not None or not undecided.settled or self._triggers.bound == FOREVER:
            return NEVER
        return self.output_frontier()

    def ended(self) -> bool:
        """Returns whether `poll` has returned the `finish` firing, and will return no other."""
        return self._finished

    def final_stamp(self) -> int | None:
        """Returns what the operator's own streams end with, unless they emitted later: known once `ended`."""
        return self._finish_stamp() - 1 if self._finished else None

    @property
    def drops(self) -> Mapping[tuple[str, str], int]:
        """Returns how many messages (and ticks, whose input is `TICK`) were dropped so far, by (input, reason)."""
        return self._drop_log.counts

    @property
    def late(self) -> Mapping[str, int]:
        """Returns how many messages came after what needed them was decided, by input. Triggers among them are dropped
        as `late`; Sampled and Batch messages still serve the firings to come."""
        return self._drop_log.late

    def take_drops(self) -> list[Drop]:
        """The drops since this was last asked, at most the last `KEPT`."""
        return self._drop_log.take()

    def take_unlisted(self) -> Mapping[tuple[str, str], int]:
        """Returns how many drops were too many to be kept since this was last asked, by (input, reason)."""
        return self._drop_log.take_unlisted()

    def buffered(self) -> dict[str, int]:
        """The number of messages held, by input."""
        return self._inputs.buffered()

    # Deciding

    def _fire(self, stamp: int) -> Firing | None:
        """The firing at a decided stamp, or None if a required Sampled input is absent: a drop instead."""
        undecided, context = self._undecided, self._context
        kind: FiringKind = "fire" if undecided.triggered else "tick"
        if context.empty:
            inputs = self._triggers.take() if undecided.triggered else self._triggers.absent()
            return Firing(stamp, kind, undecided.ticked, inputs, _NO_NAMES, _NO_NAMES)
        values = context.take(stamp, self._last_firing)
        if isinstance(values, InputAbsent):
            if undecided.triggered:
                self._triggers.reject(values.reason, values.input)
            if undecided.ticked:
                self._drop_log.tick(stamp, values.reason, values.input)
            return None
        inputs = self._triggers.take() if undecided.triggered else self._triggers.absent()
        inputs.update(values)
        return Firing(stamp, kind, undecided.ticked, inputs, context.stale, context.late)

    def _finish_stamp(self) -> int:
        if self._finished:
            return self._last_firing
        finals = [state.final for state in self._finals.values() if state.final is not None]
        reached = max(*finals, self._undecided.decided) if finals else self._undecided.decided
        return reached + 1 if reached != NEVER else 0

    def _finish(self) -> Firing:
        stamp = self._finish_stamp()
        self._context.finish()
        self._finished = True
        self._undecided.decided = FOREVER
        self._last_firing = stamp
        return Firing(stamp, "finish")

    # Bookkeeping

    def _push_forced(self, lane: Lane, entry: Entry) -> None:
        """Takes a trigger message that lies below a forced frontier."""
        if entry.stamp <= max(self._undecided.decided, self._triggers.decided):
            self._drop_log.entry(lane, entry, "late")
        else:
            lane.entries.append(entry)

    def _push_context(self, lane: Lane, entry: Entry) -> None:
        """Takes a message of a Sampled or Batch input."""
        if self._finished:
            if lane.role == "batch":
                self._drop_log.entry(lane, entry, "unused")
        elif self._context.push(lane, entry, self._last_firing):
            self._context.prune(lane, self.output_frontier())
