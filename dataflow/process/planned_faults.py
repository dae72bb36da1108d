"""Does planned faults to the operators and sources of a process."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

from dataflow.chaos.faults import OperatorFaults
from dataflow.execution.driver import Driver
from dataflow.execution.protocol import Runner
from dataflow.operator import ParameterError
from dataflow.process.live_sources import LiveSources
from dataflow.process.streams.outlet import Outlet

MALFORMED = b"\x00malformed\xff" * 8


def do_fault(
    kind: str, operator: str, fields: Mapping[str, Any], *, driver: Driver, live: LiveSources, outlet: Outlet
) -> None:
    """Does one fault now, or lets it begin. What each kind means: docs/faults.md."""
    print(f"planned fault: {kind} {operator} {dict(fields)}", file=sys.stderr)
    if live.begin_fault(kind, operator, fields):
        return
    maker = driver[operator]
    match kind:
        case "param":
            try:
                maker.set_parameter(fields["name"], fields["value"])
            except ParameterError as error:
                print(f"planned fault: {error}", file=sys.stderr)
        case "malformed":
            for stream in maker.node.outputs.values():
                outlet.put_raw(stream, MALFORMED)
        case "raise" | "hang" | "slow" | "leak" if isinstance(maker, Runner):
            maker.faults = maker.faults or OperatorFaults()
            maker.faults.begin(kind, fields, time.monotonic())
