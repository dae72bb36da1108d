"""Figures that operators sum up at their end, such as the scores of metrics, as a panel of tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import rerun as rr

from dataflow.graph.model import Graph
from dataflow.operator import FINDING
from dataflow.records.figures import figures

SCORES = "/viewer/scores"
"""Entity of the scores."""

Summaries = Mapping[str, Mapping[str, Any]]
"""Operator → name of a figure → value."""


def scores_of(summaries: Summaries, graph: Graph | None) -> Summaries:
    """Returns those of operators without outputs, which only judge, after what any operator found wrong with its input.

    Other figures of operators with outputs are in the report of the run.
    """
    nodes = graph.nodes if graph is not None else {}
    wrong = {name: {FINDING: found[FINDING]} for name, found in summaries.items() if FINDING in found}
    judged = {name: found for name, found in summaries.items() if found and not (name in nodes and nodes[name].outputs)}
    return {**wrong, **judged}


def document(summaries: Summaries) -> rr.TextDocument:
    """One table for each operator; a figure's value with its unit."""
    parts = []
    for operator, found in summaries.items():
        rows = [f"| **{operator.replace('_', ' ')}** | of the whole run |", "|---|---|"]
        rows += (f"| {label} | {text} |".replace("\n", " ") for label, text in figures(found).items())
        parts.append("\n".join(rows))
    return rr.TextDocument("\n\n".join(parts), media_type=rr.MediaType.MARKDOWN)
