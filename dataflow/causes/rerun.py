"""One re-run of one operator: which sources are fixed or changed, in which process, and what came out of each call."""

from __future__ import annotations

import pickle
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from glob import glob
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from dataflow.causes.interventions import Interventions
from dataflow.causes.places import Places
from dataflow.causes.sources import CHANCE, COMPILED, HASHES, HEAP, INPUT, LOCALE, MODULE, THREADS, kind_of, name_of
from dataflow.causes.traps import Site, Traps
from dataflow.execution.comparator import Comparator
from dataflow.execution.failure import OperatorFailure, readable
from dataflow.execution.memory import MemoryGuard
from dataflow.graph.model import Graph
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.reexecution.engine import Recomputation, plan_feeding
from dataflow.verification.workers.board import Board

SHOWN = 3
"""Sources that are listed of one re-run."""
_PATTERN, _OTHER_PATTERN = "90", "85"
"""Of `MALLOC_PERTURB_`: glibc fills fresh memory with its complement."""
_MOMENT, _OTHER_MOMENT = "2026-01-02 03:04:05", "2027-10-11 12:13:14.567891234"
"""Of libfaketime: they differ in each digit that an operator may take of a clock, below the second too."""


@dataclass(frozen=True, slots=True)
class RerunSettings:
    """The changes of a re-run: sources that are `fixed`, and `varied`. `log`: it logs what is read; `lines`: it looks
    for the line that writes into an input."""

    fixed: frozenset[str] = frozenset()
    varied: frozenset[str] = frozenset()
    log: bool = False
    lines: bool = False

    @property
    def words(self) -> str:
        """Returns what is tried, in words."""
        if self.log or self.lines:
            return "its reads are logged" if self.log else "its lines are watched"
        if self.fixed:
            free = [source for source in CHANCE if source not in self.fixed]
            return f"free: {_listed(free)}" if free else "all sources of chance fixed"
        return f"changed: {_listed(sorted(self.varied))}" if self.varied else "once more as it is"

    def environment(self) -> dict[str, str]:
        """Returns the variables of its process, besides those of every worker."""
        found: dict[str, str] = {}
        if HEAP in self.fixed | self.varied:
            found["MALLOC_PERTURB_"] = _PATTERN if HEAP in self.fixed else _OTHER_PATTERN
        if COMPILED in self.fixed | self.varied and (library := fake_time()):
            moment = _MOMENT if COMPILED in self.fixed else _OTHER_MOMENT
            found |= {"LD_PRELOAD": library, "FAKETIME": moment, "DONT_FAKE_MONOTONIC": "1"}
        if HASHES in self.varied:
            found["PYTHONHASHSEED"] = "1"
        if LOCALE in self.varied:
            found |= {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "TZ": "XXX-5:45"}
        if THREADS in self.fixed:
            found["OMP_THREAD_LIMIT"] = "1"
        return found

    def to_wire(self) -> dict[str, Any]:
        return {"fixed": sorted(self.fixed), "varied": sorted(self.varied), "log": self.log, "lines": self.lines}

    @staticmethod
    def from_wire(values: Mapping[str, Any]) -> RerunSettings:
        return RerunSettings(frozenset(values["fixed"]), frozenset(values["varied"]), values["log"], values["lines"])


def _listed(sources: Sequence[str]) -> str:
    named = [f"{kind_of(source)} {name_of(source)}".rstrip() for source in sources[:SHOWN]]
    return ", ".join(named) + (f" and {len(sources) - SHOWN} more" if len(sources) > SHOWN else "")


@dataclass(frozen=True, slots=True)
class Rerun:
    """The outcome of a re-run: for each call what came out, as digests; `cut` where its time was up before the end.

    `sites` are the lines that read a source, with the number of calls; `threads`, how many ran besides the engine's;
    `left`: names of modules and classes that the operator changed; `given`: fixed sources that its code was given.
    """

    made: tuple[str, ...]
    cut: bool = False
    sites: tuple[tuple[str, Site, int], ...] = ()
    threads: int = 0
    left: tuple[str, ...] = ()
    given: frozenset[str] = frozenset()

    def same(self, other: Rerun) -> bool:
        """Returns whether both made the same, as far as both went."""
        if self.cut or other.cut:
            shared = min(len(self.made), len(other.made))
            return self.made[:shared] == other.made[:shared]
        return self.made == other.made

    @staticmethod
    def from_wire(values: Mapping[str, Any]) -> Rerun:
        sites = tuple((source, Site(**site), count) for source, site, count in values["sites"])
        left, given = tuple(values["left"]), frozenset(values["given"])
        return Rerun(tuple(values["made"]), values["cut"], sites, values["threads"], left, given)


def run_again(request: Mapping[str, Any], board: Board) -> dict[str, Any]:
    """Re-runs an operator in this process. Runs in a worker.

    The request: `path`, `graph` (JSON), `records` (see `FiringLog.to_wire`), `operators`, `operator` (that which is
    asked about), `modules` (of these), `incomplete`, `begin`, `most` calls, `seconds` at most, `began` (ns), `setting`.
    The answer: the fields of `Rerun`.
    """
    setting = RerunSettings.from_wire(request["setting"])
    places, passes = Places(request["modules"]), 1 + (MODULE in setting.varied)
    interventions, traps = Interventions(places, request["began"]), Traps(places)
    if setting.fixed:
        interventions.fix(setting.fixed)
    interventions.vary(setting.varied)
    lines = LineTrap(places)
    if setting.log:
        traps.set()
    graph, left = Graph.from_json(request["graph"]), dict[str, bytes]()
    for _ in range(passes):
        before = dict(_kept(places)) if MODULE in setting.varied else {}
        follower, cut = _repeat(request, graph, board, interventions, lines if setting.lines else None)
        left = {name: value for name, value in (_kept(places) if before else ()) if before.get(name, value) != value}
    traps.lift()
    sites = [(source, asdict(site), count) for (source, site), count in (traps.counts + lines.counts).items()]
    return {
        "made": follower.made[: request["most"]],
        "cut": cut,
        "sites": sites,
        "threads": traps.threads(),
        "left": sorted(left),
        "given": sorted(interventions.given),
    }


def _repeat(
    request: Mapping[str, Any], graph: Graph, board: Board, interventions: Interventions, lines: LineTrap | None
) -> tuple[Follower, bool]:
    """Re-executes the operator once; returns what came out, and whether its time was up."""
    name, deadline = request["operator"], time.monotonic() + request["seconds"]
    with Recording(request["path"], watch=board.goes_on) as recording:
        feeding = plan_feeding(recording, graph, request["operators"], incomplete=request["incomplete"])
        work = Recomputation(
            recording,
            graph,
            feeding,
            FiringLog.from_wire(request["records"], recording),
            made=lambda stream, entry: None,
            begin=request["begin"],
            guard=MemoryGuard(keeping=True),
            watcher=board,
        )
        interventions.number_objects()
        runner = work.runners[name]
        runner.comparator = follower = Follower(runner.comparator)
        if lines is not None:
            lines.set(runner.operator)
        try:
            work.run(until=lambda: len(follower.made) >= request["most"] or time.monotonic() > deadline)
        except OperatorFailure as failure:
            follower.made.append(f"{failure.when}: {failure.summary}")
        finally:
            sys.settrace(None)
    return follower, time.monotonic() > deadline


class Follower(Comparator):
    """Keeps what an operator makes in each call, whether or not it is what was recorded."""

    def __init__(self, comparator: Comparator) -> None:
        self.__dict__.update(vars(comparator))
        self.made: list[str] = []

    def outputs(self, record: FiringRecord, messages: Mapping[str, Message]) -> Iterator[tuple[str, Message, int]]:
        self.made.append(" ".join(f"{port} {message.digest().hex()}" for port, message in sorted(messages.items())))
        yield from super().outputs(record, messages)

    def error(self, record: FiringRecord, error: BaseException | None) -> None:
        if error is not None:
            self.made.append(f"error {readable(error)}")
        super().error(record, error)

    def summary(self, record: FiringRecord, got: Mapping[str, float | int | str]) -> None:
        self.made.append(f"summary {dict(got)!r}")
        super().summary(record, got)


class LineTrap:
    """Finds the line of own code in which the memory of an input changes: compares after every line."""

    def __init__(self, places: Places) -> None:
        self._places = places
        self._process: CodeType | None = None
        self._inputs: dict[int, tuple[Message, bytes]] = {}
        self._at: dict[FrameType, int] = {}
        self.counts: Counter[tuple[str, Site]] = Counter()

    def set(self, operator: Any) -> None:
        """Begins to look; messages count that `process()` of this operator is given."""
        self._process = type(operator).process.__code__
        sys.settrace(self._called)

    def _called(self, frame: FrameType, event: str, arg: Any) -> Any:
        if self._places.of(frame.f_code) != "own":
            return None
        if frame.f_code is self._process:
            self._inputs = {id(m): (m, m.compute_digest()) for m in _messages(frame.f_locals.values())}
        return self._line

    def _line(self, frame: FrameType, event: str, arg: Any) -> Any:
        """Is called before each line of a frame, and at its end."""
        before, self._at[frame] = self._at.get(frame, frame.f_lineno), frame.f_lineno
        for key, (message, digest) in list(self._inputs.items()):
            if message.compute_digest() != digest:
                del self._inputs[key]
                site = Site(frame.f_code.co_filename, before, frame.f_code.co_name, "")
                self.counts[INPUT, site] += 1
        if event == "return":
            self._at.pop(frame, None)
        return self._line


def _messages(values: Any) -> Iterator[Message]:
    for value in values:
        if isinstance(value, Message):
            yield value
        elif isinstance(value, tuple | list):
            yield from _messages(value)
        elif isinstance(value, Mapping):
            yield from _messages(value.values())


def _kept(places: Places) -> Iterator[tuple[str, bytes]]:
    """Yields what own modules and their classes hold, as far as it can be compared."""
    for module in places.modules():
        for name, value in list(vars(module).items()):
            inner = list(vars(value).items()) if isinstance(value, type) and value.__module__ == module.__name__ else ()
            for path, held in ((name, value), *((f"{name}.{key}", each) for key, each in inner)):
                if path.rpartition(".")[2].startswith("__") or callable(held):
                    continue
                try:
                    yield f"{module.__name__}.{path}", pickle.dumps(held)
                except Exception:
                    continue


@cache
def fake_time() -> str:
    """Returns the path of libfaketime, of its Python package or of the system; nothing where it is not installed."""
    spec = find_spec("libfaketime")
    inside = [] if spec is None or spec.origin is None else [str(Path(spec.origin).parent / "vendor/libfaketime/src")]
    for folder in (*inside, "/usr/lib/faketime", "/usr/lib/*/faketime", "/usr/local/lib/faketime"):
        if found := glob(f"{folder}/libfaketime.so.1"):
            return found[0]
    return ""
