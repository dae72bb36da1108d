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

from collections.abc import Mapping
from itertools import count
from typing import NamedTuple

from dataflow.sync.batch import Batch
from dataflow.sync.drops import DropLog
from dataflow.sync.entries import Drop, DropReason, Entry, Firing, InputValue, Waiting
from dataflow.sync.join import Join
from dataflow.sync.lanes import PRUNE_AT, Lane, Role, StreamState
from dataflow.sync.merge import Merge
from dataflow.sync.sampled import Sampled
from dataflow.sync.spec import AlignSpec
from dataflow.sync.stamps import FOREVER, NEVER
from dataflow.sync.ticks import Ticks

_NO_NAMES: frozenset[str] = frozenset()


class StreamEnd(NamedTuple):
    """End of a stream: its final stamp (None if it carried and promised nothing) and why."""

    final_stamp: int | None
    reason: str


class Aligner:
    """Decides one operator's firings. `push`, `advance` and `end` tell it what streams said; `poll` asks.

    One thread at a time. Frontiers and stamps are integer nanoseconds.
    """

    def __init__(self, spec: AlignSpec) -> None:
        self.spec = spec
        self.ends: dict[str, StreamEnd] = {}
        """The streams that ended, and how."""
        self._drop_log = DropLog()
        self._streams = {name: StreamState(name, name in spec.static) for name in sorted(spec.streams)}
        self._lanes: dict[str, tuple[Lane, ...]] = {}
        for trigger in spec.triggers:
            self._add_lanes(trigger.name, "trigger", trigger.streams)
        for sampled in spec.sampled:
            self._add_lanes(sampled.name, "sampled", sampled.streams, sampled.before or 0)
        for batch in spec.batches:
            self._add_lanes(batch.name, "batch", batch.streams)

        triggers = [lane for trigger in spec.triggers for lane in self._lanes[trigger.name]]
        self._triggers: Join | Merge
        if spec.joins:
            self._triggers = Join(triggers, spec.tolerance, self._drop_log.entry)
        else:
            self._triggers = Merge(spec.triggers, triggers, self._drop_log.entry)
        self._sampled = {s.name: Sampled(s, self._lanes[s.name]) for s in spec.sampled}
        self._batches = {b.name: Batch(b, self._lanes[b.name], self._drop_log.entry) for b in spec.batches}
        self._ticks: Ticks | None = None
        bounding: list[Lane] = []
        if spec.every is not None:
            bounds = spec.bounds_of_ticks()
            bounding = [lane for name, stream in bounds for lane in self._lanes[name] if lane.state.name == stream]
            self._ticks = Ticks(spec.every, bounding)
        self._finals = {lane.state.name: lane.state for lane in (*triggers, *bounding)}

        self._stamp: int | None = None  # the first undecided stamp, of a trigger or a tick
        self._triggered = False  # whether a trigger candidate lies there
        self._ticked = False  # whether a tick lies there
        self._ready = False  # whether that is all known
        self._settled = False  # whether these say what is so: nothing has changed since
        self._decided = NEVER  # everything at or below is decided, or has been promised downstream
        self._last_firing = NEVER
        self._finished = False
        self.paused = False
        """True when the last `poll` ended before all was decided, since it had dropped so many."""

    def begin_at(self, stamp: int) -> None:
        """Everything before `stamp` was decided elsewhere, ticks included. To be called before the first `push`;
        messages from before may still be pushed, as partners, samples and parts of batches of what is to come."""
        self._decided = stamp - 1
        self._settled = False
        if self._ticks is not None:
            self._ticks.begin_at(stamp)

    # What streams say

    def push(self, stream: str, entry: Entry) -> None:
        """A message arrives; it implies the frontier at its stamp.

        Raises StreamOrderError if the stream had promised that there would be no such message.
        """
        state = self._streams.get(stream) or self._stream(stream)
        if entry.incarnation > state.incarnation and entry.stamp < FOREVER:
            self.reset(stream, entry.incarnation)
        if not entry.stream:
            entry = Entry(entry.stamp, entry.value, entry.seq, entry.incarnation, entry.digest, stream)
        if not state.accept(entry):
            for lane in state.lanes:
                self._drop_log.entry(lane, entry, "late")
            return
        self._settled = False
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
        """The stream promises: no later message has a stamp at or below `frontier`. Never takes one back.

        Raises StreamOrderError for a frontier at the end of time, where `end` is meant.
        """
        state = self._stream(stream)
        if state.advance(frontier):
            self._settled = False
            for lane in state.lanes:
                lane.raise_frontier(frontier)

    def end(self, stream: str, final_stamp: int | None = None, reason: str = "") -> None:
        """The stream ends: no later message. The second end of a stream is ignored.

        final_stamp: event time the stream reached, at or above its last message and every frontier it
            promised. None takes the larger of these, which is repeatable only if the promised frontiers are.
            Raises StreamOrderError for one that lies below.
        """
        state = self._stream(stream)
        if state.ended:
            return
        state.end(final_stamp)
        self._settled = False
        self.ends[stream] = StreamEnd(state.final, reason)
        for lane in state.lanes:
            lane.raise_frontier(FOREVER)

    def reset(self, stream: str, incarnation: int) -> None:
        """The stream's source restarted and begins a new incarnation.

        What it then sends at or below the last stamp of earlier incarnations is late, for every input. A
        stream that had ended is open again. `push` does this by itself on a message of a higher incarnation.
        Firings are repeatable across a restart if the old incarnation promised nothing above its last stamp.
        """
        state = self._stream(stream)
        state.reset(incarnation)
        self._settled = False
        self.ends.pop(stream, None)
        for lane in state.lanes:
            lane.reopen(self._decided)

    # What the process decides when it will not wait

    def force(self, input: str, frontier: int) -> bool:
        """Pretends that the streams of `input`, but for static ones, have promised `frontier`; False when that is no
        news. Live only."""
        if input not in self._lanes:
            raise KeyError(f"no input {input!r}; the inputs are {', '.join(self._lanes)}")
        frontier = min(frontier, FOREVER - 1)
        moved = [lane for lane in self._lanes[input] if not lane.state.static and frontier > lane.frontier]
        for lane in moved:
            lane.frontier = frontier
            self._settled = False
        return bool(moved)

    def owed_ticks(self) -> tuple[int, int, int]:
        """The ticks that are due now, with nothing between them: how many, the first and the last."""
        ticks = self._ticks
        if ticks is None or self._finished:
            return 0, NEVER, NEVER
        self._settle()
        if not ticks.confirmed:
            return 0, NEVER, NEVER
        last = min(ticks.reach, self._triggers.bound)
        if self._triggers.stamp is not None:
            last = min(last, self._triggers.stamp)
        for name in (*self._sampled, *self._batches):
            last = min(last, *(lane.frontier + lane.delay for lane in self._lanes[name]))
        return ticks.owed(last)

    def skip_ticks(self, stamp: int) -> None:
        """Drops the ticks before `stamp` that are not decided yet, as overflow. Live only."""
        ticks = self._ticks
        if ticks is None or self._finished:
            return
        self._settle()
        if ticks.confirmed and ticks.stamp < stamp:
            self._drop_log.ticks(ticks.skip(stamp), "overflow")

    def waiting(self) -> Waiting | None:
        """The first undecided stamp and what it waits for; None if the next message decides.

        When all inputs named in `needs` have been forced there, the stamp is decided, unless one needs `FOREVER`: a
        static stream that has not come.
        """
        if self._finished:
            return None
        self._settle()
        if self._exhausted():
            return None
        stamp = self._undecided()
        needs: dict[str, int] = {}
        if stamp is None:
            held = self._triggers.oldest_wait()
            return Waiting(*held) if held is not None else None
        if self._triggers.stamp == stamp:
            needs.update(self._triggers.needs())
        elif self._triggers.bound < stamp:
            lagging = [lane for trigger in self.spec.triggers for lane in self._lanes[trigger.name]]
            needs.update({lane.input: stamp for lane in lagging if lane.frontier < stamp})
        for name, frontier in self._ticks_need(stamp).items():
            needs[name] = max(frontier, needs.get(name, NEVER))
        contexts: tuple[Sampled | Batch, ...] = (*self._sampled.values(), *self._batches.values())
        for context in contexts:
            need = context.needs(stamp)
            if need is not None:
                needs[context.name] = max(need, needs.get(context.name, NEVER))
        for name, frontier in needs.items():
            if any(lane.state.static and lane.frontier < frontier for lane in self._lanes[name]):
                needs[name] = FOREVER
        return Waiting(stamp, needs)

    # What comes out

    def poll(self, most: int | None = None) -> Firing | None:
        """The next firing, or None while it is not decided. The last one has kind "finish".

        None also after `most` decided stamps that were dropped instead of fired; `paused` then tells that there is
        more to decide.
        """
        self.paused = False
        if self._finished:
            return None
        for _ in count() if most is None else range(most):
            self._settle()
            stamp = self._stamp
            if not self._ready or stamp is None:
                return self._finish() if self._exhausted() else None
            for context in self._sampled.values():
                if not context.knows(stamp):
                    return None
            for batch in self._batches.values():
                if not batch.knows(stamp):
                    return None
            firing = self._fire(stamp)
            self._settled = False
            self._decided = stamp
            if firing is not None:
                self._last_firing = stamp
                return firing
        self.paused = True
        return None

    def output_frontier(self) -> int:
        """No firing that `poll` has still to return has a stamp at or below this. It never goes back.

        A firing that poll has returned counts as done: until its messages are out, promise its stamp - 1.
        """
        if self._finished:
            return FOREVER
        self._settle()
        if self._exhausted():
            frontier = self._finish_stamp() - 1
        else:
            frontier = self._triggers.bound
            if self._stamp is not None and self._stamp <= frontier:
                frontier = self._stamp - 1
            if self._ticks is not None:
                frontier = min(frontier, self._ticks.stamp - 1, self._ticks.reach)
        if frontier > self._decided:
            self._decided = frontier
        return self._decided

    def idle_frontier(self) -> int:
        """The output frontier, where no firing is held back and none is left: nothing will come before somebody says
        more. NEVER where `poll` is to be asked."""
        if not self._settled:
            self._settle()
        if self._stamp is not None or not self._settled or self._triggers.bound == FOREVER:
            return NEVER
        return self.output_frontier()

    def ended(self) -> bool:
        """Tells whether `poll` has returned the `finish` firing, and will return no other."""
        return self._finished

    def final_stamp(self) -> int | None:
        """Returns what the operator's own streams end with, unless they emitted later: known once `ended`."""
        return self._finish_stamp() - 1 if self._finished else None

    @property
    def drops(self) -> Mapping[tuple[str, str], int]:
        """Tells how many messages (and ticks, whose input is `TICK`) were dropped so far, by (input, reason)."""
        return self._drop_log.counts

    @property
    def late(self) -> Mapping[str, int]:
        """Tells how many messages came after what needed them was decided, by input. Triggers among them are dropped as
        `late`; Sampled and Batch messages still serve the firings to come."""
        return self._drop_log.late

    def has_drops(self) -> bool:
        """Tells whether there is a drop that was not taken."""
        return self._drop_log.pending

    def take_drops(self) -> list[Drop]:
        """The drops since this was last asked, at most the last `KEPT`."""
        return self._drop_log.take()

    def take_unlisted(self) -> Mapping[tuple[str, str], int]:
        """Tells how many drops were too many to be kept since this was last asked, by (input, reason)."""
        return self._drop_log.take_unlisted()

    def buffered(self) -> dict[str, int]:
        """The number of messages held, by input."""
        return {name: sum(len(lane.entries) for lane in lanes) for name, lanes in self._lanes.items()}

    # Deciding

    def _settle(self) -> None:
        """Finds the first undecided stamp, and whether triggers and ticks there are known."""
        if self._settled:
            return
        triggers = self._triggers
        triggers.settle()
        candidate = triggers.stamp
        ticks = self._ticks
        if ticks is None:  # else what is known of ticks depends on what is decided, too
            self._settled = True
            self._stamp, self._triggered, self._ready = candidate, candidate is not None, triggers.ready
            return
        ticks.settle(self._decided)
        tick = ticks.stamp
        if candidate is not None and candidate <= tick:
            self._stamp, self._triggered, self._ticked = candidate, True, candidate == tick
            self._ready = triggers.ready and (candidate < tick or ticks.confirmed)
        else:
            self._stamp, self._triggered, self._ticked = (tick if tick != FOREVER else None), False, True
            self._ready = ticks.confirmed and triggers.bound >= tick

    def _undecided(self) -> int | None:
        """The first undecided stamp, or, while ticks have no known start, the first that may be one."""
        ticks = self._ticks
        if ticks is None or ticks.started:
            return self._stamp
        return min((s for s in (self._triggers.stamp, ticks.latest_start) if s is not None), default=None)

    def _ticks_need(self, stamp: int) -> dict[str, int]:
        if self._ticks is None:
            return {}
        if not self._ticks.started:
            return self._ticks.needs_to_start(stamp)
        return self._ticks.needs() if self._ticks.stamp == stamp else {}

    def _fire(self, stamp: int) -> Firing | None:
        """The firing at a decided stamp, or None if a required Sampled input is absent: a drop instead."""
        if not self._sampled and not self._batches:
            inputs = self._triggers.take() if self._triggered else self._triggers.absent()
            return Firing(stamp, "fire" if self._triggered else "tick", self._ticked, inputs, _NO_NAMES, _NO_NAMES)
        context: dict[str, InputValue] = {}
        stale: list[str] = []
        late: list[str] = []
        for name, sampled in self._sampled.items():
            value = sampled.choose(stamp)
            if sampled.required and not value:
                self._reject(stamp, sampled.why_absent(), name)
                return None
            context[name] = value
            if sampled.stale:
                stale.append(name)
            if sampled.late:
                late.append(name)
        for name, batch in self._batches.items():
            context[name] = batch.take(stamp, self._last_firing)
            if batch.late:
                late.append(name)
        inputs = self._triggers.take() if self._triggered else self._triggers.absent()
        if context:
            inputs.update(context)
        return Firing(
            stamp,
            "fire" if self._triggered else "tick",
            self._ticked,
            inputs,
            frozenset(stale) if stale else _NO_NAMES,
            frozenset(late) if late else _NO_NAMES,
        )

    def _reject(self, stamp: int, reason: DropReason, because: str) -> None:
        if self._triggered:
            self._triggers.reject(reason, because)
        if self._ticked:
            self._drop_log.tick(stamp, reason, because)

    def _exhausted(self) -> bool:
        """Tells whether nothing is left but the finish."""
        over = self._stamp is None and self._triggers.bound == FOREVER
        return over and (self._ticks is None or self._ticks.stamp == FOREVER)

    def _finish_stamp(self) -> int:
        if self._finished:
            return self._last_firing
        finals = [state.final for state in self._finals.values() if state.final is not None]
        reached = max(finals, default=NEVER)
        reached = max(reached, self._decided)
        return reached + 1 if reached != NEVER else 0

    def _finish(self) -> Firing:
        stamp = self._finish_stamp()
        for batch in self._batches.values():
            batch.drop_rest()
        for name in self._sampled:
            for lane in self._lanes[name]:
                lane.entries.clear()
        self._finished = True
        self._decided = FOREVER
        self._last_firing = stamp
        return Firing(stamp, "finish")

    # Bookkeeping

    def _add_lanes(self, name: str, role: Role, streams: tuple[str, ...], delay: int = 0) -> None:
        self._lanes[name] = tuple(Lane(name, role, self._streams[stream], delay) for stream in sorted(streams))
        for lane in self._lanes[name]:
            lane.state.lanes.append(lane)

    def _stream(self, name: str) -> StreamState:
        state = self._streams.get(name)
        if state is None:
            raise KeyError(f"stream {name!r} feeds no input; those that do: {', '.join(self._streams)}")
        return state

    def _push_forced(self, lane: Lane, entry: Entry) -> None:
        """Takes a trigger message that lies below a forced frontier."""
        if entry.stamp <= max(self._decided, self._triggers.decided):
            self._drop_log.entry(lane, entry, "late")
        else:
            lane.entries.append(entry)

    def _push_context(self, lane: Lane, entry: Entry) -> None:
        if self._finished:
            if lane.role == "batch":
                self._drop_log.entry(lane, entry, "unused")
            return
        if lane.state.static and lane.role == "sampled":
            lane.entries.clear()
        lane.entries.append(entry)
        if entry.stamp + lane.delay <= self._last_firing:
            lane.late = entry.stamp
            self._drop_log.came_late(lane)
        if len(lane.entries) > lane.limit:
            self._prune(lane)

    def _prune(self, lane: Lane) -> None:
        """Forgets what no firing to come can need. The limit doubles, so the cost per message stays small."""
        bound = self.output_frontier()
        if lane.role == "sampled":
            self._sampled[lane.input].prune(lane, bound)
        else:
            self._batches[lane.input].prune(bound)
        lane.limit = max(PRUNE_AT, 2 * len(lane.entries))
