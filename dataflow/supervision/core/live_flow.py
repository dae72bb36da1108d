"""Flow control of a live run: how far everything is behind the sources that it lives on, and for whom sources wait."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from dataflow.graph.model import Graph
from dataflow.graph.reach import reached
from dataflow.sync import NEVER


class LiveFlow:
    """Follows how far sources have got, and how far that leaves others behind. Stamps and lags are ns of event time.

    A source that stops leaves no operator behind: only messages that its sources have given count against an operator.
    """

    def __init__(self, graph: Graph, processes: Iterable[Collection[str]]) -> None:
        """`processes` holds the operators of each process."""
        self.upstream = sources_upstream(graph)
        self.waited_for = waited_for(graph, processes)
        self._first: dict[str, int] = {}
        self._last: dict[str, int] = {}

    def reached(self, source: str, stamp: int) -> None:
        """A source has emitted messages up to `stamp`, or none yet (`NEVER`)."""
        if stamp != NEVER:
            self._first[source] = min(stamp, self._first.get(source, stamp))
            self._last[source] = stamp

    def lag(self, source: str, done: int) -> int:
        """Returns how far one that has done everything up to `done` is behind a source."""
        last = self._last.get(source)
        return 0 if last is None else max(0, last - max(done, self._first[source] - 1))

    def lags(self, operator: str, done: int) -> tuple[int, int]:
        """Returns how far an operator is behind the last and the foremost of its sources."""
        found = [self.lag(source, done) for source in self.upstream[operator]]
        return min(found, default=0), max(found, default=0)

    def given(self, operator: str) -> int:
        """The foremost stamp that the sources of an operator have given, or `NEVER`."""
        return max((self._last[s] for s in self.upstream[operator] if s in self._last), default=NEVER)

    def covered(self, sources: Collection[str], lag: int) -> int:
        """The stamp up to which everything of these sources is done by those that are `lag` behind."""
        return max((self._last[s] - lag for s in sources if s in self._last), default=NEVER)


def sources_upstream(graph: Graph) -> dict[str, frozenset[str]]:
    """For each operator, the sources that it lives on, directly or through others; static streams do not count."""
    makers = _makers(graph)
    above = {name: {name} | reached([name], makers.__getitem__) for name in graph.nodes}
    return {name: frozenset(each for each in found if graph.nodes[each].source) for name, found in above.items()}


def waited_for(graph: Graph, processes: Iterable[Collection[str]]) -> frozenset[str]:
    """The operators for which sources wait: those that drop nothing, unless one that does is upstream or in the same
    process, since then they can be no faster than it."""
    operators = {name for name, node in graph.nodes.items() if not node.source}
    together = [operators.intersection(process) for process in processes]
    makers = _makers(graph)
    free = {name for name in operators if graph.nodes[name].live.queue != "block"}
    while True:
        beside = [others for others in together if others & free]
        more = free.union(*beside, *({n} for n in operators if makers[n] & free))
        if more == free:
            return frozenset(operators - free)
        free = more


def _makers(graph: Graph) -> dict[str, set[str]]:
    """For each operator, those whose dynamic streams it takes."""
    static = graph.static
    return {name: {graph.streams[s].node for s in node.taken - static} for name, node in graph.nodes.items()}
