"""Keys in the terminal of a run; pauses, steps and paces those that are not live by `dataflow playback`, too."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.text import Text

from dataflow.cli.commands.following.live import THE_ONLY, Running
from dataflow.cli.support.arguments import Json, number
from dataflow.cli.support.options import argument
from dataflow.cli.support.output import err, fail, out, print_json, say
from dataflow.cli.support.quantities import speed_text

if TYPE_CHECKING:
    from dataflow.supervision.supervisor import Supervisor

Pressed = Literal["toggle", "step", "faster", "slower", "keep", "quit"]
KEYS: dict[bytes, Pressed] = {
    b" ": "toggle",
    b"n": "step", b"\x1b[C": "step", b"\x1bOC": "step",  # →
    b"+": "faster", b"=": "faster", b"\x1b[A": "faster", b"\x1bOA": "faster",  # ↑
    b"-": "slower", b"\x1b[B": "slower", b"\x1bOB": "slower",  # ↓
    b"k": "keep",
    b"q": "quit",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class KeyBindings:
    """Keys that act on a run, and the help that its terminal shows for them."""

    help: str
    does: frozenset[Pressed]


PLAYING = KeyBindings(
    "space: pause and go on · → or n: one step · + and -: twice and half as fast",
    frozenset({"toggle", "step", "faster", "slower"}),
)
KEEPING = KeyBindings("k: save the history", frozenset({"keep"}))
ENDING = KeyBindings("q: end", frozenset({"quit"}))
ACTIONS = ("pause", "resume", "step", "speed", "status")


def pressed(typed: bytes) -> Iterator[Pressed]:
    """The meanings of what was typed; other keys mean nothing."""
    at = 0
    while at < len(typed):
        key = next((k for k in sorted(KEYS, key=len, reverse=True) if typed.startswith(k, at)), None)
        if key is not None:
            yield KEYS[key]
        at += 1 if key is None else len(key)


def keys(
    quiet: bool, *, live: bool = False, flight: bool = False
) -> Callable[[Supervisor], AbstractContextManager[None]] | None:
    """Returns what steers a run by keys, where there is a terminal; None elsewhere, and where no key could do a thing.

    One that is `live` cannot be paused; one with a `flight` recorder keeps what was.
    """
    offers = [*([] if live else [PLAYING]), *([KEEPING] if flight else [])]
    if not offers or quiet or not err.is_terminal or not sys.stdin.isatty():
        return None
    return partial(_steered, [*offers, ENDING]) if _in_foreground(sys.stdin.fileno()) else None


def _in_foreground(terminal: int) -> bool:
    """Returns whether keys come here: a job in the background (`&`) would be stopped if it asked for them."""
    try:
        return os.tcgetpgrp(terminal) == os.getpgrp()
    except OSError:  # the terminal of another session
        return False


@contextmanager
def _steered(offers: Sequence[KeyBindings], supervisor: Supervisor) -> Iterator[None]:
    """Reads keys on a separate thread while a run lasts; restores the terminal afterwards."""
    import termios
    import tty

    stdin = sys.stdin.fileno()
    before = termios.tcgetattr(stdin)
    over, ending = os.pipe()
    acting: frozenset[Pressed] = frozenset().union(*(offer.does for offer in offers))

    def read() -> None:
        while True:
            ready, _, _ = select.select([stdin, over], [], [])
            if over in ready:
                return
            typed = os.read(stdin, 64)
            if not typed:
                return
            for key in pressed(typed):
                if key in acting:
                    _do(key, supervisor)

    reader = threading.Thread(target=read, name="keys", daemon=True)
    say(f"[dim]{' · '.join(offer.help for offer in offers)}[/]")
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


def _do(key: Pressed, supervisor: Supervisor) -> None:
    match key:
        case "quit":
            supervisor.stop()
        case "keep":
            supervisor.trigger("the key k")
        case _:
            supervisor.play(key)


def playback(
    action: Annotated[str, argument("pause|resume|step|speed|status", "What to do; status prints the state.")],
    value: Annotated[
        str | None,
        argument(
            "N|FACTOR",
            "Of step: all messages of so many timestamps, by default 1. Of speed: 1 is real time, max as fast as "
            "the graph goes.",
        ),
    ] = None,
    which: Running = THE_ONLY,
    json: Json = False,
) -> None:
    """Pause, resume, step or pace what runs in another terminal, or in a script.

    That is a replay, or a run that is not live. In its own terminal, keys do the same: space pauses and goes on, the
    right arrow or n makes one step, + and - double and halve the speed, q ends it. Results do not depend on it: the
    same messages are made however it is paused. A step of a run whose sources are in several processes is one step in
    each of them. A live run cannot be paused: devices and the clock do not wait.

    Exit codes:

      0    done
      2    no graph runs, it is live, or it does not answer

    Examples:

      dataflow playback pause
      dataflow playback step 10
      dataflow playback resume --graph kitchen
      dataflow playback speed 0.25
      dataflow playback speed max
      dataflow playback status --json
    """
    from dataflow.client.playback import ask

    if action not in ACTIONS:
        raise fail(f"{action!r}: expected {', '.join(ACTIONS[:-1])} or {ACTIONS[-1]}")
    steps, speed = _wanted(action, value)
    found = which.found()
    answer = ask(found, None if action == "status" else action, steps, speed)
    if json:
        print_json(answer)
        return
    from dataflow.sync.stamps import format_stamp

    stamp = answer["stamp"]
    where = "" if stamp is None else f" at {format_stamp(stamp)} ({stamp})"
    state = "ended" if answer["ended"] else "paused" if answer["paused"] else "playing"
    out.print(Text.assemble((state, "bold"), where, f", {speed_text(answer['speed'])}"))


def _wanted(action: str, value: str | None) -> tuple[int, float | None]:
    """Returns the steps and the speed that the word after an action asks for."""
    if action == "speed":
        if value is None:
            raise fail("speed: expected a factor of real time, or max; for example: dataflow playback speed 0.5")
        if value == "max":
            return 1, None
        return 1, number(0.001, 1000, "1 is real time; or max, as fast as the graph goes")(value)
    if value is None:
        return 1, None
    if action != "step":
        raise fail(f"{action} takes no {value!r}; only step takes a number, and speed a factor")
    if not value.isdecimal() or int(value) < 1:
        raise fail(f"{value} steps: expected a whole number, 1 or more")
    return int(value), None


def same_digests(passes: list[dict[str, Any]]) -> bool:
    """Returns whether all passes of a loop made the same streams."""
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
