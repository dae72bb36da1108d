"""The tasks of a sweep: recordings by settings, each with the digest by which its outcome is found again."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import secrets
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import xxhash

from dataflow.environments import EnvError, environment_of, packages_in
from dataflow.extras import missing_extra
from dataflow.graph.code import files_of
from dataflow.graph.model import Graph, current_path
from dataflow.graph.problems import GraphError
from dataflow.recording import Recording, RecordingError
from dataflow.recording.streams.facts import machine_facts
from dataflow.reexecution.recorded_run import ReplayError, recorded_graph
from dataflow.text import visible
from dataflow.verification.gate import recordings_in

What = Literal["replay", "verify", "evaluate"]
Choice = tuple[tuple[str, str], ...]
"""Settings, as pairs of name and value."""
SUFFIXES = (".mcap", ".bag", ".db3")
BAG = "metadata.yaml"
"""The file that makes a folder a bag of ROS 2."""
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
    graph, the code, the packages and the words; tasks of equal keys have equal outcomes. `operators`: what the
    graph uses, as `module:name`, where it is known.
    """

    source: Source
    what: What
    settings: Choice
    words: tuple[str | None, ...]
    key: str
    operators: tuple[str, ...] = ()


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
        part = self._file.with_suffix(f".{os.getpid()}.part")
        part.write_text(json.dumps(self._known), encoding="utf-8")
        part.replace(self._file)


def sources_in(targets: Sequence[str], digests: Digests) -> list[Source]:
    """Returns the recordings and bags that files, folders and URLs name, each once.

    Raises `SweepError`, `OSError`, and `ReplayError` for a folder without recordings.
    """
    found: dict[str, Source] = {}
    for target in targets:
        here = _remote(target) if "://" in target else _local(Path(target), digests)
        found |= {source.where: source for source in here if source.where not in found}
    names = Counter(source.name for source in found.values())
    return [s if names[s.name] == 1 else replace(s, name=visible(s.where)) for s in found.values()]


def _local(path: Path, digests: Digests) -> Iterator[Source]:
    if path.is_file() or (path / BAG).exists():
        files = [(path, path.name)]
    else:
        bags = [bag.parent for bag in sorted(path.rglob(BAG))]
        bags += sorted(path.rglob("*.bag"))
        files = [(bag, bag.relative_to(path).as_posix()) for bag in bags]
        if not bags or any(path.rglob("*.mcap")):
            files += [(file, name) for file, name in recordings_in([path]) if not set(file.parents) & set(bags)]
    for file, name in files:
        yield Source(visible(name), str(file.resolve()), digests.of(file))


def _remote(url: str) -> Iterator[Source]:
    try:
        import fsspec  # of the extra `remote`

        store, path = fsspec.core.url_to_fs(url)
        found = list(_stored(store, path))
    except FileNotFoundError as error:
        why = f": {error.__cause__}" if error.__cause__ else ""
        raise SweepError(f"no file or folder {url}{why}") from None
    except Exception as error:  # whatever stores raise: no such protocol, a package that lacks, no access, no network
        why = str(error) or type(error).__name__
        raise SweepError("; ".join(filter(None, (f"{url} cannot be read: {why}", missing_extra(error))))) from error
    if not found:
        raise SweepError(f"{url} holds no recording (no file that ends in {', '.join(SUFFIXES)}, at any depth)")
    yield from found


def _stored(store: Any, path: str) -> Iterator[Source]:
    """Yields the recordings of a store at a path. A web server's folder is a file, too: its list."""
    if file_name(path).endswith(SUFFIXES):
        files = [path]
    else:
        files = sorted(p for p in store.find(path) if file_name(p).endswith(SUFFIXES))
        if not files:
            store.info(path)  # raises FileNotFoundError where there is no such folder
    for file in files:
        name = file.removeprefix(path).lstrip("/") or file_name(file)
        mark = {key: str(value) for key, value in store.info(file).items()}  # sizes, times, entity tags
        if not any(re.search("tag|time|modified|created|version|md5|digest", key, re.I) for key in mark):
            mark["read"] = secrets.token_hex(16)  # other bytes of the same size would not be distinguished
        yield Source(visible(name), store.unstrip_protocol(file), _digest((store.ukey(file), mark)))


def file_name(url: str) -> str:
    """Returns the name of a URL's file, without the query of a web address."""
    return Path(url.partition("?")[0] if url.startswith(("http://", "https://")) else url).name


def command_of(what: What) -> str:
    """Returns the command that does it."""
    return "verify" if what == "verify" else "replay"


def tasks_of(
    what: What,
    sources: Sequence[Source],
    graphs: Mapping[Choice, Graph | None],
    graph: str | None,
    words: Sequence[str],
    folders: Sequence[Path],
    digests: Digests,
) -> list[Task]:
    """Returns a task for every recording and choice of settings.

    - `graphs`: the graph of each choice as it was loaded; None where each recording's own is taken.
    - `graph`: its file.
    - `words`: further words of the command. `folders`: those in which it finds modules.
    """
    code, made = Code(digests, folders), []
    verb = command_of(what)
    given = () if graph is None else ("--graph", graph)
    for settings, loaded in graphs.items():
        chosen = tuple(word for name, value in settings for word in ("--set", f"{name}={value}"))
        same = None if loaded is None else code.of(loaded)
        for source in sources:
            graph_of = loaded or _recorded(source)
            digest = same or code.of(graph_of)
            where = ("--jobs", "1") if verb == "verify" else () if _apart(graph_of) else ("--one-process",)
            line = (verb, None, *given, *chosen, *where, *words, "--json", "--quiet")
            key = _digest((source.digest, digest, what, line[2:]))
            made.append(Task(source, what, settings, line, key, _uses(graph_of)))
    return made


def _recorded(source: Source) -> Graph | None:
    """Returns the graph inside a recording; None of a URL, which is not opened, and of what no graph can be read from:
    its run fails with the reason."""
    if "://" in source.where:
        return None
    try:
        with Recording(Path(source.where)) as opened:
            return recorded_graph(opened)
    except (OSError, RecordingError, GraphError, ReplayError):
        return None


def _apart(graph: Graph | None) -> bool:
    """Returns whether operators need several processes, since they are in several environments."""
    return graph is None or len({node.env for node in graph.nodes.values()}) > 1


def _uses(graph: Graph | None) -> tuple[str, ...]:
    return () if graph is None else tuple(sorted({node.use for node in graph.nodes.values() if node.env is None}))


class Code:
    """Digests of what makes a graph's results: its nodes, their operators' code, files they are given, packages.

    `folders`: in which modules are sought besides; all the code in them counts.
    """

    def __init__(self, digests: Digests, folders: Sequence[Path]) -> None:
        self._digests = digests
        self._packages: dict[str, str] = {}
        facts = machine_facts()
        given = [self._code(sorted(folder.rglob("*.py"))) for folder in folders]
        self._base = [self._package("dataflow"), facts["packages"], facts["machine"]["python"], given]

    def of(self, graph: Graph | None) -> str:
        """Returns the digest for a graph; for one that is not known, all operators count that are shipped, or lie in
        the current folder.

        Raises `OSError` for a file that cannot be read.
        """
        if graph is None:
            homes = sorted(
                {path.stem for path in (*Path().glob("*.py"), *(each.parent for each in Path().glob("*/*.py")))}
            )
            return _digest(
                (self._base, [self._package(name) for name in ("operators", *filter(str.isidentifier, homes))])
            )
        described = graph.to_json()
        parts = [described[part] for part in ("nodes", "streams", "seed", "threads", "namespace")]
        used = sorted({_home(node.use) for node in graph.nodes.values()})
        files = sorted(set(_files_named([node.params for node in graph.nodes.values()])))
        code = [self._package(name) for name in used]
        envs = [self._packages_of(env) for env in sorted({node.env for node in graph.nodes.values() if node.env})]
        return _digest((self._base, parts, code, envs, [self._digests.of(file) for file in files]))

    def _packages_of(self, env: str) -> dict[str, str]:
        """Returns the packages in an environment; of one that cannot serve none: the run fails."""
        with contextlib.suppress(EnvError):
            return packages_in(environment_of(env))
        return {}

    def _package(self, home: str) -> str:
        """Returns the digest of a module's code, and of whatever else its package holds."""
        if home not in self._packages:
            found = find_spec(home.partition(".")[0])
            places = [] if found is None else [Path(p) for p in found.submodule_search_locations or ()]
            inside = {file for place in places for file in place.rglob("*") if file.is_file()}
            self._packages[home] = self._code(sorted(inside.union(files_of(home).values())))
        return self._packages[home]

    def _code(self, files: Sequence[Path]) -> str:
        return _digest([f.name, self._digests.of(f)] for f in files if f.parent.name != "__pycache__")


def _home(use: str) -> str:
    """Returns the module that has an operator; as it is named, where its package cannot be imported."""
    try:
        return current_path(use).partition(":")[0]
    except (Exception, SystemExit):  # of a recording: its run fails with the reason
        return use.partition(":")[0]


def _files_named(value: Any) -> Iterator[Path]:
    """Yields the files that strings anywhere in a value name."""
    if isinstance(value, str):
        try:
            file = Path(value).expanduser()
            named = bool(value) and file.is_file()
        except (OSError, ValueError, RuntimeError):  # too long, with a zero, of an unknown user: no file's name
            named = False
        if named:
            yield file
    elif isinstance(value, Mapping):
        for part in value.values():
            yield from _files_named(part)
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _files_named(part)


def _digest(value: Iterable[Any]) -> str:
    return xxhash.xxh3_128_hexdigest(json.dumps(list(value), sort_keys=True, default=str).encode())
