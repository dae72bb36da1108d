"""Commands of `dataflow models`: the networks that have a name, and their files on this machine."""

from __future__ import annotations

import json as jsonlib
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, DownloadColumn, Progress, TransferSpeedColumn
from rich.table import Table

from operators.inference import ModelError
from operators.models.fetch import damage, digest_of, fetch, hub_file, take
from operators.models.registry import Model, Registry
from operators.models.use import missing

Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
Name = Annotated[str, typer.Argument(metavar="NAME", help="A model that `dataflow models list` prints.")]

models = typer.Typer(
    name="models",
    help="""Networks by name: list them, get their files, check these.

    Examples:

      dataflow models list --task detection
      dataflow models get yolox_nano
      dataflow models check
    """,
    no_args_is_help=True,
    rich_markup_mode="rich",
)


@models.command("list")
def list_models(
    task: Annotated[
        str | None, typer.Option(metavar="TASK", help="Only of this task: detection, masks, depth, ...")
    ] = None,
    json: Json = False,
) -> None:
    """List the models, with their licences and whether their files are here.

    Examples:

      dataflow models list
      dataflow models list --task depth --json
    """
    rows = [model for model in _registry() if task in (None, model.task)]
    if not rows:
        raise _failed(f"no model has the task {task!r}; there are {', '.join(sorted({m.task for m in _registry()}))}")
    if json:
        typer.echo(jsonlib.dumps([_described(model) for model in rows]))
        return
    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("model", "task", "licence", "here", "what it is"):
        table.add_column(column)
    for model in rows:
        here = "yes" if all(map(_place, model.files)) else "export" if model.source.export else "no"
        table.add_row(*map(escape, (model.name, model.task, str(model.licence), here, model.about)))
    _out().print(table)


@models.command("show")
def show_model(name: Name, json: Json = False) -> None:
    """Show one model: what it takes and finds, whose it is, how well it does, and where its file lies.

    Examples:

      dataflow models show yolox_nano
    """
    model = _row(name)
    if json:
        typer.echo(jsonlib.dumps(_described(model)))
        return
    out = _out()
    out.print(f"[bold cyan]{escape(model.name)}[/]  {escape(model.about)}", soft_wrap=True)
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 1))
    params = ", ".join(f"{key}: {value}" for key, value in model.params.items())
    place = _place(model)
    for title, text in (
        ("task", model.task),
        ("classes", ", ".join(model.classes) if isinstance(model.classes, list) else model.classes or "none"),
        ("input", model.input),
        ("operator", f"{model.operator}, {params}" if params else model.operator),
        ("licence", f"{model.licence}, {model.home}"),
        ("published", model.published),
        ("measured here", model.measured),
        ("from", str(model.source)),
        ("sha256", model.sha256 or "differs by export"),
        ("file", str(place) if place is not None else missing(model)),
        *((part.name, str(_place(part) or missing(part))) for part in model.files[1:]),
    ):
        table.add_row(f"[bold]{title}[/]", escape(text))
    out.print(table)


@models.command("get")
def get_model(
    name: Name,
    given: Annotated[
        Path | None, typer.Option("--from", metavar="FILE", help="Take this file instead of downloading it.")
    ] = None,
    json: Json = False,
) -> None:
    """Bring a model's file into the cache, once, and check it, with those of its parts. Prints its licence first.

    `--from` gives one file; a part is named as MODEL.PART then.

    A download that breaks off goes on where it stopped. A file in the cache whose sha256 is another is replaced.
    Proxies of the environment are used. Exit code 1 where the file cannot be had or is another one.

    Examples:

      dataflow models get yolox_nano
      dataflow models get rf_detr_nano --from exported.onnx
    """
    model = _row(name)
    console = Console(stderr=True, highlight=False)
    console.print(escape(f"{model.name}: licence {model.licence} ({model.home}); from {model.source}"), soft_wrap=True)
    files = []
    try:
        for each in model.files if given is None else ():
            if (found := damage(each)) is not None:
                console.print(escape(f"{found}: it is got anew"), soft_wrap=True)
            files.append(_fetched(each, console))
        if given is not None:
            files.append(take(model, given))
    except (ModelError, OSError) as error:
        raise _failed(str(error), code=1) from None
    typer.echo(jsonlib.dumps(_described(model)) if json else "\n".join(map(str, files)))


@models.command("check")
def check_models(
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", help="By default all there are.")] = None,
    json: Json = False,
) -> None:
    """Check the files of models against the registry's digests. Exit code 1 where one is missing or another.

    Examples:

      dataflow models check
      dataflow models check yolox_nano --json
    """
    wanted = [_row(name) for name in names] if names else [m for m in _registry() if any(map(_place, m.files))]
    verdicts = {each.name: _verdict(each) for model in wanted for each in model.files}
    if json:
        typer.echo(jsonlib.dumps(verdicts))
    else:
        for name, verdict in verdicts.items():
            typer.echo(f"{name}: {verdict}")
        if not verdicts:
            typer.echo("no model is on this machine; dataflow models get NAME brings one")
    if any(verdict.startswith(("differs", "missing")) for verdict in verdicts.values()):
        raise typer.Exit(1)


def _out() -> Console:
    return Console(highlight=False, width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else 120)


def _verdict(model: Model) -> str:
    place = _place(model)
    if place is None:
        return "missing"
    if model.sha256 is None:
        return f"here, without a digest to compare ({model.source})"
    found = digest_of(place)
    return "right" if model.accepts(found) else f"differs: {place} has sha256 {found}, expected {model.sha256}"


def _fetched(model: Model, console: Console) -> Path:
    columns = (BarColumn(), DownloadColumn(), TransferSpeedColumn())
    with Progress(*columns, console=console, transient=True, disable=not sys.stderr.isatty()) as shown:
        bar = shown.add_task(model.name, total=model.bytes)
        return fetch(model, lambda have, size: shown.update(bar, completed=have, total=size))


def _place(model: Model) -> Path | None:
    """Returns the model's file where it is on this machine."""
    file = hub_file(model) if model.source.torchvision is not None else model.file
    return file if file.is_file() else None


def _described(model: Model) -> dict[str, Any]:
    place = _place(model)
    return {**model.model_dump(mode="json", exclude_none=True), "file": None if place is None else str(place)}


def _registry() -> Registry:
    try:
        return Registry.load()
    except ModelError as error:
        raise _failed(str(error)) from None


def _row(name: str) -> Model:
    try:
        return _registry()[name]
    except ModelError as error:
        raise _failed(str(error)) from None


def _failed(message: str, code: int = 2) -> typer.Exit:
    Console(stderr=True).print(f"[bold red]error:[/bold red] {escape(message)}", highlight=False, soft_wrap=True)
    return typer.Exit(code)
