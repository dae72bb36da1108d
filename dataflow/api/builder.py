"""Graphs built in Python: the graph language without its file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from dataflow.api.graphs import GraphBuilder, words
from dataflow.arguments import checked, require
from dataflow.graph import load_text
from dataflow.graph.model import Graph as ResolvedGraph
from dataflow.graph.problems import did_you_mean
from dataflow.operator import Operator

if TYPE_CHECKING:
    from dataflow.api.runs import RunResult

FILE = "graph.yaml"
"""The name by which error messages call the text of a graph that was built here."""


class Graph(GraphBuilder):
    """A graph under construction: operators are added, then their inputs are connected to streams.

        graph = Graph("watch").add("camera", MyCamera, rate=10).add("alarm", BrightnessAlarm)
        graph.connect("alarm", image="camera/image").run(record="watch.mcap")

    It stands for a YAML text, which `yaml()` gives: the same rules, checks and errors apply. A stream is named
    `operator/port`; wildcards work. `build()` checks it and is called by whatever runs it. Graph files that it nests
    lie in `folder`, the current one unless it is given.
    """

    @checked
    def __init__(
        self,
        name: str = "graph",
        *,
        namespace: str | None = None,
        seed: int = 0,
        threads: int = 1,
        folder: str | Path = ".",
    ) -> None:
        self._folder = Path(folder)
        self._head: dict[str, Any] = {"graph": name}
        if namespace is not None:
            self._head["namespace"] = namespace
        self._tail: dict[str, Any] = {"seed": seed, "threads": threads}
        self._operators: dict[str, dict[str, Any]] = {}

    def add(self, name: str, operator: type[Operator] | str, /, **params: Any) -> Self:
        """Adds an operator with its parameters: its class, or its import path (`"operators.cloud:CloudBuilder"`), or
        a nested graph by the path of its file (`"core/perception.yaml"`).

        A class may stand in a notebook's cell; then it exists in this process alone. Raises `ValueError` for a name
        that is taken, and for a class that stands inside a function or another class.
        """
        require("Graph.add", [("name", name, str)])
        if name in self._operators:
            raise ValueError(f"there is an operator {name!r} already")
        self._operators[name] = {"use": _path(operator)} | ({"params": _plain(name, params)} if params else {})
        return self

    @checked
    def connect(self, name: str, /, **inputs: str | list[str]) -> Self:
        """Connects inputs of an operator to streams: `connect("cloud", depth="camera/depth", info="camera/info")`.

        An input that takes many streams may be given a list. Raises `ValueError` for an operator that was not added.
        """
        self._operator(name).setdefault("inputs", {}).update(inputs)
        return self

    @checked
    def configure(self, name: str, /, **sections: Any) -> Self:
        """Sets sections of an operator: `process="cameras"`, `live={"queue": "newest"}`, `sync={"tolerance": "20ms"}`.

        Raises `ValueError` for an operator that was not added.
        """
        self._operator(name).update(_plain(name, sections))
        return self

    @checked
    def record(self, *topics: str, exclude: list[str] | None = None, **settings: Any) -> Self:
        """Chooses the streams that recordings hold, by names or patterns; without this, all."""
        section = ({"topics": list(topics)} if topics else {}) | ({"exclude": exclude} if exclude else {})
        self._tail["record"] = section | _plain("record", settings)
        return self

    def _operator(self, name: str) -> dict[str, Any]:
        if name not in self._operators:
            raise ValueError(f"no operator {name!r}: {did_you_mean(name, self._operators, 'added are')}")
        return self._operators[name]

    def yaml(self) -> str:
        """The graph as a YAML text."""
        lines = [f"{key}: {_json(value)}" for key, value in self._head.items()]
        lines.append("operators:" if self._operators else "operators: {}")
        for name, sections in self._operators.items():
            lines.append(f"  {name}:")
            for key, value in sections.items():
                if isinstance(value, Mapping) and value:
                    lines.append(f"    {key}:")
                    lines += [f"      {word}: {_json(item)}" for word, item in value.items()]
                else:
                    lines.append(f"    {key}: {_json(value)}")
        lines += [f"{key}: {_json(value)}" for key, value in self._tail.items()]
        return "\n".join(lines) + "\n"

    @checked
    def save(self, path: str | Path) -> Path:
        """Writes the YAML text, for `dataflow run` and version control. Returns the path."""
        file = Path(path)
        file.write_text(self.yaml(), encoding="utf-8")
        return file

    @checked
    def build(self, settings: Mapping[str, Any] | None = None) -> ResolvedGraph:
        """The graph, checked wholly. `settings` change parameters of operators inside nested graphs, as `--set` does.
        Raises `GraphError` with everything that is wrong."""
        return load_text(self.yaml(), file=FILE, folder=self._folder, settings=words(settings))

    def run(self, record: str | Path | None = None, **options: Any) -> RunResult:
        """Runs the graph in this process; see `dataflow.run`."""
        from dataflow.api.runs import run

        return run(self, record=record, **options)

    def __repr__(self) -> str:
        return f"<graph {self._head['graph']}: {', '.join(self._operators) or 'no operators'}>"

    def _repr_html_(self) -> str:
        from dataflow.api.html import graph_html

        return graph_html(self.build())


def _path(operator: type[Operator] | str) -> str:
    if isinstance(operator, str):
        return operator
    if not (isinstance(operator, type) and issubclass(operator, Operator)):
        raise TypeError(
            f"Graph.add(): operator: expected an operator's class or import path, got {operator!r}; "
            "parameters are keywords"
        )
    if "." in operator.__qualname__:
        raise ValueError(
            f"{operator.__qualname__} stands inside a function or class, where no graph finds it: move it to the top "
            "level of a module or a notebook's cell"
        )
    return f"{operator.__module__}:{operator.__qualname__}"


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _plain(owner: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values as the graph language has them. Raises `TypeError` for what it does not."""

    def convert(value: Any) -> Any:
        if isinstance(value, Path):
            return str(value)
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        raise TypeError(f"{owner}: {value!r} ({type(value).__name__}) has no place in a graph")

    made: dict[str, Any] = json.loads(json.dumps(dict(values), default=convert, ensure_ascii=False))
    return made
