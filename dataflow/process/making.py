"""Makes what a process of operators runs: its sources, its operators, and the recording that stands in for sources."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dataflow.chaos.faults import OperatorFaults
from dataflow.firing.failure import OperatorFailure
from dataflow.graph.model import Node
from dataflow.process.runners import make_log, make_runner, make_source
from dataflow.remote import Remote

if TYPE_CHECKING:
    from dataflow.process.operator_process import OperatorProcess


def make_operators(process: OperatorProcess) -> None:
    """Makes all of them. Raises `OperatorFailure` for one that cannot be made."""
    for name in process.config.nodes:
        try:
            _make(process, process.graph.nodes[name])
        except OperatorFailure:
            raise
        except Exception as error:
            raise OperatorFailure(name, "construction", error) from error
    log = make_log(process.graph, process.config, process.outlet)
    if log is not None:
        process.feeding.feeds.append(log)


def _make(process: OperatorProcess, node: Node) -> None:
    config, runners = process.config, process.runners
    if node.source:
        source = make_source(node, process.graph, config, process.outlet)
        if isinstance(source.source, Remote) and not config.live:
            raise ValueError("messages from outside come by the clock, which only a live run has: run it with --live")
        runners.sources.append(source)
        if config.live:
            process.live.add(source)
        else:
            process.feeding.feeds.append(source)
        return

    def tell(failure: OperatorFailure, pause: float) -> None:
        process.channel.send(
            "restarting", operator=failure.operator, when=failure.when, summary=failure.summary, pause=pause
        )

    faults = runners.faults[node.name] = OperatorFaults()
    clock = process.pace.event_time
    runners.add(
        make_runner(node, process.graph, config, process.outlet, faults=faults, event_clock=clock, on_failure=tell)
    )
