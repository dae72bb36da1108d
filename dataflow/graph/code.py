"""The code of an operator: the modules that it is made of, their digests, and how it is loaded again.

Its own modules are that of its class and those that this one imports, directly or through others, at once or in a
function, as far as they are files outside of the standard library, of installed packages and of the engine.
"""

from __future__ import annotations

import hashlib
import importlib.abc
import importlib.util
import os
import re
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import FunctionType, ModuleType, NoneType
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

from dataflow.graph.model import Node, OperatorImportError, current_path, import_operator
from dataflow.messages.base import Message

if TYPE_CHECKING:
    from dataflow.operator import Operator

_ENGINE = __name__.partition(".")[0]
_INSTALLED = ("/site-packages/", "/dist-packages/")
_STANDARD = tuple(f"{sysconfig.get_path(kind)}/" for kind in ("stdlib", "platstdlib"))
_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
_DIGEST = re.compile("[0-9a-f]{64}")
_IMPORT = re.compile(r"^[ \t]*(?:from[ \t]+([.\w]+)[ \t]+import[ \t]+(\([^)]*\)|[^#\n]*)|import[ \t]+([^#\n]*))", re.M)
_FOR_TYPES = re.compile(r"^if (?:\w+\.)?TYPE_CHECKING:.*\n(?:[ \t]+.*\n|[ \t]*\n)*", re.M)
"""Imports that a type checker makes, and no program."""
_IMPORT_BY_NAME = re.compile(r"""\b(?:import_module|__import__)\(\s*["']([.\w]+)["']""")
_WORD = re.compile(r"""["'](?!/)([^"'\n]{1,255})["']""")
"""Strings of a module that may name a file."""
_texts: WeakKeyDictionary[ModuleType, bytes] = WeakKeyDictionary()
"""The source of modules as they were loaded, from the first look at them on."""


class ReloadError(ValueError):
    """The code of an operator cannot be replaced; the message has the reason."""


@dataclass(frozen=True)
class Code:
    """A class of operators, and the source of the modules that are its own, by name."""

    operator: type[Operator]
    texts: Mapping[str, bytes]

    @property
    def digests(self) -> dict[str, str]:
        """The SHA-256 of each module."""
        return {name: digest_of(text) for name, text in sorted(self.texts.items())}


def code_now(operator: type[Operator], also: Iterable[str] = ()) -> Code:
    """Returns the code of a class: of modules that are loaded as they were then, of others as their files are.

    `also`: modules that are looked at as well, where there are any of that name.
    """
    return Code(operator, _own_texts(operator.__module__, *also))


def files_of(home: str) -> dict[str, Path]:
    """Returns the files of the code of a module, without importing it, by their paths below the folder in which modules
    are found: all modules of the package that it is in, own modules that it imports from elsewhere, and files beside
    the latter that their texts name, such as a program that is started."""
    top = home.partition(".")[0]
    spec = importlib.util.find_spec(top)
    places = [] if spec is None else [Path(place) for place in spec.submodule_search_locations or ()]
    found = {f"{top}/{file.relative_to(place).as_posix()}": file for place in places for file in place.rglob("*.py")}
    if not places and spec is not None and spec.origin is not None:
        found[f"{top}.py"] = Path(spec.origin)
    for name, text in _own_texts(home).items():
        origin = getattr(sys.modules.get(name) or _spec_of(name), "__file__" if name in sys.modules else "origin", None)
        if origin is None or (places and name.partition(".")[0] == top):
            continue
        file = Path(origin)
        above = file.parents[name.count(".") + (file.name == "__init__.py")]
        named = {file, *(file.parent / word for word in _WORD.findall(text.decode(errors="replace")))}
        found |= {os.path.relpath(each, above): each for each in named if is_file(each)}
    return found


def is_file(path: Path) -> bool:
    """Returns whether a file is there; what no file can be called, as any long text, is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def file_digests(modules: Iterable[str]) -> dict[str, str]:
    """Returns the digests of modules as their files are now, of those that have one here. Imports nothing."""
    texts = {name: _file_text(name) for name in modules if _NAME.fullmatch(name)}
    return {name: digest_of(text) for name, text in texts.items() if text is not None}


def digest_of(text: bytes) -> str:
    return hashlib.sha256(text).hexdigest()


class ReloadedCode:
    """An operator's code, loaded again from its files."""

    def __init__(self, node: Node, before: Code) -> None:
        """Imports the modules of the operator whose files have changed, those that depend on them, and its own one.

        `before`: the code that it runs. Raises `ReloadError` where they declare message types or are not its own,
        `OperatorImportError` for what fails.
        """
        home, offers = before.operator.__module__, _offers(node)
        own = _own_texts(home, offers)
        now = {name: text for name in own if (text := _file_text(name)) is not None}
        if home not in now:
            raise ReloadError(f"module {home!r} is no file outside of installed packages and the engine")
        changed = {n for n, text in now.items() if n in sys.modules and not text == own[n] == before.texts.get(n)}
        again = _with_dependents({*changed, home, offers}, own)
        self.before = before
        self._swap = _Swap({name: now[name] for name in again & now.keys()})
        self.now = code_now(self._swap.load(node))

    def put_back(self) -> None:
        """Makes the code before the current one again."""
        self._swap.put_back()

    def store_before(self) -> None:
        """Stores the code before, by its digests, for re-executions of what it did. Raises `OSError`."""
        folder = store()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for text in self.before.texts.values():
            file = folder / digest_of(text)
            if not file.exists():
                partial = file.with_suffix(f".{os.getpid()}")
                partial.write_bytes(text)
                partial.replace(file)


def stored_operator(node: Node, digests: Mapping[str, str]) -> type[Operator] | None:
    """Returns the class of an operator with the code of these digests by module, out of what reloads here have stored;
    None where it is not there. The modules that others import stay as they are."""
    home, offers = node.operator.__module__, _offers(node)
    own = _own_texts(home, offers)
    now = {**own, **code_now(node.operator, digests).texts}
    differing = {name for name, digest in digests.items() if name not in now or digest_of(now[name]) != digest}
    if not differing:
        return node.operator
    texts = {}
    for name in differing:
        text = stored(digests[name])
        if text is None or not _NAME.fullmatch(name) or (name in sys.modules and name not in now):
            return None
        texts[name] = text
    again = _with_dependents({*differing, home, offers}, own)
    try:
        swap = _Swap({name: own[name] for name in again & own.keys()} | texts)
        found = swap.load(node)
    except (ReloadError, OperatorImportError):  # it may need what is no longer here
        return None
    swap.put_back()
    return None if swap.late & differing else found


@contextmanager
def other_texts(node: Node, texts: Mapping[str, bytes]) -> Iterator[None]:
    """Lets an operator have other texts of some of its modules, within the block. Raises `ReloadError`,
    `OperatorImportError`."""
    home, offers = node.operator.__module__, _offers(node)
    own = _own_texts(home, offers)
    again = _with_dependents({*texts, home, offers}, own)
    swap = _Swap({name: own[name] for name in again & own.keys()} | dict(texts))
    swap.load(node)
    try:
        yield
    finally:
        swap.put_back()


def store() -> Path:
    """The folder of this user's code that reloads have replaced: `$XDG_DATA_HOME/dataflow/code`."""
    home = os.environ.get("XDG_DATA_HOME")
    return (Path(home) if home else Path.home() / ".local" / "share") / "dataflow" / "code"


def stored(digest: str) -> bytes | None:
    """Returns what is stored under a digest, which a recording of others may hold: it may be any text."""
    if not _DIGEST.fullmatch(digest):
        return None
    try:
        text = (store() / digest).read_bytes()
    except OSError:
        return None
    return text if digest_of(text) == digest else None


class _Swap(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Modules that are imported again, from given texts."""

    def __init__(self, texts: Mapping[str, bytes]) -> None:
        """Raises `ReloadError` for modules that declare message types: objects of both classes would meet."""
        self._texts = dict(texts)
        self._before = {name: sys.modules.get(name) for name in texts}
        places = [(sys.modules.get(package), last) for package, _, last in (name.rpartition(".") for name in texts)]
        self._others = [
            (package, last, other)
            for package, last in places
            if not isinstance(other := vars(package).get(last) if package else None, ModuleType | NoneType)
        ]
        """Objects of packages by the name of one of the modules, such as functions: package, name and value."""
        self.late: set[str] = set()
        """Those that importing the operator did not import: they are imported within a function, if at all."""
        for name, module in self._before.items():
            if declared := [] if module is None else _message_types(module):
                raise ReloadError(
                    f"module {name!r} declares message types ({', '.join(declared)}), which other operators use: "
                    "move them to a module that stays as it is, or end the run and start it again"
                )

    def load(self, node: Node) -> type[Operator]:
        """Returns the operator's class, imported again. After an error everything is as before."""
        for name in self._texts:
            sys.modules.pop(name, None)
        sys.meta_path.insert(0, self)
        try:
            found = import_operator(node.use)
            self.late = self._texts.keys() - sys.modules.keys()
            for name in sorted(self.late):
                if self._before[name] is not None:
                    _import(name)
        except BaseException:
            self.put_back()
            raise
        finally:
            sys.meta_path.remove(self)
        self._rebind()
        return found

    def put_back(self) -> None:
        for name, module in self._before.items():
            if module is None:
                sys.modules.pop(name, None)
            else:
                sys.modules[name] = module
        self._rebind()

    def _rebind(self) -> None:
        """Sets the modules as attributes of their packages, as imports do, where nothing else has their names."""
        for name in [n for n in sys.modules if any(n == m or n.startswith(f"{m}.") for m in self._texts)]:
            package, _, last = name.rpartition(".")
            holder = sys.modules.get(package)
            if holder is not None and isinstance(vars(holder).get(last), ModuleType | NoneType):
                setattr(holder, last, sys.modules[name])
        for holder, last, other in self._others:
            setattr(holder, last, other)

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if fullname not in self._texts:
            return None
        there = PathFinder.find_spec(fullname, path)
        if there is None or there.origin is None:
            return ModuleSpec(fullname, self, origin=f"<{fullname} before a reload>")
        places = there.submodule_search_locations
        return importlib.util.spec_from_file_location(
            fullname, there.origin, loader=self, submodule_search_locations=places
        )

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__
        code = compile(self._texts[name], getattr(module, "__file__", f"<{name}>"), "exec", dont_inherit=True)
        exec(code, vars(module))
        _texts[module] = self._texts[name]


def _import(name: str) -> None:
    try:
        importlib.import_module(name)
    except (Exception, SystemExit) as error:  # a module may fail in any way when it runs
        raise ReloadError(f"cannot import {name!r}: {type(error).__name__}: {error}") from error


class _Source(NamedTuple):
    """An own module; the text of a package without a file is None."""

    text: bytes | None
    package: bool


def _source(name: str) -> _Source | None:
    """Returns an own module as it is loaded, else as its file is; None for any other."""
    if name.partition(".")[0] in (_ENGINE, *sys.builtin_module_names) or not _NAME.fullmatch(name):
        return None
    module = sys.modules.get(name)
    if module is None:
        spec = _spec_of(name)
        file, package = (None, False) if spec is None else (spec.origin, spec.submodule_search_locations is not None)
    else:
        file, package = getattr(module, "__file__", None), hasattr(module, "__path__")
    if file is None:
        return _Source(None, True) if package else None
    if not file.endswith(".py") or any(part in file for part in _INSTALLED) or file.startswith(_STANDARD):
        return None
    return _Source(_read(file) if module is None else _text(module), package)


def _spec_of(name: str) -> ModuleSpec | None:
    """Finds a module without importing the packages that it is in."""
    whole, spec, places = "", None, None
    for part in name.split("."):
        whole = f"{whole}.{part}" if whole else part
        spec = PathFinder.find_spec(whole, places)
        if spec is None:
            return None
        places = spec.submodule_search_locations or []
    return spec


def _text(module: ModuleType) -> bytes:
    if module not in _texts:
        _texts[module] = _read(module.__file__ or "") or b""
    return _texts[module]


def _file_text(name: str) -> bytes | None:
    module = sys.modules.get(name)
    if module is not None:
        return _read(module.__file__ or "")
    source = _source(name)
    return None if source is None else source.text


def _read(file: str) -> bytes | None:
    try:
        return Path(file).read_bytes()
    except OSError:  # deleted, or within an archive
        return None


def _offers(node: Node) -> str:
    """The module by which the graph names an operator: that of its class, or a package that offers it."""
    return current_path(node.use).partition(":")[0]


def _own_texts(home: str, *also: str) -> dict[str, bytes]:
    """The texts by name of the own modules from `home` on, and of others. Of a package through which a class or
    function is imported its own file alone counts."""
    found: dict[str, bytes] = {}
    ahead, followed, alone = {home}, set[str](), set(also)
    while ahead:
        name = ahead.pop()
        followed.add(name)
        source = _source(name)
        if source is not None and source.text is not None:
            used, offering = _imports(name, source)
            found[name] = source.text
            alone |= offering
            ahead |= used - followed
    sources = {name: source for name in alone - found.keys() if (source := _source(name)) is not None}
    return found | {name: source.text for name, source in sources.items() if source.text is not None}


def _imports(name: str, source: _Source) -> tuple[set[str], set[str]]:
    """The names of the modules that a module imports, and of the packages that only offered it what others define."""
    used, offering = set[str](), set[str]()
    here = name if source.package else name.rpartition(".")[0]
    values = vars(sys.modules[name]) if name in sys.modules else {}
    for start, names, whole in _statements(source.text or b""):
        used |= {each.split()[0] for each in whole.split(",") if each.strip()}
        if not start:
            continue
        try:
            origin = importlib.util.resolve_name(start, here) if start.startswith(".") else start
        except ImportError:  # a sentence in a docstring
            continue
        there = _source(origin)
        if there is None or not there.package:
            used.add(origin)
            continue
        for each in names.strip("()").split(","):
            what, *alias = each.split()[::2] or [""]
            value = values.get((alias or [what])[0])
            if isinstance(value, type | FunctionType):
                used.add(value.__module__)
                offering.add(origin)
            elif isinstance(value, ModuleType | NoneType) and _source(f"{origin}.{what}") is not None:
                used.add(f"{origin}.{what}")
            else:
                used.add(origin)
    return used, offering - used


@lru_cache(maxsize=1024)
def _statements(text: bytes) -> list[tuple[str, str, str]]:
    """The imports of a module: where from and which names, or the modules."""
    read = _FOR_TYPES.sub("", text.decode(errors="replace"))
    return [*_IMPORT.findall(read), *(("", "", name) for name in _IMPORT_BY_NAME.findall(read))]


def _with_dependents(found: Iterable[str], own: Mapping[str, bytes]) -> set[str]:
    """These modules, and those of `own` that depend on them."""
    found = set(found)
    sources = {name: source for name in own if (source := _source(name)) is not None}
    used = {name: set[str]().union(*_imports(name, source)) for name, source in sources.items()}
    while more := {name for name, others in used.items() if name not in found and others & found}:
        found |= more
    return found


def _message_types(module: ModuleType) -> list[str]:
    return [
        name
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Message) and value.__module__ == module.__name__
    ]
