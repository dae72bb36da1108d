"""An editor's session: breakpoints stop inside `process()` at recorded calls, and steps go forwards and back.

All of it is one thread, the operator's: where a call stops, requests are answered from within it. Going back abandons
the call and makes it again, to a line event before; so does going to another call.
"""

from __future__ import annotations

import ast
import ctypes
import os
import re
import socket
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from operator import eq, ge, gt, le, lt
from types import CodeType, FrameType, SimpleNamespace
from typing import Any

from dataflow.debugging.dap.variables import Variables
from dataflow.debugging.dap.wire import EditorDisconnected, Wire
from dataflow.debugging.debugger import DebugError, Debugger
from dataflow.debugging.fired import Abandoned, Process, RepeatedCall, Through
from dataflow.debugging.lines import CodePosition, Lines, homes_of, is_own, own_frames, stoppable_line
from dataflow.execution.failure import OperatorFailure, readable
from dataflow.messages.base import Message
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.sync import Firing

LOOPBACK = "127.0.0.1"
THREAD = 1
AS_RECORDED = "as recorded, digest by digest"
CAPABILITIES = (
    "supportsConfigurationDoneRequest",
    "supportsConditionalBreakpoints",
    "supportsEvaluateForHovers",
    "supportsHitConditionalBreakpoints",
    "supportsLogPoints",
    "supportsRestartRequest",
    "supportsStepBack",
)
UNCAUGHT = "uncaught"
"""The filter of exceptions that is offered."""
GREETS = 60.0
"""Seconds that an editor that has connected may take for its first request."""
LOOKS = 256
"""Lines of a call between two looks whether the editor asks for something."""

Stops = Callable[[FrameType, int], str]
"""Returns why a line event, of that number in its call, is stopped at; empty where it is not."""


@dataclass(frozen=True, slots=True)
class Breakpoint:
    """A line with its condition, if there is one. `hits`: which passes of a call count, of those with a true condition;
    `log`: the message, an f-string, that is printed in place of a stop."""

    text: str
    condition: CodeType | None
    hits: Callable[[int], bool] | None
    log: CodeType | None


@dataclass(frozen=True, slots=True)
class StopTarget:
    """The next call to be made, and where in it to stop; `line`: the number of the line event there, if it is known."""

    call: int
    stops: Stops
    line: int = 0


class Session:
    """Serves one editor. `first`: the call to begin with; `number` reads the number of a call from text."""

    def __init__(
        self, connection: socket.socket, debugger: Debugger, first: int, number: Callable[[str], int] = int
    ) -> None:
        connection.settimeout(GREETS)
        self._connection, self._wire, self._debugger, self._number = connection, Wire(connection), debugger, number
        self._going = StopTarget(first, self._first_line)
        self._breakpoints: dict[str, dict[int, Breakpoint]] = {}
        self._passes: Counter[tuple[str, int]] = Counter()
        """Passes of the call under way by lines of breakpoints with `hits`; editors set all anew when one is set."""
        self._variables, self._frames = Variables(), list[FrameType]()
        self._homes = homes_of(debugger.node.operator.__module__)
        self._lines = Lines(self._at_line, self._homes)
        debugger.between = self._look_on_the_way
        self._touched = False
        """True where what was evaluated in the call may have changed something."""
        self._away: Callable[[], StopTarget] | None = None
        """Leads on once the call under way is abandoned."""
        self._done = self._over = self._pauses = False
        self._missing = -1
        """The call that has last missed the line event at which it was to stop."""
        self._left = ""
        """Why the editor is taken for gone, where that was seen within a call."""
        self._checked: list[int] = []
        """Calls with one verdict, since this was last said."""
        self._verdict = AS_RECORDED
        self._origin = debugger.origin
        self._stops_raised = False
        """True where it stops at calls that raise."""
        self._raises, self._error = -1, ""
        """The call that was stopped at as it raises, and its error."""
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
            try:
                while not self._done and not self._over:
                    self._answer(self._wire.request(wait=True), None)
                while not self._over:
                    self._go()
            except (ReplayError, OperatorFailure) as error:
                self._say(str(error), "stderr")
                self._wire.event("terminated")
                raise
            if self._left:
                self._say(f"the session ends: {self._left}", "stderr")
            self._wire.event("terminated")
        except EditorDisconnected:
            self._over = True

    # ------------------------------------------------------------------------------------------------- going

    def _go(self) -> None:
        """Makes one call under watch, and finds what is next."""
        try:
            fired = self._debugger.goto(self._going.call, self._watched(self._at_line), lambda: self._touched)
        except Abandoned:  # on the way there
            self._going = self._reached()
            return
        except DebugError as error:
            self._going = self._before(error)
            return
        if self._away is not None:
            self._going = self._led()
            return
        if self._over:
            return
        self._check(fired)
        going = self._going  # a stop has changed what it stops at
        if going.line:
            self._going = self._missed(going)
            return
        if (raises := self._raised(fired)) is not None:
            self._going = raises
            return
        stops = self._breaks if going.stops == self._breaks else self._first_line
        if going.call + 1 < len(self._debugger.calls):
            self._going = StopTarget(going.call + 1, stops)
        else:
            self._say("this was the last call; at its last line again")
            self._away = partial(self._end, going.call + 1)
            self._going = self._led()

    def _missed(self, going: StopTarget) -> StopTarget:
        """Finds where to stop in a call that has not come to the line event at which it was to: the last one that it
        had this time, then its first one."""
        ran = self._lines.count
        self._say(
            f"call {going.call} ran {ran} lines this time, {going.line} before: it does not repeat "
            "(dataflow verify --why finds the cause)",
            "stderr",
        )
        if ran == 0:
            self._over = going.call + 1 == len(self._debugger.calls)
            return StopTarget(going.call if self._over else going.call + 1, self._first_line)
        if self._missing == going.call:
            return StopTarget(going.call, self._first_line)
        self._missing = going.call
        return StopTarget(going.call, _at(ran, "step"), ran)

    def _raised(self, fired: RepeatedCall) -> StopTarget | None:
        """Leads back to the line that has raised what the call raises, once; None where nothing is to be stopped at."""
        error, line = self._lines.raised
        if not self._stops_raised or fired.raised is None or fired.raised is not error:
            return None
        if self._raises == fired.number:
            self._raises = -1
            return None
        self._raises, self._error = fired.number, readable(error)
        return StopTarget(fired.number, _at(line, "exception"), line)

    def _before(self, error: DebugError) -> StopTarget:
        """Goes back to the last line event in front of a call that cannot be made. Raises `DebugError` where no call
        was made yet."""
        if (at := self._debugger.at) is None:
            raise error
        self._say(f"{error}; at the last line of call {at.number} again", "stderr")
        self._going, self._away = StopTarget(at.number, self._first_line), partial(self._end, at.number + 1)
        return self._led()

    def _led(self) -> StopTarget:
        """Finds where a command leads; of one that fails, prints the reason and begins the call again."""
        assert self._away is not None
        here, away, self._away = self._going.call, self._away, None
        self._raises = -1  # a call that reaches that line anew stops anew
        try:
            return away()
        except Abandoned:
            return self._reached()
        except (ReplayError, OperatorFailure) as error:
            self._say(str(error), "stderr")
            return StopTarget(here, self._first_line)

    def _reached(self) -> StopTarget:
        """The call behind the one at which a way to another was broken off: the only one to which no way leads anew."""
        return StopTarget(self._debugger.reached + 1, self._first_line)

    def _look_on_the_way(self) -> None:
        """Answers requests between two calls on the way to another, which a pause breaks off."""
        self._look()
        if self._pauses:
            raise Abandoned

    def _watched(self, at_line: Callable[[FrameType, int], None]) -> Through:
        """Makes calls under watch; answers requests that are there when one begins, and on its way."""

        def looking(frame: FrameType, count: int) -> None:
            try:
                if not count % LOOKS:
                    self._look()
                self._count(frame)
                at_line(frame, count)
            except EditorDisconnected as error:
                raise self._abandoned(error) from error

        def through(process: Process, firing: Firing) -> dict[str, Message]:
            self._touched = False
            self._passes.clear()
            try:
                self._look()
            except EditorDisconnected as error:
                raise self._abandoned(error) from error
            self._lines = lines = Lines(looking, self._homes)
            made = lines.through(process, firing)
            if self._away is not None or self._over:
                raise Abandoned  # the operator has caught it
            return made

        return through

    def _abandoned(self, error: EditorDisconnected) -> Abandoned:
        """Ends the session within a call, whose operator has not raised that error."""
        self._over, self._left = True, str(error)
        return Abandoned()

    def _look(self) -> None:
        while (request := self._wire.request(wait=False)) is not None:
            self._answer(request, None)
        if self._over:
            raise Abandoned

    def _check(self, fired: RepeatedCall) -> None:
        """Compares the outputs of a call with the recorded ones, and prints a difference."""
        ports = ", ".join(made.port for made in fired.made if not made.same)
        verdict = AS_RECORDED if fired.same else f"not as recorded{f', differs in {ports}' if ports else ''}"
        if verdict != self._verdict:
            self._say_checked()
        self._verdict = verdict
        self._checked.append(fired.number)
        if not fired.same and fired.error is not None:
            self._say_checked()
            self._say(fired.error, "stderr")

    def _at_line(self, frame: FrameType, count: int) -> None:
        if not self._going.line:  # what is made again, to a line that it has come to, was printed
            self._log(frame)
        why = "pause" if self._pauses else self._going.stops(frame, count)
        if why:
            self._stop(frame, why)

    def _first_line(self, frame: FrameType, count: int) -> str:
        return "entry"

    def _breakpoint(self, frame: FrameType) -> Breakpoint | None:
        return self._breakpoints.get(_real(frame.f_code.co_filename), {}).get(frame.f_lineno)

    def _count(self, frame: FrameType) -> None:
        found = self._breakpoint(frame)
        if found is not None and found.hits is not None and self._is_so(found, frame, told=False):
            self._passes[_place(frame)] += 1

    def _is_so(self, found: Breakpoint, frame: FrameType, *, told: bool = True) -> bool:
        try:
            return found.condition is None or bool(eval(found.condition, frame.f_globals, frame.f_locals))
        except Exception as error:
            if told:
                self._say(f"the condition {found.text} raises {readable(error)}", "stderr")
            return True

    def _is_hit(self, found: Breakpoint, frame: FrameType) -> bool:
        return self._is_so(found, frame) and (found.hits is None or found.hits(self._passes[_place(frame)]))

    def _breaks(self, frame: FrameType, count: int) -> str:
        found = self._breakpoint(frame)
        return "breakpoint" if found is not None and found.log is None and self._is_hit(found, frame) else ""

    def _log(self, frame: FrameType) -> None:
        found = self._breakpoint(frame)
        if found is None or found.log is None or not self._is_hit(found, frame):
            return
        try:
            self._say(str(eval(found.log, frame.f_globals, frame.f_locals)).removesuffix(" "))
        except Exception as error:
            self._say(f"the log message of line {frame.f_lineno} raises {readable(error)}", "stderr")

    def _over_from(self, start: FrameType, *, out: bool) -> Stops:
        """Stops at the next line of a frame (unless `out`), or of one that it returns to."""
        inner = own_frames(start, self._homes)
        outer = [*inner][1:]

        def stops(frame: FrameType, count: int) -> str:
            if (frame is start and not out) or frame in outer:
                return "step"
            return self._breaks(frame, count)

        return stops

    # ------------------------------------------------------------------------------------------------- back

    def _last(self, first: int, last: int, wanted: Stops, spot: CodePosition | None = None) -> tuple[int, int] | None:
        """Makes calls, up to a spot if there is one. Returns the last line event at which `wanted` would stop: its call
        and its number in that."""
        found: tuple[int, int] | None = None
        call = first

        def at_line(frame: FrameType, count: int) -> None:
            nonlocal found
            if self._pauses or (spot is not None and self._lines.spot(frame) == spot):
                raise Abandoned
            if wanted(frame, count):
                found = call, count

        for fired in self._debugger.each(first, last, self._watched(at_line)):
            if isinstance(fired.raised, Abandoned):
                break
            self._check(fired)
            call += 1
        return found

    def _back(self, call: int, spot: CodePosition | None, wanted: Stops, why: str) -> StopTarget:
        """The last line event before, in this call or in earlier ones, at which `wanted` would stop; else the beginning
        of the first one. A pause leads to the calls that are being looked at."""
        found = None if spot is None else self._last(call, call, wanted, spot)
        width = 1
        while found is None and call > 0 and not (self._over or self._pauses):
            first = self._debugger.begins(max(0, call - width))
            found = self._last(first, call - 1, wanted)
            call, width = first, 2 * width
        self._missing = -1
        return (
            StopTarget(call, self._first_line) if found is None else StopTarget(found[0], _at(found[1], why), found[1])
        )

    def _end(self, calls: int) -> StopTarget:
        """The last line event of the recording. Ends the session where no call has any."""
        going = self._back(calls, None, _everywhere, "end of the recording")
        if going.stops == self._first_line and not (self._over or self._pauses):
            self._over = True
            self._say("no call runs a line of the operator's source", "stderr")
        return going

    def _anew(self, call: int) -> StopTarget:
        """The same call from its beginning, with the source as it was edited since."""
        changed = self._debugger.reload()
        self._say(f"taken over: {', '.join(changed)}" if changed else "no source has changed")
        return StopTarget(call, self._first_line)

    def _to(self, text: str) -> StopTarget:
        try:
            return StopTarget(self._debugger.goto(self._number(text)).number, self._first_line)
        except ValueError as error:
            raise ReplayError(str(error)) from error

    # ------------------------------------------------------------------------------------------------- stopped

    def _stop(self, frame: FrameType, why: str) -> None:
        """Answers requests until one goes on, or away."""
        self._frames, self._variables, self._pauses = list(own_frames(frame, self._homes)), Variables(), False
        self._say_checked()
        more = {"text": self._error} if why == "exception" else {}
        self._wire.event(
            "stopped", reason=why, threadId=THREAD, allThreadsStopped=True, description=self._where(), **more
        )
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
        except EditorDisconnected:
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
            "stepIn": _everywhere,
            "next": self._over_from(frame, out=False),
            "stepOut": self._over_from(frame, out=True),
        }
        away = {
            "stepBack": partial(self._back, call, spot, _everywhere, "step"),
            "reverseContinue": partial(self._back, call, spot, self._breaks, "breakpoint"),
            "restart": partial(self._anew, call),
        }
        if name in on:
            return partial(setattr, self, "_going", StopTarget(call, on[name]))
        return partial(setattr, self, "_away", away[name]) if name in away else None

    # ------------------------------------------------------------------------------------------------- requests

    def _initialize(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        self._connection.settimeout(None)
        offered = {"filter": UNCAUGHT, "label": "Exceptions that leave process()", "default": True}
        return dict.fromkeys(CAPABILITIES, True) | {"exceptionBreakpointFilters": [offered]}

    def _launch(self, arguments: Mapping[str, Any]) -> None:
        if not arguments.get("stopOnEntry", True):
            self._going = StopTarget(self._going.call, self._breaks)

    def _begin(self, arguments: Mapping[str, Any]) -> None:
        self._done = True

    def _set_breakpoints(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        file = _real(arguments["source"]["path"])
        set_here: dict[int, Breakpoint] = {}
        told: list[dict[str, Any]] = []
        for each in arguments.get("breakpoints", ()):
            try:
                if not is_own(file, self._homes):
                    raise LookupError("breakpoints are for the operator's source, not for libraries")
                line = stoppable_line(file, each["line"], self._debugger.node.operator.setup.__qualname__)
                set_here[line] = _breakpoint(each)
                told.append({"verified": True, "line": line})
            except LookupError as error:
                told.append({"verified": False, "line": each["line"], "message": str(error)})
            except (OSError, SyntaxError, ValueError) as error:
                told.append({"verified": False, "line": each["line"], "message": f"no code there: {readable(error)}"})
        self._breakpoints[file] = set_here
        return {"breakpoints": told}

    def _set_exceptions(self, arguments: Mapping[str, Any]) -> None:
        self._stops_raised = UNCAUGHT in arguments.get("filters", ())

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
            tree = _parsed(text, statements=typed)
            self._touched = self._touched or _may_change(tree)
            value = _evaluated(tree, frame)
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
        calls, number = self._debugger.calls, self._going.call
        at = (calls[number].stamp - self._origin) * 1e-9
        return f"{self._debugger.node.name} call {number} of {len(calls)}, at {at:.3f} s"

    def _say(self, text: str, category: str = "console") -> None:
        self._wire.event("output", category=category, output=f"{text}\n")

    def _say_checked(self) -> None:
        if self._checked:
            first, last = min(self._checked), max(self._checked)
            calls = f"call {first}" if first == last else f"{len(self._checked)} calls, {first} to {last}"
            self._say(f"{calls}: {self._verdict}", "console" if self._verdict == AS_RECORDED else "stderr")
            self._checked.clear()


_real = cache(os.path.realpath)


def _place(frame: FrameType) -> tuple[str, int]:
    return _real(frame.f_code.co_filename), frame.f_lineno


def _breakpoint(wanted: Mapping[str, Any]) -> Breakpoint:
    """Returns a breakpoint as it is asked for. Raises LookupError for one that cannot be, with the reason."""
    text, log = wanted.get("condition") or "", wanted.get("logMessage") or ""
    return Breakpoint(
        text,
        _compiled("condition", text, text) if text else None,
        _hits(wanted.get("hitCondition") or ""),
        _compiled("log message", log, f'rf"""{log} """') if log else None,  # the space ends one that ends with a quote
    )


def _compiled(what: str, text: str, code: str) -> CodeType:
    try:
        return compile(code, f"<{what}>", "eval")
    except (SyntaxError, ValueError) as error:
        raise LookupError(f"the {what} {text} is no Python expression: {readable(error)}") from None


def _hits(text: str) -> Callable[[int], bool] | None:
    """Reads which passes are meant: "3" or "== 3" the third, "> 3", "% 3" each third. Raises LookupError."""
    if not text.strip():
        return None
    found = re.fullmatch(r"\s*(==|>=|<=|>|<|%|)\s*(\d+)\s*", text)
    if found is None or (found[1] in ("", "==", "%") and not int(found[2])):
        raise LookupError(f"the hit count {text} is none of: 3, >= 3, > 3, <= 3, < 3, % 3")
    number = int(found[2])
    if found[1] == "%":
        return lambda count: count % number == 0
    compare = {"": eq, "==": eq, ">=": ge, "<=": le, ">": gt, "<": lt}[found[1]]
    return lambda count: bool(compare(count, number))


def _parsed(text: str, *, statements: bool) -> ast.Expression | ast.Module:
    """Returns an expression; if need be and wanted, statements. Raises SyntaxError, ValueError."""
    try:
        return ast.parse(text, mode="eval")
    except SyntaxError:
        if not statements:
            raise
        return ast.parse(text)


def _may_change(tree: ast.Expression | ast.Module) -> bool:
    """Returns whether more than names, attributes, items and arithmetic is evaluated."""
    return isinstance(tree, ast.Module) or any(isinstance(n, ast.Call | ast.NamedExpr) for n in ast.walk(tree))


def _evaluated(tree: ast.Expression | ast.Module, frame: FrameType) -> Any:
    """Returns the value of an expression in a frame; None for statements, which may assign to its variables. Raises
    what is raised there."""
    code = compile(tree, "<console>", "exec" if isinstance(tree, ast.Module) else "eval")
    try:
        return eval(code, frame.f_globals, frame.f_locals)
    finally:
        if sys.version_info < (3, 13):  # `f_locals` is a copy there
            ctypes.pythonapi.PyFrame_LocalsToFast(ctypes.py_object(frame), ctypes.c_int(0))


def _at(wanted: int, why: str) -> Stops:
    return lambda frame, count: why if count == wanted else ""


def _everywhere(frame: FrameType, count: int) -> str:
    return "step"


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
