"""Loads and checks a graph: from a file, from text, or from the bundle that a recording carries."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from dataflow.graph.expansion.expand import Expander
from dataflow.graph.model import Bundle, Graph
from dataflow.graph.problems import GraphError, Place, Problems
from dataflow.graph.resolution.presence import Presence
from dataflow.graph.resolution.resolve import Resolver
from dataflow.graph.search import add_folder
from dataflow.graph.yaml import document
from dataflow.graph.yaml.limits import MAX_BUNDLE, MAX_TEXT
from dataflow.graph.yaml.tree import Table

BUNDLE_FORMAT = "dataflow-graph/1"


def load_graph(path: str | Path, *, settings: Sequence[str] = (), live: bool = False) -> Graph:
    """The graph of a YAML file, checked wholly. `settings` are `--set` words, such as `"detector.threshold=0.3"`.

    `live`: every source counts as a device, which does not wait, when the operators' live policies are worked out.

    Imports the operators it names, also from modules beside the file (`dataflow.graph.search`). Raises `GraphError`
    with everything that is wrong.
    """
    folder = Path(path).parent

    def shown(key: str) -> str:
        return os.path.normpath(folder / key)

    return _load(Path(path).name, _reader(folder), os.environ.get, folder.as_posix, settings, shown, live)


def load_text(
    text: str,
    *,
    file: str = "graph.yaml",
    files: Mapping[str, str] | None = None,
    folder: Path | None = None,
    settings: Sequence[str] = (),
) -> Graph:
    """The graph of a YAML text. `files` holds the texts of nested graphs by path; others lie in `folder`, if given:
    without it nothing is read from disk."""
    texts = {file: text, **(files or {})}
    read = None if folder is None else _reader(folder)

    def text_of(key: str) -> str:
        return read(key) if read is not None and key not in texts else _from(texts, key)

    return _load(file, text_of, os.environ.get, lambda: "." if folder is None else folder.as_posix(), settings, str)


def load_bundle(bundle: str) -> Graph:
    """The graph that `Graph.bundle()` packed, without its files and environment. Raises `GraphError`."""
    try:
        if len(bundle) > MAX_BUNDLE:
            raise ValueError(f"it has {len(bundle):,} characters; it may have {MAX_BUNDLE:,}")
        data = json.loads(bundle)
        if data["format"] != BUNDLE_FORMAT:
            raise ValueError(f"its format is {data['format']!r}, this version reads {BUNDLE_FORMAT!r}")
        packed = Bundle(
            str(data["file"]),
            {str(key): str(text) for key, text in data["files"].items()},
            tuple(str(word) for word in data["settings"]),
            {str(name): None if word is None else str(word) for name, word in data["environment"].items()},
            str(data.get("folder", "")),
        )
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        problems = Problems()
        problems.add(Place("bundle", 1, 1), f"not a graph bundle: {type(error).__name__}: {error}")
        problems.check()
        raise AssertionError from error
    read = partial(_from, packed.files)
    return _load(packed.file, read, packed.environment.get, lambda: packed.folder, packed.settings, str)


def filled_by(graph: Graph, operator: str, name: str) -> str | None:
    """The graph's own parameter that fills a text parameter of an operator: with another text, so has the operator.

    None where there is none. Loads the graph anew for each parameter that it declares, from its bundle.
    """
    packed = graph.sources_bundle
    root = document.parse(packed.files[packed.file], packed.file, Problems())
    declared = root.get("params") if isinstance(root, Table) else None
    other = f"{graph.nodes[operator].params[name]}~"
    for parameter in declared.entries if isinstance(declared, Table) else ():
        settings = (*packed.settings, f"{parameter}={json.dumps(other)}")
        try:
            changed = load_bundle(replace(graph, sources_bundle=replace(packed, settings=settings)).bundle())
        except GraphError:  # that parameter takes no such text
            continue
        if operator in changed.nodes and changed.nodes[operator].params[name] == other:
            return parameter
    return None


def _load(
    file: str,
    read: Callable[[str], str],
    variable: Callable[[str], str | None],
    folder: Callable[[], str],
    settings: Sequence[str],
    shown: Callable[[str], str],
    live: bool = False,
) -> Graph:
    problems = Problems()
    texts: dict[str, str] = {}
    environment: dict[str, str | None] = {}
    folders: list[str] = []

    def noted_read(key: str) -> str:
        texts[key] = read(key)
        return texts[key]

    def noted_variable(name: str) -> str | None:
        environment[name] = variable(name)
        return environment[name]

    def noted_folder() -> str:
        folders[:] = [folder()]
        return folders[0]

    expansion = Expander(noted_read, shown, noted_variable, noted_folder, settings, problems).expand(file)
    if expansion is None:
        problems.check()
        raise AssertionError("a graph without a shape has a problem")
    Presence(expansion, problems).settle()
    bundle = Bundle(file, texts, tuple(settings), environment, "".join(folders))
    graph = Resolver(expansion, problems, live).resolve(bundle)
    problems.check()
    return graph


def _reader(folder: Path) -> Callable[[str], str]:
    """Reads a file up to the limit of its size, and no device or pipe.

    Modules are sought beside every file that is read.
    """

    def read(key: str) -> str:
        path = folder / key
        add_folder(path.parent)
        if path.exists() and not path.is_file():
            raise OSError(errno.EINVAL, "not a regular file")
        with path.open(encoding="utf-8") as file:
            return file.read(MAX_TEXT + 1)

    return read


def _from(texts: Mapping[str, str], key: str) -> str:
    if key not in texts:
        raise FileNotFoundError(2, f"not among {', '.join(texts)}")
    return texts[key]
