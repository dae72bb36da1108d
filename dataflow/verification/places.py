"""The environment in which recorded calls are made again by one process."""

from __future__ import annotations

from collections.abc import Iterable

from dataflow.environments import EnvError, Environment, environment_of
from dataflow.graph.model import Graph
from dataflow.graph.reach import upstream
from dataflow.recording import Recording
from dataflow.reexecution.engine import plan_feeding
from dataflow.verification.choice import env_of


def env_of_calls(recording: Recording, graph: Graph, operator: str) -> Environment | None:
    """Returns the environment of an operator, by the end of its name, and of those that are repeated for its calls;
    None: that of this installation. Raises `EnvError`, `ReplayError`."""
    names = _ending(graph.nodes, operator)
    if not any(graph.nodes[name].env for name in names):
        return None
    env = env_of(graph, plan_feeding(recording, graph, names).operators, recording.streams.keys())
    return None if env is None else environment_of(env)


def env_of_chain(graph: Graph, stream: str) -> Environment | None:
    """Returns the environment of the operators that decide a stream, by the end of its name: its own and those in front
    of it. Raises `EnvError` where its own has one and another runs elsewhere."""
    makers = [graph.streams[name].node for name in _ending(graph.streams, stream)]
    if len(makers) != 1 or (env := graph.nodes[makers[0]].env) is None:
        return None
    others = {
        name: graph.nodes[name].env or "that of dataflow itself"
        for name in sorted(upstream(graph, makers))
        if not (graph.nodes[name].source or graph.nodes[name].external) and graph.nodes[name].env != env
    }
    if others:
        named = ", ".join(f"{name!r} ({where})" for name, where in others.items())
        raise EnvError(
            f"{makers[0]!r} runs in the environment {env!r}, and what is in front of it in others: {named}; one "
            "process cannot make the calls of all"
        )
    return environment_of(env)


def _ending(names: Iterable[str], end: str) -> list[str]:
    return [name for name in names if end and (name == end or name.endswith(f"/{end}"))]
