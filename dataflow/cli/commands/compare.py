"""`dataflow compare`: the same recordings by A and by B, and which figures differ by more than chance."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from dataflow.cli.commands.sweep import AS_USUAL, Recordings, WorkOptions, print_torn, torn_of, work
from dataflow.cli.support.arguments import Json, Overwrite, find_modules_in, graph_file, output_file
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import count, fail, out, plural, print_json, table
from dataflow.cli.support.repeated_calls import take_environment
from dataflow.cli.support.report import is_score
from dataflow.cli.support.run_options import Quiet, Verbose

if TYPE_CHECKING:
    from dataflow.sweep.paired import Difference, Paired
    from dataflow.sweep.plan import Choice
    from dataflow.sweep.run import Sweep
    from dataflow.sweep.swap import OperatorShare, ReplayedPair

MOST_NAMED = 5
"""Recordings listed."""
EXPLAINED = 3
"""Recordings whose change is explained."""
WHOLE = 0.9
"""Share of a change from which an operator is said to bring it."""


def compare(
    graph: Annotated[Path, argument("GRAPH", "The graph.")],
    recordings: Recordings = None,
    settings: Annotated[
        list[str] | None,
        option(
            "--set [a:|b:]NAME=VALUE", "A graph parameter, or OPERATOR.PARAM: of A, of B, or of both. May be repeated."
        ),
    ] = None,
    how: WorkOptions = AS_USUAL,
    explain: Annotated[
        str | None,
        option(
            "--explain FIGURE",
            f"Which operator brings the change of this figure? Replays the {EXPLAINED} recordings with the largest "
            "change in the direction of its mean by A, with the outputs of one operator after the other as B made "
            "them.",
        ),
    ] = None,
    rerun: Annotated[
        Path | None, option("--rerun FILE.rrd", "Draw the recording where B is worst: A and B as layers.")
    ] = None,
    overwrite: Overwrite = False,
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
      dataflow compare cloud --recordings runs --set b:cloud.stride=8 --explain f1
    """
    choices = _choices(settings or ())
    find_modules_in(how.path)
    _prepare(graph, choices[0], explain, rerun, overwrite=overwrite)
    plan = how.plan(recordings, graph, choices, name="compare")
    work(plan, quiet=quiet)
    _look(plan, explain, rerun, json=json, verbose=verbose)


def _prepare(graph: Path, first: Choice, explain: str | None, rerun: Path | None, *, overwrite: bool) -> None:
    """Checks the file, and takes the environment of operators where some are to run in this process."""
    if rerun is not None:
        output_file(rerun, ".rrd", overwrite=overwrite, option="--rerun")
    if explain is not None or rerun is not None:
        from dataflow.graph import load_graph

        take_environment(load_graph(graph_file(graph), settings=[f"{n}={v}" for n, v in first]).threads)


def _look(plan: Sweep, explain: str | None, rerun: Path | None, *, json: bool, verbose: bool) -> None:
    """Compares what is kept, and reports it."""
    from dataflow.sweep.paired import compared, differing, figures_of, unlike

    first, second, copies = unlike(*([t for t in plan.tasks if t.settings == choice] for choice in plan.choices))
    figures = compared(figures_of(first, second, plan.store))
    loaded = plan.graphs[plan.choices[0]]
    different = differing(first, second, plan.store, tuple(loaded.nodes) if loaded is not None else ())
    scores = [one for one in figures if is_score(one.figure)]
    shown = list(figures) if verbose or not scores else scores
    shares = None if explain is None else _explained(plan, _named(explain, figures), different)
    drawn = None if rerun is None or not figures else _drawn(plan, _named(explain, figures), rerun)
    code = _report(plan, figures, shown, different, shares, copies, json=json)
    if drawn is not None and not json:
        out.print(Text(f"wrote {rerun}: A and B of {drawn} as layers"), soft_wrap=True)
    if code:
        raise typer.Exit(code)


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


def _named(name: str | None, figures: Sequence[Paired]) -> Paired:
    """The figure of that name, without its operator's where one alone has it; without a name the first listed."""
    if name is None:
        return next((one for one in figures if is_score(one.figure)), figures[0])
    found = [one for one in figures if one.figure == name]
    found = found or [one for one in figures if one.figure.partition(": ")[2] == name]
    if len(found) != 1:
        from dataflow.graph.problems import did_you_mean

        there = found or [one for one in figures if is_score(one.figure)] or figures
        raise fail(f"--explain {name!r}: {did_you_mean(name, (one.figure for one in there), 'there are')}")
    return found[0]


def _both(plan: Sweep, name: str, folder: str) -> ReplayedPair:
    """A recording by A and by B, with every stream."""
    from dataflow.sweep.plan import SweepError
    from dataflow.sweep.swap import both

    a, b = (plan.graphs[choice] for choice in plan.choices)
    where = next(task.source.where for task in plan.tasks if task.source.name == name)
    if "://" in where:
        raise SweepError(f"{where}: --explain and --rerun need the recording on this machine")
    assert a is not None
    assert b is not None
    return both(Path(where), (a, b), plan.maps, Path(folder))


def _explained(plan: Sweep, figure: Paired, different: Sequence[Difference]) -> list[OperatorShare]:
    from dataflow.sweep.swap import between, parts, shares

    made = []
    for name in figure.most_changed[:EXPLAINED]:
        with tempfile.TemporaryDirectory(prefix="dataflow_compare_") as folder:
            one = _both(plan, name, folder)
            names = between(one.graphs, [d.operator for d in different], figure.figure)
            made.append(parts(one, names, figure.figure))
    return shares(made)


def _drawn(plan: Sweep, figure: Paired, file: Path) -> str:
    from dataflow.sweep.layers import draw

    name = figure.recordings[0][0]
    with tempfile.TemporaryDirectory(prefix="dataflow_compare_") as folder:
        draw(_both(plan, name, folder), file)
    return name


def _report(
    plan: Sweep,
    figures: Sequence[Paired],
    shown: Sequence[Paired],
    different: Sequence[Difference],
    shares: Sequence[OperatorShare] | None,
    copies: Mapping[str, str],
    *,
    json: bool,
) -> int:
    failed = _failed(plan)
    if json:
        print_json(
            {
                "a": dict(plan.choices[0]),
                "b": dict(plan.choices[1]),
                "figures": [asdict(one) | {"differs": one.differs} for one in figures],
                "operators": [asdict(one) for one in different],
                **({} if shares is None else {"explained": [asdict(one) for one in shares]}),
                "failed": failed,
                "copies": dict(copies),
                "torn": torn_of(plan),
            }
        )
    else:
        _print(shown, different, len(figures))
        _print_left_out(copies, torn_of(plan))
        if shares is not None:
            _print_shares(shares)
        for line in _failed_lines(failed):
            out.print(Text(line, style="red"), soft_wrap=True)
    return 1 if failed else 0


def _failed(plan: Sweep) -> list[dict[str, Any]]:
    """Returns the recordings that were not replayed to their end, by side: outcome, reason, and where its output is."""
    found = []
    for task in plan.tasks:
        result = plan.store.of(task.key)
        if result is None or result.outcome != "done":
            side = "ab"[task.settings != plan.choices[0]]
            told = {"side": side, "recording": task.source.name, "settings": dict(task.settings)}
            log = plan.store.log(task.key)
            why = ("not done", "") if result is None else (result.outcome, result.error)
            found.append(told | {"outcome": why[0], "error": why[1], "log": str(log) if log.exists() else None})
    return found


def _failed_lines(failed: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Returns a line for each recording, with the sides by which it failed alike; of many the first."""
    alike: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for one in failed:
        alike.setdefault((one["recording"], one["outcome"], one["error"].removeprefix("error: ")), []).append(one)
    for (recording, outcome, error), of in list(alike.items())[:MOST_NAMED]:
        sides = " and ".join(one["side"].upper() for one in of)
        why = ": ".join(filter(None, ("" if outcome == "failed" else outcome, error)))
        log = next((f" (its output: {one['log']})" for one in of if one["log"]), "")
        yield f"failed: {recording} by {sides}: {why}{log}"
    if len(alike) > MOST_NAMED:
        yield f"failed: {count(len(alike) - MOST_NAMED)} more: --json has all"


def _print(shown: Sequence[Paired], different: Sequence[Difference], figures: int) -> None:
    """Prints the figures `shown` of all `figures` that are compared."""
    if not shown:
        out.print("no figures to compare")
        return
    columns = ("A", "B", "B - A", "95 % interval", "p", "recordings")
    made = table("figure", *columns, right=columns)
    for one in shown:
        made.add_row(
            Text(one.figure, style="bold" if one.differs else ""),
            f"{one.a:.4g}",
            f"{one.b:.4g}",
            f"{one.difference:+.3g}",
            "–" if one.low is None else f"{one.low:+.3g} to {one.high:+.3g}",
            f"{one.adjusted:.3g}",
            count(len(one.recordings)),
        )
    out.print(made)
    real = [one for one in shown if one.differs]
    out.print(f"{len(real)} of {len(shown)} figures differ at 5 %")
    _say_least(max(len(one.recordings) for one in shown), figures)
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


def _say_least(recordings: int, figures: int) -> None:
    """Notes where p cannot fall below 5 %."""
    from dataflow.sweep.paired import ALPHA, least_p, needed

    least = least_p(recordings, figures)
    if least >= ALPHA:
        of = f"{plural(recordings, 'recording')} and {plural(figures, 'figure')}"
        text = f"with {of} no p is below {least:.3g}: a difference at 5 % needs {needed(figures)} recordings"
        out.print(text, soft_wrap=True)


def _print_left_out(copies: Mapping[str, str], torn: Sequence[str]) -> None:
    for copy, name in list(copies.items())[:MOST_NAMED]:
        out.print(Text(f"not counted: {copy} holds the same as {name}", style="yellow"), soft_wrap=True)
    if len(copies) > MOST_NAMED:
        out.print(f"not counted: {count(len(copies) - MOST_NAMED)} more copies: --json has all")
    print_torn(torn)


def _print_shares(shares: Sequence[OperatorShare]) -> None:
    made = table("its outputs as in B, all else A", "change", "of B - A", right=("change", "of B - A"))
    for one in shares:
        made.add_row(Text(one.operator), f"{one.change:+.3g}", f"{one.share:.0%}")
    out.print(made)
    bringing = next((one for one in shares if one.share >= WHOLE), None)
    if bringing is None:
        out.print("no operator's outputs alone bring the change")
    else:
        out.print(Text(f"the outputs of {bringing.operator} alone bring it; those behind it in the graph follow"))
