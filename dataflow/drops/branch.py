"""Replays the operators between losses and figures, with some of the losses undone."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from dataflow.drops.losses import Loss
from dataflow.drops.player import MOST_BYTES, PlayedCalls, Player
from dataflow.execution.admission import Arrival, Frontier
from dataflow.execution.driver import Driver, LocalEmitter
from dataflow.execution.feeds.log import LogFeed
from dataflow.execution.runner import OperatorRunner
from dataflow.graph.model import Graph
from dataflow.recording import Recorded, Recording
from dataflow.records.firing import FiringRecord
from dataflow.reexecution.engine import Feeding
from dataflow.reexecution.recorded_run import ReplayError, final_stamps
from dataflow.sync import FOREVER, NEVER, TICK, Entry

EACH = 1000
"""Bytes that a message takes in memory besides its arrays."""
Figures = Mapping[str, Mapping[str, Any]]
"""By operator, what it summed up."""


class Branch:
    """The operators of a feeding, fed from a recording, with what they lost."""

    def __init__(
        self,
        recording: Recording,
        graph: Graph,
        feeding: Feeding,
        players: Mapping[str, Player],
        losses: Collection[Loss],
    ) -> None:
        self._graph, self._feeding, self._players = graph, feeding, players
        self._losses, self._finals = losses, final_stamps(recording, feeding.streams)
        self._read = _Read(recording)
        self.records: dict[str, list[FiringRecord]] = {}
        """The firing records of the last replay, by operator."""

    def replay(self, undone: Collection[Loss] = ()) -> Figures:
        """Replays it with some losses undone: these messages come in time, the others as they came.

        Raises `OperatorFailure`, and `ReplayError` where a firing cannot be decided.
        """
        graph, left = self._graph, [loss for loss in self._losses if loss not in undone]
        driver = Driver()
        emitter = _Keeping(driver)
        for name in self._feeding.operators:
            held = [loss for loss in left if loss.operator == name]
            driver.add(HeldRunner(graph, self._players[name], emitter, held))
        makers = {stream: graph.streams[stream].node for stream in self._feeding.streams}
        feed = LogFeed(
            self._read,
            makers,
            emitter,
            ports={name: tuple(graph.nodes[name].outputs.values()) for name in set(makers.values())},
            finals=self._finals,
        )
        driver.feeding.play_back(feed)
        try:
            driver.set_up()
            while driver.turn():
                pass
        finally:
            driver.close()
        self.records = emitter.records
        if waiting := [runner for runner in driver.operators if not runner.ended]:
            raise ReplayError(f"{waiting[0].node.name} waits for {waiting[0].waiting()} after all was given")
        return {name: found[-1].detail.get("summary", {}) for name, found in self.records.items()}

    def close(self) -> None:
        """Closes the operators."""
        for player in self._players.values():
            player.close()


class _Read:
    """A recording that stays open, always asked for the same messages, which are kept where they are not too many."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.path, self.streams, self.metadata = recording.path, recording.streams, recording.metadata
        self.torn = recording.torn
        self._held: list[Recorded] | None = None
        self._keeps = True

    def messages(
        self, streams: Sequence[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[Recorded]:
        """The messages of streams."""
        if self._held is not None:
            yield from self._held
            return
        read: list[Recorded] = []
        nbytes = 0
        for item in self._recording.messages(streams, start, end):
            nbytes += item.message.nbytes() + EACH
            self._keeps = self._keeps and nbytes <= MOST_BYTES
            if self._keeps:
                read.append(item)
            yield item
        self._held = read if self._keeps else None

    def stamps(self, stream: str, start: int | None = None, end: int | None = None) -> Iterator[int]:
        """The stamps of a stream's messages."""
        return self._recording.stamps(stream, start, end)

    def opening(self) -> Mapping[str, Any] | None:
        """Returns the values by which another process opens it."""
        return self._recording.opening()

    def close(self) -> None:
        """Leaves it open."""


class _Keeping(LocalEmitter):
    """Keeps the records."""

    def __init__(self, driver: Driver) -> None:
        super().__init__(driver)
        self.records: dict[str, list[FiringRecord]] = {}

    def record(self, record: FiringRecord) -> None:
        self.records.setdefault(record.operator, []).append(record)


class HeldRunner(OperatorRunner):
    """Runs an operator without the messages and ticks that it lost, and with those that came late when they came.

    A late message is given once the firing `until` is decided, which its input is forced to be; what comes behind it on
    its stream waits as well.
    """

    def __init__(self, graph: Graph, player: Player, emitter: LocalEmitter, held: Sequence[Loss]) -> None:
        super().__init__(
            player.node, emitter, static=graph.static, seed=graph.seed, operator=player.operator.shell, lossy=True
        )
        self.calls = PlayedCalls(player)
        self._watched = 0
        self._held = {(loss.stream, loss.stamp): loss for loss in held}
        self._holds = {loss.stream for loss in held}
        self._behind: dict[str, deque[Arrival]] = {}
        self._ticks = {loss.stamp for loss in held if loss.input == TICK}

    def push(self, stream: str, entry: Entry) -> None:
        if stream in self._holds:
            self._take(stream, entry)
        else:
            super().push(stream, entry)

    def advance(self, stream: str, frontier: int) -> None:
        if stream in self._holds:
            self._take(stream, Frontier(frontier))
        else:
            super().advance(stream, frontier)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        if stream in self._holds:
            self._take(stream, Frontier(NEVER if final_stamp is None else final_stamp, True, reason))
        else:
            super().end(stream, final_stamp, reason)

    def _take(self, stream: str, arrival: Arrival) -> None:
        if behind := self._behind.get(stream):
            behind.append(arrival)
        elif not self._pass_on(stream, arrival):
            self._behind[stream] = deque([arrival])

    def _pass_on(self, stream: str, arrival: Arrival) -> bool:
        """Gives it to the aligner; False where that has to wait."""
        if isinstance(arrival, Frontier):
            if arrival.ends:
                super().end(stream, None if arrival.stamp == NEVER else arrival.stamp, arrival.reason)
            else:
                super().advance(stream, arrival.stamp)
            return True
        loss = self._held.get((stream, arrival.stamp))
        if loss is None:
            super().push(stream, arrival)
        elif loss.until == FOREVER:
            super().advance(stream, arrival.stamp)
        elif self.aligner.output_frontier() >= loss.until:
            super().push(stream, arrival)
        else:
            if self.aligner.force(loss.input, loss.until):
                self.wake()
            return False
        return True

    def step(self) -> bool:
        if self._ticks:
            number, first, _ = self.aligner.owed_ticks()
            while number and first in self._ticks:
                self.aligner.skip_ticks(first + 1)
                number, first, _ = self.aligner.owed_ticks()
        worked = super().step()
        for stream, behind in self._behind.items():
            while behind and self._pass_on(stream, behind[0]):
                behind.popleft()
                worked = True
        return worked

    def close(self) -> None:
        """Leaves the operator to its player."""
