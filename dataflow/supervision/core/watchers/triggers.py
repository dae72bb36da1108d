"""Hands the wish to keep what was, which comes through processes of operators, to the flight recorder."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.watcher import Watcher


class TriggersWatcher(Watcher):
    """Every process hands on what it is asked; the first one counts."""

    def __init__(self, run: RunState) -> None:
        super().__init__(run)
        self._seen: set[str] = set()

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        if kind == "trigger" and fields["id"] not in self._seen:
            self._seen.add(fields["id"])
            self.run.trigger(fields["text"])
