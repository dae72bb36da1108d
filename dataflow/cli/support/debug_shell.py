"""The prompt of `dataflow debug`."""

from __future__ import annotations

import ast
import cmd
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from itertools import chain, count, takewhile
from rlcompleter import Completer
from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.text import Text

from dataflow.cli.support.output import out, plural, print_json_line, say
from dataflow.cli.support.verdicts import difference_text
from dataflow.debugging.fired import described
from dataflow.messages.base import Message
from dataflow.messages.display.text import field_text
from dataflow.sync.entries import entries_of

if TYPE_CHECKING:
    from dataflow.debugging.debugger import Debugger, UnrepeatableCalls
    from dataflow.debugging.fired import RepeatedCall
    from dataflow.view import ViewerSink

MOST_FIELDS = 8
"""Fields that are shown of an output that differs."""


_PART = re.compile(r"""\b(before|after)((?:\[[^\[\]]+\])*)\[(["'])$""")
"""The beginning of a key of a state, or of a part of it, behind its quote."""


class WrongCommand(ValueError):
    """A line that cannot be done; the message has what would be right."""


class Shell(cmd.Cmd):
    """Reads lines, goes there, and prints what is there.

    `origin`: the stamp of 0 s, ns; `json`: calls are printed as one JSON object a line; `viewer`: draws what the calls
    that are gone to were given and made.
    """

    prompt = "(dataflow) "
    doc_header = "Commands (help COMMAND shows more)"

    def __init__(
        self, debugger: Debugger, origin: int, *, json: bool = False, viewer: ViewerSink | None = None
    ) -> None:
        super().__init__()
        self._debugger, self._origin, self._json, self._viewer = debugger, origin, json, viewer
        self.failed = False
        """True when the last line could not be done."""

    @property
    def calls(self) -> int:
        """The number of calls of the operator."""
        return len(self._debugger.calls)

    # ------------------------------------------------------------------------------------------------- going

    def do_goto(self, line: str) -> None:
        """goto N | goto @SECONDS | goto -1      to call N (0 is the first, -1 the last), or the last one by then"""
        self._show(self._debugger.goto(self.number(line)))

    def do_next(self, line: str) -> None:
        """next [N]      one call on, or N"""
        self._show(self._debugger.goto(self._here() + _count(line)))

    def do_back(self, line: str) -> None:
        """back [N]      one call back, or N"""
        self._show(self._debugger.goto(max(0, self._here() - _count(line))))

    def do_until(self, line: str) -> None:
        """until EXPRESSION      on to the next call for which a Python expression is true

        It sees inp and out (by input and output: out.boxes), stamp (ns), number, same (as recorded), error. An input or
        output without a message is None; where the expression raises because of that, it is not true.
        Example: until len(out.detections.boxes) > 3
        """
        try:
            code = compile(line, "<until>", "eval")
        except SyntaxError as error:
            raise WrongCommand(f"until {line}: no Python expression: {error.msg}") from None
        lacking: list[str] = []
        looked_at = 0

        def is_so(fired: RepeatedCall) -> bool:
            nonlocal looked_at
            try:
                found = bool(eval(code, fired.names()))
            except Exception as error:
                told = f"{line} at call {fired.number}: {type(error).__name__}: {error}"
                if not fired.lacks_for(error):
                    raise WrongCommand(told) from None
                lacking.extend([told] if fired.call.kind != "finish" else [])
                return False
            looked_at += 1
            return found

        found = self._debugger.until(is_so)
        unmade = self._debugger.unmade
        if found is not None:
            self._show(found, unmade)
        elif lacking and not looked_at:
            raise WrongCommand(f"in no call after this one is there what it needs: {lacking[0]}")
        elif unmade is not None:
            raise WrongCommand(f"no call after this one that can be made is so: {line}; {unmade}")
        else:
            out.print(f"no call after this one is so: {escape(line)}")
        if lacking:
            calls = plural(len(lacking), "call")
            say(f"[yellow]note:[/] not so where there is nothing, in {calls}: {escape(lacking[0])}")

    def do_diff(self, line: str) -> None:
        """diff      to the first call of all that does not give what was recorded"""
        found = self._debugger.first_difference()
        if found is None:
            if (unmade := self._debugger.unmade) is not None:
                raise WrongCommand(f"{plural(self.calls - unmade.count, 'call')} as recorded; {unmade}")
            out.print(f"{plural(self.calls, 'call')}: all give what was recorded")
        else:
            self._show(found, self._debugger.unmade)
            if not self._json:
                words = (
                    f"dataflow capture {self._debugger.path} --op {self._debugger.node.name} --firing {found.number}"
                )
                out.print(Text(f"  as a test: {words}", style="dim"), soft_wrap=True)

    # ------------------------------------------------------------------------------------------------- looking

    def do_show(self, line: str) -> None:
        """show      the call where we are"""
        self._show(self._fired())

    def do_inputs(self, line: str) -> None:
        """inputs [NAME]      the fields of what the call was given"""
        self._messages(self._fired().inputs, line)

    def do_outputs(self, line: str) -> None:
        """outputs [PORT]      the fields of what the call made"""
        self._messages(self._fired().outputs, line)

    def do_state(self, line: str) -> None:
        """state [PART]      the parts of the state that the call changed, before and after; or one part"""
        fired = self._fired()
        before, after = fired.states()
        if before is None or after is None:
            raise WrongCommand(self._debugger.no_state())
        if line and line not in {*before, *after}:
            raise WrongCommand(f"no part {line!r}; there are: {', '.join(sorted({*before, *after}))}")
        pairs = [(line, before.get(line), after.get(line))] if line else fired.changes()
        for name, was, now in pairs:
            out.print(Text.assemble((f"{name}\n", "bold"), f"  before  {_plain(was)}"), soft_wrap=True)
            out.print(Text(f"  after   {_plain(now)}"), soft_wrap=True)

    def do_print(self, line: str) -> None:
        """print EXPRESSION      the value of a Python expression, which also sees before and after, the states"""
        fired = self._fired()
        before, after = fired.states()
        value = _evaluated(line, line, {**fired.names(), "before": before, "after": after})
        out.print(Text(field_text(value)), soft_wrap=True)

    do_p = do_print

    # ------------------------------------------------------------------------------------------------- again

    def do_again(self, line: str) -> None:
        """again      take over edited source, make the call once more from the same state, and compare"""
        changed = self._debugger.reload()
        out.print(f"[dim]taken over: {', '.join(changed)}[/]" if changed else "[dim]no source has changed[/]")
        self._show(self._debugger.again())

    def do_step(self, line: str) -> None:
        """step      make the call once more under pdb, from its first line"""
        self._show(self._debugger.step_into())

    def do_quit(self, line: str) -> bool:
        """quit      leave"""
        return True

    do_q = do_exit = do_EOF = do_quit

    # ------------------------------------------------------------------------------------------------- the loop

    def converse(self, intro: str) -> None:
        """Asks for lines until one leaves; Ctrl-C clears a line."""
        while True:
            try:
                self.cmdloop(intro)
                return
            except KeyboardInterrupt:
                out.print()
                intro = ""

    def onecmd(self, line: str) -> bool:
        """Does the command of a line. An error is printed, and the loop goes on."""
        from dataflow.execution.failure import OperatorFailure
        from dataflow.recording import RecordingError
        from dataflow.reexecution.engine import ReexecutionStalled
        from dataflow.reexecution.recorded_run import ReplayError

        self.failed = False
        try:
            return bool(super().onecmd(line))
        except (WrongCommand, ReplayError, RecordingError, OperatorFailure, ReexecutionStalled) as error:
            self.failed = True
            out.print(Text.assemble(("error: ", "bold red"), str(error)), soft_wrap=True)
        except KeyboardInterrupt:
            self.failed = True
            out.print("[yellow]interrupted[/]")
        return False

    def default(self, line: str) -> None:
        word = line.split()[0]
        raise WrongCommand(f"no command {word!r}; there are: {', '.join(self._words())}")

    def emptyline(self) -> bool:
        return False

    def completenames(self, text: str, *ignored: Any) -> list[str]:
        return [word for word in self._words() if word.startswith(text)]

    def _complete_input(self, text: str, *ignored: Any) -> list[str]:
        return [n for n in self._debugger.node.inputs if n.startswith(text)]

    def _complete_output(self, text: str, *ignored: Any) -> list[str]:
        return [n for n in self._debugger.node.outputs if n.startswith(text)]

    def _complete_part(self, text: str, *ignored: Any) -> list[str]:
        states = (None, None) if self._debugger.at is None else self._debugger.at.states()
        return sorted(n for n in {*(states[0] or ()), *(states[1] or ())} if n.startswith(text))

    def _complete_expression(self, text: str, line: str, begins: int, ends: int) -> list[str]:
        at = self._debugger.at
        head = line[:begins]
        if (quoted := _PART.search(head)) is not None:
            before, after = (None, None) if at is None else at.states()
            keys = _keys(before if quoted[1] == "before" else after, quoted[2])
            return [key for key in keys if key.startswith(text)]  # readline closes the quote
        if head.count('"') % 2 or head.count("'") % 2:
            return []
        names = {} if at is None else at.names() | dict.fromkeys(("before", "after"))
        completer = Completer(names)
        found = takewhile(bool, (completer.complete(text, n) for n in count()))
        return [word for word in found if word is not None and (text or word in names)]

    complete_inputs, complete_outputs, complete_state = _complete_input, _complete_output, _complete_part
    complete_until = complete_print = complete_p = _complete_expression

    def _words(self) -> list[str]:
        names = (name.removeprefix("do_") for name in self.get_names() if name.startswith("do_"))
        return sorted(n for n in names if n not in ("EOF", "p", "q"))

    def number(self, word: str) -> int:
        """The number of a call that a word names: N, @SECONDS, or OPERATOR@SECONDS of the operator that is here."""
        operator, at_time, number = word.rpartition("@")
        here = self._debugger.node.name
        if operator and operator != here and not here.endswith(f"/{operator}"):
            raise WrongCommand(f"goto {word}: the operator here is {here}; expected the number of a call, or @SECONDS")
        try:
            value = float(number) if at_time else int(number)
            return self._debugger.number_at(self._origin + round(value * 1e9)) if at_time else int(value)
        except (ValueError, OverflowError):
            raise WrongCommand(f"goto {word}: expected the number of a call, or @SECONDS") from None

    def _here(self) -> int:
        return -1 if self._debugger.at is None else self._debugger.at.number

    def _fired(self) -> RepeatedCall:
        if self._debugger.at is None:
            raise WrongCommand("no call was made yet: goto one")
        return self._debugger.at

    def _show(self, fired: RepeatedCall, unmade: UnrepeatableCalls | None = None) -> None:
        """Shows a call. `unmade`: calls that the search for it has passed by, of which one may be meant as well."""
        if self._json:
            more = {} if unmade is None else {"not_made": asdict(unmade)}
            print_json_line(fired.as_json(self._debugger.node.name, self._origin) | more)
        else:
            for line in self.lines(fired):  # the state may take a moment longer than the rest
                out.print(line, soft_wrap=True)
            if unmade is not None:
                out.print(Text(f"  on the way to it {unmade}", style="yellow"), soft_wrap=True)
        if self._viewer is not None and fired.firing is not None:
            given = (entry for value in fired.firing.inputs.values() for entry in entries_of(value))
            made = ((made.stream, made.here) for made in fired.made if made.here is not None)
            for stream, message in chain(((entry.stream, entry.value) for entry in given), made):
                self._viewer.log(stream, message)

    def lines(self, fired: RepeatedCall) -> Iterator[Text]:
        """A call in some lines: when it was, what was given, what came out, what it changed."""
        of = f"call {fired.number} of {len(self._debugger.calls)}"
        when = (fired.call.stamp - self._origin) * 1e-9
        how = f"{fired.call.kind} at {when:.3f} s" if fired.call.kind != "finish" else "finish"
        verdict = ("as recorded", "green") if fired.same else ("not as recorded", "red")
        yield Text.assemble((self._debugger.node.name, "bold"), f"  {of}, {how}: ", verdict)
        if fired.injected:
            yield Text("  the run tried out a fault here: the operator was not called")
        for name, value in fired.inputs.items():
            yield Text(f"  given    {name:<14} {described(value, self._origin)}")
        for made in fired.made:
            what = "identical" if made.same else _difference(made.here, made.recorded)
            yield Text.assemble(
                f"  made     {made.port:<14} {described(made.here, self._origin)}  ", (what, "" if made.same else "red")
            )
            for field in made.fields[:MOST_FIELDS]:
                yield Text(f"             {difference_text(field)}")
            if len(made.fields) > MOST_FIELDS:
                yield Text(f"             and {plural(len(made.fields) - MOST_FIELDS, 'more field')}")
        if fired.before is not None:
            yield Text(f"  changed  {', '.join(fired.changed()) or 'nothing'} of its state")
        if fired.error is not None or fired.recorded_error is not None:
            yield Text(f"  recorded {fired.recorded_error or 'no error'}")
            yield Text.assemble("  raised   ", (fired.error or "nothing", "red"))

    def _messages(self, messages: Mapping[str, Any], name: str) -> None:
        if name and name not in messages:
            raise WrongCommand(f"no {name!r} here; there are: {', '.join(messages)}")
        for key, value in messages.items():
            if not name or key == name:
                out.print(Text.assemble((key, "bold"), f"  {described(value, self._origin)}"), soft_wrap=True)
                for message in _each(value):
                    for field, held in message.items():
                        out.print(Text(f"  {field:<20} {field_text(held)}"), soft_wrap=True)


def _each(value: Any) -> Iterator[Message]:
    match value:
        case Message():
            yield value
        case Mapping():
            yield from value.values()
        case tuple():
            yield from value
        case _:
            return


def _difference(here: Message | None, recorded: Message | None) -> str:
    if here is None:
        return "differs: a message was recorded, nothing came now"
    return "differs from the recorded one" if recorded is not None else "differs: nothing, or another one, was recorded"


def _count(line: str) -> int:
    if line and not line.isdigit():
        raise WrongCommand(f"{line}: expected how many calls")
    return int(line or 1)


def _evaluated(code: Any, text: str, names: dict[str, Any]) -> Any:
    try:
        return eval(code, names)
    except Exception as error:
        raise WrongCommand(f"{text}: {type(error).__name__}: {error}") from None


def _keys(state: Any, path: str) -> list[str]:
    """Returns the names in a part of a state, which the path leads to ('["motion"][3]')."""
    try:
        for key in re.findall(r"\[([^\[\]]+)\]", path):
            state = state[ast.literal_eval(key)]
    except (LookupError, TypeError, ValueError, SyntaxError):
        return []
    return [key for key in state if isinstance(key, str)] if isinstance(state, Mapping) else []


def _plain(value: Any) -> str:
    text = field_text(value)
    return text if len(text) <= 400 else f"{text[:400]}… {len(text):,} characters in all"
