"""Finds the operator class behind a `use:` path, and explains a path that leads nowhere."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import pkgutil
import sys
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType

from dataflow.extras import missing_extra
from dataflow.graph.model import current_path
from dataflow.graph.problems import did_you_mean, nearest
from dataflow.graph.search import looked_in
from dataflow.operator import Operator, Source


@dataclass(frozen=True, slots=True)
class NotFound:
    """Returns why there is no operator behind a path."""

    message: str
    hint: str = ""
    deleted: bool = False
    """True where a module or a class is not there, false where it is there and cannot be used."""


def find_operator(use: str) -> type[Operator] | NotFound:
    """The class that `use` (`"operators.cloud:CloudBuilder"`) names, also by a former path, or what is wrong."""
    module_name, colon, name = use.partition(":")
    if not (colon and name.isidentifier() and all(part.isidentifier() for part in module_name.split("."))):
        return NotFound(
            f"{use!r} names no operator", "write 'package.module:Class', or the path of a graph file (*.yaml)"
        )
    package = import_module(module_name.partition(".")[0])
    if isinstance(package, NotFound):
        return package
    use = current_path(use)
    module_name, _, name = use.partition(":")
    module = import_module(module_name)
    if isinstance(module, NotFound):
        return module
    try:
        found = getattr(module, name, None)
    except (Exception, SystemExit) as error:  # a package may import what it offers only now
        return NotFound(f"{use!r} fails to import: {type(error).__name__}: {error}", _mend(error, module_name))
    if found is None:
        message = f"module {module_name!r} has no operator {name!r}"
    elif not (isinstance(found, type) and issubclass(found, Operator)):
        what = f"the class {name}" if isinstance(found, type) else f"a {type(found).__name__}"
        message = f"{use!r} is {what}, not an Operator"
    elif not is_concrete(found):
        message = f"{use!r} is abstract: it declares no ports"
    else:
        return found
    hint = did_you_mean(name, operator_names(module), f"operators in {module_name!r}")
    return NotFound(message, hint, deleted=found is None)


def import_module(name: str) -> ModuleType | NotFound:
    """The module, imported; or which part of its path is missing, or how its code fails."""
    if name in sys.modules:
        return sys.modules[name]
    parent, _, last = name.rpartition(".")
    if parent:
        package = import_module(parent)
        if isinstance(package, NotFound):
            return package
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            return NotFound(f"module {name!r} needs {error.name!r}, which is not installed", _mend(error, name))
        if parent and not hasattr(sys.modules[parent], "__path__"):
            return NotFound(f"no module {name!r}: {parent!r} is a single module", deleted=True)
        looked = "" if parent else f"{looked_in()}; --path DIR names another folder"
        hint = "\n".join(filter(None, (_nearest_module(last, parent), looked)))
        return NotFound(f"no module {name!r}", hint, deleted=True)
    except (Exception, SystemExit) as error:  # the module's own code may fail in any way
        return NotFound(f"module {name!r} fails to import: {type(error).__name__}: {error}", _where(error, name))


def operator_names(module: ModuleType) -> list[str]:
    """Names of the usable operators that a module offers, its imports included."""
    return [name for name, value in offered(module) if is_concrete(value)]


def offered(module: ModuleType, named: str | None = None) -> Iterator[tuple[str, type[Operator]]]:
    """Yields the operators that a module offers by name, also what it imports only when it is asked.

    `named`: the only name of interest; nothing is imported for another.
    """
    for name in dir(module):
        if named not in (None, name):
            continue
        with contextlib.suppress(Exception, SystemExit):  # one that fails to import is named when its module is
            value = getattr(module, name)
            if isinstance(value, type) and issubclass(value, Operator) and not name.startswith("_"):
                yield name, value


def lost_exports(module: ModuleType) -> Iterator[tuple[str, str, str]]:
    """Yields what a module exports (`module:name`) and fails to import, why, and how to install what is missing."""
    for name in getattr(module, "__all__", ()):
        try:
            getattr(module, name)
        except (Exception, SystemExit) as error:
            yield f"{module.__name__}:{name}", f"{type(error).__name__}: {error}", missing_extra(error)


def is_concrete(cls: type[Operator]) -> bool:
    """Returns whether the class itself declares ports, so that it can be instantiated."""
    return cls not in (Operator, Source) and "spec" in vars(cls)


def _nearest_module(name: str, parent: str) -> str:
    path = sys.modules[parent].__path__ if parent else None
    found = (info.name for info in pkgutil.iter_modules(path) if not info.name.startswith("_"))
    candidates = [name for name in found if parent or name not in sys.stdlib_module_names]
    if parent:
        return did_you_mean(name, candidates, f"modules in {parent!r}").replace("mean '", f"mean '{parent}.")
    near = nearest(name, candidates)
    return "" if near is None else f"did you mean {near!r}?"


def _mend(error: BaseException, module: str) -> str:
    """Returns the extra that installs what is missing, else where the error was raised."""
    return missing_extra(error) or _where(error, module)


def _where(error: BaseException, module: str) -> str:
    """The deepest frame of the module's own code, or of the last code that failed."""
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, SyntaxError) and error.filename:
        return f"raised at {error.filename}:{error.lineno}"
    spec = importlib.util.find_spec(module) if "." not in module or module.rpartition(".")[0] in sys.modules else None
    own = [frame for frame in frames if spec is not None and frame.filename == spec.origin]
    frame = (own or [f for f in frames if "importlib" not in f.filename] or list(frames))[-1]
    return f"raised at {frame.filename}:{frame.lineno}"
