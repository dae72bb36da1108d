"""An editor's session: breakpoints stop inside `process()` at recorded calls, and steps go forwards and back.

All of it is one thread, the operator's: where a call stops, requests are answered from within it. Going back abandons
the call and makes it again, to a line event before; so does going to another call.
"""

from __future__ import annotations

import ctypes
import os
import socket
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from types import CodeType, FrameType, SimpleNamespace
from typing import Any

from dataflow.debugging.dap.variables import Variables
from dataflow.debugging.dap.wire import Gone, Wire
from dataflow.debugging.debugger import Debugger
from dataflow.debugging.fired import Abandoned, Fired, Process
from dataflow.debugging.lines import Lines, Spot, is_own, lines_of, own_frames
from dataflow.execution.failure import OperatorFailure, readable
from dataflow.messages.base import Message
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.sync import Firing

LOOPBACK = "127.0.0.1"
THREAD = 1
CAPABILITIES = (
    "supportsConfigurationDoneRequest",
    "supportsConditionalBreakpoints",
    "supportsEvaluateForHovers",
    "supportsRestartRequest",
    "supportsStepBack",
)
LOOKS = 256
"""Lines between two looks whether the editor asks for something while a call runs."""

Stops = Callable[[FrameType, int], str]
"""Returns why a line event, of that number in its call, is stopped at; empty where it is not."""


@dataclass(frozen=True, slots=True)
class Breakpoint:
    """A line with its condition, if there is one."""

    number: int
    text: str
    condition: CodeType | None


@dataclass(frozen=True, slots=True)
class Going:
    """The next call to be made, and where in it to stop."""

    call: int
    stops: Stops


class Session:
    """Serves one editor. `first`: the call to begin with; `number` reads the number of a call from text."""

    def __init__(
        self, connection: socket.socket, debugger: Debugger, first: int, number: Callable[[str], int] = int
    ) -> None:
        self._wire, self._debugger, self._number = Wire(connection), debugger, number
        self._going = Going(first, self._first_line)
        self._breakpoints: dict[str, dict[int, Breakpoint]] = {}
        self._variables, self._frames = Variables(), list[FrameType]()
        self._lines = Lines(self._at_line)
        self._away: Callable[[], Going] | None = None
        """Leads on once the call under way is abandoned."""
        self._done = self._over = self._pauses = False
        self._checked: list[int] = []
        """Calls that gave what was recorded, since this was last said."""
        self._handlers: Mapping[str, Callable[[Mapping[str, Any]], Mapping[str, Any] | None]] = {
            "initialize": self._initialize,
            "launch": self._launch,
            "attach": self._launch,
            "configurationDone": self._begin,
            "setBreakpoints": self._set_breakpoints,
            "setExceptionBreakpoints": self._set_exceptions,
            "threads": self._threads,
            "pause": self._pause,
            "stackTrace": self._stack,
            "scopes": self._scopes,
            "variables": self._parts,
            "evaluate": self._evaluate,
            "disconnect": self._disconnect,
            "terminate": self._disconnect,
        }

    def serve(self) -> None:
        """Answers until the editor leaves. Raises `DebugError` and what else goes to a call."""
        try:
            while not self._done and not self._over:
                self._answer(self._wire.request(wait=True), None)
            while not self._over:
                self._go()
            self._wire.event("terminated")
        except Gone:
            self._over = True

    # ------------------------------------------------------------------------------------------------- going

    def _go(self) -> None:
        """Makes one call under watch, and finds what is next."""
        fired = self._made(self._going.call, self._at_line)
        if self._away is not None:
            self._going = self._led()
            return
        if self._over:
            return
        self._check(fired)
        going = self._going  # a stop has changed what it stops at
        stops = self._breaks if going.stops == self._breaks else self._first_line
        if going.call + 1 < len(self._debugger.calls):
            self._going = Going(going.call + 1, stops)
        else:
            self._say("this was the last call; at its last line again")
            self._going = self._last_line(going.call + 1, "end of the recording")

    def _led(self) -> Going:
        """Finds where a command leads; of one that fails, prints the reason and begins the call again."""
        assert self._away is not None
        here, away, self._away = self._going.call, self._away, None
        try:
            return away()
        except (ReplayError, OperatorFailure) as error:
            self._say(str(error), "stderr")
            return Going(here, self._first_line)

    def _made(self, call: int, at_line: Callable[[FrameType, int], None]) -> Fired:
        self._lines = lines = Lines(at_line)

        def through(process: Process, firing: Firing) -> dict[str, Message]:
            made = lines.through(process, firing)
            if self._away is not None or self._over:
                raise Abandoned  # the operator has caught it
            return made

        return self._debugger.goto(call, through)

    def _check(self, fired: Fired) -> None:
        """Compares the outputs of a call with the recorded ones, and prints a difference."""
        if fired.same:
            self._checked.append(fired.number)
            return
        self._say_checked()
        ports = ", ".join(made.port for made in fired.made if not made.same)
        self._say(f"call {fired.number}: not as recorded{f', differs in {ports}' if ports else ''}", "stderr")
        if fired.error is not None:
            self._say(fired.error, "stderr")

    def _at_line(self, frame: FrameType, count: int) -> None:
        if not count % LOOKS:
            while (request := self._wire.request(wait=False)) is not None:
                self._answer(request, None)
        if self._over:
            raise Abandoned
        why = "pause" if self._pauses else self._going.stops(frame, count)
        if why:
            self._stop(frame, why)

    def _first_line(self, frame: FrameType, count: int) -> str:
        return "entry"

    def _breaks(self, frame: FrameType, count: int) -> str:
        found = self._breakpoints.get(_real(frame.f_code.co_filename), {}).get(frame.f_lineno)
        if found is None:
            return ""
        try:
            hit = found.condition is None or eval(found.condition, frame.f_globals, frame.f_locals)
        except Exception as error:
            self._say(f"the condition {found.text} raises {readable(error)}", "stderr")
            hit = True
        return "breakpoint" if hit else ""

    def _over_from(self, start: FrameType, *, out: bool) -> Stops:
        """Stops at the next line of a frame (unless `out`), or of one that it returns to."""
        inner = own_frames(start)
        outer = [*inner][1:]

        def stops(frame: FrameType, count: int) -> str:
            if (frame is start and not out) or frame in outer:
                return "step"
            return self._breaks(frame, count)

        return stops

    # ------------------------------------------------------------------------------------------------- back

    def _scanned(self, call: int, spot: Spot | None, wanted: Stops) -> tuple[int, list[int]]:
        """Makes a call, up to a spot if there is one; returns the number of its last line event, that of the spot, and
        the earlier ones at which `wanted` would stop."""
        hits: list[int] = []
        last = 0

        def at_line(frame: FrameType, count: int) -> None:
            nonlocal last
            last = count
            if spot is not None and self._lines.spot(frame) == spot:
                raise Abandoned
            if wanted(frame, count):
                hits.append(count)

        fired = self._made(call, at_line)
        if not isinstance(fired.raised, Abandoned):
            self._check(fired)
        return last, hits

    def _one_back(self, call: int, spot: Spot) -> Going:
        """One line event earlier, in this call or in the one before."""
        last, _ = self._scanned(call, spot, _nowhere)
        if last > 1:
            return Going(call, _at(last - 1, "step"))
        return self._last_line(call, "step") if call else Going(0, self._first_line)

    def _last_line(self, before: int, why: str) -> Going:
        """The last line event of the calls in front of one; else the beginning. Ends the session where no call has
        any."""
        for call in range(before - 1, -1, -1):
            last, _ = self._scanned(call, None, _nowhere)
            if last:
                return Going(call, _at(last, why))
        self._over = before == len(self._debugger.calls)
        if self._over:
            self._say("no call runs a line of the operator's source", "stderr")
        return Going(0, self._first_line)

    def _hit_before(self, call: int, spot: Spot | None) -> Going:
        """The last hit of a breakpoint before, in this call or in earlier ones; else the beginning of the first one."""
        _, hits = self._scanned(call, spot, self._breaks)
        while not hits and call > 0:
            call -= 1
            _, hits = self._scanned(call, None, self._breaks)
        return Going(call, _at(hits[-1], "breakpoint") if hits else self._first_line)

    def _anew(self, call: int) -> Going:
        """The same call from its beginning, with the source as it was edited since."""
        changed = self._debugger.reload()
        self._say(f"taken over: {', '.join(changed)}" if changed else "no source has changed")
        return Going(call, self._first_line)

    def _to(self, text: str) -> Going:
        try:
            return Going(self._debugger.goto(self._number(text)).number, self._first_line)
        except ValueError as error:
            raise ReplayError(str(error)) from error

    # ------------------------------------------------------------------------------------------------- stopped

    def _stop(self, frame: FrameType, why: str) -> None:
        """Answers requests until one goes on, or away."""
        self._frames, self._variables, self._pauses = list(own_frames(frame)), Variables(), False
        self._say_checked()
        self._wire.event("stopped", reason=why, threadId=THREAD, allThreadsStopped=True, description=self._where())
        while not self._answer(self._wire.request(wait=True), frame):
            pass
        self._frames = []
        if self._away is not None or self._over:
            raise Abandoned

    def _answer(self, request: Mapping[str, Any] | None, frame: FrameType | None) -> bool:
        """Answers a request; returns whether a stopped call does not stay where it is. `frame`: None while it runs."""
        assert request is not None
        name, arguments = request["command"], request.get("arguments") or {}
        moves = self._moves(name, frame)
        try:
            if moves is not None:
                moves()
                self._wire.answer(request, {"allThreadsContinued": True} if name == "continue" else None)
                return True
            handler = self._handlers.get(name)
            if handler is None:
                self._wire.answer(request, error=f"{name} is not supported" if frame else f"{name}: the call runs")
                return False
            moved = self._away is not None
            self._wire.answer(request, handler(arguments))
            if name in ("launch", "attach"):
                self._wire.event("initialized")
            return self._over or (self._away is not None and not moved)
        except Gone:
            raise
        except Exception as error:
            self._wire.answer(request, error=f"{name}: {readable(error)}")
            return False

    def _moves(self, name: str, frame: FrameType | None) -> Callable[[], None] | None:
        """Returns what a request that moves does to a stopped call; None for others."""
        if frame is None:
            return None
        call, spot = self._going.call, self._lines.spot(frame)
        on = {
            "continue": self._breaks,
            "stepIn": lambda frame, count: "step",
            "next": self._over_from(frame, out=False),
            "stepOut": self._over_from(frame, out=True),
        }
        away = {
            "stepBack": partial(self._one_back, call, spot),
            "reverseContinue": partial(self._hit_before, call, spot),
            "restart": partial(self._anew, call),
        }
        if name in on:
            return partial(setattr, self, "_going", Going(call, on[name]))
        return partial(setattr, self, "_away", away[name]) if name in away else None

    # ------------------------------------------------------------------------------------------------- requests

    def _initialize(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        return dict.fromkeys(CAPABILITIES, True)

    def _launch(self, arguments: Mapping[str, Any]) -> None:
        if not arguments.get("stopOnEntry", True):
            self._going = Going(self._going.call, self._breaks)

    def _begin(self, arguments: Mapping[str, Any]) -> None:
        self._done = True

    def _set_breakpoints(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        file = _real(arguments["source"]["path"])
        set_here: dict[int, Breakpoint] = {}
        told = []
        for number, each in enumerate(arguments.get("breakpoints", ()), 1):
            text, problem = each.get("condition") or "", ""
            try:
                line = min(n for n in lines_of(file) if n >= each["line"])
                condition = compile(text, "<condition>", "eval") if text else None
                problem = "" if is_own(file) else "breakpoints are for the operator's source, not for libraries"
            except (OSError, SyntaxError, ValueError) as error:
                problem = f"no code there: {readable(error)}"
            if problem:
                told.append({"verified": False, "line": each["line"], "message": problem})
                continue
            set_here[line] = Breakpoint(number, text, condition)
            told.append({"verified": True, "line": line})
        self._breakpoints[file] = set_here
        return {"breakpoints": told}

    def _set_exceptions(self, arguments: Mapping[str, Any]) -> None:
        """None are offered."""

    def _threads(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"threads": [{"id": THREAD, "name": self._where()}]}

    def _pause(self, arguments: Mapping[str, Any]) -> None:
        self._pauses = True

    def _stack(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        frames = [
            {
                "id": n,
                "name": frame.f_code.co_name,
                "line": frame.f_lineno,
                "column": 1,
                "source": {"name": os.path.basename(frame.f_code.co_filename), "path": frame.f_code.co_filename},
            }
            for n, frame in enumerate(self._frames, 1)
        ]
        first = arguments.get("startFrame") or 0
        most = arguments.get("levels") or len(frames)
        return {"stackFrames": frames[first : first + most], "totalFrames": len(frames)}

    def _scopes(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        frame = self._frame(arguments)
        named = {"Locals": frame.f_locals, "Globals": frame.f_globals}
        scopes = [(name, SimpleNamespace(**{str(n): v for n, v in of.items()})) for name, of in named.items()]
        shown = [(name, self._variables.reference(of)) for name, of in scopes]
        return {"scopes": [{"name": n, "variablesReference": ref, "expensive": n == "Globals"} for n, ref in shown]}

    def _parts(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"variables": self._variables.parts(arguments["variablesReference"])}

    def _evaluate(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        text, frame = arguments["expression"], self._frame(arguments)
        typed = arguments.get("context") == "repl"
        if typed and text.startswith("goto "):
            self._away = partial(self._to, text.removeprefix("goto ").strip())
            return {"result": "", "variablesReference": 0}
        try:
            value = _evaluated(text, frame, statements=typed)
        except (Exception, SystemExit) as error:
            raise ValueError(readable(error)) from error
        shown = self._variables.shown(text, value)
        return {"result": shown["value"], "type": shown["type"], "variablesReference": shown["variablesReference"]}

    def _disconnect(self, arguments: Mapping[str, Any]) -> None:
        self._over = True

    # ------------------------------------------------------------------------------------------------- saying

    def _frame(self, arguments: Mapping[str, Any]) -> FrameType:
        number = arguments.get("frameId") or 1
        if not 0 < number <= len(self._frames):
            why = "it is of an earlier stop" if self._frames else "the call runs"
            raise LookupError(f"no frame {number}: {why}")
        return self._frames[number - 1]

    def _where(self) -> str:
        call = self._debugger.calls[self._going.call]
        first = self._debugger.calls[0].stamp
        return (
            f"{self._debugger.node.name} call {self._going.call} of {len(self._debugger.calls)}, "
            f"{(call.stamp - first) * 1e-9:.3f} s after its first"
        )

    def _say(self, text: str, category: str = "console") -> None:
        self._wire.event("output", category=category, output=f"{text}\n")

    def _say_checked(self) -> None:
        if self._checked:
            first, last = self._checked[0], self._checked[-1]
            calls = f"call {first}" if first == last else f"{len(self._checked)} calls, {first} to {last}"
            self._say(f"{calls}: as recorded, digest by digest")
            self._checked.clear()


_real = cache(os.path.realpath)


def _evaluated(text: str, frame: FrameType, *, statements: bool) -> Any:
    """Returns the value of an expression in a frame; None for `statements`, which may assign to its variables. Raises
    what the text raises."""
    names = frame.f_locals
    try:
        code = compile(text, "<console>", "eval")
    except SyntaxError:
        if not statements:
            raise
        code = compile(text, "<console>", "exec")
    try:
        return eval(code, frame.f_globals, names)
    finally:
        if sys.version_info < (3, 13):  # `f_locals` is a copy there
            ctypes.pythonapi.PyFrame_LocalsToFast(ctypes.py_object(frame), ctypes.c_int(0))


def _at(wanted: int, why: str) -> Stops:
    return lambda frame, count: why if count == wanted else ""


def _nowhere(frame: FrameType, count: int) -> str:
    return ""


def listen(port: int) -> socket.socket:
    """Listens for an editor on loopback; port 0: any free one. Raises OSError."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((LOOPBACK, port))
        listening.listen(1)
    except BaseException:
        listening.close()
        raise
    return listening
