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
    of it; None: that of this installation. Raises `EnvError` where they have several."""
    makers = [graph.streams[name].node for name in _ending(graph.streams, stream)]
    if len(makers) != 1:
        return None
    envs = _envs_of_chain(graph, makers[0])
    env = envs.pop(makers[0], None)
    if others := {name: where for name, where in envs.items() if where != env}:
        named = ", ".join(f"{name!r} ({_called(where)})" for name, where in others.items())
        whole = [name for name in envs if len({*_envs_of_chain(graph, name).values()}) == 1]
        raise EnvError(
            f"{makers[0]!r} runs in the environment {_called(env)}, and what is in front of it in others: {named}; one "
            f"process cannot make the calls of all{': ask for what comes out of ' if whole else ''}{', '.join(whole)}"
        )
    return None if env is None else environment_of(env)


def _envs_of_chain(graph: Graph, operator: str) -> dict[str, str | None]:
    """The environments of an operator and of those in front of it, but for what a recording gives."""
    chain = sorted({operator} | upstream(graph, [operator]))
    return {
        name: graph.nodes[name].env for name in chain if not (graph.nodes[name].source or graph.nodes[name].external)
    }


def _called(env: str | None) -> str:
    return "of dataflow itself" if env is None else repr(env)


def _ending(names: Iterable[str], end: str) -> list[str]:
    return [name for name in names if end and (name == end or name.endswith(f"/{end}"))]
