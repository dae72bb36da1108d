"""`dataflow sweep`: many recordings by many settings, on this machine or a Ray cluster, into one table."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from dataflow.cli.support.arguments import Json, Map, ModuleFolders, find_modules_in, graph_file, number
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import DIFFERENT, count, err, fail, out, plural, print_json, say, seconds, table
from dataflow.cli.support.report import is_score
from dataflow.cli.support.run_options import Quiet, Verbose

if TYPE_CHECKING:
    from dataflow.sweep.plan import Choice, What
    from dataflow.sweep.run import Sweep

MOST_NAMED = 5
"""Recordings listed."""
Recordings = Annotated[
    list[str] | None,
    option("--recordings FILE|FOLDER|URL", "Recordings, or folders of them, at any depth. May be repeated."),
]


@dataclass(frozen=True, slots=True)
class WorkOptions:
    """Options of the runs over recordings, and of the folder of their results."""

    maps: Map = None
    path: ModuleFolders = None
    folder: Annotated[Path, option("--out FOLDER", "Where the table, the results and the logs are kept.")] = Path(
        "out/sweep"
    )
    jobs: Annotated[int | None, option("--jobs -j N", "Recordings at a time. Default: one for each core.")] = None
    ray: Annotated[
        str | None,
        option(
            "--ray ADDRESS",
            "Work on a Ray cluster: its address, auto for the one that runs here, local for one of --jobs cores.",
        ),
    ] = None
    timeout: Annotated[
        float, option("--timeout SECONDS", "Give a recording up after so long.", parser=number(1, 1e7, "seconds"))
    ] = 3600.0
    again: Annotated[bool, option("--again", "Also run what has a result already.")] = False

    def plan(
        self,
        recordings: list[str] | None,
        graph: Path | None,
        choices: Sequence[Choice],
        what: What = "replay",
        name: str = "sweep",
    ) -> Sweep:
        """The sweep of these recordings and choices of settings. Raises `SweepError`."""
        from dataflow.sweep.run import Sweep

        return Sweep(
            recordings or (),
            what,
            None if graph is None else graph_file(graph),
            choices,
            self.maps or (),
            self.path or (),
            self.folder,
            self.jobs,
            self.ray,
            self.timeout,
            self.again,
            name,
        )


AS_USUAL = WorkOptions()


def sweep(
    graph: Annotated[
        Path | None, argument("[GRAPH]", "The graph. Default: of each recording the one that made it.")
    ] = None,
    recordings: Recordings = None,
    settings: Annotated[
        list[str] | None,
        option(
            "--set NAME=VALUE,VALUE",
            "The values of a graph parameter, or OPERATOR.PARAM. May be repeated: every combination is run.",
        ),
    ] = None,
    what: Annotated[str, option("--what replay|verify|evaluate", "The work on each recording.")] = "replay",
    how: WorkOptions = AS_USUAL,
    quiet: Quiet = False,
    verbose: Verbose = False,
    json: Json = False,
) -> None:
    """Run every recording by every choice of settings, and make one table of it.

    Each runs in a process alone, --jobs of them at a time. One that has a result is not run again, as long as the
    recording, the graph, its files, the operators' code and the packages are the same: a sweep that was interrupted
    goes on, and a second one is done at once. Those that were killed or took too long are tried again.

    The folder holds `sweep.parquet`, with a row for each recording and operator, `results/`, and of what failed
    `logs/`. With --what evaluate the table holds the operators that have figures.

    Exit codes:

      0    every recording was replayed to its end, or is identical
      1    one failed or differs
      2    could not run: a wrong option, no recordings, a faulty graph
      130  interrupted with Ctrl-C; what is done is kept

    Examples:

      dataflow sweep graphs/cloud.yaml --recordings runs --set cloud.stride=4,8
      dataflow sweep --recordings runs --what verify --jobs 2
      dataflow sweep perception --recordings runs --what evaluate --json
      dataflow sweep perception --recordings s3://bucket/runs --ray auto
    """
    if what not in ("replay", "verify", "evaluate"):
        raise fail(f"--what {what!r}: expected replay, verify or evaluate")
    if how.maps and what == "verify":
        raise fail("--map is for bags, and these hold no firing records to verify")
    find_modules_in(how.path)
    from dataflow.sweep.plan import grid

    plan = how.plan(recordings, graph, grid(settings or ()), cast("What", what))
    spent = work(plan, quiet=quiet)
    _report(plan, spent, json=json, verbose=verbose)


def work(plan: Sweep, *, quiet: bool) -> float:
    """Runs what is left; returns the seconds that it took."""
    begun = time.monotonic()
    if not quiet:
        kept = len(plan.tasks) - len(plan.left)
        choices = len({task.settings for task in plan.tasks})
        what = plural(len(plan.tasks) // choices, "recording") + (f" by {choices} choices" if choices > 1 else "")
        say(f"{what}: {len(plan.left)} to {plan.what}" + (f", {kept} known" if kept else ""))
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=quiet or not err.is_terminal) as progress:
        bar, failed = progress.add_task(plan.what, total=len(plan.left)), 0
        for task, result in plan.run():
            if result.outcome != "done":
                failed += 1
                if not quiet:
                    say(Text(f"{task.source.name}: {result.outcome}: {result.error}", style="yellow").markup)
            progress.update(bar, advance=1, description=f"{plan.what}, {failed} failed" if failed else plan.what)
    return time.monotonic() - begun


def _report(plan: Sweep, spent: float, *, json: bool, verbose: bool) -> None:
    summary = plan.summary()
    well = all(not set(s["outcomes"]) - {"done"} and not set(s["verdicts"]) - {"identical"} for s in summary)
    if json:
        facts = {"table": str(plan.table), "ran": len(plan.left), "known": len(plan.tasks) - len(plan.left)}
        print_json({**facts, "wall_s": spent, "settings": summary, "torn": torn_of(plan)})
    else:
        _print(summary, verbose=verbose)
        print_torn(torn_of(plan))
        out.print(f"wrote {plan.table} in {seconds(spent)}", soft_wrap=True, markup=False)
        if any(set(s["outcomes"]) - {"done"} for s in summary):
            out.print(f"what the failed ones printed: {plan.folder / 'logs'}", soft_wrap=True, markup=False)
    if not well:
        raise typer.Exit(DIFFERENT)


def torn_of(plan: Sweep) -> list[str]:
    """Returns the recordings without a proper end, of which the stored part was run."""
    results = ((task.source.name, plan.store.of(task.key)) for task in plan.tasks)
    return list(
        dict.fromkeys(n for n, found in results if found is not None and found.torn and found.outcome == "done")
    )


def print_torn(names: Sequence[str]) -> None:
    """Names recordings that end before their run did."""
    if names:
        shown = ", ".join(names[:MOST_NAMED]) + (", …" if len(names) > MOST_NAMED else "")
        text = f"without a proper end, only what is stored counts: {len(names)} ({shown}); dataflow recover mends them"
        out.print(Text(text, style="yellow"), soft_wrap=True)


def _print(summary: Sequence[Mapping[str, Any]], *, verbose: bool) -> None:
    verified = any(choice["verdicts"] for choice in summary)
    columns = ("operators", "culprits") if verified else ("dropped", "CPU s")
    made = table("settings", "recordings", "outcomes", *columns, right=("recordings", *(() if verified else columns)))
    for choice in summary:
        done = (count(choice["recordings"]), Text(_counts(choice["outcomes"])))
        costs = (count(choice["dropped"]), f"{choice['cpu_s']:.1f}")
        verdicts = (Text(_counts(choice["verdicts"])), Text(_counts(choice["culprits"])))
        made.add_row(Text(_named(choice) or "as the graph is"), *done, *(verdicts if verified else costs))
    out.print(made)
    names = dict.fromkeys(name for choice in summary for name in choice["figures"])
    shown = [name for name in names if verbose or is_score(name)]
    if shown:
        choices = [_named(choice) or "mean" for choice in summary]
        figures = table("figure", *choices, right=tuple(choices))
        for name in shown:
            found = [choice["figures"].get(name) for choice in summary]
            figures.add_row(Text(name), *("–" if f is None else f"{f['mean']:.4g} ± {f['std']:.2g}" for f in found))
        out.print(figures)


def _named(choice: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value}" for name, value in choice["settings"].items())


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{number:,} {name}" for name, number in counts.items())
