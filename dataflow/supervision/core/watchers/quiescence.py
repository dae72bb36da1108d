"""The proof that nothing will happen any more: no operator can fire, and nothing is on its way.

Guessing it from a timeout would be a guess, so all processes are asked. When in two rounds everybody is idle, as many
envelopes were received as sent, and nothing has moved between the rounds, nothing will. Where envelopes may be lost (a
process died, a link broke; live runs), the sums may differ for good: then what has not moved for a while is lost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dataflow.supervision.core.life import WORKS
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.watcher import Watcher

QUIET = 0.3
"""Seconds without news after which all are asked."""
ANSWER_WITHIN = 1.0
LOST_AFTER = 5.0
"""Seconds after which what was sent and not received, while nothing moved, counts as lost (live runs)."""
MAX_WINDOW_DOUBLINGS = 12


class Proof:
    """Judges rounds of answers. `lost_after` (s): see above; None: nothing is ever lost."""

    def __init__(self, lost_after: float | None) -> None:
        self.lost_after = lost_after
        self._totals: tuple[int, int] | None = None
        """Envelopes sent and received by all processes together."""
        self._since = 0.0

    def moved(self) -> None:
        """Something happened: what was shown so far shows nothing."""
        self._totals = None

    def judge(self, answers: Sequence[Mapping[str, Any]], now: float) -> bool:
        """Takes the answers of all processes to one question; returns whether nothing will happen any more."""
        if not all(a["idle"] for a in answers):
            self.moved()
            return False
        sent, received = sum(a["sent"] for a in answers), sum(a["received"] for a in answers)
        if (sent, received) != self._totals:
            self._totals, self._since = (sent, received), now
            return False
        return sent == received or (self.lost_after is not None and now - self._since >= self.lost_after)


class Quiescence(Watcher):
    """Asks when it is quiet. A proof with a full window doubles it; any other ends the run as stuck."""

    def __init__(self, run: RunState, *, lost_after: float | None = None) -> None:
        super().__init__(run)
        self.latest: dict[str, Mapping[str, Any]] = {}
        """The last answer of each process since anything moved."""
        self._answers: dict[str, Mapping[str, Any]] = {}
        self.asked = False
        """True while a question is out."""
        self._proof = Proof(lost_after)
        self._round = 0
        self._asked_at = 0.0
        self._heard = 0.0
        self._doublings = 0

    def released(self) -> None:
        self._moved()

    def away(self, process: Supervised) -> None:
        self._moved()

    def back(self, process: Supervised) -> None:
        self._moved()

    def _moved(self) -> None:
        self._heard = self.run.steady
        self.asked = False
        self.latest.clear()
        self._proof.moved()

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        if kind in ("progress", "ended"):
            self._moved()
        elif kind == "state" and self.asked and fields["round"] == self._round:
            self._answers[process.label] = self.latest[process.label] = fields

    def tick(self) -> None:
        run = self.run
        if run.steady - self._heard <= QUIET:
            return
        if not all(p.life in WORKS for p in run.processes.values()):
            self._moved()  # one that is away, or on its way back, moves
            return
        if not self.asked:
            self._ask()
        elif all(p.label in self._answers for p in run.working()):
            if self._proof.judge(list(self._answers.values()), run.steady):
                self._proven()
            else:
                self._ask()

    def unanswered(self) -> list[Supervised]:
        """Returns the processes that have owed an answer for longer than one needs."""
        if not self.asked or self.run.steady - self._asked_at < ANSWER_WITHIN:
            return []
        return [p for p in self.run.working() if p.label not in self._answers]

    def _ask(self) -> None:
        self._round += 1
        self._asked_at = self.run.steady
        self.asked = True
        self._answers.clear()
        self.run.send_all("poll", replaces=True, round=self._round)

    def _proven(self) -> None:
        run = self.run
        full = [label for label, answer in self._answers.items() if answer["full"]]
        if not full or self._doublings >= MAX_WINDOW_DOUBLINGS:
            raise RunFailed("the graph is stuck: nothing is on its way and no operator can fire", self._who_waits())
        self._doublings += 1
        run.note(
            "the graph looks further ahead than the window: doubled to "
            f"{run.plan.window[0] << self._doublings} messages"
        )
        for label in full:
            run.send(run.processes[label], "grow")
        self._moved()

    def _who_waits(self) -> str:
        waiting = {node: held for answer in self._answers.values() for node, held in answer["waiting"].items()}
        return "\n".join(
            f"  {node} waits at stamp {stamp} for " + (", ".join(f"{i} (≥ {f})" for i, f in needs.items()) or "input")
            for node, (stamp, needs) in waiting.items()
        )
