"""The tasks of a sweep: recordings by settings, each with the digest by which its outcome is found again."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import xxhash

from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.recording.streams.facts import machine_facts
from dataflow.reexecution.recorded_run import recorded_graph
from dataflow.verification.gate import recordings_in

What = Literal["replay", "verify", "evaluate"]
Choice = tuple[tuple[str, str], ...]
"""Settings, as pairs of name and value."""
SUFFIXES = (".mcap", ".bag", ".db3")
CHUNK = 1 << 20
_OPENS, _CLOSES, _QUOTES = "([{", ")]}", "\"'"


class SweepError(ValueError):
    """Raised for what cannot be swept; the message names it and what would be right."""


@dataclass(frozen=True, slots=True)
class Source:
    """A recording.

    `where`: a path, or a URL that fsspec opens. `digest`: of its bytes; of a URL, the mark that its store gives it.
    """

    name: str
    where: str
    digest: str


@dataclass(frozen=True, slots=True)
class Task:
    """One recording with one choice of settings.

    `words`: those of the command, with `None` where the recording's path stands. `key`: a digest of the recording, the
    graph, the code, the packages and the words; tasks of equal keys have equal outcomes.
    """

    source: Source
    what: What
    settings: Choice
    words: tuple[str | None, ...]
    key: str


def grid(words: Sequence[str]) -> list[Choice]:
    """Returns every combination of "NAME=VALUE,VALUE..." words, the last name's values changing fastest.

    A comma inside brackets or quotes belongs to the value. Raises `SweepError`.
    """
    axes: dict[str, list[tuple[str, str]]] = {}
    for word in words:
        name, separator, text = word.partition("=")
        values = [value.strip() for value in _divided(text)]
        if not separator or not name.strip() or not all(values):
            raise SweepError(f"--set {word!r}: expected NAME=VALUE or NAME=VALUE,VALUE,...")
        if name in axes:
            raise SweepError(f"--set {word!r}: {name} has values already; give all of them in one word")
        if len(set(values)) < len(values):
            raise SweepError(f"--set {word!r}: a value stands there twice")
        axes[name] = [(name, value) for value in values]
    return list(itertools.product(*axes.values()))


def _divided(text: str) -> Iterator[str]:
    depth, quote, begin = 0, "", 0
    for at, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in _QUOTES:
            quote = letter
        elif letter in _OPENS:
            depth += 1
        elif letter in _CLOSES:
            depth -= 1
        elif letter == "," and depth == 0:
            yield text[begin:at]
            begin = at + 1
    yield text[begin:]


class Digests:
    """Digests of files' bytes, kept in a file by size and time of change, so that a second sweep reads none of them."""

    def __init__(self, file: Path) -> None:
        self._file = file
        try:
            self._known: dict[str, list[Any]] = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # not there, or torn: everything is read once more
            self._known = {}

    def of(self, path: Path) -> str:
        """Returns the digest of a file, of a folder that of all its files. Raises `OSError`."""
        if path.is_dir():
            inside = sorted(p for p in path.rglob("*") if p.is_file())
            return _digest([str(p.relative_to(path)), self.of(p)] for p in inside)
        state = path.stat()
        mark = [state.st_size, state.st_mtime_ns]
        known = self._known.get(key := str(path.resolve()))
        if known is None or known[:2] != mark:
            hashed = xxhash.xxh3_128()
            with path.open("rb") as file:
                while chunk := file.read(CHUNK):
                    hashed.update(chunk)
            known = self._known[key] = [*mark, hashed.hexdigest()]
        return str(known[2])

    def save(self) -> None:
        """Raises `OSError`."""
        self._file.write_text(json.dumps(self._known), encoding="utf-8")


def sources_in(targets: Sequence[str], digests: Digests) -> list[Source]:
    """Returns the recordings that files, folders and URLs name.

    Raises `SweepError`, `OSError`, and `ReplayError` for a folder without recordings.
    """
    found = []
    for target in targets:
        if "://" in target:
            found += _remote(target)
        elif (path := Path(target)).is_file() or (path / "metadata.yaml").exists():
            found.append(Source(path.name, target, digests.of(path)))
        else:
            found += [Source(name, str(file), digests.of(file)) for file, name in recordings_in([path])]
    unique = {source.where: source for source in found}
    names = [source.name for source in unique.values()]
    return [s if names.count(s.name) == 1 else Source(s.where, s.where, s.digest) for s in unique.values()]


def _remote(url: str) -> list[Source]:
    import fsspec  # of the extra `sweep`

    store, path = fsspec.core.url_to_fs(url)
    if not store.exists(path):
        raise SweepError(f"no file or folder {url}")
    files = [path] if store.isfile(path) else sorted(p for p in store.find(path) if p.endswith(SUFFIXES))
    if not files:
        raise SweepError(f"{url} holds no recording (no file that ends in {', '.join(SUFFIXES)}, at any depth)")
    return [
        Source(file.removeprefix(path).lstrip("/") or Path(file).name, store.unstrip_protocol(file), store.ukey(file))
        for file in files
    ]


def tasks_of(
    what: What,
    sources: Sequence[Source],
    graphs: Mapping[Choice, Graph | None],
    graph: str | None,
    words: Sequence[str],
    digests: Digests,
) -> list[Task]:
    """Returns a task for every recording and choice of settings.

    - `graphs`: the graph of each choice as it was loaded; None where each recording's own is taken.
    - `graph`: its file.
    - `words`: further words of the command.
    """
    code, made = Code(digests), []
    verb = "verify" if what == "verify" else "replay"
    where = {"verify": ("--jobs", "1")}.get(verb, ("--one-process",))
    given = () if graph is None else ("--graph", graph)
    for settings, loaded in graphs.items():
        chosen = tuple(word for name, value in settings for word in ("--set", f"{name}={value}"))
        for source in sources:
            line = (verb, None, *given, *chosen, *where, *words, "--json", "--quiet")
            graph_digest = code.of(loaded) if loaded is not None else code.of_recorded(source)
            made.append(Task(source, what, settings, line, _digest((source.digest, graph_digest, what, line[2:]))))
    return made


class Code:
    """Digests of what makes a graph's results: its nodes, their operators' code, files they are given, packages."""

    def __init__(self, digests: Digests) -> None:
        self._digests = digests
        self._packages: dict[str, str] = {}
        self._graphs: dict[int, str] = {}
        facts = machine_facts()
        self._base = [self._package("dataflow"), facts["packages"], facts["machine"]["python"]]

    def of(self, graph: Graph) -> str:
        """Raises `OSError` for a file that cannot be read."""
        if id(graph) not in self._graphs:
            described = graph.to_json()
            parts = [described[part] for part in ("nodes", "streams", "seed", "threads", "namespace")]
            used = sorted({node.use.partition(":")[0].partition(".")[0] for node in graph.nodes.values()})
            files = sorted(set(_files_named([node.params for node in graph.nodes.values()])))
            code = [self._package(name) for name in used]
            self._graphs[id(graph)] = _digest((self._base, parts, code, [self._digests.of(file) for file in files]))
        return self._graphs[id(graph)]

    def of_recorded(self, source: Source) -> str:
        """Returns the digest for the graph inside a recording. A URL is not opened: all shipped operators count."""
        if "://" in source.where:
            return _digest((self._base, self._package("operators")))
        with Recording(Path(source.where)) as opened:
            graph = recorded_graph(opened)
        described = sorted({node.use.partition(":")[0].partition(".")[0] for node in graph.nodes.values()})
        return _digest((self._base, [self._package(name) for name in described]))

    def _package(self, name: str) -> str:
        if name not in self._packages:
            found = find_spec(name)
            places = [] if found is None else [Path(p) for p in found.submodule_search_locations or ()]
            alone = [] if found is None or places or found.origin is None else [Path(found.origin)]
            inside = sorted(file for place in places for file in place.rglob("*") if file.is_file())
            files = alone + [file for file in inside if file.parent.name != "__pycache__"]
            self._packages[name] = _digest(self._digests.of(file) for file in files)
        return self._packages[name]


def _files_named(value: Any) -> Iterator[Path]:
    """Yields the files that strings anywhere in a value name."""
    if isinstance(value, str):
        try:
            named = bool(value) and Path(value).is_file()
        except (OSError, ValueError):  # too long, or with a zero: no file's name
            named = False
        if named:
            yield Path(value)
    elif isinstance(value, Mapping):
        for part in value.values():
            yield from _files_named(part)
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _files_named(part)


def _digest(value: Iterable[Any]) -> str:
    return xxhash.xxh3_128_hexdigest(json.dumps(list(value), sort_keys=True, default=str).encode())
