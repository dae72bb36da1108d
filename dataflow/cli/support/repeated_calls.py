"""Prepares commands that make recorded calls again in this process."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dataflow.cli.support import command_line
from dataflow.cli.support.arguments import ModuleFolders, OtherGraph, OtherSettings, find_modules_in, graph_file
from dataflow.cli.support.output import fail, out

if TYPE_CHECKING:
    from dataflow.environments import Environment
    from dataflow.graph import Graph


@dataclass(frozen=True, slots=True)
class CodeOptions:
    """The graph and the modules by which recorded calls are made again."""

    graph: OtherGraph = None
    settings: OtherSettings = None
    path: ModuleFolders = None

    @property
    def words(self) -> list[str]:
        """The words by which another command is given the same."""
        named = (("--graph", self.graph and [self.graph]), ("--set", self.settings), ("--path", self.path))
        return [word for option, values in named for value in values or () for word in (option, str(value))]

    def check(self) -> None:
        """Ends the command where `--set` has no graph file to change."""
        if self.graph is None and self.settings:
            raise fail("--set changes a graph file: name it with --graph")

    def load(self) -> Graph | None:
        """Makes operators importable; returns the graph that `--graph` names."""
        find_modules_in(self.path)
        from dataflow.graph import load_graph

        return None if self.graph is None else load_graph(graph_file(self.graph), settings=self.settings or ())

    def begin_again(self, recording: Path, operator: str = "", *, stream: str = "") -> Graph | None:
        """Makes operators importable, and this process one like those of the run; returns the graph of `--graph`.

        `operator`: the one whose calls are made, in its environment where it has one (`env:`); `stream`: what is asked
        for, which is made by operators of one environment.

        Raises `GraphError`, `EnvError`, `ReplayError`, and ends the command where `--set` has no graph file to change.
        """
        self.check()
        find_modules_in(self.path)
        from dataflow.recording import Recording
        from dataflow.reexecution.recorded_run import resolved_graph

        with Recording(recording) as opened:
            recorded = resolved_graph(opened)
            env = None
            if recorded is not None and any(node.env for node in recorded.nodes.values()):
                from dataflow.verification.places import env_of_calls, env_of_chain

                env = env_of_chain(recorded, stream) if stream else env_of_calls(opened, recorded, operator)
        take_environment(1 if recorded is None else recorded.threads, env)
        return self.load()


RECORDED = CodeOptions()


def take_environment(threads: int, env: Environment | None = None) -> None:
    """Begins anew with the environment of operators where this process has another one, or in `env`: libraries read the
    number of their threads, and Python the salt of hashes, when they begin."""
    from dataflow.execution.threads import environment

    wanted, python = environment(threads), sys.executable
    if env is not None:
        wanted, python = env.variables(wanted), env.python
    if command_line.words is not None and any(
        os.environ.get(name) != value for name, value in wanted.items() if name != "PYTHONPATH"
    ):
        out.file.flush()
        os.execve(python, [python, "-P", "-m", "dataflow.cli.main", *command_line.words], wanted)
