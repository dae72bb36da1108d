"""Commands of `dataflow scene`: the scene graph of a recording, in words, as JSON, or asked for something."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dataflow.api.recordings import open as open_recording
from dataflow.messages import Activity, FeatureVector, SceneGraph
from dataflow.messages.scene_summary import (
    agents_in_words,
    carriers_in_words,
    movers_in_words,
    rooms_in_words,
    spaced,
    summarize,
)
from dataflow.recording import Recording, RecordingError
from operators.labels import LabelSpace, LabelSpaceError, labels_file
from operators.scene.graph.history import Event, history
from operators.scene.graph.meaning import by_meaning, how_to_embed
from operators.scene.graph.query import Match, QueryError, as_json, ask
from operators.scene.graph.spark import as_spark_dsg

_OLD = 1.0
"""Seconds by which a graph may be older than what is asked for, without a word."""

_LIKEST = 10
"""Nodes that a question by meaning is answered with."""

_PIPED = 160
"""Columns of a table that no terminal shows."""

scene = typer.Typer(name="scene", add_completion=False)


@scene.command()
def show(
    recording: Annotated[Path, typer.Argument(help="A recording with a scene graph.", show_default=False)],
    at: Annotated[
        float | None, typer.Option(metavar="SECONDS", min=0, help="So long after its first message. Default: its end.")
    ] = None,
    query: Annotated[
        str | None,
        typer.Option(help="Whatever fits: 'mug on table near person', or by meaning: 'something to drink from'."),
    ] = None,
    story: Annotated[
        str | None, typer.Option("--history", metavar="NODE", help="What happened to a node, such as 'mug 12', so far.")
    ] = None,
    stream: Annotated[str | None, typer.Option(help="The stream of the graph, where there are several.")] = None,
    nodes: Annotated[bool, typer.Option("--nodes", help="List nodes with position, size, tracks, relations.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print nodes, relations and matches as JSON.")] = False,
    export: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Write it for Spark-DSG, which Hydra's tools open.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the --export file if it is there.")] = False,
) -> None:
    """Show the scene graph of a recording at a time in short, all its nodes, what in it a question asks for, or one
    node's history up to then.

    A question names a class and conditions on it: `mug on table near person` is a mug that is on a table and near a
    person; `not` denies a relation. A class may be `anything` or have a number, as in `on table 3`. Any other text
    names the ten nodes that are most like it in meaning, where nodes have embeddings. Exit code 1 where nothing fits.

    Examples:

      dataflow scene out/demo.mcap
      dataflow scene out/demo.mcap --at 9.2 --query "book in shelf"
      dataflow scene out/demo.mcap --nodes --json
      dataflow scene out/demo.mcap --history "person 14"
    """
    try:
        if story is not None:
            _told(_history(recording, stream, at, story), json=json)
            return
        graph, activities, since = _graph(recording, stream, at)
        if at is not None and since < at - _OLD:
            note = f"note: nothing is newer than {since:.1f} s, so this is of then, not of {at:g} s"
            Console(stderr=True).print(note, highlight=False, soft_wrap=True)
        matches = None if query is None else _asked(recording, stream, graph, query)
        if export is not None:
            _write(graph, export, overwrite=overwrite)
    except (QueryError, RecordingError, ValueError, OSError) as error:
        Console(stderr=True).print(f"[bold red]error:[/bold red] {escape(str(error))}", highlight=False, soft_wrap=True)
        raise typer.Exit(2) from None
    if json:
        _print_json(graph, activities, query, matches)
    elif nodes:
        _show(graph, since)
    elif matches is None:
        _tell(recording, graph, activities, since)
    else:
        _answer(graph, matches)
        if not matches:
            Console().print(f"nothing at {since:.1f} s is {query}", highlight=False)
    if matches is not None and not matches:
        raise typer.Exit(1)


def _print_json(graph: SceneGraph, activities: Activity | None, query: str | None, matches: list[Match] | None) -> None:
    content = as_json(graph, activities)
    if matches is not None:
        content["query"] = query
        content["matches"] = [{"id": int(graph.ids[m.node]), "score": round(m.score, 4)} for m in matches]
    typer.echo(jsonlib.dumps(content))


def _answer(graph: SceneGraph, matches: list[Match]) -> None:
    out, names = Console(), graph.names()
    for m in matches:
        place = ", ".join(f"{v:.2f}" for v in graph.positions[m.node])
        reasons = "; ".join(f"{p.replace('_', ' ')} {names[o] if s == m.node else names[s]}" for s, p, o in m.because)
        out.print(f"{names[m.node]} at ({place}) m, score {m.score:.2f}" + (f": {reasons}" if reasons else ""))


def _asked(path: Path, stream: str | None, graph: SceneGraph, query: str) -> list[Match]:
    """Returns what fits a question, or, where that is none of classes and relations, what is like it in meaning."""
    with _opened(path) as recording:
        built, _ = _built(recording, stream)
        try:
            return ask(graph, query, _labels(path, built))
        except QueryError as error:
            reason = str(error)
        room = built.rpartition("/")[0].rpartition("/")[0]
        known = [n for n, info in recording.streams.items() if info.message_type is FeatureVector]
        means = [n for n in known if n.endswith("/means") and n.startswith(f"{room}/" if room else "")]
        if len(means) != 1:
            found = f"there are several of embeddings: {', '.join(means)}" if means else "nodes have no embeddings"
            asked = reason if reason.endswith("?") else f"{reason}."
            raise QueryError(f"{asked} By meaning it cannot be asked: {found}; {how_to_embed()}")
        records = recording.messages(means, end=graph.stamp)
        vectors = (record.message for record in records if isinstance(record.message, FeatureVector))
        matches = by_meaning(graph, vectors, query)[:_LIKEST]
    Console(stderr=True).print(f"note: by meaning, since {reason}", highlight=False, soft_wrap=True, markup=False)
    return matches


def _labels(path: Path, built: str) -> LabelSpace:
    """Returns the label space of the operator that made the graph; one without entries where its file is not here."""
    with open_recording(path) as recording:
        run = recording.graph
    maker = None if run is None or built not in run.streams else run.nodes[run.streams[built].node]
    given = "" if maker is None else str(maker.params.get("labels", ""))
    try:
        return LabelSpace.read(Path(labels_file(given))) if given else LabelSpace("none")
    except (OSError, LabelSpaceError) as error:
        note = f"note: classes have no other names here, since their label space cannot be read: {error}"
        Console(stderr=True).print(note, highlight=False, soft_wrap=True, markup=False)
        return LabelSpace("none")


def _write(graph: SceneGraph, file: Path, *, overwrite: bool) -> None:
    if file.exists() and not overwrite:
        raise FileExistsError(f"{file} exists; name another file, or replace it with --overwrite")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(jsonlib.dumps(as_spark_dsg(graph)), encoding="utf-8")


def _graph(path: Path, stream: str | None, at: float | None) -> tuple[SceneGraph, Activity | None, float]:
    """Returns the newest graph at a time, its operator's activities then, and its age (s) since the recording began."""
    with _opened(path) as recording:
        built, first = _built(recording, stream)
        end = None if at is None else first + round(at * 1e9)
        graph = None
        for record in recording.messages([built], end=end):
            graph = record.message
        if not isinstance(graph, SceneGraph):
            raise ValueError(f"{built} has no graph up to {at} s")
        activities = _activities(recording, built, start=graph.stamp, end=graph.stamp).get(graph.stamp)
        return graph, activities, (graph.stamp - first) * 1e-9


def _history(path: Path, stream: str | None, at: float | None, node: str) -> list[tuple[float, Event]]:
    """Returns what happened to a node up to a time, with the seconds since the recording began."""
    with _opened(path) as recording:
        built, first = _built(recording, stream)
        end = None if at is None else first + round(at * 1e9)
        graphs = (r.message for r in recording.messages([built], end=end) if isinstance(r.message, SceneGraph))
        found = history(graphs, _activities(recording, built, start=None, end=end), node)
        return [((event.stamp - first) * 1e-9, event) for event in found]


def _opened(path: Path) -> Recording:
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    return Recording(path)


def _built(recording: Recording, stream: str | None) -> tuple[str, int]:
    """Returns the stream of scene graphs that is meant, and the first stamp of the recording."""
    known = [n for n, info in recording.streams.items() if info.message_type is SceneGraph]
    wanted = [n for n in known if stream is None or n == stream or n.endswith(f"/{stream}")]
    built = [n for n in wanted if n.endswith("/graph")] or wanted
    path = recording.path
    if not known:
        made = f"dataflow replay {path} --graph perception --record OUT.mcap"
        raise ValueError(f"{path} holds no scene graph; a graph that makes one, of a robot's camera: {made}")
    if len(built) != 1:
        there = ", ".join(known) or "none"
        raise ValueError(f"{path} has no single scene graph to show; give --stream one of: {there}")
    return built[0], min(i.first for i in recording.streams.values() if i.first is not None and not i.static)


def _activities(recording: Recording, built: str, *, start: int | None, end: int | None) -> dict[int, Activity]:
    """Returns the activities from the graph's activity operator, by stamp."""
    beside = f"{built.rpartition('/')[0]}/activities"
    if beside not in recording.streams or recording.streams[beside].message_type is not Activity:
        return {}
    found = (record.message for record in recording.messages([beside], start=start, end=end))
    return {message.stamp: message for message in found if isinstance(message, Activity)}


def _told(found: list[tuple[float, Event]], *, json: bool) -> None:
    if json:
        typer.echo(jsonlib.dumps([{"seconds": s, "stamp": event.stamp, "event": event.text} for s, event in found]))
        return
    out = Console(highlight=False)
    for seconds, event in found:
        out.print(f"{seconds:8.1f} s  {event.text}", soft_wrap=True)


def _tell(recording: Path, graph: SceneGraph, activities: Activity | None, since: float) -> None:
    """Prints who does what, what carries what, the strongest other relations, and what to ask next."""
    told, names = summarize(graph, activities, most=8), graph.names()
    out = Console(highlight=False)
    out.print(
        f"[bold]{graph.count} nodes, {len(graph.subjects)} relations[/bold] at {since:.1f} s, in {escape(graph.frame)}"
    )
    who = [(row.name, row.text) for row in agents_in_words(graph, told, activities)]
    moving = [(row.name, row.text) for row in movers_in_words(graph, told, activities)]
    rooms = [(row.name, row.text) for row in rooms_in_words(graph, told)]
    what = [(row.name, row.text) for row in carriers_in_words(graph, told)]
    others = [
        (names[r.subject], f"{spaced(r.predicate)} {names[r.object]} {r.score:.2f}")
        for r in told.telling
        if r.subject not in told.agents
    ]
    for title, rows in (
        ("rooms", rooms),
        ("who does what", who),
        ("what moves", moving),
        ("what carries what", what),
        ("strongest other relations", others),
    ):
        if rows:
            table = Table(title=title, title_justify="left", show_header=False, box=None, padding=(0, 2, 0, 1))
            for name, text in rows:
                table.add_row(f"[bold]{escape(name)}[/bold]", escape(text))
            out.print(table)
    out.print(
        f'next: dataflow scene {recording} --query "chair near table"; also --at SECONDS, --nodes, --json',
        soft_wrap=True,
    )


def _show(graph: SceneGraph, since: float) -> None:
    out, names = Console(), graph.names()
    out = out if out.is_terminal else Console(width=_PIPED)
    scores = graph.relation_scores
    title = f"{graph.count} nodes at {since:.1f} s in {graph.frame}"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in ("node", "score", "position, m", "size, m", "tracks", "relations"):
        table.add_column(column, no_wrap=column not in ("tracks", "relations"))
    for k in range(graph.count):
        held = [
            f"{p.replace('_', ' ')} {names[o]}" + ("" if scores is None else f" {scores[j]:.2f}")
            for j, (s, p, o) in enumerate(graph.relations())
            if s == k and p not in ("near", "left_of", "in_front_of")
        ]
        place, size = (", ".join(f"{v:.2f}" for v in row) for row in (graph.positions[k], graph.sizes[k]))
        score = "" if graph.scores is None else f"{graph.scores[k]:.2f}"
        table.add_row(names[k], score, place, size, ", ".join(map(str, graph.tracks_of(k))), "; ".join(held))
    out.print(table)
