"""`dataflow cut`, `filter` and `split`: parts of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.markup import escape
from rich.text import Text

from dataflow.cli.support.arguments import Json, Overwrite, Without, chosen_streams, output_file
from dataflow.cli.support.edited_files import (
    Compression,
    EditedFile,
    Out,
    Quiet,
    Word,
    asked_span,
    copying,
    fail_if_lost,
    opened_file,
    print_unknown,
    refuse_itself,
    tell_edited,
)
from dataflow.cli.support.options import option
from dataflow.cli.support.output import count, fail, out, plural, print_json, say, seconds, size, table
from dataflow.cli.support.quantities import parsed_duration, parsed_size

if TYPE_CHECKING:
    from dataflow.editing.report import WrittenFile


def cut(
    recording: EditedFile,
    output: Out,
    start: Annotated[Word, option("--from --start TIME", "Begin there. Default: at the beginning.")] = None,
    end: Annotated[Word, option("--to --end TIME", "End there. Default: at the end.")] = None,
    duration: Annotated[Word, option("--duration TIME", "Instead of --to: last so long.")] = None,
    bare: Annotated[bool, option("--bare", "Exactly the messages of the span, without firing records.")] = False,
    compression: Compression = "zstd",
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Cut a span out of a recording.

    A TIME is seconds after the first message (12.5), a duration (500ms, 2min), or a date in ISO 8601 with its time
    zone. Messages go over byte for byte, static streams always.

    The part replays from there with the states that operators had, and verifies: every operator is taken up after its
    last recorded state at or before --from, and what its firings took since then goes along. For that, record with
    `record: {snapshots: 10s}`. Operators that keep a state and gave none are named; `dataflow verify` reports that they
    cannot be verified before their next recorded state.

    Exit codes:

      0    written
      1    written, but damage keeps messages from being read, or the recording has no proper end
      2    could not cut: a wrong option, a file that cannot be read

    Examples:

      dataflow cut run.mcap --from 30 --to 45 -o part.mcap
      dataflow cut run.mcap --from 2min --duration 10s -o part.mcap
      dataflow cut run.mcap --from 2026-03-01T12:00:00Z -o end.mcap
      dataflow cut bag.mcap --to 10 --bare -o beginning.mcap
    """
    from dataflow.editing.part import Part, write_part

    with opened_file(recording) as origin, copying("cutting", quiet or json) as watch:
        output_file(output, ".mcap", overwrite=overwrite, option="--out")
        refuse_itself(output, [recording])
        part = asked_span(origin, start, end, duration)
        done = write_part(
            origin, Part(*part, bare=bare), output, compression=compression, overwrite=overwrite, watch=watch
        )
    tell_edited(done, json=json)


def filter_(
    recording: EditedFile,
    output: Out,
    streams: Annotated[
        list[str] | None, option("--stream STREAM", "Keep these streams; wildcards work. May be repeated.")
    ] = None,
    without: Without = None,
    compression: Compression = "zstd",
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Keep some streams of a recording and leave out the others.

    Firing records stay, so `dataflow verify` still compares what operators make with the digests of what they made,
    where their inputs are there or can be made again, and reports where they are not. With the sensors alone, the
    recording becomes a thin one, from which `dataflow replay --complete` makes the whole again.

    Exit codes:

      0    written
      1    written, but damage keeps messages from being read, or the recording has no proper end
      2    could not filter: no stream matches, a file that cannot be read

    Examples:

      dataflow filter run.mcap --stream imu/imu --stream "camera/*" -o s.mcap
      dataflow filter run.mcap --without "camera/**" -o small.mcap
    """
    from dataflow.editing.part import Part, write_part

    with opened_file(recording) as origin, copying("filtering", quiet or json) as watch:
        if not streams and not without:
            raise fail("nothing to choose by: name streams with --stream, or with --without")
        output_file(output, ".mcap", overwrite=overwrite, option="--out")
        refuse_itself(output, [recording])
        names = sorted(origin.counts())
        kept = chosen_streams(streams, names, origin.namespace, without)
        done = write_part(origin, Part(streams=kept), output, compression=compression, overwrite=overwrite, watch=watch)
    tell_edited(done, json=json)


def split(
    recording: EditedFile,
    every: Annotated[Word, option("--every TIME", "Event time of a part: 60s, 5min, or a number of seconds.")] = None,
    nbytes: Annotated[Word, option("--size SIZE", "Size of a part, about: 500MB, 2GB, 100MiB.")] = None,
    folder: Annotated[
        Path | None, option("--out -o DIR", "The folder to write to. Default: named as the recording.")
    ] = None,
    compression: Compression = "zstd",
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Split a recording into parts of a duration or a size.

    Each part is a recording by itself, cut as `dataflow cut` does: it replays, verifies where it can, and holds what
    its first firings need from before it. `dataflow merge` makes one of them again.

    Exit codes:

      0    written
      1    written, but damage keeps messages from being read, or the recording has no proper end
      2    could not split: a wrong option, a file that cannot be read

    Examples:

      dataflow split run.mcap --every 60s
      dataflow split run.mcap --size 500MB -o parts
    """
    from dataflow.editing.split import split as parts_of

    with opened_file(recording) as origin, copying("splitting", quiet or json) as watch:
        if (every is None) == (nbytes is None):
            raise fail("say how to split: --every TIME or --size SIZE")
        target = folder or recording.with_suffix("")
        if target.exists() and not target.is_dir():
            raise fail(f"--out {target}: expected a folder")
        period = None if every is None else parsed_duration("--every", every)
        most = None if nbytes is None else parsed_size("--size", nbytes)
        done = list(
            parts_of(origin, target, every=period, size=most, compression=compression, overwrite=overwrite, watch=watch)
        )
    if json:
        print_json([one.as_json() for one in done])
    else:
        _print_parts(done, target)
    fail_if_lost(done)


def _print_parts(done: Sequence[WrittenFile], target: Path) -> None:
    made = table("part", "begins", "lasts", "messages", "size", right=("begins", "lasts", "messages", "size"))
    first = next((one.span[0] for one in done if one.span is not None), 0)
    for one in done:
        low, high = one.span or (first, first)
        row = (f"{(low - first) * 1e-9:.2f} s", seconds((high - low) * 1e-9), count(one.messages), size(one.bytes))
        made.add_row(Text(Path(one.path).name), *row)
    out.print(made)
    for note in (note for one in done if one.lost or one.lacking for note in one.notes):
        say(f"[yellow]{escape(note)}[/]")
    print_unknown({name for one in done for name in one.unknown})
    out.print(f"wrote {plural(len(done), 'part')} to {escape(str(target))}", soft_wrap=True)
