"""Builds the environment of a file of requirements, and locks the versions that were chosen."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dataflow.environments import lock
from dataflow.environments.environment import EnvError

_WITHIN = 3600.0
_SHOWN = 3
_OTHER_FILE = re.compile(
    r"DO NOT MATCH THE HASHES.*?\n\s*(?P<what>\S+)[^\n]*:\n"
    r"(?P<locked>(?:\s*(?:Expected|or) [^\n]*\n)+)\s*Got\s+(?P<got>\w+)",
    re.DOTALL,
)
"""The words of pip about a file with another hash than was asked for."""
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
    if anew or not lock.is_locked(requirements):
        lock.write(
            requirements, options, _reported([*pip, "-r", str(requirements)], f"{requirements} does not resolve")
        )
    elif lock.HERE in lock.kinds(requirements):
        _install_locked(pip, requirements, options)
    else:
        _add_hashes(pip, requirements, options)
    lock.note_built(requirements)


def _reported(command: list[str], fault: str) -> lock.Pins:
    """Installs; returns what was. Raises `EnvError`."""
    with tempfile.NamedTemporaryFile(suffix=".json") as report:
        _run([*command, "--report", report.name], fault)
        return dict(_pin(each) for each in json.load(report)["install"])


def _install_locked(pip: list[str], requirements: Path, options: list[str]) -> None:
    """Installs what is locked: files by their hashes, then folders and repositories, which have none. Raises `EnvError`
    for a file that is another one than was locked."""
    locked, pins = lock.lock_of(requirements), lock.pins(requirements)
    hashed = {pin: hashes for pin, hashes in pins.items() if hashes}
    others = dict.fromkeys(pins.keys() - hashed.keys(), ())
    for some, more in ((hashed, ["--require-hashes"]), (others, [])):
        if some:
            with _listed(options, some) as file:
                _run([*pip, "--no-deps", *more, "-r", file], f"{locked} cannot be installed")


def _add_hashes(pip: list[str], requirements: Path, options: list[str]) -> None:
    """Installs the versions that are locked on a kind of machine of which the lock has no hashes, and adds them. Raises
    `EnvError`."""
    pins = lock.pins(requirements)
    with _listed(options, dict.fromkeys(pins, ())) as file:
        found = _reported([*pip, "--no-deps", "-r", file], f"{lock.lock_of(requirements)} cannot be installed")
    kinds = lock.kinds(requirements) | {lock.HERE}
    lock.write(requirements, options, {pin: {*hashes, *found.get(pin, ())} for pin, hashes in pins.items()}, kinds)


@contextmanager
def _listed(options: list[str], pins: lock.Pins) -> Iterator[str]:
    """A file of requirements for pip."""
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write("\n".join((*options, *lock.lines(pins), "")))
        file.flush()
        yield file.name


def _options(requirements: Path) -> list[str]:
    """Returns the lines that say where packages are looked for. Raises `EnvError` for options that a lock cannot hold:
    other files, whose changes it would not show, and hashes, which it takes itself."""
    found = []
    for line in map(str.strip, requirements.read_text().splitlines()):
        option = re.split(r"[\s=]", line, maxsplit=1)[0]
        if re.search(r"(^|\s)--hash\b", line) or (line.startswith("-") and option not in _OPTIONS):
            raise EnvError(f"{requirements}: {line!r} cannot be locked; options that can: {', '.join(_OPTIONS)}")
        if line.startswith("-"):
            found.append(line)
    return found


def _pin(installed: Mapping[str, Any]) -> tuple[str, set[str]]:
    """Returns the line that installs the same, and the hash of its file; none of a folder or a repository."""
    name, origin = installed["metadata"]["name"], installed["download_info"]
    sha256 = origin.get("archive_info", {}).get("hashes", {}).get("sha256")
    hashes = set() if sha256 is None else {sha256}
    if not installed["is_direct"]:
        return f"{name}=={installed['metadata']['version']}", hashes
    vcs = origin.get("vcs_info")
    return f"{name} @ " + (f"{vcs['vcs']}+{origin['url']}@{vcs['commit_id']}" if vcs else origin["url"]), hashes


def _run(command: list[str], fault: str) -> None:
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=_WITHIN)
    except subprocess.CalledProcessError as error:
        if (other := _OTHER_FILE.search(f"{error.stdout}\n{error.stderr}")) is not None:
            raise EnvError(
                f"{fault}: {other['what']} is another file than was locked: sha256 {other['got']}, and "
                f"{' or '.join(re.findall('[0-9a-f]{64}', other['locked']))} is locked. It was replaced where it comes "
                "from, or on its way; --anew takes it"
            ) from error
        lines = [line for line in f"{error.stdout}\n{error.stderr}".splitlines() if line.strip()]
        said = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR")] or lines
        raise EnvError(f"{fault}: {'; '.join(said[-_SHOWN:]) or f'exit code {error.returncode}'}") from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise EnvError(f"{fault}: {error}") from error
