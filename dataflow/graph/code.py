"""The code of an operator: the modules that it is made of, their digests, and how it is loaded again.

Its own modules are that of its class and those that this one imports, directly or through others, as far as they are
files outside of the standard library, of installed packages and of the engine.
"""

from __future__ import annotations

import hashlib
import importlib.abc
import importlib.util
import os
import re
import sys
import sysconfig
from collections.abc import Iterable, Mapping
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from dataflow.graph.model import Node, OperatorImportError, current_path, import_operator
from dataflow.messages.base import Message

if TYPE_CHECKING:
    from dataflow.operator import Operator

_ENGINE = __name__.partition(".")[0]
_INSTALLED = ("/site-packages/", "/dist-packages/")
_STANDARD = tuple(f"{sysconfig.get_path(kind)}/" for kind in ("stdlib", "platstdlib"))
_IMPORT = re.compile(r"^[ \t]*(?:from[ \t]+([.\w]+)[ \t]+import[ \t]+(\([^)]*\)|[^#\n]*)|import[ \t]+([^#\n]*))", re.M)
_texts: WeakKeyDictionary[ModuleType, bytes] = WeakKeyDictionary()
"""The source of modules as they were loaded, from the first look at them on."""
_imported: WeakKeyDictionary[ModuleType, tuple[set[str], set[str]]] = WeakKeyDictionary()


class ReloadError(ValueError):
    """The code of an operator cannot be replaced; the message has the reason."""


def code_digests(operator: type[Operator]) -> dict[str, str]:
    """Returns the SHA-256 of each of an operator's own modules, as loaded, by the module's name."""
    return {name: digest_of(_text(module)) for name, module in sorted(_own_modules(operator).items())}


def digest_of(text: bytes) -> str:
    return hashlib.sha256(text).hexdigest()


class Replaced:
    """An operator's code, loaded again from its files. `before` are the texts of the modules until then."""

    def __init__(self, node: Node) -> None:
        """Imports the modules of the operator whose files have changed, those that depend on them, and its own one.

        Raises `ReloadError` where they declare message types, `OperatorImportError` for what fails.
        """
        own = _own_modules(node.operator)
        now = {name: _read(module) for name, module in own.items()}
        self.before = {name: _text(module) for name, module in own.items()}
        changed = {name for name, text in now.items() if text != self.before[name]}
        self._swap = _Swap({name: now[name] for name in _with_dependents(changed, node, own)})
        self.operator = self._swap.load(node)

    def put_back(self) -> None:
        """Makes the code before the current one again."""
        self._swap.put_back()

    def store_before(self) -> None:
        """Stores the code before, by its digests, for re-executions of what it did. Raises `OSError`."""
        folder = store()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for text in self.before.values():
            file = folder / digest_of(text)
            if not file.exists():
                partial = file.with_suffix(f".{os.getpid()}")
                partial.write_bytes(text)
                partial.replace(file)


def stored_operator(node: Node, digests: Mapping[str, str]) -> type[Operator] | None:
    """Returns the class of an operator with the code of these digests by module, out of what reloads here have stored;
    None where it is not there. The modules that others import stay as they are."""
    own = _own_modules(node.operator)
    differing = {n for n, digest in digests.items() if n not in own or digest_of(_text(own[n])) != digest}
    if not differing:
        return node.operator
    texts = {}
    for name in differing:
        try:
            texts[name] = (store() / digests[name]).read_bytes()
        except OSError:
            return None
        if digest_of(texts[name]) != digests[name]:
            return None
    for name in _with_dependents(differing, node, own) - differing:
        texts[name] = _text(own[name])
    try:
        swap = _Swap(texts)
        found = swap.load(node)
    except (ReloadError, OperatorImportError):  # it may need what is no longer here
        return None
    swap.put_back()
    return found


def store() -> Path:
    """The folder of this user's code that reloads have replaced: `$XDG_DATA_HOME/dataflow/code`."""
    home = os.environ.get("XDG_DATA_HOME")
    return (Path(home) if home else Path.home() / ".local" / "share") / "dataflow" / "code"


class _Swap(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Modules that are imported again, from given texts."""

    def __init__(self, texts: Mapping[str, bytes]) -> None:
        """Raises `ReloadError` for modules that declare message types: objects of both classes would meet."""
        self._texts = dict(texts)
        self._before = {name: sys.modules.get(name) for name in texts}
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
        """Sets the modules as attributes of their packages, as imports do."""
        names = [n for n in sys.modules if any(n == m or n.startswith(f"{m}.") for m in self._texts)]
        for name in names:
            package, _, last = name.rpartition(".")
            if package in sys.modules:
                setattr(sys.modules[package], last, sys.modules[name])

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


def _text(module: ModuleType) -> bytes:
    if module not in _texts:
        _texts[module] = _read(module)
    return _texts[module]


def _read(module: ModuleType) -> bytes:
    try:
        return Path(module.__file__ or "").read_bytes()
    except OSError:  # deleted, or within an archive
        return b""


def _own_modules(operator: type[Operator]) -> dict[str, ModuleType]:
    """By name. Of a package through which a class or function is imported its own file alone counts."""
    found: dict[str, ModuleType] = {}
    ahead, followed = {operator.__module__}, set[str]()
    while ahead:
        name = ahead.pop()
        followed.add(name)
        if (module := _own(name)) is not None:
            used, offering = _imports(module)
            found |= {name: module} | {n: own for n in offering if (own := _own(n)) is not None}
            ahead |= used - followed
    return found


def _own(name: str) -> ModuleType | None:
    module = sys.modules.get(name)
    return module if module is not None and _is_own(name, getattr(module, "__file__", None)) else None


def _is_own(name: str, file: str | None) -> bool:
    if not file or not file.endswith(".py") or name.partition(".")[0] == _ENGINE:
        return False
    return not any(part in file for part in _INSTALLED) and not file.startswith(_STANDARD)


def _imports(module: ModuleType) -> tuple[set[str], set[str]]:
    """The names of the modules that a module imports, and of the packages that only offered it what others define."""
    if module not in _imported:
        _imported[module] = _imports_in(module)
    return _imported[module]


def _imports_in(module: ModuleType) -> tuple[set[str], set[str]]:
    used, offering = set[str](), set[str]()
    here = module.__name__ if hasattr(module, "__path__") else module.__name__.rpartition(".")[0]
    for start, names, whole in _IMPORT.findall(_text(module).decode(errors="replace")):
        used |= {each.split()[0] for each in whole.split(",") if each.strip()}
        if not start:
            continue
        try:
            source = importlib.util.resolve_name(start, here) if start.startswith(".") else start
        except ImportError:  # a sentence in a docstring
            continue
        if not hasattr(sys.modules.get(source), "__path__"):
            used.add(source)
            continue
        for each in names.strip("()").split(","):
            name, *alias = each.split()[::2] or [""]
            value = vars(module).get((alias or [name])[0])
            if f"{source}.{name}" in sys.modules and (value is None or isinstance(value, ModuleType)):
                used.add(f"{source}.{name}")
            elif isinstance(value, type | FunctionType):
                used.add(value.__module__)
                offering.add(source)
            else:
                used.add(source)
    return used, offering - used


def _with_dependents(names: Iterable[str], node: Node, own: Mapping[str, ModuleType]) -> set[str]:
    """The modules to import again: these, the operator's, the one that offers it, and what depends on them."""
    offers = current_path(node.use).partition(":")[0]
    own = {**own, offers: sys.modules[offers]}
    found = {*names, node.operator.__module__, offers}
    used = {name: set[str]().union(*_imports(module)) for name, module in own.items()}
    while more := {name for name, others in used.items() if name not in found and others & found}:
        found |= more
    return found


def _message_types(module: ModuleType) -> list[str]:
    return [
        name
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Message) and value.__module__ == module.__name__
    ]
