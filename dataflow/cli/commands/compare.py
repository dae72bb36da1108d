"""`dataflow compare`: the same recordings by A and by B, and which figures differ by more than chance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from dataflow.cli.commands.sweep import Again, Folder, Jobs, Patience, Ray, Recordings, work
from dataflow.cli.support.arguments import Json, Map, ModuleFolders, find_modules_in, graph_file
from dataflow.cli.support.output import count, fail, friendly_errors, out, print_json, table
from dataflow.cli.support.report import is_score
from dataflow.cli.support.run_options import Quiet, Verbose

if TYPE_CHECKING:
    from dataflow.sweep.paired import Difference, Paired
    from dataflow.sweep.plan import Choice
    from dataflow.sweep.run import Sweep

MOST_NAMED = 5
"""Recordings listed."""
LEAST = 6
"""Pairs that Wilcoxon's test needs for a p below 5 %."""


def compare(
    graph: Annotated[Path, typer.Argument(metavar="GRAPH", help="The graph.")],
    recordings: Recordings = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="[a:|b:]NAME=VALUE",
            help="A graph parameter, or OPERATOR.PARAM: of A, of B, or of both. May be repeated.",
        ),
    ] = None,
    maps: Map = None,
    path: ModuleFolders = None,
    folder: Folder = Path("out/sweep"),
    jobs: Jobs = None,
    ray: Ray = None,
    timeout: Patience = 3600.0,
    again: Again = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    json: Json = False,
) -> None:
    """Replay recordings with A's settings and with B's, and compare the figures of the graph pair by pair.

    Each figure's mean of B - A has a 95 % interval (bootstrap over recordings) and the p of Wilcoxon's signed-rank
    test, adjusted by Holm's method where there are several. Besides: the recordings where B is worst, and the operators
    whose outputs differ. Results are kept as those of `dataflow sweep` are: A runs once for several B.

    Exit codes:

      0    done, whatever the figures are
      1    a recording failed
      2    could not run: a wrong option, no recordings, a faulty graph
      130  interrupted with Ctrl-C; what is done is kept

    Examples:

      dataflow compare perception --recordings runs --set b:detector=yolox_nano
      dataflow compare cloud --recordings runs --set b:cloud.stride=8 --json
    """
    choices = _choices(settings or ())
    with friendly_errors():
        find_modules_in(path)
        from dataflow.sweep.paired import compared, differing, figures_of
        from dataflow.sweep.plan import SweepError
        from dataflow.sweep.run import Sweep

        try:
            file = graph_file(graph)
            given = (choices, maps or (), path or ())
            plan = Sweep(recordings or (), "replay", file, *given, folder, jobs, ray, timeout, again, "compare")
            work(plan, quiet=quiet)
        except SweepError as error:
            raise fail(str(error)) from None
        first, second = ([task for task in plan.tasks if task.settings == choice] for choice in choices)
        figures = compared(figures_of(first, second, plan.store))
        loaded = plan.graphs[choices[0]]
        different = differing(first, second, plan.store, tuple(loaded.nodes) if loaded is not None else ())
    _report(plan, figures, different, json=json, verbose=verbose)


def _choices(words: Sequence[str]) -> tuple[Choice, Choice]:
    sides: dict[str, list[tuple[str, str]]] = {"a": [], "b": []}
    for word in words:
        side, separator, rest = word.partition(":")
        given = rest if separator and side in sides else word
        name, equals, value = given.partition("=")
        if not equals or not name:
            raise fail(f"--set {word!r}: expected NAME=VALUE, a:NAME=VALUE or b:NAME=VALUE")
        for each in (side,) if given is rest else sides:
            sides[each].append((name, value))
    if sides["a"] == sides["b"]:
        raise fail("A and B are the same: give one of them a setting, such as --set b:detector.threshold=0.3")
    return tuple(sides["a"]), tuple(sides["b"])


def _report(
    plan: Sweep, figures: Sequence[Paired], different: Sequence[Difference], *, json: bool, verbose: bool
) -> None:
    failed = [s for s in plan.summary() if set(s["outcomes"]) - {"done"}]
    if json:
        print_json(
            {
                "a": dict(plan.choices[0]),
                "b": dict(plan.choices[1]),
                "figures": [asdict(one) | {"differs": one.differs} for one in figures],
                "operators": [asdict(one) for one in different],
                "failed": [{"settings": s["settings"], "outcomes": s["outcomes"]} for s in failed],
            }
        )
    else:
        _print(figures, different, verbose=verbose)
        for summary in failed:
            out.print(Text(f"failed: {summary['settings'] or 'as the graph is'}: {summary['outcomes']}", style="red"))
    if failed:
        raise typer.Exit(1)


def _print(figures: Sequence[Paired], different: Sequence[Difference], *, verbose: bool) -> None:
    scores = [one for one in figures if is_score(one.figure)]
    shown = list(figures) if verbose or not scores else scores
    columns = ("A", "B", "B - A", "95 % interval", "p", "recordings")
    made = table("figure", *columns, right=columns)
    for one in shown:
        made.add_row(
            Text(one.figure, style="bold" if one.differs else ""),
            f"{one.a:.4g}",
            f"{one.b:.4g}",
            f"{one.difference:+.3g}",
            f"{one.low:+.3g} to {one.high:+.3g}",
            f"{one.adjusted:.3g}",
            count(len(one.recordings)),
        )
    out.print(made)
    real = [one for one in shown if one.differs]
    out.print(f"{len(real)} of {len(shown)} figures differ at 5 %" if shown else "no figures to compare")
    if shown and len(shown[0].recordings) < LEAST:
        out.print(f"p stays above 5 % with fewer than {LEAST} recordings", soft_wrap=True)
    for one in (real or shown)[:1]:
        worst = ", ".join(f"{name} {value:+.3g}" for name, value in one.recordings[:MOST_NAMED])
        out.print(Text(f"{one.figure}, {'worst for B' if one.directed else 'the most'}: {worst}"), soft_wrap=True)
    for one in shown:
        if one.left_out:
            names = ", ".join(one.left_out[:MOST_NAMED])
            out.print(Text(f"{one.figure}: left out, without a number: {len(one.left_out)} ({names})", style="yellow"))
    if different:
        listed = ", ".join(
            f"{d.operator} in {d.recordings}" + (f" (first in {d.first})" if d.first else "") for d in different
        )
        out.print(Text(f"outputs differ of: {listed}"), soft_wrap=True)
