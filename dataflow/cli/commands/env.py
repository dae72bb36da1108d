"""`dataflow env`: the environments of a graph's operators."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from dataflow.cli.support.arguments import GraphFile, ModuleFolders, find_modules_in, graph_file
from dataflow.cli.support.options import option
from dataflow.cli.support.output import fail, say


def env(
    graph: GraphFile,
    anew: Annotated[bool, option("--anew", "Choose versions anew, and write the locks again.")] = False,
    path: ModuleFolders = None,
) -> None:
    """Build the environments of a graph's operators (`env:`), and lock the versions of their packages.

    One that is named by a file of requirements (NAME.txt) is built in NAME.env, by its lock (NAME.lock) where that
    is of these requirements; others are looked at. Exit code 1 where one cannot serve.

    Examples:

      dataflow env graph.yaml
      dataflow env graph.yaml --anew
    """
    from dataflow.environments import EnvError, environment_of, lock
    from dataflow.environments.build import build
    from dataflow.graph import load_graph

    find_modules_in(path)
    loaded = load_graph(graph_file(graph))
    users: dict[str, list[str]] = {}
    for node in loaded.nodes.values():
        if node.env is not None:
            users.setdefault(node.env, []).append(node.name)
    if not users:
        say(f"no operator of {loaded.name} has an environment (env:)")
    faults = []
    for each, operators in users.items():
        try:
            built = lock.is_requirements(each) and build(Path(each), anew=anew)
            found = environment_of(each)
            say(f"{each}: {'built' if built else 'as it should be'}, {found.folder}, for {', '.join(operators)}")
        except EnvError as error:
            faults.append(str(error))
    if faults:
        raise fail("; ".join(faults))
