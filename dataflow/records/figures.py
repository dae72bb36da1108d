"""The figures that an operator sums up at its end, as people read them and as a recording holds them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from dataflow.recording import Recording
from dataflow.records.reading import recorded_firings

_UNITS = {"m": "m", "s": "s", "ms": "ms", "deg": "°", "rad": "rad", "hz": "Hz", "percent": "%"}


def figure(name: str, value: Any) -> tuple[str, str, str]:
    """(name, value, unit) for people: ("ate_rmse_m", 0.0213) → ("ate rmse", "0.0213", "m")."""
    stem, _, unit = name.rpartition("_")
    if isinstance(value, (int, float)) and not isinstance(value, bool) and stem and unit in _UNITS:
        name = stem
    else:
        unit = ""
    text = f"{value:.4g}" if isinstance(value, float) else f"{value:,}" if type(value) is int else str(value)
    return name.replace("_", " "), text, _UNITS.get(unit, "")


def words_of(name: str) -> set[str]:
    """Returns the words of a figure's name, without those of its operator ("operator: name").

    "trajectory_score: ate_rmse_m" → {"ate", "rmse", "m"}.
    """
    return set(re.findall("[a-z]+[0-9]*", name.partition(": ")[2] or name))


def figures(summary: Mapping[str, Any]) -> dict[str, str]:
    """Returns the values of a summary by their names, both for people, in its order.

    Figures whose names differ in their unit alone, such as a translation and a rotation, have one line:
    {"rpe_1s_rmse_m": 0.0213, "rpe_1s_rmse_deg": 0.5} → {"rpe 1s rmse": "0.0213 m, 0.5 °"}.
    """
    found: dict[str, list[str]] = {}
    for name, value in summary.items():
        label, text, unit = figure(name, value)
        found.setdefault(label, []).append(f"{text} {unit}".rstrip())
    return {label: ", ".join(values) for label, values in found.items()}


def recorded_summaries(recording: Recording, operators: Iterable[str]) -> dict[str, Mapping[str, Any]]:
    """Returns what each of some operators summed up when it last ended; nothing for those that did not get so far."""
    found: dict[str, Mapping[str, Any]] = {}
    for operator in operators:
        for record in recorded_firings(recording, operator):
            if record.kind == "finish" and "summary" in record.detail:
                found[operator] = record.detail["summary"]
    return found
