"""Classes of a network that the label space of an operator has no entry for."""

from __future__ import annotations

from collections.abc import Sequence

from dataflow.operator import Operator
from operators.labels import LabelSpace


def warn_of_unknown(operator: Operator, labels: LabelSpace, classes: Sequence[str]) -> int:
    """Returns how many classes have no entry, after one warning that names them."""
    unknown = labels.unknown(classes)
    if unknown:
        names = ", ".join(map(repr, unknown))
        text = "the label space %s has no entry for %s: they have no roles and no usual size; `labels` names another"
        operator.log.warning(text, labels.name, names)
    return len(unknown)
