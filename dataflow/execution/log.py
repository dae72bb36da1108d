"""Numbers the firing records of one operator."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from dataflow.environments import imported_packages
from dataflow.execution.ports import Emitter
from dataflow.graph.code import Code, code_now
from dataflow.operator import Operator
from dataflow.records.firing import Emission, FiringRecord, Kind, Outcome
from dataflow.sync import NEVER, Drop, Firing, InputRef, input_refs

_NO_INPUTS: Mapping[str, InputRef] = {}
_NO_NAMES: frozenset[str] = frozenset()


class FiringLog:
    """The firing records of one incarnation of an operator, numbered and handed on."""

    def __init__(self, operator: str, emitter: Emitter, incarnation: int = 0) -> None:
        self.operator, self.emitter, self.incarnation, self.index = operator, emitter, incarnation, 0

    def add(self, kind: Kind, stamp: int, started: int, **fields: Any) -> None:
        """Hands on one record; `started` is wall time in ns."""
        duration = time.time_ns() - started
        self.emitter.record(
            FiringRecord(
                self.operator,
                self.incarnation,
                self.index,
                kind,
                stamp,
                wall_start=started,
                duration=duration,
                **fields,
            )
        )
        self.index += 1

    def add_firing(
        self,
        kind: Kind,
        started: int,
        firing: Firing,
        outputs: tuple[Emission | None, ...],
        outcome: Outcome,
        drops: tuple[Drop, ...],
        detail: Mapping[str, Any],
    ) -> None:
        """Hands on the record of a firing; `started` is wall time in ns."""
        record = FiringRecord(
            self.operator,
            self.incarnation,
            self.index,
            kind,
            firing.stamp,
            firing.tick,
            input_refs(firing),
            firing.stale,
            firing.late,
            outputs,
            outcome,
            drops,
            detail,
            started,
            time.time_ns() - started,
        )
        self.emitter.record(record)
        self.index += 1

    def add_step(
        self, stamp: int, started: int, outputs: tuple[Emission | None, ...], detail: Mapping[str, Any]
    ) -> None:
        """Hands on the record of a source's step; `started` is wall time in ns."""
        index = self.index
        self.index = index + 1
        self.emitter.record(
            FiringRecord(
                self.operator,
                self.incarnation,
                index,
                "fire",
                stamp,
                False,
                _NO_INPUTS,
                _NO_NAMES,
                _NO_NAMES,
                outputs,
                "ok",
                (),
                detail,
                started,
                time.time_ns() - started,
            )
        )

    def add_setup(
        self, operator: Operator, started: int, emissions: tuple[Emission | None, ...], code: Code | None = None
    ) -> None:
        """The record of `setup()`: parameters, files, code (by default that which is there) and static messages."""
        detail: dict[str, Any] = {
            "params": operator.params.model_dump(mode="json"),
            "files": dict(operator.files),
            "code": (code or code_now(type(operator))).digests,
        }
        if packages := imported_packages():
            detail["packages"] = packages
        self.add("setup", NEVER + 1, started, outputs=emissions, detail=detail)


def unlisted(dropped: Mapping[tuple[str, str], int]) -> dict[str, Any]:
    """The detail of a record for drops that were too many to be listed: [input, reason, number] each."""
    return {"unlisted_drops": [[name, reason, n] for (name, reason), n in sorted(dropped.items())]} if dropped else {}
