"""Names of classes in an operator's parameters against those that the network tells apart."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from dataflow.operator import Operator


def unknown_classes(operator: Operator, parameters: Sequence[str], known: Sequence[str]) -> int:
    """Returns how many class names in parameters are unknown, each of which is logged with the nearest known one.

    A parameter that was left at its default counts as fitting: its names are those of several networks.
    """
    count = 0
    fields = operator.spec.parameters.model_fields
    for parameter in parameters:
        given = list(getattr(operator, parameter))
        if given == list(fields[parameter].default) or not known:
            continue
        for name in given:
            if name not in known:
                near = difflib.get_close_matches(name, known, 1)
                hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"
                operator.log.warning("%s: no class is called %r; %s", parameter, name, hint)
                count += 1
    return count
