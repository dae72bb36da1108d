"""`dataflow join` and `dataflow keys`: machines that take part in a graph, and what lets them in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from dataflow.cli.support.arguments import ModuleFolders, find_modules_in
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import fail, say

Connect = Annotated[str, option("--connect ENDPOINT", "Where the run listens (`dataflow run --listen`).")]
Authority = Annotated[Path, option("--authority FOLDER", "The folder of `dataflow keys new`.")]


def join(
    name: Annotated[str, argument("NAME", "This machine's name in graphs (`machine:`).")],
    connect: Connect,
    keys: Annotated[Path | None, option("--keys FOLDER", "This machine's keys.")] = None,
    folder: Annotated[Path, option("--folder FOLDER", "Where operators run, and files that are sent lie.")] = Path(
        "dataflow-agent"
    ),
    path: ModuleFolders = None,
    timeout: Annotated[
        float, option("--timeout SECONDS", "Operators go on for so long without the supervisor.")
    ] = 30.0,
    once: Annotated[bool, option("--once", "End after one run.")] = False,
) -> None:
    """Let this machine take part in graphs that run elsewhere.

    It waits for a run, compares its code with the run's, takes the files that it lacks, and starts, watches and ends
    the operators that the graph gives to it. When the supervisor is not heard for too long (--timeout), it ends
    them. Then it waits for the next run; Ctrl-C ends it.

    Examples:

      dataflow join robot --connect tls/192.168.1.2:7447 --keys robot-keys
    """
    import signal

    from dataflow.machines.keys import require_machine
    from dataflow.supervision.agent import Agent

    find_modules_in(path)
    if keys is not None:
        require_machine(keys, name)
    agent = Agent(name, connect, keys, folder, say, patience=timeout)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: agent.stop())
    agent.run(once=once)


def new(folder: Annotated[Path, argument("FOLDER", "The folder to make.")]) -> None:
    """Make an authority, which issues keys. Its folder stays where it is: its owner can issue keys.

    Examples:

      dataflow keys new authority
    """
    from dataflow.machines.keys import new_authority

    new_authority(folder)
    say(f"{folder} issues keys: dataflow keys add NAME --authority {folder}")


def add(
    name: Annotated[str, argument("NAME", "The machine's name, and that of the folder to make.")],
    authority: Authority,
    serves: Annotated[
        list[str] | None, option("--serves ADDRESS", "Graphs are run there, and others reach it by this address.")
    ] = None,
    tools: Annotated[bool, option("--tools", "Keys for tools alone, on any machine.")] = False,
    out: Annotated[Path | None, option("--out FOLDER", "Another folder than NAME.")] = None,
) -> None:
    """Make the keys of one machine, in a folder to be taken there.

    Examples:

      dataflow keys add laptop --authority authority --serves 192.168.1.2 --serves laptop.local
      dataflow keys add robot --authority authority
      dataflow keys add my_tools --authority authority --tools
    """
    from dataflow.graph.keys import NAME_RULE, name_fault
    from dataflow.machines.keys import TOOLS, issue

    if fault := name_fault(name):
        raise fail(f"machine name {fault}: {NAME_RULE}")
    if tools and serves:
        raise fail("--tools and --serves exclude each other: tools only connect")
    folder = out or Path(name)
    issue(authority, folder, TOOLS if tools else name, serves=serves or ())
    say(f"{folder}: the keys of {'tools' if tools else f'machine {name!r}'}")
