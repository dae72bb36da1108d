"""The needs of another machine: the code of its operators, compared by digest, and their files, which are sent.

Code is installed, never sent: a difference is an error that names the file. Files are those that parameters name by a
relative path (weights, calibrations); they are sent into the agent's folder, in which its processes run. A file that is
named by an absolute path must lie there already, with the same content.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from dataflow.graph.code import files_of as files_of_code
from dataflow.graph.code import is_file
from dataflow.graph.model import current_path

MOST_SENT = 4 << 30
"""Bytes of files that are sent to a machine, at most."""
PIECE = 1 << 20

Digests = dict[str, str]
"""By name of a file, the SHA-256 of its content."""


class FilesError(ValueError):
    """A machine cannot be given what it needs; the message names the file, and what would be right."""


def code_of(uses: Iterable[str]) -> Digests:
    """Returns the digests of the files of this package's code and of that of operators (`use:`), by path."""
    homes = sorted({"dataflow", *(current_path(use).partition(":")[0] for use in uses)})
    code = {name: path for home in homes for name, path in files_of_code(home).items()}
    return {name: digest_of(path) for name, path in code.items()}


def python() -> str:
    """Returns the version of Python, of which machines must have the same."""
    return f"Python {sys.version_info.major}.{sys.version_info.minor}"


def digest_of(path: Path) -> str:
    """Returns the SHA-256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def differences(wanted: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """Returns, for each file that differs, what is wrong with it there."""
    missing = [f"{name} is missing" for name in sorted(wanted.keys() - found.keys())]
    return missing + [f"{name} differs" for name in sorted(wanted.keys() & found.keys()) if wanted[name] != found[name]]


def files_of(parameters: Iterable[Mapping[str, Any]], folder: Path) -> Digests:
    """Returns the digests of the files that parameters name, by the path that they name them by.

    Relative paths are from `folder`. Raises `FilesError` for one that leads out of it, and for too much.
    """
    found: Digests = {}
    total = 0
    for text in sorted({text for params in parameters for text in _texts(dict(params))}):
        path = Path(text)
        if not is_file(folder / path):
            continue
        if not path.is_absolute():
            if ".." in path.parts:
                raise FilesError(f"file {text!r} lies outside the folder that the graph is run from; move it below it")
            total += (folder / path).stat().st_size
        found[text] = digest_of(folder / path)
    if total > MOST_SENT:
        raise FilesError(f"the files to be sent have {total / 1e9:.1f} GB, the limit is {MOST_SENT / 1e9:.1f} GB")
    return found


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for each in value.values():
            yield from _texts(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _texts(each)


def lacking(wanted: Mapping[str, str], folder: Path) -> tuple[list[str], list[str]]:
    """Returns which files `folder` lacks, or has with other content, and what is wrong with those of absolute paths.

    Raises `FilesError` for a relative path that leads out of `folder`.
    """
    sent, wrong = [], []
    for text, digest in wanted.items():
        path = inside(folder, text) if not Path(text).is_absolute() else Path(text)
        if is_file(path) and digest_of(path) == digest:
            continue
        if Path(text).is_absolute():
            wrong.append(f"{text} {'differs' if is_file(path) else 'is missing'} (only relative paths are sent)")
        else:
            sent.append(text)
    return sent, wrong


def inside(folder: Path, text: str) -> Path:
    """Returns where a relative path lies in `folder`. Raises `FilesError` where it leads out of it."""
    path = (folder / text).resolve()
    if Path(text).is_absolute() or not path.is_relative_to(folder.resolve()):
        raise FilesError(f"file {text!r} leads out of {folder}")
    return path


def pieces(path: Path) -> Iterator[tuple[int, bytes, bool]]:
    """Yields the content of a file in pieces: where each begins, its bytes, and whether it is the last one."""
    with path.open("rb") as file:
        at, piece = 0, file.read(PIECE)
        while True:
            following = file.read(PIECE)
            yield at, piece, not following
            if not following:
                return
            at, piece = at + len(piece), following
