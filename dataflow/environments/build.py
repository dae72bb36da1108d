"""Builds the environment of a file of requirements, and locks the versions that were chosen."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dataflow.environments import lock
from dataflow.environments.environment import EnvError

_WITHIN = 3600.0
_SHOWN = 3
_OPTIONS = (
    *("--index-url", "--extra-index-url", "--no-index", "--find-links", "--trusted-host"),
    *("--pre", "--prefer-binary", "--only-binary", "--no-binary"),
)


def build(requirements: Path, *, anew: bool = False) -> bool:
    """Builds the environment, by its lock where that is of these requirements; returns whether there was a need to.

    `anew`: chooses versions anew. Raises `EnvError`: the environment is then as it was.
    """
    if not anew and not lock.fault(requirements):
        return False
    if not requirements.is_file():
        raise EnvError(f"there is no file {requirements}")
    options, folder = _options(requirements), lock.folder_of(requirements)
    aside = folder.with_name(f"{folder.name}.before")
    if aside.exists():  # a build was killed
        shutil.rmtree(folder, ignore_errors=True)
    elif folder.exists():
        if not (folder / "pyvenv.cfg").is_file():
            raise EnvError(f"{folder} is no environment, and one is to be built there: rename it, or {requirements}")
        folder.rename(aside)
    try:
        _fill(requirements, folder, options, anew=anew)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        if aside.exists():
            aside.rename(folder)
        raise
    shutil.rmtree(aside, ignore_errors=True)
    return True


def _fill(requirements: Path, folder: Path, options: list[str], *, anew: bool) -> None:
    """Makes the environment in a folder that is not there yet. Raises `EnvError`."""
    _run([sys.executable, "-m", "venv", "--without-pip", str(folder)], f"{folder} cannot be made")
    (folder / ".gitignore").write_text("*\n")
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin/python"), "install", "--quiet"]
    if not anew and lock.is_locked(requirements):
        locked = str(lock.lock_of(requirements))
        _run([*pip, "--no-deps", "-r", locked], f"{locked} cannot be installed")
    else:
        with tempfile.NamedTemporaryFile(suffix=".json") as report:
            _run([*pip, "--report", report.name, "-r", str(requirements)], f"{requirements} does not resolve")
            lock.write(requirements, [*options, *_pins(json.load(report))])
    lock.note_built(requirements)


def _options(requirements: Path) -> list[str]:
    """Returns the lines that say where packages are looked for. Raises `EnvError` for options that a lock cannot hold:
    other files, whose changes it would not show, and hashes, which its pins would lack."""
    found = []
    for line in map(str.strip, requirements.read_text().splitlines()):
        option = re.split(r"[\s=]", line, maxsplit=1)[0]
        if re.search(r"(^|\s)--hash\b", line) or (line.startswith("-") and option not in _OPTIONS):
            raise EnvError(f"{requirements}: {line!r} cannot be locked; options that can: {', '.join(_OPTIONS)}")
        if line.startswith("-"):
            found.append(line)
    return found


def _pins(report: Mapping[str, Any]) -> list[str]:
    found = []
    for each in report["install"]:
        name, version = each["metadata"]["name"], each["metadata"]["version"]
        found.append(f"{name} @ {each['download_info']['url']}" if each["is_direct"] else f"{name}=={version}")
    return sorted(found, key=str.lower)


def _run(command: list[str], fault: str) -> None:
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=_WITHIN)
    except subprocess.CalledProcessError as error:
        lines = [line for line in f"{error.stdout}\n{error.stderr}".splitlines() if line.strip()]
        said = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR")] or lines
        raise EnvError(f"{fault}: {'; '.join(said[-_SHOWN:]) or f'exit code {error.returncode}'}") from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise EnvError(f"{fault}: {error}") from error
