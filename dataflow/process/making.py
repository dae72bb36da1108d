"""Makes what a process of operators runs: its sources, its operators, and the recording that stands in for sources."""

from __future__ import annotations

from functools import partial

from dataflow.chaos.faults import OperatorFaults
from dataflow.firing.failure import OperatorFailure
from dataflow.graph.model import Graph, Node
from dataflow.process.channel import Channel
from dataflow.process.config import ProcessConfig
from dataflow.process.feeding import Feeding
from dataflow.process.live_sources import LiveSources
from dataflow.process.outlet import Outlet
from dataflow.process.outlived import tell_outlived
from dataflow.process.pace import Pace
from dataflow.process.runners import Runners, make_log, make_runner, make_source
from dataflow.remote import Remote


class Making:
    """Puts what it makes where it belongs: among the runners, the feeds, or the live sources."""

    def __init__(
        self,
        config: ProcessConfig,
        graph: Graph,
        channel: Channel,
        pace: Pace,
        runners: Runners,
        feeding: Feeding,
        live: LiveSources,
        outlet: Outlet,
    ) -> None:
        self._config, self._graph, self._channel, self._pace = config, graph, channel, pace
        self._runners, self._feeding, self._live, self._outlet = runners, feeding, live, outlet

    def make(self) -> None:
        """Makes all of them. Raises `OperatorFailure` for one that cannot be made."""
        for name in self._config.nodes:
            try:
                self._make(self._graph.nodes[name])
            except OperatorFailure:
                raise
            except Exception as error:
                raise OperatorFailure(name, "construction", error) from error
        log = make_log(self._graph, self._config, self._outlet)
        if log is not None:
            self._feeding.play_back(log)

    def _make(self, node: Node) -> None:
        if node.source:
            self._make_source(node)
            return
        faults = self._runners.faults[node.name] = OperatorFaults()
        self._runners.add(
            make_runner(
                node,
                self._graph,
                self._config,
                self._outlet,
                faults=faults,
                event_clock=self._pace.event_time,
                on_failure=partial(tell_outlived, self._channel),
            )
        )

    def _make_source(self, node: Node) -> None:
        source = make_source(node, self._graph, self._config, self._outlet)
        if isinstance(source.source, Remote) and not self._config.live:
            raise ValueError("messages from outside come by the clock, which only a live run has: run it with --live")
        self._runners.sources.append(source)
        if self._config.live:
            self._live.add(source)
        else:
            self._feeding.feeds.append(source)
