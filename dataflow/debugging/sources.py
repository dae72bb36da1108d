"""Takes over source that was edited while an operator is being looked at."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from dataflow.operator import Operator

_ENGINE = Path(__file__).parent.parent


class Sources:
    """The source files of the package of an operator, and of modules that lie in its folder, as they are loaded."""

    def __init__(self, operator: type[Operator]) -> None:
        self._home = operator.__module__
        self._texts = {module.__name__: text for module, text in self._modules()}

    def reload(self) -> Sequence[str]:
        """Runs the changed modules again, and the operator's, in the order of their first imports; returns the names
        of the changed ones.

        Other modules that have imported functions or classes of them get the new ones. Raises what the source raises:
        then all is as it was.
        """
        now = list(self._modules())
        changed = [module.__name__ for module, text in now if self._texts.get(module.__name__) != text]
        if not changed:
            return []
        again = [(module, text) for module, text in now if module.__name__ in {*changed, self._home}]
        before = {module.__name__: dict(vars(module)) for module, _ in again}
        codes = [(module, compile(text, str(module.__file__), "exec")) for module, text in again]
        try:
            for module, code in codes:
                exec(code, vars(module))
        except BaseException:
            for name, names in before.items():
                vars(sys.modules[name]).update(names)
            raise
        _replace_imported({id(old): new for name, names in before.items() for old, new in _pairs(name, names)})
        self._texts = {module.__name__: text for module, text in now}
        return changed

    def _modules(self) -> Iterator[tuple[ModuleType, str]]:
        """The modules, in the order of their imports, with their source."""
        folder = Path(sys.modules[self._home].__file__ or "").parent
        top = self._home.partition(".")[0]
        for name, module in list(sys.modules.items()):
            path = Path(getattr(module, "__file__", None) or "")
            near = name.partition(".")[0] == top or path.parent == folder
            if near and path.suffix == ".py" and _ENGINE not in path.parents:
                yield module, path.read_text(encoding="utf-8")


def _pairs(module: str, before: Mapping[str, Any]) -> Iterator[tuple[Any, Any]]:
    """The functions and classes that a module defined, with those that it defines now by these names."""
    now = vars(sys.modules[module])
    for name, old in before.items():
        if isinstance(old, (FunctionType, type)) and old.__module__ == module and now[name] is not old:
            yield old, now[name]


def _replace_imported(new: Mapping[int, Any]) -> None:
    for module in list(sys.modules.values()):
        for name, value in list(vars(module).items()) if isinstance(module, ModuleType) else ():
            if id(value) in new:
                setattr(module, name, new[id(value)])
