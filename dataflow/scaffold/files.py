"""Lists the files of a beginning, by path."""

from __future__ import annotations

import keyword
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from dataflow.scaffold import templates

Kind = Literal["operator", "timer", "source", "program"]
KINDS: tuple[Kind, ...] = ("operator", "timer", "source", "program")
_HEADER = Path(__file__).parents[1] / "program" / "dataflow.hpp"
_OPERATORS = {
    "operator": (templates.OPERATOR, templates.OPERATOR_TEST),
    "timer": (templates.TIMER, templates.TIMER_TEST),
    "source": (templates.SOURCE, templates.SOURCE_TEST),
    "program": (templates.PROGRAM, templates.PROGRAM_TEST),
}


class InvalidName(ValueError):
    """A module, a class or a graph cannot have this name; the message has the reason."""


def snake(name: str) -> str:
    """`NearestObstacle`, `nearest-obstacle` → `nearest_obstacle`. Raises `InvalidName`."""
    parts = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name)
    found = re.sub(r"[-\s.]+", "_", parts).lower()
    if not found.isidentifier() or not found.isascii():
        raise InvalidName(f"{name!r} cannot be a name in Python: write letters, digits and '_', a letter first")
    if keyword.iskeyword(found) or found in sys.stdlib_module_names or found in ("dataflow", "operators", "tests"):
        raise InvalidName(f"{name!r} is taken: Python has {found!r} already; choose another name")
    return found


def camel(name: str) -> str:
    """`nearest_obstacle` → `NearestObstacle`."""
    return "".join(part[:1].upper() + part[1:] for part in snake(name).split("_") if part)


def operator_files(name: str, kind: Kind = "operator", package: str = "") -> Mapping[Path, str]:
    """An operator's module and its test, with the source of a program. `package`: the package that the module is put
    into."""
    module = snake(name)
    code, test = _OPERATORS[kind]
    words = {
        "Class": camel(name),
        "Title": camel(name),
        "module": f"{package}.{module}" if package else module,
        "stem": module,
    }
    files = {Path(f"{module}.py"): code.substitute(words), Path(f"test_{module}.py"): test.substitute(words)}
    if kind == "program":
        files[Path(f"{module}.cpp")] = templates.PROGRAM_SOURCE.substitute(words)
        files[Path("dataflow.hpp")] = _HEADER.read_text(encoding="utf-8")
    return files


def graph_files(name: str) -> Mapping[Path, str]:
    """A graph file."""
    stem = snake(name)
    words = {"Title": stem.replace("_", " "), "name": stem, "file": f"{stem}.yaml"}
    about = "a camera and the clouds of what it sees."
    text = templates.GRAPH.substitute(words, about=about, more=templates.GRAPH_CLOUD)
    return {Path(f"{stem}.yaml"): _trimmed(text)}


def project_files(name: str) -> Mapping[Path, str]:
    """A project: a package with an operator, a graph, tests, and what installs them."""
    package = snake(name)
    words = {
        "name": name,
        "package": package,
        "distribution": package.replace("_", "-"),
        "module": f"{package}.brightness",
        "Class": "Brightness",
        "Title": package.replace("_", " "),
        "node": "brightness",
    }
    operator = operator_files("brightness", package=package)
    node = templates.GRAPH_OPERATOR.substitute(words)
    about = "how bright the camera's images are."
    graph = templates.GRAPH.substitute(words | {"name": package}, file=f"graphs/{package}.yaml", about=about, more=node)
    return {
        Path("README.md"): templates.README.substitute(words),
        Path("pyproject.toml"): templates.PROJECT.substitute(words),
        Path(".gitignore"): templates.GITIGNORE,
        Path(package, "__init__.py"): templates.PACKAGE.substitute(words),
        Path(package, "brightness.py"): operator[Path("brightness.py")],
        Path("graphs", f"{package}.yaml"): _trimmed(graph),
        Path("tests", "test_brightness.py"): operator[Path("test_brightness.py")],
        Path("tests", "test_graphs.py"): templates.GRAPH_TEST.substitute(words),
    }


def service_files(
    name: str, command: Sequence[str], *, folder: Path, out: Path, user: str, days: int
) -> Mapping[Path, str]:
    """A unit of systemd that runs `command` in `folder` as `user`, and what deletes files in `out` after `days`.

    Raises `InvalidName` for a name that systemd does not take.
    """
    words = {**_unit_words(name, command, folder, user), "out": _systemd_word(str(out)), "days": str(days)}
    install = f"sudo cp {name}.service /etc/systemd/system/ && sudo cp {name}.conf /etc/tmpfiles.d/"
    return {
        Path(f"{name}.service"): templates.SERVICE.substitute(words, install=install, what=f"graph {name}"),
        Path(f"{name}.conf"): templates.SERVICE_FILES.substitute(words),
    }


def agent_files(name: str, command: Sequence[str], *, folder: Path, user: str) -> Mapping[Path, str]:
    """A unit of systemd by which machine `name` joins runs with `command`. Raises `InvalidName` as `service_files`."""
    unit = f"dataflow-{name}"
    words = _unit_words(unit, command, folder, user)
    install = f"sudo cp {unit}.service /etc/systemd/system/"
    return {Path(f"{unit}.service"): templates.SERVICE.substitute(words, install=install, what=f"machine {name}")}


def _unit_words(name: str, command: Sequence[str], folder: Path, user: str) -> dict[str, str]:
    if not re.fullmatch(r"[A-Za-z0-9_.-]+", name):
        raise InvalidName(f"{name!r} cannot be the name of a service: write letters, digits, '_', '-' and '.'")
    return {
        "name": name,
        "user": user,
        "folder": str(folder).replace("%", "%%"),
        "command": " ".join(map(_systemd_word, command)),
    }


def _systemd_word(word: str) -> str:
    """A word as a unit of systemd has it: '%' and '$' doubled, quoted where it has spaces or quotes."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"' if re.search(r"""[\s"']""", word) else escaped


def _trimmed(text: str) -> str:
    return text.rstrip("\n") + "\n"
