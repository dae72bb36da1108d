"""`dataflow demo` and `dataflow graphs`: what comes with dataflow."""

from __future__ import annotations

import time
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.padding import Padding
from rich.text import Text

from dataflow.cli.support.arguments import Json, number, output_file, span
from dataflow.cli.support.execution import Outputs, checked_outputs, execute, plan_options
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import fail, out, print_json, say, seconds
from dataflow.cli.support.run_options import Quiet, ReportOptions, ViewOptions
from dataflow.cli.support.storage import RecordOptions

if TYPE_CHECKING:
    from dataflow.graph import Graph

GRAPH, RECORDING = "perception", "demo"
SHOWN = "dataflow-demo.rrd"
"""The file that the demo writes where there is no display."""


def demo(
    to: Annotated[
        str | None,
        option(
            "--to --out -o TARGET",
            "spawn: a viewer window; serve: a page for a browser; FILE.rrd: a file. Default: a window, or a file "
            "where there is no display.",
        ),
    ] = None,
    duration: Annotated[
        float, option("--seconds SECONDS", "So much of it.", parser=number(1, 21, "seconds of the recording"))
    ] = 21.0,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Show a robot's perception at work: the bundled recording through all operators, in the viewer.

    A robot drives through an office for 21 seconds. Odometry, objects, a map of them and a scene graph are computed
    while you look, in real time: what is where, who does what and where to; at the end their accuracy is printed.
    Without a display everything that would have been shown is written to a file, as fast as the machine goes.

    Examples:

      dataflow demo
      dataflow demo --to serve
      dataflow demo --to robot.rrd --seconds 5
    """
    began = time.monotonic()
    import dataflow.shipped as shipped
    from dataflow.graph import load_graph
    from dataflow.supervision.run import replay as replay_recording

    graph, recording = shipped.graph(GRAPH), shipped.recording(RECORDING)
    if graph is None or recording is None:
        where = shipped.folder("graphs").parent
        raise fail(f"the demo's graph or recording is missing under {where}; install robot-dataflow again")
    outputs = _outputs() if to is None else checked_outputs(RecordOptions(), ViewOptions(to), overwrite=False)
    loaded = load_graph(graph.path)
    rate = None if outputs.view_file is not None else 1.0
    options = plan_options(loaded, outputs, rate=rate)
    shown = _announced(recording, loaded, duration, in_real_time=rate is not None)
    execute(
        lambda watch: replay_recording(recording, graph=loaded, end=duration, watch=watch, **options),
        loaded,
        outputs,
        shown,
        ReportOptions(quiet=quiet, json=json),
        began=began,
    )
    if not json:
        _print_next(recording, outputs)


def _print_next(recording: Path, outputs: Outputs) -> None:
    if outputs.view_file is not None:
        out.print(Text(f"look at it where there is a display: rerun {outputs.view_file}"), soft_wrap=True)
    again = f"dataflow replay {recording} --graph {GRAPH} --record demo.mcap"
    out.print(Text(f"the same, recorded: {again}; then what it found: dataflow scene demo.mcap"), soft_wrap=True)
    out.print(Text(f"the graph: dataflow graphs {GRAPH}; all graphs: dataflow graphs"), soft_wrap=True)


def _announced(recording: Path, graph: Graph, duration: float, *, in_real_time: bool) -> tuple[int, int] | None:
    """Prints how long it takes; returns the first and the last stamp (ns) that are played."""
    from dataflow.recording import Recording
    from dataflow.supervision.replay import plan_replay

    with Recording(recording) as opened:
        whole = span(opened, plan_replay(opened, graph).streams)
    pace = "in real time; Ctrl-C ends it" if in_real_time else "as fast as this machine computes it"
    say(f"plays {seconds(duration)} of a drive {pace}, once the processes have started, which takes some 10 s")
    return None if whole is None else (whole[0], min(whole[1], whole[0] + round(duration * 1e9)))


def _outputs() -> Outputs:
    """A viewer window where one can be opened, else a file of a name that is free."""
    from dataflow.view.process import display_problem

    problem = display_problem()
    if problem is None:
        return Outputs(None, None, "spawn", False, False)
    base = Path(SHOWN)
    names = (base if k == 1 else base.with_stem(f"{base.stem}-{k}") for k in count(1))
    file = next(name for name in names if not name.exists())
    say(f"{problem}: writing {file}; a page for a browser: dataflow demo --to serve")
    return Outputs(None, output_file(file, ".rrd", overwrite=False, option="--to"), None, False, False)


def graphs(
    name: Annotated[str | None, argument("NAME", "Print this graph, to read or to begin from.")] = None,
    json: Json = False,
) -> None:
    """List the graphs that come with dataflow, or print one.

    Their names stand for their files wherever a graph file is expected, unless there is a file of that name.

    Examples:

      dataflow graphs
      dataflow graphs synthetic_rgbd > mine.yaml
      dataflow graphs --json
    """
    import dataflow.shipped as shipped
    from dataflow.graph.problems import did_you_mean

    found = shipped.graphs()
    if name is not None:
        graph = shipped.graph(name)
        if graph is None:
            hint = did_you_mean(name, [graph.name for graph in found], "there are")
            raise fail(f"no graph {name!r} comes with dataflow: {hint}")
        text = graph.path.read_text(encoding="utf-8")
        if json:
            print_json({"name": graph.name, "file": str(graph.path), "text": text})
        else:
            print(text, end="")
        return
    if json:
        print_json([{"name": g.name, "file": str(g.path), "about": list(g.about)} for g in found])
        return
    if not found:
        raise fail(f"no graph was found in {shipped.folder('graphs')}; install robot-dataflow again")
    for graph in found:
        out.print(Text(graph.name, style="bold cyan"))
        out.print(Padding(Text(_first_paragraph(graph.about)), (0, 0, 0, 4)))
    out.print(Text(f"in {shipped.folder('graphs')}; run one by its name: dataflow run synthetic_rgbd"), soft_wrap=True)


def _first_paragraph(lines: tuple[str, ...]) -> str:
    return " ".join(lines[: lines.index("")] if "" in lines else lines)
