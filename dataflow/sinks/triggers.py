"""Triggers of a flight recorder: conditions over messages, events and how operators fare."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dataflow.graph.sections import Trigger
from dataflow.messages import Diagnostics
from dataflow.messages.base import Message

Reason = dict[str, Any]


class Triggers:
    """The conditions of one graph. One that goes on to hold asks once, until it has ceased to."""

    def __init__(self, triggers: Sequence[Trigger]) -> None:
        self._fields: dict[str, list[Trigger]] = {}
        for trigger in triggers:
            if trigger.kind == "field":
                self._fields.setdefault(trigger.stream, []).append(trigger)
        self._drops = [trigger for trigger in triggers if trigger.kind == "drops"]
        self._raises = any(trigger.kind == "raise" for trigger in triggers)
        self._holding: set[tuple[Trigger, str]] = set()

    def message(self, stream: str, message: Message) -> Iterator[Reason]:
        """The reasons that a message gives."""
        for trigger in self._fields.get(stream, ()):
            value = getattr(message, trigger.field, None)
            if self._begins(trigger, "", value is not None and _meets(value, trigger)):
                yield {"what": f"{stream} {trigger.field} {_condition(trigger)}", "stream": stream}

    def event(self, name: str, data: Mapping[str, Any]) -> Iterator[Reason]:
        """Yields the reasons that an event gives: a request, or an operator that failed and was started again."""
        if name == "trigger":
            yield {"what": data.get("text") or "asked for"}
        elif name == "restart" and self._raises:
            reason = {"what": str(data.get("text", "an operator failed")), "operators": list(data.get("operators", ()))}
            yield reason | {key: data[key] for key in ("where", "traceback") if data.get(key)}

    def diagnostics(self, message: Diagnostics) -> Iterator[Reason]:
        """The reasons that operators give by what they drop."""
        owners = () if message.owners is None else message.owners.tolist()
        rates = {
            message.names[owner]: float(value)
            for owner, key, value in zip(owners, message.keys, message.values, strict=True)
            if key == "drop_rate_hz"
        }
        for trigger in self._drops:
            for name, rate in rates.items():
                meant = trigger.operator in ("", name)
                if meant and self._begins(trigger, name, rate > (trigger.above or 0.0)):
                    yield {"what": f"{name} drops {rate:.3g} messages a second", "operator": name}

    def outcome(self, outcome: str) -> Iterator[Reason]:
        """The reason that the end of a run gives."""
        if self._raises and outcome not in ("complete", "interrupted"):
            yield {"what": f"the run ended: {outcome}"}

    def _begins(self, trigger: Trigger, name: str, holds: bool) -> bool:
        place = trigger, name
        before = place in self._holding
        (self._holding.add if holds else self._holding.discard)(place)
        return holds and not before


def _meets(value: Any, trigger: Trigger) -> bool:
    """Returns whether a field, or any of its elements, meets a condition."""
    if trigger.equals is not None:
        return bool(np.any(np.asarray(value) == trigger.equals))
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        return False
    above = trigger.above is not None and bool(np.any(numbers > trigger.above))
    return above or (trigger.below is not None and bool(np.any(numbers < trigger.below)))


def _condition(trigger: Trigger) -> str:
    if trigger.equals is not None:
        return f"is {trigger.equals}"
    limits = {"above": trigger.above, "below": trigger.below}
    return " or ".join(f"{word} {limit:g}" for word, limit in limits.items() if limit is not None)
