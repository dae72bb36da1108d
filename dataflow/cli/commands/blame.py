"""`dataflow blame`: what decided a value. `dataflow drops`: which lost messages cost a figure."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from dataflow.cli.support.arguments import Json, RecordingFile, existing_recording, number, span
from dataflow.cli.support.options import option
from dataflow.cli.support.output import count, err, fail, out, plural, print_json, seconds, table
from dataflow.cli.support.repeated_calls import RECORDED, CodeOptions

if TYPE_CHECKING:
    from dataflow.blame.field import Field
    from dataflow.blame.links import Chain, Effect, Link
    from dataflow.drops.search import Cost
    from dataflow.graph import Graph

MOST_ROWS = 40
LONGEST_VALUE = 60
Budget = Annotated[
    float,
    option(
        "--budget SECONDS", "Time to look for it; what is left then is named.", parser=number(0.1, 86_400, "seconds")
    ),
]


def blame(
    recording: RecordingFile,
    field: Annotated[str, option("--field STREAM.FIELD@SECONDS", "The value, of the last message by that time.")],
    budget: Budget = 60.0,
    tolerance: Annotated[
        float,
        option(
            "--tolerance PART",
            "What a floating-point value must change by to count, as a part of it.",
            parser=number(0, 1, "a part of the value"),
        ),
    ] = 1e-4,
    code: CodeOptions = RECORDED,
    json: Json = False,
) -> None:
    """Find what decided a value: the chain of calls back to the sensors' messages.

    Each call on the chain is made again from its state with an input nudged, replaced by the message before, or left
    out, and so are all later calls that this reaches: an input that changes the value is on the chain, and so is the
    call that made it. Earlier calls of an operator are tried where the value depends on its state. The largest effect
    is named first.

    Exit codes:
      0   the chain is whole: it leads to what was sensed, or to a state that an operator was given
      1   it is not: nothing that was tried changes the value, or changes could not be tried, or the time was up
      2   there is no such value, or it does not repeat

    Examples:

      dataflow blame run.mcap --field "tracks.ids[3]@12.4"
      dataflow blame run.mcap --field "tracks.boxes[ids == 7]@12.4" --budget 300
      dataflow blame run.mcap --field odometry.position@3 --json
    """
    recording = existing_recording(recording)
    asked = _field(field)
    loaded = code.begin_again(recording, stream=asked.stream)
    chain, begin = _found(recording, asked, loaded, budget, tolerance)
    if json:
        print_json(chain.as_json())
    else:
        _print(chain, field, begin)
    if not chain.whole:
        raise typer.Exit(1)


def drops(
    recording: RecordingFile,
    worse: Annotated[str, option("--worse EXPRESSION", 'True of figures that are bad: "ate_rmse_m > 0.05".')],
    budget: Budget = 60.0,
    code: CodeOptions = RECORDED,
    json: Json = False,
) -> None:
    """Find which drops, late messages and timeouts of a live run cost its result.

    The operators between them and the figures are replayed with some of them undone: these messages come in time. What
    is named is a smallest set without which the figures are not worse: it suffices, and no part of it does. Another set
    may, too. Steps that sources dropped before they numbered them are not in the file.

    Exit code 0; 1: the time was up before the set was known to be a smallest; 2: it cannot be found, with the reason.

    Examples:

      dataflow drops run.mcap --worse "ate_rmse_m > 0.05"
      dataflow drops run.mcap --worse "score.recall < 0.8" --budget 300
    """
    recording = existing_recording(recording)
    loaded = code.begin_again(recording)
    from dataflow.drops.search import Drops
    from dataflow.recording import Recording

    with Recording(recording) as opened, progress() as show, redirect_stdout(sys.stderr):

        def watch(replays: int, left: int) -> None:
            show(f"{plural(replays, 'replay')}; losses undone in the next one: {count(left)}")

        try:
            cost = Drops(opened, worse, loaded, budget=budget, watch=watch).find()
        except SyntaxError as error:
            raise fail(f"--worse {worse}: no Python expression: {error.msg}") from None
        begin, _ = span(opened, opened.streams) or (0, 0)
    if json:
        print_json(cost.as_json())
    else:
        _print_cost(cost, worse, begin)
    if not cost.minimal:
        raise typer.Exit(1)


def _print_cost(cost: Cost, worse: str, begin: int) -> None:
    made = table("lost at", "operator", "input", "message of", "reason", right=("lost at",))
    for loss in cost.named[:MOST_ROWS]:
        at = f"{(loss.stamp - begin) * 1e-9:.3f} s"
        made.add_row(at, *map(Text, (loss.operator, loss.input, loss.stream or "tick", loss.reason)))
    out.print(made)
    if len(cost.named) > MOST_ROWS:
        out.print(f"and {count(len(cost.named) - MOST_ROWS)} more: --json has all")
    for name, value in cost.figures.items():
        text = f"{name}: {_text(value)}; without these {_text(cost.undone.get(name))}"
        out.print(Text(f"{text}, without any of the losses {_text(cost.best.get(name))}"), soft_wrap=True)
    if cost.minimal:
        of = f"{count(cost.losses)} losses ({', '.join(f'{count(n)} {reason}' for reason, n in cost.reasons.items())})"
        text = f"{len(cost.named)} of {of}: a smallest set, not the only cause. Without them it is"
        out.print(Text(f"{text} not {worse}; with any one of them it is. Another set may do the same."), soft_wrap=True)
    else:
        text = f"the time was up: without these {len(cost.named)} it is not {worse}, but fewer may do (--budget)"
        out.print(Text(text, style="yellow"), soft_wrap=True)
    unsent = f"; {count(cost.not_sent)} recorded as a number only" if cost.not_sent else ""
    out.print(f"steps that sources dropped before they numbered them are not in the file{unsent}", soft_wrap=True)
    names = ", ".join(cost.operators)
    text = f"{plural(cost.replays, 'replay')} of {names}: {plural(cost.calls, 'call')} made in {seconds(cost.seconds)}"
    out.print(Text(text), soft_wrap=True)


def _field(text: str) -> Field:
    from dataflow.blame.field import Field

    try:
        return Field.parse(text)
    except ValueError as error:
        raise fail(f"--field {error}") from None


def _found(recording: Path, field: Field, graph: Graph | None, budget: float, tolerance: float) -> tuple[Chain, int]:
    from dataflow.blame.chain import Blame
    from dataflow.recording import Recording

    with Recording(recording) as opened, progress() as show, redirect_stdout(sys.stderr):

        def watch(made: int, links: int) -> None:
            show(f"{plural(made, 'call')} made again, {plural(links, 'link')} found")

        chain = Blame(opened, field, graph, budget=budget, tolerance=tolerance, watch=watch).find()
        begin, _ = span(opened, opened.streams) or (0, 0)
        return chain, begin


@contextmanager
def progress() -> Iterator[Callable[[str], None]]:
    """Shows a line of what is being done, where there is a terminal."""
    with err.status("reading the recording") as status:
        yield lambda text: status.update(Text(text))


def _print(chain: Chain, field: str, begin: int) -> None:
    at = f"{(chain.stamp - begin) * 1e-9:.3f} s"
    late = ", the last one: the recording ends before" if chain.late else ""
    out.print(Text(f"{field} is {_text(chain.value)}, made by {_call(chain.target)} at {at}{late}"), soft_wrap=True)
    made = table("call", "its", "from", "the value then")
    rows = _rows(chain)
    for row in rows[:MOST_ROWS]:
        made.add_row(*map(Text, row))
    if rows:
        out.print(made)
    if len(rows) > MOST_ROWS:
        out.print(f"and {count(len(rows) - MOST_ROWS)} more: --json has all")
    _print_ends(chain)
    for operator, first in chain.ended.items():
        text = f"calls of {operator} before #{first} were not tried: a new operator in front of it gives the same value"
        out.print(Text(text), soft_wrap=True)
    for operator, first, last in chain.unsplit:
        text = f"not known which of calls {first} to {last} of {operator} left a mark: the time, or the memory, was up,"
        text += " or it was given its state behind them"
        out.print(Text(text, style="yellow"), soft_wrap=True)
    if chain.left:
        names = ", ".join(map(_call, chain.left[:5]))
        left = f"{plural(len(chain.left), 'call')} on the chain not looked into ({names})"
        text = f"the time (--budget), or the memory, was up: {left}"
        out.print(Text(text, style="yellow"), soft_wrap=True)
    out.print(f"{plural(chain.made, 'call')} made again in {seconds(chain.seconds)}")


def _print_ends(chain: Chain) -> None:
    """Prints what the chain leads to, where it leads to nothing, and what could not be tried."""
    sensed = _in_runs(chain.sensed)
    more = f" and {count(len(sensed) - MOST_ROWS)} more" if len(sensed) > MOST_ROWS else ""
    given = [f"the state given to {_call(link.call)}" for link in chain.links if not link.input and link.maker is None]
    if sensed or given:
        out.print(Text(f"decided by {', '.join(sensed[:MOST_ROWS] + given) + more}"), soft_wrap=True)
    tried = ", ".join(f"{count(n)} {way}" for way, n in chain.tried.items())
    if chain.loose:
        names = ", ".join(map(_call, chain.loose[:5])) + (", …" if len(chain.loose) > 5 else "")
        text = f"not known what decided {names}: nothing that was tried there changes the value, so it may be made by"
        text += " inputs or earlier calls that only change it together, by the code, or by the call's time"
        what = f"{plural(chain.tried.total(), 'change')} tried in all: {tried}"
        out.print(Text(f"{text} ({what})", style="yellow"), soft_wrap=True)
    for each in chain.untried:
        what = (
            f"{each.input} of {_call(each.call)}"
            if each.input
            else f"{_calls(each.call, each.last)} left out or others"
        )
        text = f"could not be tried: {what}: {each.error}"
        out.print(Text(text, style="yellow"), soft_wrap=True)
    if chain.raised and not chain.whole:
        text = (
            f"{count(chain.raised.total())} of {plural(chain.tried.total(), 'change')} made a call raise, which shows"
        )
        out.print(Text(f"{text} nothing", style="yellow"), soft_wrap=True)


def _in_runs(links: Sequence[Link]) -> list[str]:
    """The messages of links in words: those that follow each other on a stream as one, in the order of the first."""
    streams: dict[tuple[str, int], set[int]] = {}
    for link in links:
        for stream, incarnation, place in link.messages:
            streams.setdefault((stream, incarnation), set()).add(place)
    runs: list[str] = []
    for (stream, _), places in streams.items():
        ends = [each for each in sorted(places) if each + 1 not in places]
        begins = [each for each in sorted(places) if each - 1 not in places]
        runs += [_calls((stream, begin), end) for begin, end in zip(begins, ends, strict=True)]
    return runs


def _rows(chain: Chain) -> list[tuple[str, str, str, str]]:
    """The rows of the table; one for links that differ in the numbers of the messages or calls alone, which follow
    each other."""
    rows: list[tuple[str, str, str, str]] = []
    before: Link | None = None
    first = 0
    for link in chain.links:
        shown = "; ".join(_effect(effect, chain.value) for effect in link.effects)
        row = _call(link.call), link.input or "state", _origin(link), shown
        if before is not None and rows[-1][:2] + rows[-1][3:] == row[:2] + row[3:] and _follow(link, before):
            assert link.maker is not None
            low, high = sorted((first, link.maker.number))
            rows[-1] = (*row[:2], _calls((link.maker.operator, low), high), row[3])
        else:
            rows.append(row)
            first = link.maker.number if link.maker is not None else 0
        before = link
    return rows


def _follow(link: Link, other: Link) -> bool:
    """Returns whether two links are to calls of an operator of which one follows the other."""
    if link.input or link.maker is None or other.maker is None or link.last is not None or other.last is not None:
        return False
    return link.maker.operator == other.maker.operator and abs(link.maker.number - other.maker.number) == 1


def _calls(first: tuple[str, int], last: int | None) -> str:
    return _call(first) if last is None or last == first[1] else f"{_call(first)} to #{last}"


def _call(call: tuple[str, int]) -> str:
    return f"{call[0]} #{call[1]}"


def _origin(link: Link) -> str:
    if link.message is None:
        return "given" if link.maker is None else _calls(link.maker, link.last)
    stream, _, place = link.message
    message = _calls((stream, place), link.last)
    return message if link.maker is None else f"{_call(link.maker)}: {message}"


def _effect(effect: Effect, before: Any) -> str:
    how = effect.way + (f" ({', '.join(effect.fields)})" if effect.fields else "")
    return f"{how}{f' with {effect.together - 1} more' if effect.together > 1 else ''} → {_other(effect.value, before)}"


def _other(value: Any, before: Any) -> str:
    from dataflow.messages.base import Message
    from dataflow.recording.streams.diff import differences

    if isinstance(value, Message) and isinstance(before, Message) and type(value) is type(before):
        return f"another {', '.join(found.field for found in differences(before, value, None)[0])}"
    return _text(value)


def _text(value: Any) -> str:
    text = f"{value:.4g}" if isinstance(value, float) else "none" if value is None else " ".join(str(value).split())
    return text if len(text) <= LONGEST_VALUE else text[:LONGEST_VALUE] + "…"
