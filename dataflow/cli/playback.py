"""Pauses and steps a replay or a plain run: by keys in its terminal, and by `dataflow playback` from another."""

from __future__ import annotations

import contextlib
import math
import os
import select
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.text import Text

from dataflow.cli.arguments import Json
from dataflow.cli.live import GraphName, Wait, running_graph
from dataflow.cli.output import err, fail, friendly_errors, out, print_json, say

if TYPE_CHECKING:
    from dataflow.supervision.supervisor import Supervisor

Pressed = Literal["toggle", "step", "quit"]
KEYS: dict[bytes, Pressed] = {b" ": "toggle", b"n": "step", b"\x1b[C": "step", b"\x1bOC": "step", b"q": "quit"}
HELP = "space: pause and go on · → or n: one step · q: end"


def pressed(typed: bytes) -> Iterator[Pressed]:
    """The meanings of what was typed; other keys mean nothing."""
    at = 0
    while at < len(typed):
        key = next((k for k in sorted(KEYS, key=len, reverse=True) if typed.startswith(k, at)), None)
        if key is not None:
            yield KEYS[key]
        at += 1 if key is None else len(key)


def keys(quiet: bool) -> Callable[[Supervisor], AbstractContextManager[None]] | None:
    """Returns what steers a replay by keys, where there is a terminal; None elsewhere."""
    if quiet or not err.is_terminal or not sys.stdin.isatty():
        return None
    return _steered


@contextmanager
def _steered(supervisor: Supervisor) -> Iterator[None]:
    """Reads keys on a thread of its own while a replay lasts; the terminal is as before afterwards."""
    import termios
    import tty

    stdin = sys.stdin.fileno()
    before = termios.tcgetattr(stdin)
    over, ending = os.pipe()

    def read() -> None:
        while True:
            ready, _, _ = select.select([stdin, over], [], [])
            if over in ready:
                return
            typed = os.read(stdin, 64)
            if not typed:
                return
            for key in pressed(typed):
                if key == "quit":
                    supervisor.stop()
                else:
                    supervisor.play(key)

    reader = threading.Thread(target=read, name="keys", daemon=True)
    say(f"[dim]{HELP}[/]")
    try:
        tty.setcbreak(stdin)
        reader.start()
        yield
    finally:
        os.write(ending, b"!")
        reader.join(1.0)
        with contextlib.suppress(termios.error):
            termios.tcsetattr(stdin, termios.TCSADRAIN, before)
        os.close(over)
        os.close(ending)


def playback(
    action: Annotated[
        str, typer.Argument(metavar="pause|resume|step|rate|to|status", help="What to do; status says how it stands.")
    ],
    value: Annotated[
        str | None,
        typer.Argument(
            metavar="[VALUE]",
            help="Of step: all messages of so many timestamps (1). Of rate: a factor of real time, or max. "
            "Of to: seconds from the recording's first message.",
        ),
    ] = None,
    graph: GraphName = None,
    wait: Wait = 0.0,
    json: Json = False,
) -> None:
    """Pause, resume, step or hurry a replay that runs in another terminal, or in a script.

    In a replay's own terminal, keys do the same: space pauses and goes on, the right arrow or n makes one step, q ends
    it. Results do not depend on it: a replay makes the same messages however it is paused. A plain run (not --live) can
    be steered as well; where its sources are in several processes, each of them makes the step. Devices cannot be
    paused.

    Exit codes:

      0    done
      2    nothing runs that can be paused, or it cannot go there: sources go only forward

    Examples:

      dataflow playback pause
      dataflow playback step 10
      dataflow playback resume --graph kitchen
      dataflow playback rate 0.5
      dataflow playback to 12.5
      dataflow playback status --json
    """
    from dataflow.client.playback import steering

    if action not in ("pause", "resume", "step", "rate", "to", "status"):
        raise fail(f"{action!r}: expected pause, resume, step, rate, to or status")
    wanted = _wanted(action, value)
    with friendly_errors(), steering(running_graph(graph, wait)) as steered:
        if action == "to":
            span = steered.ask(None)["span"]
            if span is None:
                raise fail("to: the sources do not come from a recording; pause, resume, step and rate can be had")
            wanted = {"stamp": span[0] + round(wanted["seconds"] * 1e9)}
        answer = steered.ask(None if action == "status" else action, **wanted)
    if json:
        print_json(answer)
        return
    from dataflow.sync.stamps import format_stamp

    stamp = answer["stamp"]
    where = "" if stamp is None else f" at {format_stamp(stamp)} ({stamp})"
    state = "ended" if answer["ended"] else "paused" if answer["paused"] else "playing"
    pace = "as fast as it goes" if answer["rate"] is None else f"{answer['rate']:g} times real time"
    out.print(Text.assemble((state, "bold"), where, f", {pace}"))


def _wanted(action: str, value: str | None) -> dict[str, Any]:
    """Returns what goes with an action. Raises `Exit` for a value that it does not take."""
    match action:
        case "step":
            try:
                steps = int(value or "1")
            except ValueError:
                steps = 0
            if steps < 1:
                raise fail(f"step {value}: expected how many, 1 or more")
            return {"steps": steps}
        case "rate" if value == "max":
            return {"rate": None}
        case "rate" | "to":
            try:
                number = float(value or "nan")
            except ValueError:
                number = math.nan
            if not 0 <= number < math.inf:
                what = "a factor of real time, or max" if action == "rate" else "seconds from the first message"
                raise fail(f"{action} {value or ''}: expected {what}")
            return {"rate": number} if action == "rate" else {"seconds": number}
    if value is not None:
        raise fail(f"{action} takes no value, got {value!r}")
    return {}


def same_digests(passes: list[dict[str, Any]]) -> bool:
    """Tells whether all passes of a loop made the same streams."""
    return all(one == passes[0] for one in passes)


def looped(count: int, one: Callable[[], dict[str, Any]]) -> None:
    """Replays `count` times (0: until it is interrupted) and compares what the passes made."""
    made: list[dict[str, Any]] = []
    number = 0
    while not count or number < count:
        number += 1
        if count != 1:
            say(f"[dim]pass {number}{f' of {count}' if count else ''}[/]")
        streams = one()
        made = [*made[:1], streams]
        if not same_digests(made):
            differing = sorted(s for s in made[0].keys() | streams.keys() if made[0].get(s) != streams.get(s))
            raise fail(f"pass {number} made other messages than the first one: {', '.join(differing)}", code=1)
    if number > 1:
        out.print(f"{number} passes, the same digests in each")
