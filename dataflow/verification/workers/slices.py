"""Divides the recorded calls of operators without state among workers, and puts together what these have found.

Such an operator repeats any run of its calls as well alone, so a heavy one need not be the work of one worker. Slices
serve only to show that all is as recorded: an operator of which one shows anything else is verified as a whole.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import reduce
from itertools import accumulate, pairwise
from typing import Any

from dataflow.graph.model import Graph
from dataflow.records.comparison import Verification
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.supervision.core.report import OperatorCounts
from dataflow.verification.record_totals import GraphRecordTotals, NodeRecordTotals

LEAST_NS = 300_000_000
"""Work (ns) that is worth a separate slice."""

Share = tuple[int, int]
"""Part and work (ns)."""


@dataclass(frozen=True, slots=True)
class Slice:
    """The calls of an operator from the stamp `begin` on, up to the first at or after `end`; None is without bound."""

    begin: int | None
    end: int | None


def divisible(graph: Graph, books: GraphRecordTotals, work: Mapping[str, int]) -> list[str]:
    """Chooses those of the operators in `work` whose calls may be divided, heaviest first.

    They are without state, worth dividing, and nothing has happened to them but calls.
    """
    found = [name for name, ns in work.items() if ns >= 2 * LEAST_NS and graph.nodes[name].operator.stateless]
    return sorted((name for name in found if books.of(name).only_calls), key=lambda name: (-work[name], name))


def shares(loads: Sequence[int], makers: Mapping[str, int], work: Mapping[str, int]) -> Mapping[str, list[Share]]:
    """Pours the `work` of divisible operators into parts that have `loads` already, so that they come out even.

    `makers` is the work that comes with each slice of an operator: what makes its inputs. A part has one slice of an
    operator at most.
    """
    filled = list(loads)
    level = (sum(loads) + sum(work.values()) + sum(makers[name] for name in work)) // len(loads)
    poured: dict[str, list[Share]] = {}
    for name, ns in work.items():
        left, given = ns, dict[int, int]()
        while left:
            part = filled.index(min(filled))
            besides = 0 if part in given else makers[name]
            taken = min(left, max(LEAST_NS, level - filled[part] - besides))
            if left - taken < LEAST_NS:
                taken = left
            given[part] = given.get(part, 0) + taken
            filled[part] += taken + besides
            left -= taken
        poured[name] = list(given.items())
    return poured


def cut(records: Iterable[FiringRecord], amounts: Sequence[int], per_call: int) -> list[Slice]:
    """Cuts an operator's records, in the order of its calls, into slices of about these amounts of its work (ns), in
    this order; fewer where one would be without a call."""
    calls = (record for record in records if record.kind in CALLS)
    due = list(accumulate(amounts[:-1]))
    bounds: list[int] = []
    done, latest = 0, None
    for before, record in pairwise(calls):
        if len(bounds) == len(due):
            break
        done += before.duration + per_call
        latest = before.stamp if latest is None else max(latest, before.stamp)
        if done >= due[len(bounds)] and record.stamp > latest:
            bounds.append(record.stamp)
    return [Slice(begin, end) for begin, end in pairwise([None, *bounds, None])]


def together(found: Sequence[Mapping[str, Any]], book: NodeRecordTotals) -> Mapping[str, Any] | None:
    """Makes the verification (as on the wire) of an operator of those of its slices; None where they do not show that
    every call was repeated as recorded."""
    verifications = [Verification.from_wire(values) for values in found]
    verified = sum(v.verified for v in verifications)
    if any(v.verdict != "identical" or v.firings != v.verified for v in verifications) or verified != book.calls:
        return None
    effects: dict[str, Counter[str]] = {}
    for name, counts in (pair for v in verifications for pair in v.effects.items()):
        effects.setdefault(name, Counter()).update(counts)
    more = {"outputs": book.outputs, "began": "start", "effects": {name: dict(c) for name, c in effects.items()}}
    return {**found[0], "firings": verified, "verified": verified, **more}


def answer(books: GraphRecordTotals, answers: Sequence[Mapping[str, Any]]) -> tuple[dict[str, Any], set[str]]:
    """Puts together what `answers` say of divided operators, as one answer more; names those to verify as a whole."""
    told: dict[str, Any] = {name: {} for name in ("operators", "work", "digests", "comparisons")}
    told |= {"stored": [], "reading": 0, "wall": 0.0}
    left = set[str]()
    for name in {name for each in answers for name in each["slices"]}:
        book = books.of(name)
        of = [each["slices"][name] for each in answers if name in each["slices"]]
        verification = together([each["operator"] for each in of], book)
        if verification is None:
            left.add(name)
            continue
        told["operators"][name] = verification
        counts = (OperatorCounts(*each["work"]) for each in of)
        told["work"][name] = astuple(reduce(lambda base, one: one.after(base), counts))
        told["digests"] |= {stream: [digest.count, digest.hexdigest()] for stream, digest in book.digests.items()}
    return told, left
