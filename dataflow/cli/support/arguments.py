"""Options and arguments that several commands share, and what they are resolved to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import fail, seconds

if TYPE_CHECKING:
    from dataflow.execution.feeds.playable import PlayableStreams


def shipped_graphs(incomplete: str) -> Iterator[str]:
    """The graphs that come with dataflow; where none fits, the shell completes files."""
    from dataflow.shipped import graphs

    yield from (graph.name for graph in graphs() if incomplete and graph.name.startswith(incomplete))


Json = Annotated[bool, option("--json", "Print JSON instead of tables.")]
Network = Annotated[
    bool,
    option(
        "--network",
        "Obey the `network:` section of the graph inside the recording: open its ports, connect to its endpoints.",
    ),
]
Settings = Annotated[
    list[str] | None, option("--set NAME=VALUE", "Set a graph parameter, or OPERATOR.PARAM. May be repeated.")
]
OtherSettings = Annotated[
    list[str] | None,
    option(
        "--set NAME=VALUE",
        "Set a graph parameter, or OPERATOR.PARAM, of the graph that --graph names. May be repeated.",
    ),
]
GraphFile = Annotated[
    Path,
    argument("GRAPH", "A graph file (.yaml), or a name that `dataflow graphs` lists.", autocompletion=shipped_graphs),
]
OtherGraph = Annotated[Path | None, option("--graph GRAPH", "Another graph than the one that made the recording.")]
AnyRecording = Annotated[Path, argument("RECORDING", "A recording (.mcap), or a bag: .bag, .db3, .mcap or a folder.")]
Clock = Annotated[
    Literal["auto", "header", "log"],
    option(
        "--clock auto|header|log",
        "Of a bag: stamp messages with the time in their headers, or with the time of their recording.",
    ),
]
Strict = Annotated[bool, option("--strict", "Of a bag: fail at a message that cannot be read, instead of counting it.")]
Map = Annotated[
    list[str] | None,
    option(
        "--map TOPIC=STREAM", "Of a bag: the topic that stands in for a stream of the graph's sources. May be repeated."
    ),
]
OutInstead = Annotated[Path | None, option("--out -o PATH", "Instead of the argument: what to write.")]
RecordingFile = Annotated[Path, argument("RECORDING", "A recording (.mcap).")]


def offset(word: str) -> float:
    """Seconds of a number of them, or of a duration with its unit, for `typer.Option(parser=...)`."""
    from dataflow.sync.stamps import parse_duration

    try:
        return float(word)
    except ValueError:
        try:
            return parse_duration(word) * 1e-9
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None


Start = Annotated[
    float | None,
    option(
        "--start TIME", "Begin so long after the recording's first message: seconds, or 500ms, 2min.", parser=offset
    ),
]
End = Annotated[
    float | None,
    option("--end TIME", "End so long after the recording's first message: seconds, or 500ms, 2min.", parser=offset),
]
Every = Annotated[
    float | None,
    option(
        "--every TIME",
        "Of a viewer file: draw one image, overlay and cloud of each stream in so much event time; 0: every one. "
        "Default: that of the graph (`view: every`), else 200ms.",
        parser=offset,
    ),
]
Streams = Annotated[list[str] | None, option("--stream STREAM", "Only these streams; wildcards work. May be repeated.")]
Without = Annotated[list[str] | None, option("--without STREAM", "Leave these streams out. May be repeated.")]


@dataclass(frozen=True, slots=True)
class BagOptions:
    """Options of a bag: its topics, clock and faults."""

    maps: Map = None
    clock: Clock = "auto"
    strict: Strict = False


@dataclass(frozen=True, slots=True)
class Selection:
    """Selection of messages: streams, a span, and the clock of a bag."""

    streams: Streams = None
    without: Without = None
    start: Start = None
    end: End = None
    clock: Clock = "auto"

    def of(self, names: Iterable[str], namespace: str) -> list[str]:
        """The streams that are asked for."""
        return chosen_streams(self.streams, names, namespace, self.without)


ALL = Selection()


ModuleFolders = Annotated[
    list[Path] | None,
    option("--path DIR", "Look for the operators' modules in DIR too, before the current folder. May be repeated."),
]
Overwrite = Annotated[bool, option("--overwrite", "Replace output files that exist.")]


def number(low: float, high: float, meaning: str) -> Callable[[str], float]:
    """A parser of numbers from `low` to `high`, for `typer.Option(parser=...)`; `meaning` goes into its error."""

    def parse(word: str) -> float:
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise typer.BadParameter(f"{word}: expected a number from {low:g} to {high:,.0f} ({meaning})")
        return value

    return parse


def existing(path: Path, what: str, names: Iterable[str] = ()) -> Path:
    """`path`, or an error that names the files which could be meant. `what`: "a recording", "a graph file".

    `names`: words that would have done instead of a file.
    """
    from dataflow.graph.problems import nearest

    if path.is_file():
        return path
    if path.is_dir():
        raise fail(f"{path} is a folder; expected {what}")
    if path.exists():
        raise fail(f"{path} is no regular file; expected {what}")
    folder = path.parent
    if not folder.is_dir():
        raise fail(f"no file {path}: there is no folder {folder}")
    near = nearest(path.name, sorted(p.name for p in folder.iterdir() if p.is_file()))
    meant = str(folder / near) if near else nearest(path.as_posix(), names)
    raise fail(f"no file {path}; " + (f"did you mean {meant}?" if meant else f"expected {what}"))


def graph_file(path: Path) -> Path:
    """`path` as a graph file: one that is there, or one that comes with dataflow, by its name."""
    from dataflow.shipped import graph, graphs

    if not path.exists() and (found := graph(path.as_posix().removeprefix("graphs/"))) is not None:
        return found.path
    what = "a graph file (dataflow graphs lists those that come with it)"
    return existing(path, what, () if path.exists() else [shipped.name for shipped in graphs()])


def existing_recording(path: Path) -> Path:
    """`path` of a recording or a bag, which may be a folder; or an error that names what could be meant."""
    return path if path.is_dir() else existing(path, "a recording")


def find_modules_in(folders: Sequence[Path] | None) -> None:
    """Lets operators be found in `folders` and in the current folder, after installed packages."""
    from dataflow.graph.search import add_current_folder, add_folder

    for folder in folders or ():
        if not folder.is_dir():
            raise fail(f"--path {folder}: no such folder")
        add_folder(folder)
    add_current_folder()


def output_file(path: Path, suffix: str, *, overwrite: bool, option: str) -> Path:
    """`path`, checked as a file to write: the suffix, its folder, and that nothing is replaced unasked."""
    if path.suffix != suffix:
        raise fail(f"{option} {path}: expected a file name that ends in {suffix}")
    if path.is_dir():
        raise fail(f"{option} {path}: that is a folder; name a file in it")
    if path.exists() and not overwrite:
        raise fail(f"{path} exists; name another file, or replace it with --overwrite")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise fail(f"{option} {path}: cannot make the folder {path.parent}: {error.strerror}") from None
    return path


def chosen_streams(
    words: Sequence[str] | None, names: Iterable[str], namespace: str = "", without: Sequence[str] | None = None
) -> list[str]:
    """The streams that `words` mean, but those of `without`.

    They are full names, names without the namespace, patterns with wildcards, or the last parts of names; None or no
    words: all. A word that matches nothing is an error that names the nearest stream.
    """
    known = list(names)
    left_out = set(_meant(without, known, namespace)) if without else set()
    chosen = [name for name in (_meant(words, known, namespace) if words else known) if name not in left_out]
    if left_out and not chosen:
        raise fail(f"no stream is left: --without takes {'all that --stream gives' if words else 'all of them'}")
    return chosen


def _meant(words: Sequence[str], known: Sequence[str], namespace: str) -> list[str]:
    from dataflow.graph.keys import as_expression, canonical, has_wildcard, key_fault, matching
    from dataflow.graph.problems import did_you_mean

    keys = {name.strip("/"): name for name in known}  # foreign recordings name streams "/tf"
    found: dict[str, None] = {}
    for word in words:
        bare = as_expression(word.removeprefix("/"))
        fault = key_fault(bare)
        if fault is not None:
            raise fail(f"stream {word!r}: {fault}")
        expressions = [bare] if word.startswith("/") or not namespace else [f"{namespace}/{bare}", bare]
        matches = [keys[key] for expression in expressions for key in matching(canonical(expression), keys)]
        if not matches and not has_wildcard(bare) and not word.startswith("/"):
            matches = [keys[key] for key in matching(f"**/{bare}", keys)]
        if not matches:
            shown = [name.removeprefix(f"{namespace}/") if namespace else name for name in known]
            raise fail(f"no stream {word!r}: " + did_you_mean(word, shown, "there are"))
        found |= dict.fromkeys(matches)
    return [name for name in known if name in found]


def span(recording: PlayableStreams, streams: Iterable[str]) -> tuple[int, int] | None:
    """The first and the last stamp (ns) of those streams that are not static; None when they hold no message.

    Of a part of a recording, what lies outside of its span is left out.
    """
    from dataflow.execution.feeds.playable import span_of

    return span_of(recording, streams)


def named_once(metavar: str, argument: Path | None, option: Path | None) -> Path | None:
    """Returns the path to write, which may be named by an argument or by --out, and not by both."""
    if argument is not None and option is not None:
        raise fail(f"--out {option} and {metavar} {argument} both name what to write: name one of them")
    return argument if option is None else option


def check_offset(option: str, value: float | None) -> None:
    """Refuses what cannot be seconds into a recording."""
    if value is not None and not 0 <= value < 1e9:
        raise fail(f"{option} {value:g}: expected seconds from the recording's first message, 0 or more")


def refuse_of_recording(path: Path, clock: str, *, strict: bool = False) -> Path:
    """Returns the path of a recording; refuses options of bags, which have no effect on it."""
    options = [word for word, given in (("--clock", clock != "auto"), ("--strict", strict)) if given]
    if options:
        raise fail(f"{' and '.join(options)}: {path} is a recording, whose messages have stamps; of bags alone")
    return path


def window(
    whole: tuple[int, int] | None, start: float | None, end: float | None, path: Path
) -> tuple[int | None, int | None]:
    """`--start` and `--end` as stamps (ns), checked against what the recording holds."""
    check_offset("--start", start)
    check_offset("--end", end)
    if start is not None and end is not None and end <= start:
        raise fail(f"--end {end:g} must be greater than --start {start:g}")
    if whole is None:
        return None, None
    first, last = whole
    if start is not None and first + round(start * 1e9) > last:
        raise fail(f"--start {start:g}: {path} ends {seconds((last - first) * 1e-9)} after its first message")
    return (
        None if start is None else first + round(start * 1e9),
        None if end is None else first + round(end * 1e9),
    )
