"""Code of operators that is replaced while they run, on a simulated machine: revisions of a class stand for files.

All processes of a simulated machine share the interpreter and its modules, so importing them again is not simulated;
what the engine does with the code that it is given is: states, incarnations, records, and re-execution by revision.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from dataflow.graph.code import Code, digest_of
from dataflow.graph.model import Node, import_operator
from dataflow.operator import Operator
from dataflow.recording import Recording
from dataflow.records.cuts import code_in
from dataflow.records.reading import FiringLog
from simulation.bindings import Bindings, bound, load
from simulation.operators import Revised


class Files:
    """The source of the operators as it lies on the disk, and what reloads have stored of it.

    `last`: the revision that each operator ran last, by name: so its file is left.
    """

    revision = 0
    stored: frozenset[str] = frozenset()
    last: Mapping[str, int] = {}

    @classmethod
    def change(cls) -> None:
        """Writes the next revision; the store has the one before."""
        cls.stored |= {digest_of(_text(cls.revision))}
        cls.revision += 1


def _text(revision: int) -> bytes:
    return f"revision {revision}".encode()


@functools.cache
def revised(operator: Any, revision: int) -> Any:
    """An operator's class in a revision."""
    if not issubclass(operator, Revised) or revision == operator.revision:
        return operator
    fields = {"revision": revision, "__module__": operator.__module__, "__qualname__": operator.__qualname__}
    return type(operator.__name__, (operator,), fields)


def code_now(operator: type[Any], also: Iterable[str] = ()) -> Code:
    return Code(operator, {operator.__module__: _text(getattr(operator, "revision", 0))})


def imported(use: str) -> Any:
    """Stands for `import_operator`: a process that begins has the code of the files."""
    operator: Any = import_operator(use)
    return revised(operator, Files.revision)


class ReloadedCode:
    """Stands for `dataflow.graph.code.ReloadedCode`."""

    def __init__(self, node: Node, before: Code) -> None:
        operator: Any = node.operator
        self.before, self.now = before, code_now(revised(operator, Files.revision))

    def put_back(self) -> None:
        """Nothing was put elsewhere."""

    def store_before(self) -> None:
        Files.stored |= set(self.before.digests.values())


def with_code(node: Node, digests: Mapping[str, str] | None) -> tuple[Operator, bool]:
    """Stands for what takes an operator's code from the store or, without digests, from the files."""
    stored = {digest_of(_text(k)): k for k in range(Files.revision) if digest_of(_text(k)) in Files.stored}
    found = None if digests is None else stored.get(digests.get(node.operator.__module__, ""))
    operator: Any = node.operator
    made = revised(operator, Files.last.get(node.name, 0) if found is None else found)
    return made(**node.params), found is not None


def leave_files(path: Path) -> None:
    """Leaves the files as the operators of a recording ran last."""
    revisions = {digest_of(_text(k)): k for k in range(Files.revision + 1)}
    last: dict[str, int] = {}
    with Recording(path) as recording:
        log = FiringLog.read(recording)
        for name in log.operators:
            for record in sorted(log.of(name), key=lambda r: r.incarnation):
                for digest in (code_in(record) or {}).values():
                    last[name] = revisions.get(digest, 0)
    Files.last = last


def bindings() -> Bindings:
    return {
        ("dataflow.execution.live", "ReloadedCode"): ReloadedCode,
        ("dataflow.execution.live", "code_now"): code_now,
        ("dataflow.execution.log", "code_now"): code_now,
        ("dataflow.execution.source", "code_now"): code_now,
        ("dataflow.execution.recorded", "code_now"): code_now,
        ("dataflow.execution.recorded", "_with_code"): with_code,
    }


@contextlib.contextmanager
def fresh_files() -> Iterator[None]:
    """No code has been replaced yet."""
    load()
    Files.revision, Files.stored, Files.last = 0, frozenset(), {}
    with bound(bindings()):
        yield
