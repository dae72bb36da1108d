"""`dataflow latency`: how long messages take from sources to sinks, and which operator costs most."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.text import Text

from dataflow.cli.support.arguments import Json, ModuleFolders, RecordingFile, existing_recording, find_modules_in
from dataflow.cli.support.output import count, fail, out, print_json, table

if TYPE_CHECKING:
    from dataflow.analysis.latency import PathLatency


def latency(recording: RecordingFile, folders: ModuleFolders = None, json: Json = False) -> None:
    """Print the latency of every path of a recorded run, from source to sink.

    The time runs from the moment a source gave a message to the end of the sink's firing that the message caused. It is
    computed from the firing records, so every recorded run has it: of a live run the latencies of that run, of a run as
    fast as the graph goes those under full load. "costs most" names the operator with the largest share: its own calls
    and the time that messages waited in front of it. `dataflow spans` gives the calls themselves.

    Examples:

      dataflow latency run.mcap
      dataflow latency run.mcap --json
    """
    from dataflow.analysis.latency import latencies, records_of
    from dataflow.recording import Recording
    from dataflow.reexecution.recorded_run import recorded_graph, resolved_graph

    find_modules_in(folders)
    with Recording(existing_recording(recording)) as opened:
        if not opened.firing_batches():
            raise fail(
                f"{recording} holds no firing records, from which latencies are computed: `dataflow run --record` and "
                "replays keep them; `dataflow record`, conversions and other programs do not"
            )
        graph = resolved_graph(opened) or recorded_graph(opened)
        records = records_of(opened, graph)
        found = latencies(graph, records)
    if not found:
        raise fail(f"{recording}: no firing of a sink is recorded that a source's message caused")
    if json:
        print_json([path.as_json() for path in found])
    else:
        _print(found)


def _print(found: list[PathLatency]) -> None:
    made = table("from", "to", *_NUMBERS[:4], "costs most", *_NUMBERS[4:], right=_NUMBERS)
    made.padding = (0, 0, 0, 0)
    for name in (0, 1, 6):
        made.columns[name].min_width = 8
    for path in found:
        share = next(s for s in path.shares if s.operator == path.costliest)
        numbers = (_ms(path.p50), _ms(path.p99), _ms(path.largest))
        made.add_row(
            Text(path.source),
            Text(path.sink),
            count(path.count),
            *numbers,
            Text(path.costliest),
            _ms(share.work),
            _ms(share.wait),
        )
    out.print(made)


_NUMBERS = ("count", "p50 ms", "p99 ms", "max ms", "work ms", "wait ms")


def _ms(nanoseconds: float) -> str:
    return f"{nanoseconds * 1e-6:,.2f}"
