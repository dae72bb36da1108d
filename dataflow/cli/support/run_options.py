"""Options that `dataflow run`, `dataflow replay` and other commands share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from dataflow.cli.support.arguments import number
from dataflow.cli.support.options import option
from dataflow.cli.support.output import fail
from dataflow.cli.support.storage import OUTPUT

if TYPE_CHECKING:
    from dataflow.graph import Graph

PLACEMENT = "Placement"
TIMEOUT = 120.0
"""Seconds without any progress after which a run is given up."""

Replace = Annotated[bool, option("--overwrite", "Replace output files that exist.", OUTPUT)]
Rate = Annotated[
    float | None,
    option(
        "--rate RATE",
        "Pace: 1 is real time. Default: as fast as the graph goes.",
        parser=number(0.001, 1000, "1 is real time"),
    ),
]
Step = Annotated[bool, option("--step", "Begin paused: → or n makes a step, space lets it go on.")]
Listen = Annotated[
    str | None,
    option(
        "--listen ENDPOINT", "Where other machines join, and tools with keys: tls/ADDRESS:PORT, with --keys.", PLACEMENT
    ),
]
Keys = Annotated[Path | None, option("--keys FOLDER", "This machine's keys (`dataflow keys`).", PLACEMENT)]
Timeout = Annotated[
    float,
    option(
        "--timeout SECONDS",
        "Give up after so long without any progress, and when the operators take longer to be set up.",
        parser=number(0.1, 1e6, "seconds"),
    ),
]
Paranoid = Annotated[bool, option("--paranoid", "Catch operators that write into their inputs.")]
MakeEffects = Annotated[
    bool,
    option(
        "--make-effects",
        "Make calls to services (`self.effect`) again. Their answers are compared, and the recorded ones given; a "
        "call that is not recorded gets the new one.",
    ),
]
Verbose = Annotated[bool, option("--verbose -v", "Report every operator, every figure, every loss.")]
Quiet = Annotated[bool, option("--quiet -q", "No progress display.")]


@dataclass(frozen=True, slots=True)
class PlacementOptions:
    """Placement of operators in processes."""

    one_process: Annotated[bool, option("--one-process", "Run all operators in one process.", PLACEMENT)] = False
    process_each: Annotated[bool, option("--process-each", "Run every operator in a separate process.", PLACEMENT)] = (
        False
    )
    place: Annotated[
        list[str] | None,
        option("--place OPERATOR=PROCESS", "Run OPERATOR in the process of that name. May be repeated.", PLACEMENT),
    ] = None

    def placement(self, graph: Graph) -> Any:
        """The `placement` of a run plan."""
        if self.one_process + self.process_each + bool(self.place) > 1:
            raise fail("--one-process, --process-each and --place exclude each other")
        if not self.place:
            return "one_process" if self.one_process else "process_each" if self.process_each else "graph"
        placement = {}
        for word in self.place:
            operator, separator, process = word.partition("=")
            if not separator or not process or operator not in graph.nodes:
                known = ", ".join(graph.nodes)
                raise fail(f"--place {word!r}: expected OPERATOR=PROCESS with an operator of the graph ({known})")
            placement[operator] = process
        return placement


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """The viewer of a run."""

    view: Annotated[
        str | None,
        option(
            "--view TARGET",
            "spawn: a viewer window; serve: a page for a browser; FILE.rrd: save everything that is shown.",
            OUTPUT,
        ),
    ] = None
    open_saved: Annotated[
        bool,
        option("--open", "With --view FILE.rrd: open the saved file in the viewer when there is a display.", OUTPUT),
    ] = False


@dataclass(frozen=True, slots=True)
class ReportOptions:
    """Output of a run on the terminal."""

    quiet: Quiet = False
    verbose: Verbose = False
    json: Annotated[bool, option("--json", "Print the report, digests included, as JSON.", OUTPUT)] = False


def machines_of(
    graph: Graph, listen: str | None, keys: Path | None, *, here: bool, begins: bool = True
) -> dict[str, Any]:
    """Returns the field of a `RunPlan` for other machines, if an option is about them; a run listens."""
    from dataflow.machines.keys import require_address, require_serving, settings
    from dataflow.supervision.plan import Rendezvous

    if here and listen is not None:
        raise fail("--here runs everything on this machine; --listen is for others")
    if keys is not None and listen is None:
        raise fail("--keys is for --listen: where do other machines join?")
    if listen is not None and all(node.machine is None for node in graph.nodes.values()):
        raise fail("--listen: no operator is to run on another machine; place one there by `machine: NAME`")
    if listen is not None and not here:
        settings(keys, listen)
    if keys is not None:
        require_serving(keys)
        if begins and not here and listen is not None:
            require_address(listen)
    return {"machines": Rendezvous(listen, keys)} if listen is not None else {"machines": None} if here else {}
