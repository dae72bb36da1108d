"""`dataflow convert`: recordings and bags in the formats of other systems, and bags as recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import typer
from rich.markup import escape
from rich.text import Text

from dataflow.cli.support.arguments import (
    AnyRecording,
    Json,
    OutInstead,
    Overwrite,
    Selection,
    Strict,
    existing_recording,
    named_once,
    output_file,
    refuse_of_recording,
    window,
)
from dataflow.cli.support.edited_files import Quiet
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import DIFFERENT, count, counting, fail, out, plural, print_json, say, shown, table

if TYPE_CHECKING:
    from dataflow.interop.account import Account
    from dataflow.interop.export.report import Exported
    from dataflow.interop.export.source import ExportSource
    from dataflow.interop.playing import BagReadOptions

Format = Literal[
    "mcap",
    "ros2",
    "foxglove",
    "rrd",
    "tum",
    "7scenes",
    "euroc",
    "kitti",
    "kitti-raw",
    "lerobot",
    "lerobot-v3",
    "csv",
    "parquet",
]
SUFFIXES = {"mcap": ".mcap", "foxglove": ".mcap", "rrd": ".rrd"}
"""Of formats that are one file; the others are folders."""
_MCAP = ("mcap", "foxglove", "ros2")
"""Formats that have places for attachments and metadata records."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConvertOptions:
    """The options of `dataflow convert`, in the order of its help."""

    out_option: OutInstead = None
    to: Annotated[
        Format | None, option("--to FORMAT", "The format; the examples name all of them. Not needed for NAME.rrd.")
    ] = None
    chosen: Selection
    action: Annotated[str | None, option("--action STREAM", "Of lerobot: the stream that is the action.")] = None
    task: Annotated[str, option("--task TEXT", "Of lerobot: what is done.")] = ""
    depth: Annotated[
        list[str] | None,
        option(
            "--depth TOPIC[=UNITS]",
            "16-bit images of this topic are depth of so many units a metre: 1000 unless given.",
        ),
    ] = None
    lossy: Annotated[bool, option("--lossy", "Write values with fewer bits where the format has fewer.")] = False
    strict: Strict = False
    overwrite: Overwrite = False
    quiet: Quiet = False
    json: Json = False


def convert(
    recording: AnyRecording,
    options: ConvertOptions,
    output: Annotated[Path | None, argument("OUTPUT", "The file or folder to write; or name it with --out.")] = None,
) -> None:
    """Convert a recording or a bag to another format.

    Into ros2, ROS topics of a bag go byte for byte, streams of a recording as the ROS types they have a counterpart in;
    what is left out is said. Into mcap, a bag becomes a recording of streams, and topics that nothing here can read are
    kept as they are. Into mcap, ros2 and foxglove, attachments and metadata records of an MCAP file go along; other
    formats have no place for them, which is said. Datasets (tum, 7scenes, euroc, kitti, kitti-raw) take one stream of a
    kind: --without leaves out others, --stream names all that are taken. Into lerobot (format 2.1) and lerobot-v3
    (3.0), every image of the first camera is a frame, with the newest message of every other stream; images stay
    images, lossless, since no video encoder is among the dependencies.

    All that has no place is said, and stands in --json and in the metadata: messages that cannot be read, fields, bits,
    shapes. Where a format has fewer bits than a stream, the command refuses; --lossy writes it all the same, and into
    mcap 16-bit images as images of 8 bits.

    Exit codes:

      0    everything was written, but for what is said to be left out
      1    it was written, and the file holds fewer messages than it promises
      2    could not convert: a wrong option, a stream that the format needs and the recording lacks

    Examples:

      dataflow convert run.mcap bag --to ros2
      dataflow convert drive.bag drive.mcap --to mcap
      dataflow convert run.mcap run_foxglove.mcap --to foxglove
      dataflow convert run.mcap run.rrd --to rrd
      dataflow convert run.mcap folder --to tum
      dataflow convert run.mcap folder --to 7scenes
      dataflow convert run.mcap folder --to euroc
      dataflow convert run.mcap folder --to kitti --stream "camera/*"
      dataflow convert run.mcap folder --to kitti-raw
      dataflow convert run.mcap folder --to lerobot --action cmd/twist
      dataflow convert run.mcap folder --to lerobot-v3 --task "pick up cups"
      dataflow convert run.mcap folder --to csv --stream imu/imu
      dataflow convert run.mcap folder --to parquet --start 5 --end 10
    """
    existing_recording(recording)
    output, to = _target(named_once("OUTPUT", output, options.out_option), options.to)
    _check_output(output, to, options.overwrite)
    scales = _depth_scales(options.depth or (), to)
    if to == "rrd":
        _draw(recording, output, options)
    else:
        _convert(recording, output, to, scales, options)


def _convert(recording: Path, output: Path, to: Format, scales: dict[str, float], options: ConvertOptions) -> None:
    from dataflow.interop.playing import BagReadOptions

    wishes = BagReadOptions(scales, lossy=options.lossy, strict=options.strict)
    if not to.startswith("lerobot") and (options.action is not None or options.task):
        raise fail("--action and --task are of --to lerobot and lerobot-v3")
    with (
        _opened(recording, options.chosen, wishes) as source,
        counting("converting", hidden=options.quiet or options.json) as watch,
        _complete(output) as place,
    ):
        done = _export(source, place, to, watch, options)
    done.files = [str(output / Path(file).relative_to(place)) for file in done.files]
    shown([*source.account.notes, *source.account.short])
    if options.json:
        print_json(done.as_json() | {"source": source.account.as_json()})
    else:
        _report(done, source.account, output)
    _fail_if_short(source.account)


def _target(output: Path | None, to: Format | None) -> tuple[Path, Format]:
    if output is None:
        raise fail("no output given: name a file or folder behind the recording, or with --out")
    if to is None and output.suffix != ".rrd":
        raise fail(f"the format of {output} is not known: give one with --to: {', '.join(get_args(Format))}")
    return output, to or "rrd"


def _report(done: Exported, account: Account, output: Path) -> None:
    made = table("stream", "messages", right=("messages",))
    for name, number in done.written.items():
        made.add_row(Text(name), count(number))
    out.print(made)
    if done.attachments or done.metadata:
        out.print(f"carried over: {plural(done.attachments, 'attachment')}, {count(done.metadata)} metadata records")
    for line in account.lines(lambda topic: topic.strip("/")):
        say(f"[yellow]{escape(line)}[/]")
    _print_left_out(done)
    files = done.files if len(done.files) <= 3 else [f"{plural(len(done.files), 'file')} in {output}"]
    for file in files:
        out.print(f"wrote {escape(file)}", soft_wrap=True)


def _draw(recording: Path, output: Path, options: ConvertOptions) -> None:
    from dataflow.cli.support.drawing import draw_recording, drawn_as_json, report
    from dataflow.view import Save

    with _complete(output) as place:
        drawn = draw_recording(recording, Save(place), options.chosen, strict=options.strict)
    done = _left_by_rrd(recording)
    if options.json:
        told = {"left_out": done.left_out, "source": drawn.account.as_json()}
        print_json(drawn_as_json(drawn.sink, output) | told)
        _fail_if_short(drawn.account)
    else:
        _print_left_out(done)
        report(drawn, output)


def _left_by_rrd(recording: Path) -> Exported:
    from dataflow.interop.export.extras import tell_left_out
    from dataflow.interop.export.report import Exported
    from dataflow.interop.export.source import ExportSource

    done = Exported()
    with ExportSource(recording) as source:
        tell_left_out(source, "rrd", done)
        return done


def _print_left_out(done: Exported) -> None:
    for name, reason in done.left_out.items():
        say(f"[yellow]left out:[/] {escape(name)}: {escape(reason)}")
    for name, losses in done.lost.items():
        for what, number in losses.items():
            say(f"[yellow]no place for:[/] {escape(name)}: {escape(what)} ({count(number)})")


def _fail_if_short(account: Account) -> None:
    if account.short:
        raise typer.Exit(DIFFERENT)


def _check_output(output: Path, to: str, overwrite: bool) -> None:
    suffix = SUFFIXES.get(to)
    if suffix is not None:
        output_file(output, suffix, overwrite=overwrite, option=f"--to {to}")
    elif output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise fail(f"{output} exists; {to} is written to a new or empty folder")
    elif output.exists():
        output.rmdir()


def _depth_scales(words: Iterable[str], to: Format) -> dict[str, float]:
    """Topic → units a metre."""
    from dataflow.messages.depth_units import MILLIMETRES

    if words and to in ("rrd", "ros2"):
        raise fail(f"--depth has no effect on {to}: convert to mcap with it, and that to {to}")
    scales = {}
    for word in words:
        topic, given, units = word.partition("=")
        try:
            scales[topic] = float(units) if given else MILLIMETRES
        except ValueError:
            scales[topic] = 0.0
        if not 1 <= scales[topic] < math.inf:
            raise fail(f"--depth {word}: expected units a metre, such as 1000 where they are millimetres")
    return scales


@contextmanager
def _complete(output: Path) -> Iterator[Path]:
    """Gives a place to write to, of the same name; what is written there appears as `output` when it is complete."""
    output.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{output.name}.", dir=output.parent) as folder:
        place = Path(folder) / output.name
        yield place
        if place.exists():
            place.replace(output)


@contextmanager
def _opened(path: Path, asked: Selection, wishes: BagReadOptions) -> Iterator[ExportSource]:
    from dataflow.interop.export.source import ExportSource
    from dataflow.recording.layout import RECORDING
    from dataflow.recording.streams.cutting import cut_of

    metadata: Mapping[str, Mapping[str, str]]
    with ExportSource(path, clock=asked.clock, wishes=wishes) as whole:
        found = [*whole.account.notes, *whole.account.short]
        if not any(topic.count for topic in whole.bag.topics.values()) and found:
            raise fail(f"{path} holds no message that can be read: {'; '.join(found)}")
        names = [*whole.streams, *(t.name for t in whole.untouched)]
        namespace, metadata = "", {}
        if not whole.foreign:
            refuse_of_recording(path, asked.clock, strict=wishes.strict)
            from dataflow.recording import Recording

            with Recording(path) as opened:
                metadata = opened.metadata
                namespace = metadata.get(RECORDING, {}).get("namespace", "")
        chosen = asked.of(names, namespace) if asked.streams or asked.without else None
        part = None if whole.foreign else cut_of(metadata)
        begin, finish = window(_span(whole, None if part is None else part.start), asked.start, asked.end, path)
        if whole.clock:
            say(f"[dim]stamps: {escape(whole.clock)}[/]")
    with ExportSource(path, chosen, asked.clock, begin, finish, wishes) as source:
        yield source


def _span(whole: ExportSource, begin: int | None) -> tuple[int, int] | None:
    """The first and the last stamp (ns) of all but static streams; `begin`: where a part begins."""
    spans = [(i.first, i.last, 0) for i in whole.streams.values() if not i.static]
    spans += [(t.first, t.last, whole.shift) for t in whole.untouched]
    times = [(first + shift, last + shift) for first, last, shift in spans if first is not None and last is not None]
    first = min((first for first, _ in times), default=0) if begin is None else begin
    return (first, max(last for _, last in times)) if times else None


def _export(
    source: ExportSource, output: Path, to: str, watch: Callable[[int], None] | None, options: ConvertOptions
) -> Exported:
    from dataflow.interop.export.datasets import DATASETS, tell_untaken
    from dataflow.interop.export.extras import tell_left_out
    from dataflow.interop.export.foxglove import export_foxglove
    from dataflow.interop.export.own import export_own
    from dataflow.interop.export.report import Exported
    from dataflow.interop.export.ros2 import export_ros2
    from dataflow.interop.export.tables import export_csv, export_parquet

    done = Exported(lossy=options.lossy, watch=watch)
    match to:
        case "mcap":
            export_own(source, output, done)
        case "foxglove":
            export_foxglove(source, output, done)
        case "ros2":
            export_ros2(source, output, done)
        case "lerobot" | "lerobot-v3":
            from dataflow.interop.export.lerobot import export_lerobot
            from dataflow.interop.export.lerobot_layouts import Layout21, Layout30

            layout = Layout21() if to == "lerobot" else Layout30()
            export_lerobot(source, output, done, layout=layout, action=options.action, task=options.task)
        case "csv":
            export_csv(source, output, done)
        case "parquet":
            export_parquet(source, output, done)
        case _:
            DATASETS[to](source, output, done)
            tell_untaken(source, to, done)
    if to not in _MCAP:
        tell_left_out(source, to, done)
    return done
