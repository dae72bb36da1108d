"""Composes the parts that watch over a run: here alone live runs and others part."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.supervision.configs import Config
from dataflow.supervision.core.core import Core
from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.watchers.counts import Counts
from dataflow.supervision.core.watchers.diagnostics import DiagnosticsWatcher
from dataflow.supervision.core.watchers.drain_limit import DrainLimit
from dataflow.supervision.core.watchers.flow_control import LiveFlowControl, LosslessFlowControl
from dataflow.supervision.core.watchers.heartbeats import Heartbeats
from dataflow.supervision.core.watchers.lateness import Lateness
from dataflow.supervision.core.watchers.leftover_records import LeftoverRecords
from dataflow.supervision.core.watchers.planned_faults import PlannedFaults
from dataflow.supervision.core.watchers.quiescence import LOST_AFTER, Quiescence
from dataflow.supervision.core.watchers.restarts import LiveRestarts, RestartPolicy
from dataflow.supervision.core.watchers.stall import LiveStallWatch, StallWatch
from dataflow.supervision.core.watchers.watcher import Watcher
from dataflow.supervision.plan import ProcessPlan, RunPlan


def core_of(plan: RunPlan, processes: Mapping[str, ProcessPlan], configs: Mapping[str, Config]) -> Core:
    """Returns the core that a plan needs."""
    return (_live if plan.live else _lossless)(RunState(plan, processes, configs))


def _lossless(run: RunState) -> Core:
    """Nothing may be lost: sources wait for all, and the first death ends the run."""
    quiescence = Quiescence(run)
    watch = StallWatch(run, quiescence)
    parts = [Counts(run), LosslessFlowControl(run), quiescence, watch, DrainLimit(run)]
    return Core(run, parts, RestartPolicy(run))


def _live(run: RunState) -> Core:
    """Time does not wait: what fails is started again by its policy, and the rest goes on."""
    parts: list[Watcher] = []
    remains, cover, quiescence = LeftoverRecords(run), LiveFlowControl(run), Quiescence(run, lost_after=LOST_AFTER)
    restarts = LiveRestarts(run, remains, parts)
    parts += [Counts(run), remains, cover, Lateness(run), restarts, Heartbeats(run, cover, restarts)]
    if run.plan.faults is not None:
        parts.append(PlannedFaults(run, run.plan.faults))
    parts += [DiagnosticsWatcher(run), quiescence, LiveStallWatch(run, quiescence), DrainLimit(run)]
    return Core(run, parts, restarts)
