"""Firing records of processes of a live run that have ended: for the recorder, and where others go on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from dataflow.records.black_box import OperatorProgress, RecoveredRecords
from dataflow.supervision.core.life import WORKS
from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.watcher import Watcher

HANDED_OVER = 4096
"""Records of one operator, the latest, that the recorder is given: many more than can be on their way to it."""


class LeftoverRecords(Watcher):
    """Gives the recorder what it may lack of the dead, and has the living send again what it lacks of them."""

    def __init__(self, run: RunState) -> None:
        super().__init__(run)
        self._batches: dict[str, list[bytes]] = {}
        self._reached: dict[str, OperatorProgress] = {}
        self._lacking: set[str] = set()  # operators of which records were lost, and whose process can send none

    def remained(self, process: Supervised, remains: RecoveredRecords) -> None:
        for name in process.nodes:
            self._batches[name] = list(remains.batches[name][-HANDED_OVER:])
            self._reached[name] = remains.reached[name]
        lacking = self._lacking.intersection(process.nodes)
        self._lacking -= lacking
        self.hand_over(lacking)

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        if kind == "lacks":
            self._lacks(fields["operator"])

    def _lacks(self, operator: str) -> None:
        maker = next(p for p in self.run.processes.values() if operator in p.nodes)
        if maker.life in WORKS:
            self.run.send(maker, "lacks", operator=operator)
        elif maker.reachable:
            self._lacking.add(operator)
        self.hand_over([operator])

    def forget(self, operators: Iterable[str]) -> None:
        """Begins anew for these operators."""
        for name in operators:
            self._batches.pop(name, None)
            self._reached.pop(name, None)

    def hand_over(self, operators: Iterable[str]) -> None:
        """Gives the recorder what is left of some operators' records; it leaves out what it has."""
        for name in operators:
            if batches := self._batches.get(name):
                self.run.tell_recorder("records", batches=batches)

    def resumed(self, operator: str) -> dict[str, Any]:
        """Returns what the next process of this operator begins with: fields of `ResumeState`, as plain values."""
        reached = self._reached.get(operator, OperatorProgress())
        return {
            "incarnation": reached.incarnation + 1,
            "last": reached.last,
            "changed": reached.changed,
            "places": reached.places,
        }
