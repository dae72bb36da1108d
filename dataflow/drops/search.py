"""Finds a smallest set of losses that cost a figure."""

from __future__ import annotations

import ast
import functools
import math
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from types import SimpleNamespace
from typing import Any

from dataflow.debugging.reduce import needed, none_to_spare, shortest_end, smallest, thinned
from dataflow.drops.branch import Branch, Figures
from dataflow.drops.losses import Loss, Sent, bursts_of, losses_of, sent_by
from dataflow.drops.player import Player
from dataflow.execution.failure import OperatorFailure
from dataflow.execution.threads import limited_threads
from dataflow.graph.model import Graph
from dataflow.graph.reach import upstream
from dataflow.recording import Recording
from dataflow.records.figures import recorded_summaries
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.reexecution.engine import Feeding, plan_feeding
from dataflow.reexecution.recorded_run import ReplayError, graph_that_is_here, seeding_of
from dataflow.sync import FOREVER, NEVER

SECONDS = 60.0
GROWS = 4
"""Times as many bursts are tried next, where some do not suffice."""
FUNCTIONS: Mapping[str, Callable[..., Any]] = {f.__name__: f for f in (abs, min, max, round, sum, len, any, all)}
"""Functions that an expression may call."""


class DropsError(ReplayError):
    """Raised where it cannot be found what losses cost; the message has the reason."""


class NothingLost(DropsError):
    """Raised where no message was lost, or late."""


class FailureCondition:
    """An expression that is true of figures that are bad, such as "ate_rmse_m > 0.05" or "abs(end_error_m) > 1". It may
    call `FUNCTIONS`. Raises SyntaxError.

    Names are those of figures, without what follows where only one begins so (of several the one that goes on with
    `rmse`), or OPERATOR.FIGURE where several operators have it; other characters than letters and digits are `_`.
    """

    def __init__(self, text: str, summaries: Figures) -> None:
        self.text = text
        self._code = compile(text, "<worse>", "eval")
        called = {
            n.func.id for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)
        }
        if unknown := sorted(called - FUNCTIONS.keys()):
            raise DropsError(f"--worse {text}: no function {', '.join(unknown)}; there are: {', '.join(FUNCTIONS)}")
        self._plain = {o: {_word(n): v for n, v in found.items()} for o, found in summaries.items()}
        self._named = {name: self._meant(name) for name in self._code.co_names if name not in called}
        missing = [name for name, meant in self._named.items() if meant is None and not self._is_part(name)]
        if missing or not any(self._named.values()):
            known = ", ".join(sorted({n for found in self._plain.values() for n in found})) or "none"
            raise DropsError(f"--worse {text}: no figure {', '.join(missing)}; there are: {known}")

    @property
    def operators(self) -> list[str]:
        """The operators whose figures it sees."""
        return list(dict.fromkeys(meant[0] for meant in self._named.values() if meant is not None))

    def is_true(self, figures: Figures) -> bool:
        """Returns whether it is true of figures. Raises `DropsError` where one is missing, or no number, or where it
        is not true and one is NaN."""
        names: dict[str, Any] = {"__builtins__": FUNCTIONS}
        for name, meant in self._named.items():
            if meant is None:
                continue
            found = {_word(n): value for n, value in figures.get(meant[0], {}).items()}
            names[name] = found.get(meant[1]) if meant[1] else SimpleNamespace(**found)
        try:
            is_worse = bool(eval(self._code, names))
        except Exception as error:
            raise DropsError(
                f"--worse {self.text}: {type(error).__name__}: {error}; figures: {_said(self.values(figures))}"
            ) from error
        seen = self.values(figures)
        if not is_worse and (unknown := [n for n, v in seen.items() if isinstance(v, float) and math.isnan(v)]):
            raise DropsError(f"--worse {self.text}: {', '.join(unknown)} is NaN, so it is not known whether it is true")
        return is_worse

    def values(self, figures: Figures) -> dict[str, Any]:
        """Returns the figures that it sees, by name."""
        seen: dict[str, Any] = {}
        for operator, figure in filter(None, self._named.values()):
            here = figures.get(operator, {})
            seen |= {
                f"{operator}: {n}": v
                for n, v in here.items()
                if _word(n) == figure or (not figure and self._is_part(_word(n)))
            }
        return seen

    def _is_part(self, name: str) -> bool:
        """Returns whether a name is that of a figure behind an operator's."""
        behind = [operator for operator in self._plain if _word(operator) in self._code.co_names]
        return name in self._code.co_names and any(name in self._plain[operator] for operator in behind)

    def _meant(self, name: str) -> tuple[str, str] | None:
        """The operator and figure of a name; of the name of an operator, "" for the figure."""
        if operators := [operator for operator in self._plain if _word(operator) == name]:
            return operators[0], ""
        if self._is_part(name):
            return None
        for fits in (str.__eq__, _begins, lambda figure, name: _begins(figure, f"{name}_rmse")):
            found = [(o, n) for o, figures in self._plain.items() for n in figures if fits(n, name)]
            if len(found) == 1:
                return found[0]
        return None


@dataclass(frozen=True, slots=True)
class Cost:
    """Losses that cost the figures.

    - `named`: a smallest set: without them it is not worse, and with any one of them it is. `minimal`: False where the
      time was up before that was known of each.
    - `losses`: how many there are in the `operators` between them and the figures; `reasons`: of each kind.
    - `figures`: as recorded; `undone`: without the named ones; `best`: without any.
    - `not_sent`: steps that sources dropped before they were numbered: these are not in the file.
    """

    named: Sequence[Loss]
    minimal: bool
    losses: int
    reasons: Mapping[str, int]
    operators: Sequence[str]
    figures: Mapping[str, Any]
    undone: Mapping[str, Any]
    best: Mapping[str, Any]
    not_sent: int
    replays: int
    calls: int
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Returns it as plain values; `until` of a message that never came is null."""
        named = [asdict(loss) | {"until": None if loss.until == FOREVER else loss.until} for loss in self.named]
        return asdict(self) | {"named": named}


class Drops:
    """Looks for the losses of a recorded run that made `worse` true of its figures.

    `budget`: seconds; `watch` gets the numbers of replays and of losses that may still be left. Runs operators in this
    process, or in those of their environments. Raises `DropsError`, `ReplayError`, `OperatorFailure`, and SyntaxError
    for `worse`.
    """

    def __init__(
        self,
        recording: Recording,
        worse: str,
        graph: Graph | None = None,
        *,
        budget: float = SECONDS,
        watch: Callable[[int, int], None] = lambda replays, left: None,
    ) -> None:
        self._began = time.monotonic()
        self._recording, self._budget, self._watch = recording, budget, watch
        self.graph = graph_that_is_here(recording)[0] if graph is None else graph
        self._log = FiringLog.read(recording)
        names = [name for name in self.graph.nodes if name in self._log.operators]
        self._recorded = recorded_summaries(recording, names)
        self._records = {name: list(self._log.ordered(self.graph.nodes[name])) for name in names}
        if not any(record.kind == "finish" for records in self._records.values() for record in records):
            raise DropsError("no figures are recorded: the run was ended before its operators' finish(), which sums up")
        self.worse = FailureCondition(worse, self._recorded)
        self.replays = 0
        self._known: dict[frozenset[Loss], Figures | OperatorFailure | ReplayError] = {}
        """By what was undone, what a replay gave."""
        self._players: list[Player] = []

    def figures_without(self, undone: Sequence[Loss]) -> Figures:
        """Returns the figures of one replay with some losses undone, by operators that are made anew."""
        feeding, losses, _ = self._plan
        branch = self._branch(feeding, losses)
        try:
            with limited_threads(self.graph.threads):
                return branch.replay(frozenset(undone))
        finally:
            branch.close()

    def find(self) -> Cost:
        """Finds them."""
        if not self.worse.is_true(self._recorded):
            raise DropsError(
                f"the recorded figures are not {self.worse.text}: {_said(self.worse.values(self._recorded))}"
            )
        feeding, losses, sent = self._plan
        if not losses:
            raise NothingLost("nothing was lost, or came late, between the sources and these figures")
        branch = self._branch(feeding, losses)
        try:
            with limited_threads(self.graph.threads):
                return self._search(branch, feeding, bursts_of(losses, sent))
        finally:
            branch.close()

    @functools.cached_property
    def _plan(self) -> tuple[Feeding, list[Loss], Sent]:
        """The operators between losses and figures, with what feeds them, the losses, and the messages sent."""
        graph = self.graph
        above = {*self.worse.operators} | upstream(graph, self.worse.operators)
        sent: dict[str, Sequence[tuple[tuple[int, int], int]]] = {}
        for name, records in self._records.items():
            sent |= sent_by(list(graph.nodes[name].outputs.values()), records)
        losses: list[Loss] = []
        for name in above:
            node = graph.nodes[name]
            if node.taken and not node.external and name in self._records:
                losses += losses_of(node, self._records[name], sent, graph.static)
        losing = {loss.operator for loss in losses}
        between = [name for name in graph.nodes if name in above and losing & ({name} | upstream(graph, [name]))]
        for name in between:
            self._refuse_restarts(name)
        inside = {s for name in between for s in graph.nodes[name].outputs.values()}
        outer = plan_feeding(self._recording, graph, between, incomplete=inside)
        return outer, sorted(losses), sent

    def _refuse_restarts(self, name: str) -> None:
        """Raises `DropsError` for an operator that went on anew: with other messages it might not have failed."""
        last = NEVER
        for record in self._records.get(name, ()):
            if record.incarnation:
                what = "its clock went back" if record.kind == "reset" else "it was restarted"
                when = "before its first call" if last == NEVER else f"behind its call at stamp {last}"
                raise DropsError(
                    f"{name}: {what} {when}. What it would have done with the lost messages is not known, so losses of "
                    "such a run are not undone; dataflow debug and dataflow blame go to its calls"
                )
            last = record.stamp if record.kind in CALLS else last

    def _branch(self, feeding: Feeding, losses: Sequence[Loss]) -> Branch:
        version = seeding_of(self._recording)
        players = {
            name: Player(self.graph.nodes[name], self.graph, version, self._records.get(name, ()))
            for name in feeding.operators
        }
        self._players += players.values()
        return Branch(self._recording, self.graph, feeding, players, losses)

    def _search(self, branch: Branch, feeding: Feeding, bursts: Sequence[Sequence[Loss]]) -> Cost:
        losses = _flat(bursts)
        before = self._replay(branch, ())
        self._check(branch, before)
        best = self._replay(branch, losses)
        if self.worse.is_true(best):
            found = _said(self.worse.values(best))
            raise DropsError(f"with all {len(losses)} losses undone it is {self.worse.text} still: {found}")
        in_time = True

        def heals(part: Sequence[Loss]) -> bool:
            nonlocal in_time
            if time.monotonic() > self._began + self._budget:
                in_time = False
                return False
            self._watch(self.replays, len(part))
            try:
                return not self.worse.is_true(self._replay(branch, part))
            except (OperatorFailure, ReplayError):  # what comes then cannot be coped with, or gives no figure
                return False

        def heal(part: Sequence[Sequence[Loss]]) -> bool:
            return heals(_flat(part))

        # The longest at first; of those that suffice the last: a replay makes the calls behind its first difference.
        suffice = shortest_end(sorted(bursts, key=len), heal, GROWS)
        named = _flat(needed(sorted(suffice, key=lambda burst: burst[0]), heal))
        if in_time and len(named) > 1:
            named = _reduced(named, heals)
        undone = self._replay(branch, named)
        self.replays += 1
        if self.worse.values(self.figures_without(named)) != self.worse.values(undone):
            raise DropsError("two equal replays do not give equal figures: dataflow verify --why shows what differs")
        return Cost(
            named=named,
            minimal=in_time,
            losses=len(losses),
            reasons=dict(Counter(loss.reason for loss in losses).most_common()),
            operators=feeding.operators,
            figures=self.worse.values(before),
            undone=self.worse.values(undone),
            best=self.worse.values(best),
            not_sent=self._not_sent(),
            replays=self.replays,
            calls=sum(player.made for player in self._players),
            seconds=time.monotonic() - self._began,
        )

    def _replay(self, branch: Branch, undone: Sequence[Loss]) -> Figures:
        """Returns the figures of a replay; those of an equal one that was made before. Raises what it raised."""
        asked = frozenset(undone)
        if asked not in self._known:
            self.replays += 1
            try:
                self._known[asked] = branch.replay(asked)
            except (OperatorFailure, ReplayError) as error:
                self._known[asked] = error
        found = self._known[asked]
        if isinstance(found, Exception):
            raise found
        return found

    def _check(self, branch: Branch, figures: Figures) -> None:
        """Raises `DropsError` where a replay with all losses is not what was recorded: then one without them would show
        nothing."""
        made = {player.node.name for player in self._players}
        for name, records in branch.records.items():
            node = self.graph.nodes[name]
            if node.source or name not in made:
                continue
            there, here = _firings(self._records[name]), _firings(records)
            while len(there) > len(here) and there[-1][1]:  # beats behind the end of all streams, by the clock
                there.pop()
            if there != here:
                k = next(
                    (k for k, (a, b) in enumerate(zip(there, here, strict=False)) if a != b), min(len(there), len(here))
                )
                stamp = (there[k : k + 1] or here[k : k + 1])[0][0]
                raise DropsError(
                    f"the replay with all losses is not the recorded run: {name} has other firings from stamp {stamp} "
                    "on (other code? dataflow verify shows that)"
                )
        recorded, found = self.worse.values(self._recorded), self.worse.values(figures)
        if recorded != found:
            both = f"recorded {_said(recorded, 17)}, replayed {_said(found, 17)}"
            raise DropsError(f"the figures change by themselves: {both}")

    def _not_sent(self) -> int:
        sources = [records for name, records in self._records.items() if self.graph.nodes[name].source]
        details = [r.detail for records in sources for r in records if r.kind in ("fire", "finish")]
        return sum(n for detail in details for n in detail.values() if type(n) is int)


def _reduced(named: Sequence[Loss], heals: Callable[[Sequence[Loss]], bool]) -> list[Loss]:
    """A smallest set of some losses. Of a stop every second, fourth... message may do."""
    at_once = [list(group) for _, group in groupby(sorted(named), key=lambda loss: loss.stamp)]

    def heal(part: Sequence[Sequence[Loss]]) -> bool:
        return heals(_flat(part))

    thin = thinned(at_once, heal)
    if len(thin) == len(at_once):
        return list(smallest(needed(named, heals), heals))
    left = none_to_spare(thin, heal)
    return _flat(left) if all(len(group) == 1 for group in left) else list(none_to_spare(_flat(left), heals))


def _flat(bursts: Sequence[Sequence[Loss]]) -> list[Loss]:
    """Returns the losses of some bursts, sorted."""
    return sorted(loss for burst in bursts for loss in burst)


def _firings(records: Sequence[FiringRecord]) -> list[tuple[Any, ...]]:
    """Stamps, inputs and digests of the firings, which a replay with all losses gives alike."""
    return [
        (r.stamp, r.tick, dict(r.inputs), [e and e.digest for e in r.outputs])
        for r in records
        if r.kind in CALLS and r.kind != "finish"
    ]


def _word(name: str) -> str:
    return re.sub(r"\W", "_", name)


def _begins(figure: str, name: str) -> bool:
    return figure.startswith(f"{name}_")


def _said(values: Mapping[str, Any], digits: int = 6) -> str:
    """Figures in words."""
    told = {name: f"{value:.{digits}g}" if isinstance(value, float) else value for name, value in values.items()}
    return ", ".join(f"{name} {value}" for name, value in told.items())
