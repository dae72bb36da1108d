"""Flow control: reports to the processes with sources how far all work is done, so that their windows regain room.

Only the latest report counts, so it replaces one that a process has not read yet.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from dataflow.supervision.core.life import Life
from dataflow.supervision.core.live_flow import LiveFlow
from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.watcher import Watcher
from dataflow.sync import FOREVER, NEVER


class FlowControl(Watcher):
    """Takes in how far each process is, and recomputes what is sent to sources when that changes."""

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        if kind == "progress":
            process.done |= self._decided(process, fields["done"])
            self.cover()
        elif kind == "ended":
            process.done = dict.fromkeys(process.done, FOREVER)
            self.cover()

    def _decided(self, process: Supervised, done: Mapping[str, int]) -> Mapping[str, int]:
        return done

    def cover(self) -> None:
        """Sends each process with sources its new bounds."""
        raise NotImplementedError


class LosslessFlowControl(FlowControl):
    """The least stamp that every operator and every sink has done: sources wait for all."""

    def __init__(self, run: RunState) -> None:
        super().__init__(run)
        self._covered = NEVER

    def cover(self) -> None:
        run = self.run
        covered = min(
            (
                process.done.get(name, NEVER)
                for process in run.processes.values()
                if process.report is None
                for name in run.consumers(process)
            ),
            default=FOREVER,
        )
        if covered <= self._covered:
            return
        self._covered = covered
        for process in run.processes.values():
            if process.report is None and (process.plan.has_log or run.sources(process)):
                run.send(process, "covered", replaces=True, frontier=covered)


class LiveFlowControl(FlowControl):
    """Computes how far the operators that sources wait for are behind (the window), and how far any is (the backlog).

    An operator does not count while its process is away or gives no sign of life. A new process owes nothing of what
    was given before it. One that gives signs of life again begins its backlog anew, too, where its queue bounds what
    it has to take in; with `queue: block` nothing else does, so sources drop until it has caught up.
    """

    def __init__(self, run: RunState) -> None:
        super().__init__(run)
        self.flow = LiveFlow(run.graph, [process.nodes for process in run.processes.values()])
        self._told: dict[str, tuple[int, int]] = {}
        self._excused: dict[str, int] = {}  # operator → the stamp up to which it owes nothing

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        super().said(process, kind, fields)
        if kind == "jumped":
            self._jumped(fields["stamp"])

    def _decided(self, process: Supervised, done: Mapping[str, int]) -> Mapping[str, int]:
        """One that was started again has not decided anything yet."""
        return (
            done
            if process.is_sink and not process.attempt
            else {name: stamp for name, stamp in done.items() if stamp != NEVER}
        )

    def _jumped(self, stamp: int) -> None:
        """The clock of a source has jumped back: nothing from there on is done."""
        self._told.clear()
        for process in self.run.processes.values():
            process.done = {n: min(f, stamp - 1) for n, f in process.done.items() if f != FOREVER}
        self._excused = {n: min(f, stamp - 1) for n, f in self._excused.items()}

    def away(self, process: Supervised) -> None:
        self.cover()

    def back(self, process: Supervised) -> None:
        self._told.pop(process.label, None)
        self._excuse([] if process.is_sink else self.run.consumers(process))

    def heard_again(self, process: Supervised) -> None:
        """A process that gave no sign of life gives one."""
        nodes = self.run.graph.nodes
        self._excuse([name for name in self.run.consumers(process) if nodes[name].live.queue != "block"])

    def _excuse(self, operators: Iterable[str]) -> None:
        """Holds nothing against these operators that was given until now."""
        for name in operators:
            if (given := self.flow.given(name)) != NEVER:
                self._excused[name] = given
        self.cover()

    def counted(self) -> Iterator[tuple[Supervised, str]]:
        """Yields the operators that take part at the moment, with their processes."""
        for process in self.run.processes.values():
            if process.life is Life.RUNNING and not process.is_sink and not process.silent:
                for name in self.run.consumers(process):
                    yield process, name

    def lags(self, process: Supervised, name: str) -> tuple[int, int]:
        """Returns how far an operator is behind the last and the foremost of its sources (ns of event time)."""
        done = process.done.get(name, NEVER)
        return self.flow.lags(name, max(done, self._excused.get(name, NEVER)))

    def cover(self) -> None:
        run = self.run
        for name, node in run.graph.nodes.items():
            if node.source and name in run.status.operators:
                self.flow.reached(name, run.status.operators[name].done)
        strict = [
            max((self.flow.lag(source, stamp) for source, stamp in process.done.items()), default=0)
            for process in run.processes.values()
            if process.is_sink and process.report is None and process.life is not Life.AWAY
        ]
        loose = list(strict)
        for process, name in self.counted():
            behind_last, behind_foremost = self.lags(process, name)
            loose.append(behind_foremost)
            if name in self.flow.waited_for:
                strict.append(behind_last)
        for process in run.processes.values():
            sources = run.sources(process)
            if sources and process.report is None:
                self._tell(process, self._frontier(sources, strict), self._frontier(sources, loose))

    def _frontier(self, sources: tuple[str, ...], lags: list[int]) -> int:
        return self.flow.covered(sources, max(lags)) if lags else FOREVER

    def _tell(self, process: Supervised, covered: int, backlog: int) -> None:
        if self._told.get(process.label) != (covered, backlog) and process.life is Life.RUNNING:
            self._told[process.label] = covered, backlog
            self.run.send(process, "covered", replaces=True, frontier=covered, backlog=backlog)
