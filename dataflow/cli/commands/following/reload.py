"""`dataflow reload`: new code of an operator in a graph that runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from rich.markup import escape
from rich.text import Text

from dataflow.cli.commands.following.live import THE_ONLY, Running
from dataflow.cli.support.arguments import Json, find_modules_in
from dataflow.cli.support.options import argument, option
from dataflow.cli.support.output import DIFFERENT, fail, out, print_json, say


def reload(
    operator: Annotated[str, argument("OPERATOR", "Its name in the graph, such as detector.")],
    which: Running = THE_ONLY,
    timeout: Annotated[float, option("--timeout SECONDS", "Wait so long for an answer.", min=0.1)] = 90.0,
    json: Json = False,
) -> None:
    """Let an operator of a live run go on with its code as it is in its files now.

    Its module is imported again, with the modules of the same code that have changed, between two firings. It keeps its
    state where it gives one (`snapshot`) and the new code takes it, and its messages that wait. Where the new code
    fails, takes longer than 30 s to be imported or set up, or declares other ports, the old code goes on. On another
    machine it is the code that lies there: where it differs from that here, nothing is reloaded. The recording holds
    this as a restart, with the digests of both codes. Sources, and modules that declare message types, are not
    reloaded. With --connect it takes the keys of the machine that runs the graph; those of tools load no code.

    Exit codes: 0 reloaded; 1 refused: the old code goes on, or no answer; 2 no such graph or operator.

    Examples:

      dataflow reload tracker
      dataflow reload front/cloud --graph two_cameras
    """
    from dataflow.client.attach import graph_of, with_keys_of_tools
    from dataflow.client.processes import NoAnswer, RequestRejected, processes_of
    from dataflow.graph.problems import did_you_mean

    found = which.found()
    nodes = graph_of(found).nodes
    if operator not in nodes:
        raise fail(f"no operator {operator!r} runs: {did_you_mean(operator, nodes, 'there are')}")
    if with_keys_of_tools():
        why = "these are keys of tools, which load no code: take those of the machine that runs the graph"
        raise fail(f"{operator} is not reloaded: {why}", code=DIFFERENT)
    with processes_of(found) as processes:
        try:
            if (machine := nodes[operator].machine) is not None:
                _require_same_files(processes.files(operator, timeout), machine)
            outcome = processes.reload(operator, timeout)
        except (RequestRejected, NoAnswer) as error:
            raise fail(f"{operator} is not reloaded: {error}", code=DIFFERENT) from None
    if outcome["warning"]:
        say(escape(outcome["warning"]))
    if json:
        print_json({"operator": operator, **outcome})
    else:
        where = f" on machine {machine}, to which no code is sent" if machine else ""
        code = "new code" if outcome["changed"] else f"the code that it had: no file of it has changed{where},"
        text = f"{operator} goes on with {code} after {outcome['seconds']:.2g} s; its state: {outcome['state']}"
        out.print(Text(text), soft_wrap=True)


def _require_same_files(there: Mapping[str, str], machine: str) -> None:
    """Raises `RequestRejected` where files of an operator's modules differ between here, where they were edited, and
    its machine; files that are not found here are not compared."""
    from dataflow.client.processes import RequestRejected
    from dataflow.graph.code import file_digests

    find_modules_in(None)
    here = file_digests(there)
    if differing := [name for name, digest in sorted(there.items()) if here.get(name, digest) != digest]:
        which = ", ".join(differing)
        raise RequestRejected(
            f"{which} on machine {machine!r} differs from here: install it there first, the old code goes on"
        )
