"""Finds the virtual environment that `env:` names, and gives the variables of processes in it.

Its packages come first; this installation's, the engine among them, serve what it lacks. So both have the same minor
version of Python.
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

from dataflow.environments import lock

if TYPE_CHECKING:
    from importlib.metadata import Distribution

_MARK = "DATAFLOW_ENV"
"""Variable of processes in an environment: its folder and the folders of its packages."""
_PROBE = (
    "import importlib.util, json, os, sys; std = os.path.dirname(os.__file__); "
    "own = [p for p in sys.path if not p.endswith('.zip') and p not in (std, std + '/lib-dynload')]; "
    "engine = importlib.util.find_spec('dataflow'); "
    "print(json.dumps([sys.version_info[:2], own, engine and engine.origin]))"
)
_PROBE_WITHIN = 20.0
_LIBRARIES = {sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib")}
_STANDARD = {
    *_LIBRARIES,
    *(os.path.join(path, "lib-dynload") for path in _LIBRARIES),
    *(path for path in sys.path if os.path.basename(path) == f"python{sys.version_info[0]}{sys.version_info[1]}.zip"),
}
"""The folders of the standard library of this installation."""
_ENGINE = str(Path(__file__).resolve().parent.parent / "__init__.py")


class EnvError(ValueError):
    """An environment cannot serve; the message names it, and what would be right."""


@dataclass(frozen=True, slots=True)
class Environment:
    """An environment: its folder, its interpreter, and the folders of its packages in the order of its `sys.path`."""

    folder: Path
    python: str
    path: tuple[str, ...]

    def variables(self, common: Mapping[str, str]) -> dict[str, str]:
        """Returns the variables of a process in it; `common` are those of one in this installation, whose standard
        library stays out: the environment may be of another build of Python."""
        here = [path for path in common["PYTHONPATH"].split(os.pathsep) if path not in _STANDARD]
        return {
            **common,
            "PYTHONPATH": os.pathsep.join((*self.path, *here, *_editable())),
            _MARK: os.pathsep.join((str(self.folder), *self.path)),
        }


def environment_of(env: str) -> Environment:
    """Returns the environment that `env:` names: by its folder, or by the file of requirements that it is built from.

    A relative path is from the current folder. Raises `EnvError`.
    """
    folder = _folder(env)
    if lock.is_requirements(env) and (fault := lock.fault(Path(env))):
        raise EnvError(f"env {env!r}: {fault}: `dataflow env GRAPH` builds it")
    python = folder / "bin/python"
    if not python.exists():
        raise EnvError(
            f"env {env!r} is no environment: {python} is missing; `{sys.executable} -m venv {env}` makes one"
        )
    try:
        python_version, path, engine = _probed(str(python), _state(folder))
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        why = (getattr(error, "stderr", "") or str(error)).strip().rpartition("\n")[2]
        raise EnvError(f"env {env!r}: its Python cannot be run: {why}") from error
    if tuple(python_version) != sys.version_info[:2]:
        raise EnvError(
            f"env {env!r} has Python {python_version[0]}.{python_version[1]}, and this one is "
            f"{sys.version_info[0]}.{sys.version_info[1]}: make it with `{sys.executable} -m venv {env}`"
        )
    if engine is not None and os.path.realpath(engine) != _ENGINE:
        raise EnvError(
            f"env {env!r} has another dataflow, {engine}: uninstall it there (`{python} -m pip uninstall "
            "robot-dataflow`); operators run with this one"
        )
    return Environment(folder, str(python), tuple(path))


@functools.lru_cache(maxsize=64)
def _probed(python: str, state: tuple[tuple[int, int, int], ...]) -> tuple[Any, Any, Any]:
    """Returns version, import path and engine of an interpreter: asked once while the `state` lasts."""
    probe = [python, "-I", "-c", _PROBE]
    answer = subprocess.run(probe, capture_output=True, text=True, timeout=_PROBE_WITHIN, check=True).stdout
    version, path, engine = json.loads(answer)
    return version, path, engine


def _state(folder: Path) -> tuple[tuple[int, int, int], ...]:
    """Returns what changes when the interpreter of an environment, its settings or its packages do."""
    places = (folder / "bin/python", folder / "pyvenv.cfg", *sorted(folder.glob("lib/python*/site-packages")))
    found = [place.stat() for place in places if place.exists()]
    return tuple((state.st_ino, state.st_size, state.st_mtime_ns) for state in found)


def require_environment(operator: str, env: str | None) -> None:
    """Raises `EnvError` where this process is not in the environment that an operator needs."""
    if env is not None and not is_environment(env):
        here = os.environ.get(_MARK, "").partition(os.pathsep)[0]
        raise EnvError(
            f"operator {operator!r} needs the environment {env!r}, and this process is in "
            f"{here or 'that of dataflow itself'}: `dataflow run`, `replay`, `verify`, `debug`, "
            "`capture` and `blame` start processes in it"
        )


def packages_in(environment: Environment) -> dict[str, str]:
    """Returns the versions of all packages in an environment, by name."""
    from importlib.metadata import distributions

    found = [(each.metadata["Name"], each.version) for each in distributions(path=list(environment.path))]
    return dict(sorted(found, reverse=True))


def is_environment(env: str) -> bool:
    """Returns whether this process is in the environment that `env:` names."""
    return str(_folder(env)) == os.environ.get(_MARK, "").partition(os.pathsep)[0]


def in_same(variables: Mapping[str, str]) -> bool:
    """Returns whether a process with these variables is in the environment that this one is in."""
    return variables.get(_MARK) == os.environ.get(_MARK)


def imported_packages() -> dict[str, str]:
    """Returns the versions of the environment's packages of which this process has imported something, by name; none
    in a process that is in no environment."""
    from importlib.metadata import distributions

    _, *path = os.environ.get(_MARK, "").split(os.pathsep)
    if not path:
        return {}
    loaded = {name.partition(".")[0] for name in sys.modules}
    found: dict[str, str] = {}
    for each in distributions(path=path):
        if each.metadata["Name"] not in found and loaded & _modules(each):
            found[each.metadata["Name"]] = each.version
    return dict(sorted(found.items()))


def installed(package: str) -> str:
    """Returns the version of a package that this process imports; "–" where it is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return "–"


def _modules(distribution: Distribution) -> set[str]:
    """Returns the top-level names that a package installs."""
    listed = (distribution.read_text("top_level.txt") or "").split()
    return set(listed) or {PurePath(file).parts[0].partition(".")[0] for file in distribution.files or ()}


def _editable() -> list[str]:
    """Returns the folders of packages that this installation finds by import hooks: those installed with `pip -e`."""
    maps = [getattr(each, "MAPPING", {}) for name, each in sys.modules.items() if name.startswith("__editable__")]
    return sorted({os.path.dirname(path) for mapping in maps for path in mapping.values()})


def _folder(env: str) -> Path:
    return Path(os.path.abspath(lock.folder_of(Path(env)) if lock.is_requirements(env) else env))
