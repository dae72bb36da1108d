"""`dataflow merge` and `recover`: recordings made of several, and of broken ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.text import Text

from dataflow.cli.support.arguments import Json, Overwrite, existing, output_file
from dataflow.cli.support.edited_files import Compression, Out, Quiet, copying, opened_file, refuse_itself, tell_edited
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import count, fail, out, plural, print_json, say, shown, size, table

if TYPE_CHECKING:
    from dataflow.editing.recover import RecoveryReport


def merge(
    recordings: Annotated[list[Path], argument("A B ...", "Recordings, or other MCAP files: two or more.")],
    output: Out,
    prefix: Annotated[
        list[str] | None, option("--prefix FILE=NAME/", "Put NAME/ before the streams of FILE. May be repeated.")
    ] = None,
    compression: Compression = "zstd",
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Merge recordings into one.

    Parts of one run (of `dataflow split` or `cut`) are joined: what several hold is taken once, and their firing
    records become one log again, so what is whole verifies as a whole.

    Of different recordings, the first one's graph and firing records count; the others give their streams. Streams of
    one name in two of them are an error, which --prefix resolves. Stamps are left as they are: when each was recorded
    is printed, and whether they overlap.

    Exit codes:

      0    written
      1    written, without messages that damage keeps from being read (of another program's file)
      2    could not merge: streams of one name, a file that cannot be read

    Examples:

      dataflow merge run/run_000.mcap run/run_001.mcap -o run.mcap
      dataflow merge front.mcap rear.mcap -o both.mcap --prefix rear.mcap=rear/
    """
    from contextlib import ExitStack

    from dataflow.editing.merge import merge as merge_all
    from dataflow.recording.streams.part_folder import NOTHING_IN_IT

    with ExitStack() as stack:
        if len(recordings) < 2:
            raise fail("nothing to merge: name two recordings or more")
        output_file(output, ".mcap", overwrite=overwrite, option="--out")
        refuse_itself(output, recordings)
        empty = [path for path in recordings if path.is_file() and not path.stat().st_size]
        recordings = [path for path in recordings if path not in empty]
        prefixes = _prefixes(prefix or (), recordings)
        origins = [stack.enter_context(opened_file(path)) for path in recordings]
        watch = stack.enter_context(copying("merging", quiet or json))
        done = merge_all(origins, output, prefixes=prefixes, compression=compression, overwrite=overwrite, watch=watch)
        done.notes += [f"{path} {NOTHING_IN_IT}" for path in empty]
    tell_edited(done, json=json)


def _prefixes(words: Sequence[str], recordings: Sequence[Path]) -> list[str]:
    """Prefixes of the streams of each recording."""
    from dataflow.graph.keys import key_fault

    found = [""] * len(recordings)
    for word in words:
        file, equals, name = word.rpartition("=")
        places = [k for k, path in enumerate(recordings) if file in (str(path), path.name)]
        if not equals or len(places) != 1:
            names = ", ".join(str(path) for path in recordings)
            raise fail(f"--prefix {word}: expected FILE=NAME/ with one of {names}")
        if key_fault(name.rstrip("/")) is not None:
            raise fail(f"--prefix {word}: {name!r} cannot begin the name of a stream: {key_fault(name.rstrip('/'))}")
        found[places[0]] = name
    return found


def recover(
    recording: Annotated[Path, argument("BROKEN", "A torn or damaged MCAP file, .db3 or .bag.")],
    output: Out,
    compression: Compression = "zstd",
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Save what can be read of a torn or damaged recording.

    The new file has a proper end and an index. Losses are counted by the numbers of messages, which have no gaps, and
    by firing records, which are stored before the messages that they list. `dataflow verify` of what was saved
    is never "identical" for more than what is there. Of a ROS 2 bag in sqlite3 that was cut off, and of a ROS 1 bag
    without its index, whole messages are saved wherever they lie.

    Exit codes:

      0    written, and nothing is known to be lost
      1    written, and something is lost
      2    could not recover: neither an MCAP file nor a ROS bag, or no whole message

    Examples:

      dataflow recover broken.mcap -o saved.mcap
      dataflow recover broken.mcap -o saved.mcap --json
      dataflow recover cut.db3 -o saved.mcap
    """
    from dataflow.cli.support.output import DIFFERENT
    from dataflow.editing.recover import recover as save
    from dataflow.interop.opening import is_ros_bag
    from dataflow.recording.mcap.index import NO_END

    with copying("recovering", quiet or json) as watch:
        existing(recording, "a recording")
        output_file(output, ".mcap", overwrite=overwrite, option="--out")
        if is_ros_bag(recording):
            from dataflow.editing.recover_bag import recover_bag

            done = recover_bag(recording, output, compression=compression)
        else:
            done = save(recording, output, compression=compression, overwrite=overwrite, watch=watch)
        shown([NO_END, *done.damage])
    if json:
        print_json(done.as_json())
    else:
        _print_recovered(done, recording, output)
    if not done.whole:
        raise typer.Exit(DIFFERENT)


def _print_recovered(done: RecoveryReport, recording: Path, output: Path) -> None:
    lost = {loss.stream: loss.messages for loss in done.lost}
    made = table("stream", "saved", "lost", right=("saved", "lost"))
    for name in sorted(done.saved.streams.keys() | lost):
        made.add_row(Text(name), count(done.saved.streams.get(name, 0)), count(lost[name]) if name in lost else "")
    out.print(made)
    if done.torn:
        ending = (
            f"; its last {plural(done.lost_bytes, 'byte')} are an unfinished record: whole messages of it are saved"
        )
        rest = ending if done.lost_bytes else ""
        torn = "has no proper end: it is being written, or its writer died"
        say(f"[yellow]torn:[/] {escape(str(recording))} {torn}{rest}")
    for note in done.damage:
        say(f"[yellow]damaged:[/] {escape(note)}")
    what = f"{plural(done.saved.messages, 'message')}, {size(done.saved.bytes)}"
    out.print(f"wrote {escape(str(output))} ({what})", soft_wrap=True)
