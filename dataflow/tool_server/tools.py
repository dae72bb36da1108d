"""The tools: what each takes, and how the library answers it. They run in a process for each call (`work`)."""

from __future__ import annotations

import ast
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dataflow.execution.failure import cut

if TYPE_CHECKING:
    from dataflow.debugging.debugger import Debugger
    from dataflow.debugging.fired import RepeatedCall
    from dataflow.graph import Graph
    from dataflow.recording import Recording
    from dataflow.tool_server.proof import Changes
    from dataflow.verification.report import VerifyReport

MOST_CALLS = 200
"""Calls that `history` shows."""
MOST_CHANGED = 50
"""Changed calls that `prove` names."""
MOST_ERRORS = 8
"""Errors of calls that it names."""

CallName = str | int
"""The number of a call, or in text also "@SECONDS" and "diff"."""
Say = Callable[[str], None]
"""Takes a line about how far the work is."""


class ToolError(ValueError):
    """Raised for arguments that do not fit; the message has what would be right."""


def verify(recording: str, only: list[str] | None = None, graph: str | None = None) -> Any:
    """Re-execute a recorded run with the code as it is now and compare every output, bit for bit.

    A culprit was given the recorded inputs and made another output; `first` is its first differing call, with the
    field; its `call` is the number for the other tools. `only`: these operators; `graph`: a graph file in place of
    the recorded graph; `path`: folders of modules.
    """
    return _verified(_verify(_file(recording), only, _loaded(graph)))


def why(recording: str, operator: str, graph: str | None = None, *, say: Say) -> Any:
    """Find why a culprit of `verify` does not repeat: at most 8 re-runs of it with clocks, random numbers, threads,
    hashes, memory and files fixed in turn. Gives causes with the lines that led to them."""
    from dataflow.causes.ladder import MOST
    from dataflow.causes.why import why as find
    from dataflow.verification.workers.processes import call_workers

    runs = count(1)

    def told(*arguments: Any, **named: Any) -> Any:
        say(f"re-run {next(runs)} of at most {MOST}")
        return call_workers(*arguments, **named)

    file, loaded = _file(recording), _loaded(graph)
    report = _verify(file, [operator], loaded)
    return find(file, report, operator, graph=loaded, workers=told).as_json()


def goto(recording: str, operator: str, call: CallName, graph: str | None = None) -> Any:
    """Make one recorded call of an operator again: what it was given, made, and changed, against the recording.

    `call`: its number (0 is the first, -1 the last), "@12.3" (the last one by 12.3 s), or "diff" (the first that does
    not give what was recorded).
    """
    with _debugger(recording, operator, graph) as (debugger, origin, _):
        return _shown(_at(debugger, origin, call), debugger, origin)


def diff(recording: str, operator: str, graph: str | None = None) -> Any:
    """Go to the first call of an operator that does not give what was recorded, and show it as `goto` does. Where all
    give it, `same` is true."""
    with _debugger(recording, operator, graph) as (debugger, origin, _):
        found = debugger.first_difference()
        if found is None and debugger.unmade is None:
            return {"operator": debugger.node.name, "same": True, "of": len(debugger.calls)}
        return _shown(_at(debugger, origin, "diff") if found is None else found, debugger, origin)


def state(recording: str, operator: str, call: CallName, part: str = "", graph: str | None = None) -> Any:
    """Show the state of an operator before and after a call (as in `goto`): the parts it changed, or the one named."""
    with _debugger(recording, operator, graph) as (debugger, origin, _):
        fired = _at(debugger, origin, call)
        before, after = fired.states()
        if before is None or after is None:
            raise ToolError(debugger.no_state())
        if part and part not in {*before, *after}:
            raise ToolError(f"no part {part!r} in the state; there are: {', '.join(sorted({*before, *after}))}")
        pairs = [(part, before.get(part), after.get(part))] if part else list(fired.changes())
        shown = {name: {"before": _text(was), "after": _text(now)} for name, was, now in pairs}
        return {"call": fired.number, "parts": sorted({*before, *after}), "part" if part else "changed": shown}


def lines(recording: str, operator: str, call: CallName = "diff", graph: str | None = None) -> Any:
    """Name the lines that can have made a call of an operator other than recorded (`call` as in `goto`).

    `changes`: where the operator's code differs from that which was recorded, as far as that is in git's commits or was
    replaced by a reload (`recorded_code`); first those without which the call gives what was recorded (`mends`), or a
    smallest set of them where that takes several (`together`), then those that ran in it. `raised`: the line of its
    error. `alone`: the lines that ran in it and in none of the 8 calls before. `ran`, where there are no changes: all
    its lines.
    """
    from dataflow.debugging.suspects import ranges, suspects

    with _debugger(recording, operator, graph) as (debugger, origin, opened):
        found = suspects(opened, debugger, _at(debugger, origin, call).number)
    values = {
        "call": found.number,
        "same": found.same,
        "raised": found.raised,
        "recorded_code": {name: where or "not found" for name, where in found.modules.items()},
        "changes": [asdict(change) for change in found.changes],
        "alone": ranges(found.alone),
    }
    return values if found.changes else values | {"ran": ranges(found.ran)}


def history(recording: str, operator: str, field: str, first: int = 0, last: int = -1, graph: str | None = None) -> Any:
    """Give the value of a Python expression over the calls of an operator, from number `first` to `last`.

    It sees inp, out (by input and port: "len(out.tracks.ids)"), stamp, number, same, error. Calls that give the same
    value as the one before are left out; at most 200 are given. Where it fails, the error is the value; it is an error
    where it fails in all.
    """
    from dataflow.execution.failure import readable

    with _debugger(recording, operator, graph) as (debugger, *_):
        code = _compiled("field", field)
        begin, end = (debugger.number(number) for number in (first, last))
        values: list[dict[str, Any]] = []
        before: Any = None

        def visit(fired: RepeatedCall) -> bool:
            nonlocal before
            try:
                value = eval(code, fired.names())
                shown = _text(value)
            except Exception as error:  # such as of an output that this call did not make
                value = shown = {"error": readable(error)}
            if not values or not _alike(value, before):
                values.append({"call": fired.number, "stamp": fired.call.stamp, "value": shown})
            before = value
            return len(values) == MOST_CALLS

        found = debugger.until(visit, first=begin, last=end)
        reached, not_made = end if found is None else found.number, _not_made(debugger)
        if not values and debugger.unmade is not None:
            raise ToolError(f"{debugger.node.name}, calls {begin} to {end}: {debugger.unmade}")
        if all(isinstance(each["value"], dict) for each in values):  # it fails in every call
            _evaluated(code, field, debugger.goto(begin).names())
    rest = {} if reached == end else {"next": f"history with first={reached + 1} goes on"}
    return {"field": field, "calls": [begin, reached], "changes": values} | not_made | rest


def what_if(
    recording: str,
    operator: str,
    call: CallName,
    params: dict[str, Any] | None = None,
    show: str = "",
    graph: str | None = None,
) -> Any:
    """Make one call of an operator again with other parameters, or with its source as it was edited, from the recorded
    inputs and state; compare with the recording.

    `params`: values by name, such as {"threshold": 0.3}; `show`: a Python expression over the call, which also sees
    before and after, the states.
    """
    with _debugger(recording, operator, graph, params) as (debugger, origin, _):
        fired = _at(debugger, origin, call)
        found = _shown(fired, debugger, origin)
        if show:
            found["show"] = _text(_evaluated(_compiled("show", show), show, _names(fired)))
        return found


def capture(
    recording: str,
    operator: str,
    to: str,
    call: CallName | None = None,
    predicate: str = "",
    graph: str | None = None,
    path: list[str] | None = None,
) -> Any:
    """Write a wrong call of an operator as a pytest file with the smallest inputs that still show it.

    `to`: the file, which must not exist (test_NAME.py; its data lie beside it). `call`: as in `goto`, by default
    the first wrong one. `predicate`: a Python expression, true of a wrong call; by default: not as recorded, or error.
    """
    from dataflow.capture.capture import capture as find
    from dataflow.capture.capture import write_test

    file = Path(to)
    if file.suffix != ".py" or file.exists() or not file.parent.is_dir():
        raise ToolError(f"to={to!r}: expected a new file that ends in .py, in a folder that exists")
    if predicate:
        _compiled("predicate", predicate)
    with _debugger(recording, operator, graph) as (debugger, origin, opened):
        found = find(opened, debugger, None if call is None else _at(debugger, origin, call).number, predicate)
    words = ["dataflow", "capture", Path(recording).name, "--op", operator, "--firing", str(found.number)]
    words += ["--predicate", predicate] * bool(predicate) + ["--graph", graph or ""] * bool(graph)
    words += [word for folder in path or () for word in ("--path", folder)]
    nbytes = write_test(found, file, Path(recording).name, shlex.join(words))
    kept = {"call": found.number, "calls": found.calls, "kept": found.left, "begins": found.begins}
    return {"test": to, "wrong": found.wrong, "bytes": nbytes} | kept


def blame(recording: str, field: str, budget: float = 60.0, graph: str | None = None, *, say: Say) -> Any:
    """Find what decided a value: the chain of calls back to the sensors' messages, each shown by re-execution.

    `field`: STREAM.FIELD@SECONDS, such as "tracks.ids[3]@12.4"; `budget`: seconds to look for it. Where `whole` of the
    answer is false, `sensed` may lack what decided: nothing that was tried shows it, or not all could be tried.
    """
    from dataflow.blame.chain import Blame
    from dataflow.blame.field import Field
    from dataflow.recording import Recording

    def watch(made: int, links: int) -> None:
        say(f"{made} calls made again, {links} links found")

    with Recording(_file(recording)) as opened:
        found = Blame(opened, Field.parse(field), _loaded(graph), budget=budget, watch=watch)
        return found.find().as_json()


def drops(recording: str, worse: str, budget: float = 60.0, graph: str | None = None, *, say: Say) -> Any:
    """Find a smallest set of drops, late messages and timeouts of a live run without which its figures are not bad.

    `worse`: a Python expression over the figures, true where they are bad: "ate_rmse_m > 0.05"; `budget`: seconds.
    """
    from dataflow.drops.search import Drops, NothingLost
    from dataflow.recording import Recording

    def watch(replays: int, left: int) -> None:
        say(f"{replays} replays; losses undone in the next one: {left}")

    _compiled("worse", worse)
    with Recording(_file(recording)) as opened:
        try:
            return Drops(opened, worse, _loaded(graph), budget=budget, watch=watch).find().as_json()
        except NothingLost as told:
            return {"named": [], "losses": 0, "told": str(told)}


def prove(
    recording: str,
    operator: str,
    call: CallName,
    expect: str,
    may_change: str = "True",
    right: str | None = None,
    params: dict[str, Any] | None = None,
    graph: str | None = None,
    path: list[str] | None = None,
    *,
    say: Say,
) -> Any:
    """Check a fix (edited source, or `params`): it changes what it should, and nothing else.

    Proven is a fix by which the call gives another result than the recorded one, for which `expect` is true, all other
    calls of the operator that change are such that `may_change` is true, none raises an error that is not the recorded
    one (unless the expression names `error`), and every other operator that is given the recorded inputs makes what was
    recorded. Both are Python expressions over a call: inp, out, stamp, number, same, error; `expect` also sees before
    and after, the states. `call`: as in `goto`. `right`: a recording that right code made: the operator makes all that
    is recorded there, too. Operators that do not repeat with the recorded code either are named, and not judged.
    Nothing is proven where calls could not be made again.
    """
    from dataflow.recording import Recording
    from dataflow.reexecution.recorded_run import graph_that_is_here
    from dataflow.tool_server.jobs import answered_there
    from dataflow.tool_server.proof import judge

    asked = {"recording": recording, "operator": operator, "call": call, "expect": expect, "may_change": may_change}
    made = answered_there(mended, asked | {"alone": right is None, "params": params, "graph": graph, "path": path}, say)
    name, number, with_graph = made["operator"], made["call"], _loaded(graph)
    say("all operators are verified")
    with Recording(_file(recording)) as opened:
        with_graph = _with(with_graph, opened, operator, params) if params else with_graph
        report = _verify(_file(recording), None, with_graph)
        others = judge(opened, report, graph_that_is_here(opened)[0] if with_graph is None else with_graph, name)
    of_right = "identical" if right is None else _verdict(_file(right), name, with_graph)
    reasons = [
        *(() if made["differs"] else [f"call {number} still gives what was recorded"]),
        *(() if made["meets"] else [f"call {number}: expect is false: {expect}"]),
        *([f"calls raise what is not recorded: {dict(raised[:MOST_ERRORS])}"] if (raised := made["raised"]) else ()),
        *([f"calls that may not change do: {made['refused'][:MOST_CHANGED]}"] if made["refused"] else ()),
        *([f"{name}: {made['unmade']}"] if made["unmade"] else ()),
        *([f"{name} does not repeat: it differs each time"] if report.repeats(name) is False else ()),
        *([f"other operators: {others.reasons}"] if others.reasons else ()),
        *([f"{name} in {right}: {of_right}"] if of_right != "identical" else ()),
    ]
    changed = made["changed"]
    return {
        "proven": not reasons,
        "reasons": reasons,
        "do_not_repeat": others.unrepeated,
        "changed_calls": {"count": len(changed), "of": made["calls"], "first": changed[:MOST_CHANGED]}
        | made["not_made"],
        "other_operators": _by_verdict(report, name),
        "call": made["shown"],
    }


def mended(
    recording: str,
    operator: str,
    call: CallName,
    expect: str,
    may_change: str,
    alone: bool,
    params: dict[str, Any] | None,
    graph: str | None,
    *,
    say: Say,
) -> Any:
    """Make all calls of an operator that was mended, for `prove`. `alone`: there is no recording of right code."""
    expected, _ = _compiled("expect", expect), _compiled("may_change", may_change)
    with _debugger(recording, operator, graph, params) as (debugger, origin, _):
        fired = _at(debugger, origin, call)
        number = fired.number
        if alone and _is_true_then(expected, fired):
            told = "is true of what was recorded as well: expected what is right in this call, and was not"
            raise ToolError(f"expect={expect!r} {told}")
        meets, differs = bool(_evaluated(expected, expect, _names(fired))), not fired.same
        shown = _shown(fired, debugger, origin)
        say(f"call {number} of {debugger.node.name} made again; all its calls follow")
        changes = _changes(debugger, number, expect, may_change)
        found = {"operator": debugger.node.name, "call": number, "calls": len(debugger.calls), "shown": shown}
        unmade = {"unmade": str(debugger.unmade or ""), "not_made": _not_made(debugger)}
        return found | unmade | {"meets": meets, "differs": differs} | asdict(changes)


def _changes(debugger: Debugger, number: int, expect: str, may_change: str) -> Changes:
    """Returns the calls that a fix changes; that of `number` may change."""
    from dataflow.tool_server.proof import changes_of

    allowed, raises = _compiled("may_change", may_change), {True: expect, False: may_change}
    return changes_of(
        debugger,
        lambda each: each.number == number or bool(_evaluated(allowed, may_change, each.names())),
        lambda each: "error" in _named_in(raises[each.number == number]),
    )


TOOLS: Mapping[str, Callable[..., Any]] = {
    each.__name__: each
    for each in (verify, why, goto, diff, lines, state, history, what_if, capture, blame, drops, prove)
}


PARTS: Mapping[str, Callable[..., Any]] = {"mended": mended}
"""Parts of tools that have their own process."""


def answer(name: str, arguments: Mapping[str, Any], say: Say) -> Any:
    """Answers one call of a tool, or of a part of one, by values that JSON can hold. Raises what the library raises."""
    import inspect

    from dataflow.graph.search import add_current_folder, add_folder

    for folder in arguments.get("path") or ():
        if not Path(folder).is_dir():
            raise ToolError(f"path: no such folder: {folder}")
        add_folder(folder)
    add_current_folder()
    tool = {**TOOLS, **PARTS}[name]
    unused = {"path", "say"} - inspect.signature(tool).parameters.keys()
    return tool(**{name: value for name, value in {**arguments, "say": say}.items() if name not in unused})


# ------------------------------------------------------------------------------------------------- inside


def _file(recording: str) -> Path:
    file = Path(recording)
    if not file.is_file():
        near = sorted(str(each) for each in file.parent.glob("*.mcap"))[:5] if file.parent.is_dir() else []
        raise ToolError(f"no recording {recording}; beside it: {', '.join(near) or 'none'}")
    return file


def _loaded(graph: str | None) -> Graph | None:
    from dataflow.graph import load_graph

    return None if graph is None else load_graph(graph)


def _verify(file: Path, only: Sequence[str] | None, graph: Graph | None) -> VerifyReport:
    from dataflow.verification.verify import verify as verify_recording

    return verify_recording(file, graph=graph, only=only or None)


def _verdict(file: Path, operator: str, graph: Graph | None) -> str:
    """Returns the verdict of verification on one operator, or which of its calls could not be made."""
    from dataflow.tool_server.proof import unmade

    report = _verify(file, [operator], graph)
    found = next((v for v in report.operators if v.operator == operator), None)
    return "not re-executed" if found is None else unmade(found) or report.verdict(found)


def _by_verdict(report: VerifyReport, but: str = "") -> dict[str, list[str]]:
    from dataflow.tool_server.proof import unmade

    found: dict[str, list[str]] = {}
    for v in report.operators:
        if v.operator != but:
            verdict = report.verdict(v)
            words = "identical up to the cut" if verdict == "identical" and unmade(v) else verdict
            found.setdefault(words, []).append(v.operator)
    return found


def _verified(report: VerifyReport) -> dict[str, Any]:
    """Returns the report; of operators that are identical, and of which all calls were made, the names alone."""
    from dataflow.tool_server.proof import unmade

    values = report.as_json()
    values["verdicts"] = _by_verdict(report)
    values["not_made"] = {v.operator: told for v in report.operators if (told := unmade(v))}
    values["operators"] = [each for each in values["operators"] if each["verdict"] != "identical"]
    return {name: value for name, value in values.items() if value not in ([], {}, None)}


@contextmanager
def _debugger(
    recording: str, operator: str, graph: str | None, params: Mapping[str, Any] | None = None
) -> Iterator[tuple[Debugger, int, Recording]]:
    """Opens a debugger, with the stamp of 0 s and the recording."""
    from dataflow.debugging.debugger import Debugger
    from dataflow.execution.feeds.playable import span_of
    from dataflow.recording import Recording

    with Recording(_file(recording)) as opened:
        loaded = _loaded(graph)
        if params:
            loaded = _with(loaded, opened, operator, params)
        debugger = Debugger(opened, operator, loaded)
        try:
            yield debugger, (span_of(opened, opened.streams) or (0, 0))[0], opened
        finally:
            debugger.close()


def _with(graph: Graph | None, recording: Recording, operator: str, params: Mapping[str, Any]) -> Graph:
    """Returns the graph with other parameters of one operator."""
    from dataflow.operator import validate_parameters
    from dataflow.reexecution.recorded_run import graph_that_is_here

    graph = graph_that_is_here(recording)[0] if graph is None else graph
    names = [name for name in graph.nodes if name == operator or name.endswith(f"/{operator}")]
    if len(names) != 1:
        raise ToolError(f"no operator {operator!r} in the graph; there are: {', '.join(sorted(graph.nodes))}")
    node = graph.nodes[names[0]]
    changed = {**node.params, **params}
    validate_parameters(node.operator, changed)
    return replace(graph, nodes={**graph.nodes, node.name: replace(node, params=changed)})


def _at(debugger: Debugger, origin: int, call: CallName) -> RepeatedCall:
    if call == "diff":
        if (found := debugger.first_difference()) is not None:
            return found
        if (unmade := debugger.unmade) is not None:
            made = len(debugger.calls) - unmade.count
            raise ToolError(f"{debugger.node.name}: {made} calls give what was recorded; {unmade}")
        raise ToolError(f"{debugger.node.name}: all {len(debugger.calls)} calls give what was recorded")
    text = str(call)
    try:
        at_time = text.startswith("@")
        number = debugger.number_at(origin + round(float(text[1:]) * 1e9)) if at_time else int(text)
    except (ValueError, OverflowError):
        raise ToolError(f'call={call!r}: expected a number such as 7 or -1, "@SECONDS" or "diff"') from None
    return debugger.goto(number)


def _shown(fired: RepeatedCall, debugger: Debugger, origin: int) -> dict[str, Any]:
    given = {m.port: _fields(m.here) for m in fired.made}
    more = {"of": len(debugger.calls), "made": given} | _not_made(debugger)
    return fired.as_json(debugger.node.name, origin) | more


def _not_made(debugger: Debugger) -> dict[str, Any]:
    """Returns what the last search has passed by, since it cannot be made again; nothing where there is nothing."""
    return {} if debugger.unmade is None else {"not_made": asdict(debugger.unmade)}


def _fields(message: Any) -> Any:
    return None if message is None else {name: _text(value) for name, value in message.items()}


def _names(fired: RepeatedCall) -> dict[str, Any]:
    before, after = fired.states()
    return fired.names() | {"before": before, "after": after}


def _text(value: Any) -> Any:
    """A value as JSON has it: numbers as they are, those of numpy by their own digits, mappings of strings, anything
    else in words."""
    import numpy as np

    from dataflow.messages.display.text import field_text

    if isinstance(value, np.floating):
        return float(str(value))
    if isinstance(value, np.bool_ | np.integer):
        return value.item()
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _text(each) for key, each in value.items()}
    return value if value is None or isinstance(value, bool | int | float) else field_text(value)


def _alike(value: Any, other: Any) -> bool:
    """Returns whether two values of an expression are the same; NaN is the same as NaN."""
    import numpy as np

    if isinstance(value, np.ndarray) and isinstance(other, np.ndarray):
        return (value.dtype, value.shape) == (other.dtype, other.shape) and value.tobytes() == other.tobytes()
    if isinstance(value, list | tuple) and type(value) is type(other):
        return len(value) == len(other) and all(map(_alike, value, other))
    if isinstance(value, Mapping) and isinstance(other, Mapping):
        return value.keys() == other.keys() and all(_alike(value[key], other[key]) for key in value)
    try:
        return bool(value == other or (value != value and other != other))
    except Exception:  # such as an array beside a number
        return False


def _compiled(argument: str, text: str) -> Any:
    try:
        return compile(text, f"<{argument}>", "eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        told = getattr(error, "msg", "") or str(error) or type(error).__name__
        raise ToolError(f"{argument}={cut(text, 200)!r}: no Python expression: {told}") from None


def _named_in(expression: str) -> set[str]:
    return {node.id for node in ast.walk(ast.parse(expression, mode="eval")) if isinstance(node, ast.Name)}


def _is_true_then(code: Any, fired: RepeatedCall) -> bool:
    """Returns whether an expression is true of a call as it was recorded, or only because it differs from that, as far
    as that is known: not what is in the state behind it, nor what is in no recorded stream."""
    names = fired.names_then() | {"before": fired.states()[0], "after": object()}
    for same in (True, False):
        try:
            if eval(code, names | {"same": same}):
                return True
        except Exception:  # it needs what is not known, or what the recorded call did not make
            continue
    return False


def _evaluated(code: Any, text: str, names: dict[str, Any]) -> Any:
    try:
        return eval(code, names)
    except Exception as error:
        parts = [f"{n}.{m}" for n in ("inp", "out") for m in vars(names[n])]
        there = ", ".join(parts + [f"{n}[{m!r}]" for n in ("before", "after") for m in names.get(n) or ()])
        raise ToolError(
            f"{text} at call {names['number']}: {type(error).__name__}: {error}; there are: {there}"
        ) from None
