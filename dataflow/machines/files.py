"""The needs of another machine: the code of its operators, compared by digest, and their files, which are sent.

Code is installed, never sent: a difference is an error that names the file. Files are those that parameters name by a
relative path (weights, calibrations); they are sent into the agent's folder, in which its processes run. A file that is
named by an absolute path must lie there already, with the same content. Copies that earlier runs sent are known
(`SENT`): one of a file that the run does not have any more is not used.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from dataflow.graph.code import files_of as files_of_code
from dataflow.graph.code import is_file

MOST_SENT = 4 << 30
"""Bytes of files that are sent to a machine, at most."""
PIECE = 1 << 20
SENT = ".sent.json"
"""Lists, in the agent's folder, the digests of the files that were sent there."""
_ELF = b"\x7fELF"
_PROCESSOR = slice(18, 20)
"""Bytes of the header of a program (ELF) with the kind of processor that it is compiled for."""

Digests = dict[str, str]
"""By name of a file, the SHA-256 of its content."""


class FilesError(ValueError):
    """A machine cannot be given what it needs; the message names the file, and what would be right."""


def code_of(uses: Iterable[str], given: Iterable[str] = ()) -> Digests:
    """Returns the digests of the files of this package's code and of that of operators (`use:`), by path; those of
    compiled programs with their kind of processor in front. Imports nothing.

    `given`: texts of parameters; a file that one of these names belongs to the parameters, and is no program.
    """
    homes = sorted({"dataflow", *(use.partition(":")[0] for use in uses)})
    data = tuple(f"/{Path(text).as_posix()}" for text in given if text and not text.endswith(".py"))
    found = {name: path for home in homes for name, path in files_of_code(home).items()}
    code = {name: path for name, path in found.items() if not path.as_posix().endswith(data)}
    return {name: _processor(path) + digest_of(path) for name, path in code.items()}


def _processor(path: Path) -> str:
    with path.open("rb") as file:
        head = file.read(_PROCESSOR.stop)
    return f"{head[_PROCESSOR].hex()}:" if head.startswith(_ELF) and len(head) == _PROCESSOR.stop else ""


def python() -> str:
    """Returns the version of Python, of which machines must have the same."""
    return f"Python {sys.version_info.major}.{sys.version_info.minor}"


def digest_of(path: Path) -> str:
    """Returns the SHA-256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def differences(wanted: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """Returns, for each file that differs, what is wrong with it there. Programs for other processors cannot agree."""
    missing = [f"{name} is missing" for name in sorted(wanted.keys() - found.keys())]
    both = sorted(wanted.keys() & found.keys())
    return missing + [f"{name} differs" for name in both if _differ(wanted[name], found[name])]


def _differ(one: str, other: str) -> bool:
    built_for, built_there = one.partition(":"), other.partition(":")
    if built_for[1] and built_there[1] and built_for[0] != built_there[0]:
        return False
    return one != other


def files_of(parameters: Iterable[Mapping[str, Any]], folder: Path) -> Digests:
    """Returns the digests of the files that parameters name, by the path that they name them by.

    Relative paths are from `folder`. Raises `FilesError` for one that leads out of it, and for too much.
    """
    found: Digests = {}
    total = 0
    for text in sorted(set(texts_of(parameters))):
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


def texts_of(parameters: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """Yields the texts that parameters hold."""
    for each in parameters:
        yield from _texts(dict(each))


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


def note_sent(folder: Path, text: str, digest: str) -> None:
    """Notes that the file of a relative path in `folder` is a copy that was sent. Raises `OSError`."""
    part = folder / f"{SENT}.part"
    part.write_text(json.dumps(_sent(folder) | {text: digest}), encoding="utf-8")
    part.replace(folder / SENT)


def _sent(folder: Path) -> dict[str, str]:
    try:
        found = json.loads((folder / SENT).read_text(encoding="utf-8"))
    except (OSError, ValueError):  # nothing was sent, or not by a version that notes it
        return {}
    return found if isinstance(found, dict) else {}


def left_over(parameters: Iterable[Mapping[str, Any]], wanted: Mapping[str, str], folder: Path) -> list[str]:
    """Returns what is wrong with files that parameters name, of which `folder` has only the copy of an earlier run."""
    named = set(texts_of(parameters))
    copies = {text: digest for text, digest in _sent(folder).items() if text in named and text not in wanted}
    return [
        f"{text} is missing where the run is started, and here is only the copy that an earlier run was sent: "
        f"put the file back there, or delete {folder / text}"
        for text, digest in sorted(copies.items())
        if is_file(folder / text) and digest_of(folder / text) == digest  # another content is this machine's own
    ]


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
