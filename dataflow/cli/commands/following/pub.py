"""`dataflow pub`: messages into a running graph."""

from __future__ import annotations

import json as json_module
import sys
import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from dataflow.cli.commands.completion import running_operators
from dataflow.cli.commands.following.live import THE_ONLY, Running
from dataflow.cli.commands.following.param import Timeout, _check, _value
from dataflow.cli.support.arguments import number
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import INTERRUPTED, fail, out, print_json_line

if TYPE_CHECKING:
    from dataflow.client.processes import Processes, PublishTarget
    from dataflow.messages import Message

OURS = ("stream", "type")
"""Keys of the lines that `dataflow echo --json` prints which are no fields."""


def pub(
    operator: Annotated[str, argument("OPERATOR", "A source of `dataflow.remote`.", autocompletion=running_operators)],
    fields: Annotated[str, argument("FIELDS", "Its fields as YAML or JSON; `-`: lines of JSON from standard input.")],
    count: Annotated[int | None, option("--count -n N", "Give it so many times.")] = None,
    rate: Annotated[
        float | None, option("--rate HZ", "Again and again.", parser=number(0.001, 1000, "messages a second"))
    ] = None,
    stamp: Annotated[int | None, option("--stamp NS", "Its timestamp. Default: the graph's event time of now.")] = None,
    which: Running = THE_ONLY,
    timeout: Timeout = 5.0,
    json: Annotated[bool, option("--json", "One JSON object a message.")] = False,
) -> None:
    """Give a message to a live graph, for a test or by hand.

    The graph takes messages from outside through a source declared for it:
    `use: dataflow.remote:Twist`, or any other message type. These messages are recorded and replayed like those of any
    other source. Lines that `dataflow echo --json` prints can be given again.

    Exit codes: 0 given; 1 refused, or no answer; 2 no such graph or source, or fields that do not fit.

    Examples:

      dataflow pub desk "{value: 21.5, unit: m}"
      dataflow pub desk "{value: 0}" --rate 10 -n 50
      dataflow pub desk - --rate 10 < lines.jsonl
    """
    from dataflow.client.attach import graph_of, types_of
    from dataflow.client.processes import processes_of

    _check(timeout)
    if count is not None and count < 1:
        raise fail(f"--count {count}: expected 1 or more")
    if stamp is not None and (rate is not None or count not in (None, 1) or fields == "-"):
        raise fail("--stamp is that of one message; leave --rate and --count out")
    if stamp is not None and not 0 < stamp < 2**63:
        raise fail(f"--stamp {stamp}: expected nanoseconds, above 0")
    found = which.found()
    with processes_of(found) as processes:
        taker = _taker(processes, operator, [*graph_of(found).nodes], len(found.endpoints), timeout)
        kind = types_of(graph_of(found))(taker.types[0])
        messages = _messages(kind, fields, stamp or 0, count, rate)
        try:
            for message in _paced(messages, rate):
                given = processes.publish(operator, message, timeout)
                _say(operator, taker, given, json=json)
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None


def _taker(processes: Processes, operator: str, known: Iterable[str], number: int, timeout: float) -> PublishTarget:
    """The source of that name, asked for until all processes are reached."""
    from dataflow.graph.problems import did_you_mean

    deadline = time.monotonic() + timeout
    processes.connected(number, timeout)
    takers = processes.takers(timeout)
    while operator not in takers and operator in known and time.monotonic() < deadline and not takers:
        time.sleep(0.05)
        takers = processes.takers(timeout)
    if operator in takers:
        return takers[operator]
    if not takers:
        raise fail("the graph takes no messages from outside: it has no source such as `use: dataflow.remote:Twist`")
    hint = did_you_mean(operator, takers, "these do")
    raise fail(f"{operator!r} takes no messages from outside: {hint}")


def _messages(kind: type[Message], fields: str, stamp: int, count: int | None, rate: float | None) -> Iterator[Message]:
    if fields != "-":
        message = _message(kind, _value(fields, "FIELDS"), stamp, "FIELDS")
        given = 0
        while given < (count or (1 if rate is None else sys.maxsize)):
            given += 1
            yield message
        return
    for line_number, line in enumerate(sys.stdin, 1):
        if count is not None and line_number > count:
            return
        if line.strip():
            where = f"line {line_number}"
            try:
                value = json_module.loads(line)
            except ValueError as error:
                raise fail(f"{where}: no JSON: {error}") from None
            if isinstance(value, dict):
                value = {key: item for key, item in value.items() if key not in (*OURS, "stamp")}
            yield _message(kind, value, 0, where)


def _message(kind: type[Message], value: Any, stamp: int, where: str) -> Message:
    """Raises what ends the command, for fields that do not fit."""
    from dataflow.graph.problems import did_you_mean

    if not isinstance(value, dict):
        raise fail(f"{where}: expected a mapping from fields of {kind.SCHEMA} to values, such as {{x: 1}}")
    names = [field.name for field in kind.FIELDS if field.name != "stamp"]
    for name in value:
        if name not in names:
            raise fail(f"{where}: {kind.SCHEMA} has no field {name!r}: {did_you_mean(str(name), names, 'it has')}")
    try:
        return kind(stamp=stamp, **value)
    except (ValueError, TypeError) as error:
        raise fail(f"{where}: {error}") from None


def _paced(messages: Iterator[Message], rate: float | None) -> Iterator[Message]:
    """The messages, by the clock where there is a rate."""
    began = time.monotonic()
    for k, message in enumerate(messages):
        if rate is not None and (left := began + k / rate - time.monotonic()) > 0:
            time.sleep(left)
        yield message


def _say(operator: str, taker: PublishTarget, stamp: int, *, json: bool) -> None:
    from dataflow.sync.stamps import format_stamp

    stream = f"{operator}/{taker.port}"
    if json:
        print_json_line({"stream": stream, "type": taker.types[0], "stamp": stamp})
    else:
        out.print(
            Text.assemble((stream, "bold"), f"  {format_stamp(stamp)}  ", (taker.types[0], "dim")), soft_wrap=True
        )
